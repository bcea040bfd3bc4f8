# `make study` runs the main job, `make test` the tests, `make docs` builds the site; each does all set-up first.
PYTHON ?= python3
VENV ?= .venv
LOWEST ?= .venv-lowest
ARGS ?=
# A process for each core; the tests of a file stay in one of them, and files begin in the order of tests/conftest.py. Benchmarks are
# not for processes that share a machine. ARGS="-n 0" runs all in one process.
SIDE_BY_SIDE = -n logical --dist loadfile --no-loadscope-reorder -p no:benchmark
BUILT_FROM = pyproject.toml setup.py rrr_oc/robot/_rigid_body.cpp rrr_oc/numerics/_along.cpp rrr_oc/numerics/_stepping.cpp \
  rrr_oc/calibration/estimator/_evidence.cpp
# A short part of the tests that touches every dependency.
SHORT = $(addprefix tests/,numerics/test_rank.py robot/test_robot.py robot/test_rigid_body.py codesign/test_task.py \
  effects/test_effects.py recordings/test_recordings.py recordings/test_importers.py commands/test_cli.py model/test_metrics.py \
  optimal_control/test_solver.py simulation/test_rollout.py studies/test_evolution.py)

.PHONY: study test coverage test-lowest docs lint wheel
study: $(VENV)/installed
	$(VENV)/bin/python studies/pea_bpea.py $(ARGS)

test: $(VENV)/installed
	$(VENV)/bin/python -m pytest $(SIDE_BY_SIDE) $(ARGS)

# Recording which statements run takes a quarter to a third more processor time.
coverage: $(VENV)/installed
	$(VENV)/bin/python -m pytest $(SIDE_BY_SIDE) --cov=rrr_oc --cov-report=term $(ARGS)

# The lowest versions warn of each other's deprecations, which is no fault of ours: warnings stay warnings here.
test-lowest: $(LOWEST)/installed
	$(LOWEST)/bin/python -m pytest -q -W default --disable-warnings --benchmark-skip $(SHORT) $(ARGS)

docs: $(VENV)/installed
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict $(ARGS)

# The wheel of the last commit, its proof and its list of ingredients, in build/wheel.
wheel:
	PYTHON="$(PYTHON)" .ci/wheel $(SHORT)

lint: $(VENV)/installed
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

$(VENV)/installed: $(BUILT_FROM) constraints/ci.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint constraints/ci.txt --editable '.[test]'
	touch $@

$(LOWEST)/installed: $(BUILT_FROM) constraints/lowest.txt
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/pip install --quiet --constraint constraints/lowest.txt --editable '.[test]'
	touch $@
