"""The numbers, set by hand, that decide what a diagnosis claims; those of the estimate are in `rrr_oc.calibration.estimator.knobs`."""

# Probability from which an effect is claimed; lower, more is claimed, and more of it wrong.
CLAIM = 0.95
# Share of a joint's torque below which an effect is too small to matter and is not claimed; 0 claims effects of any size.
NEGLIGIBLE = 0.0003
# Share by which an effect must lower the held-out error of a joint, or its innovations; with less it is small; doubled, fewer matter.
MATTERS = 0.02
# By how much effects exceed their typical size, and in which share of arms; with smaller factors, large effects are taken for others.
EXCESS = {1.0: 0.7, 4.0: 0.25, 16.0: 0.05}
# Share of what the best function of some variables explains that a law must explain to be named; higher, more is only described.
NAMED = 0.9
# Residual over noise above which a joint has a mismatch whatever was found; doubled, fewer verdicts are "cannot tell".
FAR = 3.0
# Share of claims like it that are right from which a law is named; higher, more is only described.
LIKELY = 0.5
