# `make study` runs the main job, `make test` the tests; each does all set-up first.
PYTHON ?= python3
VENV ?= .venv
ARGS ?=

.PHONY: study test lint
study: $(VENV)/installed
	$(VENV)/bin/python studies/pea_bpea.py $(ARGS)

test: $(VENV)/installed
	$(VENV)/bin/python -m pytest $(ARGS)

lint: $(VENV)/installed
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

$(VENV)/installed: pyproject.toml setup.py rrr_oc/robot/_rigid_body.cpp rrr_oc/numerics/_along.cpp
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --editable '.[test]'
	touch $@
