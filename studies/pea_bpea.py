"""Springs and motion of the pick-and-place task, designed together.

    python studies/pea_bpea.py --out results/paper

An RRR arm carries 5 kg to a release position and comes back empty. Which springs, in parallel with its joints (PEA), across
two of them (BPEA) or both, and which motion, need the least load torque? For each configuration the integral of the squared
load torques (Eq. 13) is minimised by direct collocation and IPOPT from starts that CMA-ES and Sobol points propose; the best
purchasable hardware is searched in a catalogue (the starred designs); the paper's own springs are given the best motion on the
same model; every optimum comes with a certificate and is simulated again in MuJoCo. Results stand beside the paper's.

It is `rrr-oc design paper`, with the same options.
"""

import sys

from rrr_oc.cli import app
from rrr_oc.errors import entry_point

run = entry_point(lambda: app(["design", *sys.argv[1:]]))

if __name__ == "__main__":
    run()
