"""The hand-set numbers that decide anything in a discovery; `priors.toml` may change them."""

MEMORY = 0.5  # [s] over which a joint's noise is correlated; doubled, slow noise is told better, from more data
DISCREPANCY = 0.003  # share of a joint's torque that no law is exact enough for; doubled, small claims are made later
FRICTION_DISCREPANCY = 0.05  # the same share of a joint's dry friction, for laws of friction
CLOCK_ERROR = 0.003  # [s] by which torque, speed and acceleration of a joint are apart
MASS_ERROR, CENTRE_ERROR, INERTIA_ERROR = (
    0.03,
    0.01,
    0.05,
)  # of a URDF's links: share, [m], share; doubled, laws of position lose
CLAIM = 0.95  # probability from which an effect is claimed; lower, more claims, and more of them wrong
EXCESS = {1.0: 0.7, 4.0: 0.25, 16.0: 0.05}  # by which effects are larger than their typical size, and in which share of arms
