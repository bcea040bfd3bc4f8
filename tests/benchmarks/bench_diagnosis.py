"""What does a diagnosis cost? Wall time on all cores, from files read to verdict, against duration and number of joints.

    python -m pytest tests/benchmarks/bench_diagnosis.py --benchmark-columns=median,rounds

Eight recordings at 100 Hz of the independent plant, in which one friction law is concealed. Eight recordings of 30 s are to take
no more than a minute on two cores with three joints, five with seven.
"""

import pytest

from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.recordings.reader import load_recordings
from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case

SETS = [("rrr", 7.5), ("rrr", 15.0), ("rrr", 30.0), ("rrr", 60.0), ("arm1", 30.0), ("arm5", 30.0), ("arm7", 30.0)]


@pytest.mark.parametrize(("robot", "seconds"), SETS, ids=[f"{robot}-{seconds:g}s" for robot, seconds in SETS])
def test_diagnosis(benchmark, tmp_path, robot, seconds):
    case = Case(f"benchmark/{robot}/{seconds}", "benchmark", 0, robot, (Concealed("stribeck", 2.0),))
    write_case(build(case, seconds), tmp_path)
    recordings = load_recordings(tmp_path / case.id / "data")
    found = benchmark.pedantic(diagnose, (recordings,), rounds=1)
    assert found.verdict == "missing_physics"
    assert found.findings[0].term.effect.name == "stribeck"
