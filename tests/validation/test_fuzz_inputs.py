"""What the counter of damaged inputs calls a fault, and that an input follows from its number."""

import time
import warnings
from pathlib import Path

import pytest

from rrr_oc.errors import UserError
from validation import fuzz_inputs as fuzz


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> fuzz.Inputs:
    return fuzz.Inputs(tmp_path_factory.mktemp("fuzz"))


def failing(error: Exception):
    def read() -> None:
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "found", "said"),
    [
        (lambda: None, "read", ""),
        (failing(UserError("joints[0]: found 'x'; allowed are a, b")), "refused", "allowed are a, b"),
        (failing(UserError("one line\nand another")), "fault", "more than one line"),
        (failing(UserError("KeyError: 'x'")), "fault", "insides"),
        (failing(UserError("found None")), "fault", "insides"),
        (failing(UserError("many words " * 200)), "fault", "characters"),
        (failing(KeyError("x")), "fault", "KeyError"),
        (lambda: warnings.warn("divided by zero", RuntimeWarning, stacklevel=1), "fault", "RuntimeWarning"),
        (lambda: fuzz.finite([1.0, float("nan")]), "fault", "not finite"),
    ],
)
def test_outcomes(read, found, said):
    outcome = fuzz.outcome(read)
    assert outcome[0] == found
    assert said in outcome[1]


def test_a_reader_that_does_not_end_is_a_fault(monkeypatch):
    monkeypatch.setattr(fuzz, "LONGEST", 1)
    found, said = fuzz.outcome(lambda: time.sleep(30))
    assert found == "fault"
    assert said.startswith("TimeoutError: longer than 1 s")


@pytest.mark.parametrize("kind", ["urdf", "mjcf", "task", "header", "csv", "model", "options"])
def test_an_input_follows_from_its_number(made: fuzz.Inputs, kind, monkeypatch):
    monkeypatch.chdir(made.folder)
    shown = [made.kinds[kind](fuzz.Random(3, kind, i)) for i in (0, 1, 2, 3, 0)]
    texts = [text for _, text in shown]
    assert texts[0] == texts[4]
    assert len(set(texts)) > 2
    assert [fuzz.outcome(read)[0] for read, _ in shown[:4]].count("fault") == 0


def test_what_is_right_is_read(made: fuzz.Inputs):
    for read in (
        lambda: made._robot(made.folder / "arm.xml"),
        lambda: made._set(Path(made.folder / "set" / "recordings.json")),
        *(lambda name=name, words=words: fuzz.run([name, *words]) for name, words in made._commands().items()),
    ):
        assert fuzz.outcome(read) == ("read", "")
