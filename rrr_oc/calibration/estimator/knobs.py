"""The numbers, set by hand, that decide what an estimate takes for noise, for an imperfect law or URDF, and for told apart."""

# Time before a row on which its noise is taken to depend, and its memory where it does not wander [s]; doubled, slow laws are taken for it.
PAST = 0.5
# Longest time over which a joint's noise may stay alike, as of a sensor whose zero wanders [s]; shorter, laws are found in such wander.
MEMORY = 5.0
# Share of a joint's torque, rms, up to which what is left may wander so; doubled, more of what is missing is taken for that.
WANDER = 0.1
# Share of a joint's torque by which the best law may be wrong; doubled, small effects are claimed later.
DISCREPANCY = 0.003
# Share of a joint's dry friction by which the best law of friction may be wrong; doubled, details of friction are claimed later.
FRICTION_DISCREPANCY = 0.05
# Time by which the recorded torque, speed and acceleration of a joint may be apart [s]; doubled, short delays are claimed later.
CLOCK_ERROR = 0.003
# Age of the positions on which a loop acts whose commands are recorded [s]; doubled, viscous friction is known half as well there.
INNER_CYCLE = 0.001
# Share by which a link's mass in the URDF may be wrong; doubled, a wrong mass is claimed later.
MASS_ERROR = 0.03
# Distance by which a link's centre of mass in the URDF may be wrong [m]; doubled, laws of the position are claimed later.
CENTRE_ERROR = 0.01
# Share by which a link's inertia in the URDF may be wrong; doubled, laws of the acceleration are claimed later.
INERTIA_ERROR = 0.05
# χ² of the difference of recorded torques above which a recording tells two models apart; doubled, 7 standard deviations are asked for.
DECISIVE = 25.0
