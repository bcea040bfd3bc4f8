"""What calibration of large sets costs: `rrr-oc calibrate` on eight recordings of a three-joint arm, from start to end.

    python -m pytest tests/benchmarks/bench_recordings.py --benchmark-columns=median

A set as large as that of the paper's arm, and one of a million rows.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.recordings.writer import save_recordings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
from recorded import Plant, as_set, record

TRUTH = np.array([[5.2, 7.1, 3.3], [14.0, 21.0, 9.0], [0.31, 0.22, 0.12]])
RATE, RECORDINGS = 100, 8  # Hz


@pytest.mark.parametrize("rows", [76_000, 1_000_000])
def test_calibrate(benchmark, rows, tmp_path, capsys):
    plant, rng = Plant("rrr", *TRUTH), np.random.default_rng(0)
    made = [record(plant, f"{i}.csv", rng, rows / RATE / RECORDINGS) for i in range(RECORDINGS)]
    save_recordings(as_set(plant, made), tmp_path / "set")
    command = [sys.executable, "-c", "from rrr_oc.cli import main; main()", "calibrate", str(tmp_path / "set")]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = {"args": [*command, "--out", str(tmp_path)], "check": True, "capture_output": True}
    benchmark.pedantic(subprocess.run, kwargs=run, rounds=1)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    with capsys.disabled():
        print(f"\n{rows} rows: {spent:.0f} s of processor time, {after.ru_maxrss / 1e6:.1f} GB at the most")
    content = json.loads((tmp_path / "model.json").read_text())
    found = [p["value"] for e in content["effects"] for p in e["parameters"].values()]
    np.testing.assert_allclose(found, TRUTH.T.ravel(), rtol=0.03)
