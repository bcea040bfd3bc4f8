"""The numbers, set by hand, that decide what a diagnosis claims."""

# Time over which a joint's noise stays alike [s]; doubled, slow disturbances are rather taken for noise.
MEMORY = 0.5
# Share of a joint's torque by which the best law may be wrong; doubled, small effects are claimed later.
DISCREPANCY = 0.003
# Share of a joint's dry friction by which the best law of friction may be wrong; doubled, details of friction are claimed later.
FRICTION_DISCREPANCY = 0.05
# Time by which the recorded torque, speed and acceleration of a joint may be apart [s]; doubled, short delays are claimed later.
CLOCK_ERROR = 0.003
# Share by which a link's mass in the URDF may be wrong; doubled, a wrong mass is claimed later.
MASS_ERROR = 0.03
# Distance by which a link's centre of mass in the URDF may be wrong [m]; doubled, laws of the position are claimed later.
CENTRE_ERROR = 0.01
# Share by which a link's inertia in the URDF may be wrong; doubled, laws of the acceleration are claimed later.
INERTIA_ERROR = 0.05
# Probability from which an effect is claimed; lower, more is claimed, and more of it wrong.
CLAIM = 0.95
# Share of a joint's torque below which an effect is too small to matter and is not claimed; 0 claims effects of any size.
NEGLIGIBLE = 0.0003
# Share by which an effect must lower the held-out error of a joint; with less it is small, and not claimed; doubled, less is claimed.
MATTERS = 0.02
# By how much effects exceed their typical size, and in which share of arms; with smaller factors, large effects are taken for others.
EXCESS = {1.0: 0.7, 4.0: 0.25, 16.0: 0.05}
