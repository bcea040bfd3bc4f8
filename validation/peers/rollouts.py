"""How fast are rollouts with the project's effects in MuJoCo, beside the bare engine and its own springs?

    python validation/peers/rollouts.py --out results/peers

64 candidates of 3.5 s at 2 ms, by Euler's method, on the three-joint arm, as in `tests/benchmarks/bench_rollout.py`; processor time
of one thread, best of rounds that take turns. Writes OUT/rollouts.json.
"""

import argparse
import os
import sys
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from rrr_oc.storage import write_json  # noqa: E402
from tests.benchmarks.bench_rollout import FORMS, STEPS, Batch, batch  # noqa: E402

ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    options = parser.parse_args()
    path = options.out / "rollouts.json"
    if path.exists():
        return
    works: dict[str, Batch] = {form: batch(form, "euler") for form in FORMS}
    best: dict[str, float] = dict.fromkeys(works, float("inf"))
    for _ in range(ROUNDS):
        for form, work in works.items():
            began = time.process_time()
            work.run(1)
            best[form] = min(best[form], time.process_time() - began)
    result = {form: STEPS / seconds for form, seconds in best.items()}  # steps a second
    write_json(path, result)
    print(result)


if __name__ == "__main__":
    main()
