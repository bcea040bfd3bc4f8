"""Springs and motion of the pick-and-place task, designed together.

    python studies/pea_bpea.py --out results/paper

An RRR arm carries 5 kg to a release position and comes back empty. Which springs, in parallel with its joints (PEA), across
two of them (BPEA) or both, and which motion, need the least load torque? For each configuration the integral of the squared
load torques (Eq. 13) is minimised by direct collocation and IPOPT from starts that CMA-ES and Sobol points propose; the best
purchasable hardware is searched in a catalogue (the starred designs); the paper's own springs are given the best motion on the
same model; every optimum comes with a certificate and is simulated again in MuJoCo. Results stand beside the paper's.

This is `rrr-oc design`, with the task as an option `--preset`, the paper's unless another is named. It takes the same options, which
--help lists.
"""

import argparse

from rrr_oc.errors import ends_at_once, entry_point


def main() -> None:
    with ends_at_once():
        from rrr_oc.commands.design import app
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--out", default="results/pea_bpea")
    given, options = parser.parse_known_args()
    app([given.preset, "--out", given.out, *options])


run = entry_point(main)

if __name__ == "__main__":
    run()
