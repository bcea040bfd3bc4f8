"""What does a diagnosis say of arms whose recordings passed a chain of measurement?

    python -m validation.chains.make --out cases --count 96
    python -m validation.chains.diagnoses cases --out results/chains --limit 300

Every case is diagnosed in a process of its own, which is ended after `--limit` seconds of processor time. A case that is done is not
done again; `scoring.py` says what is counted.
"""

import argparse
import json
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from validation.chains.make import cases_of
from validation.chains.scoring import Sealed, score, table

ROOT = Path(__file__).resolve().parents[2]


def diagnosed(folder: Path, file: Path) -> None:
    """Write what is said of a case, and the processor time."""
    from rrr_oc.diagnosis.diagnosis_file import to_json
    from rrr_oc.diagnosis.procedure import diagnose
    from rrr_oc.parallel import one_thread
    from rrr_oc.recordings.reader import load_recordings
    from rrr_oc.storage import write_json

    with one_thread():
        content = to_json(diagnose(load_recordings(folder / "recordings")))
    write_json(file, {"seconds": time.process_time(), "diagnosis": json.loads(json.dumps(content))})


def once(folder: Path, file: Path, limit: int) -> dict[str, Any]:
    """The result of a case, which may be that it failed or took too long."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        command = ["-m", "validation.chains.diagnoses", str(folder), "--out", str(file), "--one", "--limit", str(limit)]
        run = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False)
        why = (
            f"more than {limit} s"
            if run.returncode == -signal.SIGXCPU
            else run.stderr[-3000:].strip() or f"status {run.returncode}"
        )
        failed = why if run.returncode else ""
        if failed:
            file.write_text(json.dumps({"failed": failed}))
        print(folder.name, failed.splitlines()[-1] if failed else "", flush=True)
    return json.loads(file.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, help="a folder of cases; with --one, a case")
    parser.add_argument("--out", type=Path, required=True, help="a folder; with --one, a file")
    parser.add_argument("--limit", type=int, default=600, help="processor time of a case [s]")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        resource.setrlimit(resource.RLIMIT_CPU, (options.limit, options.limit + 5))
        diagnosed(options.cases, options.out)
        return
    scores, failed, seconds = [], [], []
    for folder in cases_of(options.cases):
        result = once(folder, options.out.resolve() / "diagnoses" / f"{folder.name}.json", options.limit)
        truth = json.loads((folder / "sealed" / "truth.json").read_text())
        if "failed" in result:
            failed.append(folder.name)
            continue
        seconds.append(result["seconds"])
        scores.append((folder.name.split("-")[0], score(result["diagnosis"], Sealed.read(folder / "sealed", truth))))
    print(table(scores))
    print(f"Failed: {', '.join(failed) or 'none'}.")
    if seconds:
        print(f"Processor time of a case: {np.median(seconds):.0f} s (median), {max(seconds):.0f} s (most).")


if __name__ == "__main__":
    main()
