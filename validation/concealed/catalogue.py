"""The effects by name."""

from validation.concealed import effects_body, effects_friction, effects_outside, effects_sensor
from validation.concealed.effect import Effect


def effect_types(module) -> dict[str, type[Effect]]:
    found = (x for x in vars(module).values() if isinstance(x, type) and issubclass(x, Effect))
    return {x.name: x for x in found if x.__module__ == module.__name__ and "name" in vars(x)}


CATALOGUE = effect_types(effects_friction) | effect_types(effects_body) | effect_types(effects_sensor)
OUTSIDE = effect_types(effects_outside)
# Relatives of laws that the catalogue had first; mixtures are drawn from the others, so that the cases of a seed stay what they are
RELATIVES = (
    "two_sided_biarticular_spring",
    "viscous_asymmetry",
    "missing_gravity",
    "motor_dependent_friction",
    "common_gain",
    "hardening_harness",
    "torque_zeros",
    "encoder_zeros",
    "controller_gain",
)
FIRST = tuple(name for name in CATALOGUE if name not in RELATIVES)
TWO_JOINTS = {
    "coupled_friction",
    "biarticular_spring",
    "two_sided_biarticular_spring",
    "cross_fan",
    "posture_torque",
    "cross_talk",
}
RECORDED_AS = {"controller_gain": "command"}  # what is recorded where an effect is concealed; else the motor torque
SENSED = {name for name, x in (CATALOGUE | OUTSIDE).items() if x.sense is not Effect.sense}


def effect_type(name: str) -> type[Effect]:
    return (CATALOGUE | OUTSIDE)[name]
