"""`model.json`: a calibrated model written and read."""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel, Estimate, Term
from rrr_oc.effects import CATALOGUE, BlackBox, Effect
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import offsets
from rrr_oc.robot.inertial_parameters import is_possible
from rrr_oc.robot.parameters import Parameter
from rrr_oc.robot.robot import Robot, ToolPoint, load_robot
from rrr_oc.schema import Interval, NonNegative, Text, Vector, check_interval, check_names, read_json, validated
from rrr_oc.storage import number, plain, write_json

FORMAT = "rrr_oc-model/1"
DIGITS = 6  # of a standard deviation in the file; with fewer, files are shorter
INERTIAL_ORDER = "m [kg], m c [kg m] (x, y, z), I about the joint's frame [kg m²] (xx, xy, yy, xz, yz, zz)"
# How many joints an effect has, by its placement
JOINTS = {"joint": (1,), "joint or arm": (0, 1), "many": (1,), "pair": (2,), "spring": (1, 2), "arm": (0,)}
Links = dict[str, Annotated[list[float], Meta(min_length=10, max_length=10, description="ten numbers are required")]]
MOST = 1e12  # of an estimate and of what is not known of it, in any unit; more of either is no knowledge
Number = Annotated[float, Meta(ge=-MOST, le=MOST)]
Spread = list[list[Number]]
T = TypeVar("T")
# Keys that are not known here are ignored, so that files of later versions can be read.


class RobotEntry(msgspec.Struct):
    """The robot.

    Attributes:
        name: Its name.
        source: Where the URDF was read from.
        urdf: The text of the URDF; of an MJCF, what it was made into.
        inertial: By link the ten inertial parameters in use.
        inertial_order: The order of these, with units.
    """

    name: Text
    source: Text
    urdf: str
    inertial: Links
    inertial_order: str = INERTIAL_ORDER


class ToolEntry(msgspec.Struct):
    """Where a payload is held.

    Attributes:
        joint: The joint that moves the link.
        position: The point in the joint's frame [m].
    """

    joint: Text
    position: Vector


class WidthEntry(msgspec.Struct):
    """A smoothing width.

    Attributes:
        value: The width, in `unit`.
        unit: Its unit.
    """

    value: NonNegative
    unit: str


class ParameterEntry(msgspec.Struct):
    """An estimate.

    Attributes:
        value: The estimate, in `unit`.
        unit: Its unit; "1" for none.
        std: Standard error; null where the recordings do not determine it.
        interval: 95 % interval; null as well.
        at_bound: Whether the estimate lies at a bound of the parameter.
    """

    value: Number
    unit: str
    std: NonNegative | None
    interval: Interval | None
    at_bound: bool

    def __post_init__(self) -> None:
        check_interval("interval", self.interval)


class TermEntry(msgspec.Struct):
    """An effect with its options and estimates.

    Attributes:
        effect: Its name.
        joints: The joints it acts on; none for the arm as a whole.
        options: Its form.
        width: Width over which it is smoothed; null where it is smooth.
        recordings: The recordings that have it.
        groups: The set-ups that have it; none if all do.
        parameters: Estimates by parameter.
    """

    effect: str
    joints: list[str]
    options: dict[str, Any]
    width: WidthEntry | None
    recordings: Literal["all"] | tuple[str, ...]
    groups: tuple[str, ...]
    parameters: dict[str, ParameterEntry]


class AlternativeEntry(msgspec.Struct):
    """Another model that the recordings do not tell from this one.

    Attributes:
        says: In what it differs.
        differs: Effects in which it differs; `link_errors` stands for the links.
        decided_by: File beside this one with a motion that would decide, if it were recorded; null where none is known.
        effects: Its effects.
        inertial: By link the ten inertial parameters.
        spread: As of this model.
    """

    says: str
    differs: tuple[str, ...]
    decided_by: str | None
    effects: list[TermEntry]
    inertial: Links
    spread: Spread | None


class ModelFile(msgspec.Struct):
    """The content of `model.json`.

    Attributes:
        format: What the file is.
        versions: Of the programs that made it.
        robot: The arm.
        joints: Its joints, base first.
        gravity: Acceleration of gravity in the base frame [m/s²].
        tool: Where a payload is held.
        torque: What was recorded.
        torque_constant: Motor torque by current, by joint; null where it is not known [Nm/A].
        inertial: Whether inertial parameters are the URDF's or estimated.
        effects: The effects of the model.
        noise: Standard deviation of what is left of the torque, by joint [Nm].
        nrmse: Error of the predicted torque over the recorded one's standard deviation, by joint [1].
        report: How the calibration went.
        spread: What is not known of the estimates: independent changes, of one standard deviation each, of the parameters of all
            effects and then of the inertial parameters of all links, in their order; null where that is not known.
        alternatives: Other models that the recordings do not tell from this one.
        unexplained: Rms of the torque that is left beyond noise, by joint, 0 where its error is not far above noise [Nm]; empty where
            it is not known.
    """

    format: Literal["rrr_oc-model/1"]
    versions: dict[str, str]
    robot: RobotEntry
    joints: Annotated[list[str], Meta(min_length=1)]
    gravity: Vector
    tool: ToolEntry
    torque: Literal["motor", "load", "current", "command"]
    torque_constant: dict[str, float | None]
    inertial: Literal["nominal", "identify"]
    effects: list[TermEntry]
    noise: dict[str, NonNegative | None]
    nrmse: dict[str, NonNegative | None]
    report: dict[str, Any]
    spread: Spread | None = None
    alternatives: list[AlternativeEntry] = []
    unexplained: dict[str, NonNegative | None] = {}


def save_model(model: CalibratedModel, path: str | Path) -> None:
    """Write `model.json`, whole or not at all. Raises `UserError` where the path cannot be written."""
    robot = model.robot
    content = ModelFile(
        format=FORMAT,
        versions=dict(model.versions),
        robot=RobotEntry(robot.name, model.source, model.urdf, links_of(robot)),
        joints=list(robot.joints),
        gravity=robot.gravity.tolist(),
        tool=ToolEntry(robot.joints[model.tool.joint], model.tool.position.tolist()),
        torque=model.torque,
        torque_constant=dict(zip(robot.joints, model.torque_constant, strict=True)),
        inertial=model.inertial,
        effects=[term_entry(term, robot) for term in model.terms],
        noise={joint: number(v) for joint, v in zip(robot.joints, model.noise, strict=True)},
        nrmse={joint: number(v) for joint, v in zip(robot.joints, model.nrmse, strict=True)},
        report=dict(model.report),
        spread=spread_entry(model.spread),
        alternatives=[alternative_entry(one) for one in model.alternatives],
        unexplained={} if model.unexplained is None else dict(zip(robot.joints, model.unexplained.tolist(), strict=True)),
    )
    write_json(path, plain(msgspec.to_builtins(content, enc_hook=lambda scalar: scalar.item())))  # of numpy


def links_of(robot: Robot) -> Links:
    """The ten inertial parameters by link."""
    return dict(zip(robot.links, robot.inertial.T.tolist(), strict=True))


def spread_entry(spread: np.ndarray | None) -> Spread | None:
    """`CalibratedModel.spread` as in the file: a row for each change, to `DIGITS` digits, more than are known; None where it is no number."""
    if spread is None or not np.all(np.isfinite(spread)):
        return None
    return [[float(f"{x:.{DIGITS}g}") for x in change] for change in np.clip(spread, -MOST, MOST).T.tolist()]


def alternative_entry(one: Alternative) -> AlternativeEntry:
    """An alternative as in the file."""
    model = one.model
    terms = [term_entry(term, model.robot) for term in model.terms]
    return AlternativeEntry(one.says, one.effects, one.decided_by, terms, links_of(model.robot), spread_entry(model.spread))


def alternative_of(entry: AlternativeEntry, model: CalibratedModel, where: str = "alternative") -> Alternative:
    """The alternative of an entry to a model; raises `UserError`, which says `where`, for one that is not of the model's arm."""
    terms, robot = terms_of(entry.effects, model.robot, f"{where}.effects"), model.robot
    inertial = _inertial(f"{where}.inertial", entry.inertial, robot)
    spread = spread_of(entry.spread, terms, robot, f"{where}.spread")
    other = replace(model, robot=replace(robot, inertial=inertial), terms=terms, spread=spread, alternatives=())
    return Alternative(other, entry.says, entry.differs, entry.decided_by)


def spread_of(entry: Spread | None, terms: Sequence[Term], robot: Robot, where: str = "spread") -> np.ndarray | None:
    """`CalibratedModel.spread` of an entry; raises `UserError`, which says `where`, unless its rows have a number for each parameter."""
    if entry is None:
        return None
    wanted = offsets([t.effect for t in terms])[-1] + 10 * robot.n
    for i, change in enumerate(entry):
        if len(change) != wanted:
            raise UserError(f"{where}[{i}]: found {len(change)} numbers; {wanted} are required, of all parameters and links")
    return np.array(entry, float).reshape(-1, wanted).T


def term_entry(term: Term, robot: Robot) -> TermEntry:
    """A term as in the file; raises `UserError` where an estimate is no number or beyond all that is known."""
    effect = term.effect
    for p, e in zip(effect.parameters, term.estimates, strict=True):
        if not abs(e.value) <= MOST:
            where = f"{effect.name}{' of ' * bool(effect.joints)}{', '.join(robot.joints[j] for j in effect.joints)}"
            raise UserError(
                f"{where}: the fit ends with {p.name} = {e.value:g} {p.unit}; are torques, angles and masses in SI units?"
            )
    return TermEntry(
        effect=effect.name,
        joints=[robot.joints[j] for j in effect.joints],
        options=options_of(effect),
        width=None if term.width is None or effect.width is None else WidthEntry(term.width, effect.width.unit),
        recordings=term.recordings,
        groups=term.groups,
        parameters={
            p.name: ParameterEntry(e.value, p.unit, number(e.std), _between(e.interval), e.at_bound)
            for p, e in zip(effect.parameters, term.estimates, strict=True)
        },
    )


def _between(interval: Interval | None) -> Interval | None:
    """An interval whose ends are known."""
    return interval if interval is not None and interval[0] <= interval[1] and np.all(np.isfinite(interval)) else None


def options_of(effect: Effect) -> dict[str, Any]:
    """What distinguishes an effect from others of its kind on the same joints."""
    return {f.name: getattr(effect, f.name) for f in fields(effect) if f.name != "joints"}


def load_model(path: str | Path) -> CalibratedModel:
    """Read `model.json`.

    Raises:
        UserError: The file is missing, no JSON, of another format, or something in it is missing or wrong; the message names
            the file and the key.
    """
    data = read_json(path, ModelFile)
    try:
        return _model(data)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def robot_of(urdf: str, joints: Sequence[str], gravity: Sequence[float]) -> Robot:
    """The robot of a model, with the inertial parameters of its URDF (text)."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.urdf"
        file.write_text(urdf, encoding="utf-8")
        return load_robot(file, joints, inertial=False, gravity=gravity)


def _model(data: ModelFile) -> CalibratedModel:
    described, joints = data.robot, tuple(data.joints)
    robot = replace(robot_of(described.urdf, joints, data.gravity), name=described.name)
    inertial = _inertial("robot.inertial", described.inertial, robot)
    constants = tuple(_by_name("torque_constant", data.torque_constant, joints))
    if data.torque == "current" and not all(constants):
        raise UserError("torque_constant: torque 'current' needs one for every joint [Nm/A]")
    terms = terms_of(data.effects, robot)
    model = CalibratedModel(
        robot=replace(robot, inertial=inertial),
        source=described.source,
        urdf=described.urdf,
        tool=ToolPoint(robot.index(data.tool.joint), np.array(data.tool.position)),
        torque=data.torque,
        torque_constant=constants,
        inertial=data.inertial,
        terms=terms,
        noise=np.array(_by_name("noise", data.noise, joints), float),
        nrmse=np.array(_by_name("nrmse", data.nrmse, joints), float),
        report=data.report,
        versions=data.versions,
        spread=spread_of(data.spread, terms, robot),
    )
    others = [alternative_of(one, model, f"alternatives[{i}]") for i, one in enumerate(data.alternatives)]
    left = np.array(_by_name("unexplained", data.unexplained, joints), float) if data.unexplained else None
    return replace(model, alternatives=tuple(others), unexplained=left)


def _inertial(where: str, given: Links, robot: Robot) -> np.ndarray:
    """Inertial parameters (10, n) by link; raises `UserError` for a link that is missing or no possible body."""
    inertial = np.array(_by_name(where, given, robot.links), float).T
    for link, parameters in zip(robot.links, inertial.T, strict=True):
        if not is_possible(parameters):
            raise UserError(f"{where}.{link}: found {parameters.tolist()}; mass and inertia of a possible body are required")
    return inertial


def _by_name(where: str, found: Mapping[str, T], names: Iterable[str]) -> list[T]:
    """Values in the order of their names; raises `UserError` for one that is missing."""
    for name in names:
        if name not in found:
            raise UserError(f"{where}: key {name!r} is missing; required are {', '.join(names)}")
    return [found[name] for name in names]


def terms_of(entries: list[TermEntry], robot: Robot, where: str = "effects") -> tuple[Term, ...]:
    """The terms of a model; raises `UserError` for one that stands twice, which would count twice."""
    terms: list[Term] = []
    for i, entry in enumerate(entries):
        term = term_of(entry, robot, f"{where}[{i}]")
        same = [
            k for k, t in enumerate(terms) if (t.effect, t.recordings, t.groups) == (term.effect, term.recordings, term.groups)
        ]
        if same and term.effect.placement != "many":
            raise UserError(f"{where}[{i}]: {entry.effect} stands in {where}[{same[0]}] already; once per joint is allowed")
        terms.append(term)
    return tuple(terms)


def term_of(entry: TermEntry, robot: Robot, where: str = "effect") -> Term:
    """The term of an entry; raises `UserError`, which says `where`, for one that no effect of the catalogue has."""
    if entry.effect not in CATALOGUE:
        raise UserError(f"{where}: unknown effect {entry.effect!r}; this version knows {', '.join(sorted(CATALOGUE))}")
    effect = _effect(where, CATALOGUE[entry.effect], entry, robot)
    if effect.width is not None and entry.width is None:
        raise UserError(f"{where}: key 'width' is missing; {entry.effect} has one [{effect.width.unit}]")
    width = None if effect.width is None or entry.width is None else _quantity(f"{where}.width", effect.width, entry.width)
    parameters = _by_name(f"{where}.parameters", entry.parameters, [p.name for p in effect.parameters])
    for parameter, given in zip(effect.parameters, parameters, strict=True):
        _quantity(f"{where}.parameters.{parameter.name}", parameter, given)
    estimates = tuple(Estimate(p.value, p.std, p.interval, p.at_bound) for p in parameters)
    return Term(effect, estimates, width, entry.recordings, entry.groups)


def _effect(where: str, kind: type[Effect], entry: TermEntry, robot: Robot) -> Effect:
    """An effect on its joints, with its options; raises `UserError` for what the effect does not have."""
    count, joints = JOINTS[kind.placement], tuple(robot.index(joint) for joint in entry.joints)
    if len(joints) not in count or len(set(joints)) < len(joints):
        wanted = (
            "no joint is" if count == (0,) else f"{' or '.join(map(str, count))} different joint{'s' * (count != (1,))} are"
        )
        raise UserError(f"{where}.joints: found {entry.joints}; {wanted} required by {entry.effect}")
    check_names(entry.options, [f.name for f in fields(kind) if f.name != "joints"], f"{where}.options", "option")
    options = _options(f"{where}.options", kind, entry.options)
    for key, value in options.items():
        allowed = kind.options.get(key)
        if allowed is not None and not set(value if isinstance(value, tuple) else [value]) <= set(allowed):
            raise UserError(f"{where}.options.{key}: found {value!r}; allowed are {', '.join(map(str, allowed))}")
    try:
        effect = kind(joints, **options)
        if isinstance(effect, BlackBox):
            effect.check_options(robot.n)
    except (TypeError, ValueError, UserError) as error:
        raise UserError(f"{where}.options: {error}") from None
    return effect


def _options(where: str, kind: type[Effect], options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of an effect in their own types, as JSON lacks tuples."""
    hints = get_type_hints(kind)
    return {key: validated(f"{where}.{key}", value, hints[key]) for key, value in options.items()}


def effect_of(name: str, joints: tuple[int, ...], options: Mapping[str, Any]) -> Effect:
    """An effect of the catalogue with options as in the file, which may have no range yet."""
    return CATALOGUE[name](joints, **_options("options", CATALOGUE[name], options))


def _quantity(where: str, parameter: Parameter, given: ParameterEntry | WidthEntry) -> float:
    """A value in the unit and within the bounds of a parameter."""
    if given.unit != parameter.unit:
        raise UserError(f"{where}.unit: found {given.unit!r}; {parameter.unit!r} is required")
    if not parameter.lower <= given.value <= parameter.upper:
        raise UserError(f"{where}.value: found {given.value:g}; {parameter.lower:g} to {parameter.upper:g} are allowed")
    return given.value
