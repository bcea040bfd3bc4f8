"""The numbers of a calibrated model as a table, with which a reader can compute a torque again."""

from collections.abc import Mapping
from typing import Any

from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.words import joint_words, read, words
from rrr_oc.report.tables import NONE, Table

# How friction changes sign, by the name in the file, with x = dq / width; see `rrr_oc.numerics.smooth.TURNS`
SIGNS = {
    "tanh": "tanh(x)",
    "erf": "erf(x)",
    "arctan": "2/pi atan(x)",
    "root": "x / sqrt(1 + x^2)",
    "ratio": "x / (1 + |x|)",
    "clip": "x within -1 and 1",
}


def model_numbers(model: Mapping[str, Any]) -> Table:
    """Friction and rotor of every joint, each with unit and 95 % interval, and the sign that friction has.

    Args:
        model: The content of model.json.
    """
    own = [e for e in model["effects"] if e["effect"] in CATALOGUE and CATALOGUE[e["effect"]].role == "plain"]
    kinds = list(dict.fromkeys(e["effect"] for e in own))
    body = []
    for joint in model["joints"]:
        cells = {e["effect"]: _cell(e) for e in own if e["joints"] == [joint]}
        signs = [_sign(e) for e in own if e["joints"] == [joint] and e["width"] is not None]
        body.append([joint_words(joint), *(cells.get(kind, NONE) for kind in kinds), ", ".join(signs) or NONE])
    return ["joint", *map(words, kinds), "sgn(dq)"], body


def _cell(e: Mapping[str, Any]) -> str:
    return ", ".join(f"{read(entry)}" for entry in e["parameters"].values())


def _sign(e: Mapping[str, Any]) -> str:
    form = SIGNS[e["options"].get("turn", "tanh")]
    return f"{form}, x = dq / ({read({**e['width'], 'interval': None})})"
