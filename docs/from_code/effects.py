"""Reference pages of the effects, one for each and an index, made from the effects' own files.

They are written when the site of the documentation is built.
"""

import inspect
import re
import sys

from docs.from_code.effect_figures import AXES, svg
from docs.from_code.examples import DRY, PAYLOAD, VISCOUS, Example, example, followed
from rrr_oc.effects import CATALOGUE, DesignSpring, Effect, ExportTwin, ListedSpring
from rrr_oc.effects.base import PARTLY, PLACEMENTS, SIDES, SOUGHT
from rrr_oc.effects.words import listed, words
from rrr_oc.robot.parameters import Parameter

ELSEWHERE = "other packages"
# Units of `Prior.typical`, as in `View.unit`
UNITS = {
    "dry": "the joint's dry friction",
    "dry/speed": "the joint's dry friction over its largest speed",
    "dry/speed²": "the joint's dry friction over the square of its largest speed",
    "torque": "the standard deviation of the joint's torque",
    "torque/travel": "the standard deviation of the joint's torque over its range of positions",
    "torque/travel³": "the standard deviation of the joint's torque over the third power of its range of positions",
    "travel": "the joint's range of positions",
    "mass": "the mass of the link",
    "arm's mass": "the mass of all links",
    "mass length": "the mass of the link times a length that stands for the arm",
    "mass length²": "the mass of the link times the square of a length that stands for the arm",
    "inertia": "the inertia that the drive moves",
}
ROLES = {
    "plain": "It is part of every calibrated model.",
    "law": "A diagnosis looks for it.",
    "black_box": "It is no law: it stands for a torque that no law of the catalogue explains.",
    "design": "A co-design may use it; a diagnosis does not look for it.",
}
RESEMBLES = {
    "friction_over_speed": "It is another course of dry friction over the speed",
    "position_harmonic": "It is a harmonic of a torque over the joint's position",
    "constant": "It is the mean of a torque over the joint's position",
}


def pages() -> dict[str, str]:
    """The index and the page of every effect in the catalogue, by the name of their file; Markdown with pictures in it."""
    return {"index.md": index()} | {f"{name}.md": page(kind) for name, kind in CATALOGUE.items()}


def index() -> str:
    """The catalogue by groups, which are the folders of `rrr_oc/effects/`."""
    parts = [
        "# Effects",
        f"The catalogue has {len(CATALOGUE)} effects. Each is one piece of physics beside the rigid body, written once, and is the same "
        "in co-design, simulation, calibration and diagnosis. `rrr-oc effects` lists them on the console. "
        "[Contributing](../../CONTRIBUTING.md) says how to add one, and [Priors](../priors.md) how common each is believed to be.",
    ]
    for title, kinds in groups().items():
        rows = [f"| [{title_of(k)}]({k.name}.md) | `{k.equation}` | {summary(k)} |" for k in kinds]
        parts += [
            f"## {words(title).capitalize()}",
            _folder(title),
            "\n".join(["| effect | law | what it is |", "| --- | --- | --- |", *rows]),
        ]
    return "\n\n".join(parts) + "\n"


def groups() -> dict[str, list[type[Effect]]]:
    """The effects by their folder in `rrr_oc/effects/`, those that stand for no law last."""
    found: dict[str, list[type[Effect]]] = {}
    for kind in sorted(CATALOGUE.values(), key=lambda kind: (kind.role == "black_box", _group(kind), kind.name)):
        found.setdefault(_group(kind), []).append(kind)
    return found


def page(kind: type[Effect]) -> str:
    """The page of an effect."""
    lead, notes = _law(kind)
    shown = example(kind.name)
    parts = [
        f"# {title_of(kind)}",
        summary(kind),
        f"- Name in files: `{kind.name}`. {ROLES[kind.role]}\n- It acts on {PLACEMENTS[kind.placement]}.\n- How: {SIDES[kind.side]}.",
        "## Law",
        f"```text\n{kind.equation}\n```",
        lead,
        *notes,
        "## Parameters",
        _parameters(kind),
        *_options(kind),
        "## How common it is",
        _prior(kind),
        *(_look(shown) if shown else []),
        *_alike(kind, shown),
        "## Where it is used",
        *_uses(kind),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def title_of(kind: type[Effect]) -> str:
    """Its name in words."""
    return words(kind.name).capitalize()


def summary(kind: type[Effect]) -> str:
    """What it is, in a sentence: the first line of its file."""
    return _said(kind.__module__)


def _said(module: str) -> str:
    return (inspect.getdoc(sys.modules[module]) or "").split("\n\n")[0].replace("\n", " ")


def _group(kind: type[Effect]) -> str:
    parts = kind.__module__.split(".")
    return parts[2] if parts[:2] == ["rrr_oc", "effects"] else ELSEWHERE


def _folder(group: str) -> str:
    return "Effects that installed packages add." if group == ELSEWHERE else _said(f"rrr_oc.effects.{group}")


def _law(kind: type[Effect]) -> tuple[str, list[str]]:
    """The law with its source, and what else its class says."""
    text = (inspect.getdoc(kind) or "").split("\nAttributes:")[0]
    lead, *notes = [" ".join(part.split()) for part in text.strip().split("\n\n")]
    return _plain(lead), [_plain(note) for note in notes]


def _plain(text: str) -> str:
    """Text of a docstring as Markdown: what stands for multiplication or an index is no emphasis."""
    return re.sub(r"(?<!`)([*_|<>])", r"\\\1", text) if "`" not in text else text


def _known(kind: type[Effect]) -> tuple[Parameter, ...] | None:
    return kind.parameters if isinstance(kind.parameters, tuple) else None


def _parameters(kind: type[Effect]) -> str:
    known = _known(kind)
    if known is None:
        return "Coefficients in Nm, whose number depends on the variables that it was found to depend on."
    rows = ["| parameter | unit | bounds | typical size |", "| --- | --- | --- | --- |"]
    for p in (*known, *((kind.width,) if kind.width is not None else ())):
        rows.append(f"| `{p.name}` | {'–' if p.unit == '1' else p.unit} | {_bounds(p)} | {_size(kind, p)} |")
    return "\n".join(rows)


def _bounds(p: Parameter) -> str:
    ends = [f"≥ {p.lower:.4g}" * (p.lower > -1e300), f"≤ {p.upper:.4g}" * (p.upper < 1e300)]
    return " and ".join(end for end in ends if end) or "any"


def _size(kind: type[Effect], p: Parameter) -> str:
    if p is kind.width:
        return f"width over which what is not smooth changes; {p.nominal:g} unless estimated"
    if p.name in kind.prior.typical:
        return _typical(*kind.prior.typical[p.name], unit=p.unit)
    return "see below" if p.name in kind.amplitudes and kind.prior.typical else "–"


def _typical(number: float, of: str, unit: str = "") -> str:
    if of:
        return f"{number:g} × {UNITS[of]}"
    return f"{number:g}{f' {unit}' if unit not in ('', '1') else ''}"


def _options(kind: type[Effect]) -> list[str]:
    said = [
        f"`{name}` is {' or '.join(f'`{v!r}`'.replace(chr(39), chr(34)) for v in values)}"
        for name, values in kind.options.items()
    ]
    return [f"It is mounted in one of several ways: {listed(said)}."] if said else []


def _prior(kind: type[Effect]) -> str:
    if kind.role == "plain":
        return "Every drive has it, so it has no prior."
    if kind.role == "design":
        return "A diagnosis does not look for it, so it has no prior."
    p, names = kind.prior, [q.name for q in _known(kind) or ()]
    other = {name: size for name, size in p.typical.items() if name not in names}
    parts = [
        f"The probability that it is present at one place of an arm is taken as {p.probability:g} before any recording is seen."
    ]
    parts += [
        f"The typical {words(name)} is {_typical(*size)}{'' if size[1] else ' in SI units'}." for name, size in other.items()
    ]
    if p.where_springs != 1:
        parts.append(f"On arms that carry springs its odds are {p.where_springs:g} times as large.")
    if p.where_exact != 1:
        parts.append(f"Where inertial parameters are known exactly, its odds are {p.where_exact:g} times as large.")
    if PARTLY[kind.scope]:
        parts.append(f"If present, it is so in some recordings only with probability {PARTLY[kind.scope]:g}.")
    return (
        " ".join(parts)
        + f" Source: {p.source}. [Priors](../priors.md) says what typical sizes refer to, and how to change them."
    )


def _look(of: Example) -> list[str]:
    """Its picture, and a sentence about it, for most effects that of a diagnosis that finds it."""
    sought = of.effect.role in SOUGHT
    size = "its amplitude has the typical size" if sought else "its size is that in the sentence below"
    if len(of.curves) > 1:
        size = "each curve has one amplitude of typical size, the others 0"
    caption = [
        f"By how much the motor torque changes through the effect while the paper's arm moves along sines with {PAYLOAD:g} kg; {size}."
    ]
    variable = followed(of)
    if variable:
        name = AXES[variable[0]][0].format(variable[1] + 1)
        caption.append(f"On the right, the same over the {name}; motion in either direction may have a branch of its own.")
    else:
        caption.append("It follows no single variable of the instant.")
    if "friction" in of.effect.inputs:
        caption.append(f"Joint 2 has dry friction of {DRY[1]:g} Nm and viscous friction of {VISCOUS[1]:g} Nm s/rad.")
    said = of.sentence()
    told = [f"A diagnosis that finds it would say:\n\n> {said}" if sought else f"> {said}"] if said else []
    return ["## What it looks like", f"<figure>{svg(of)}</figure>", " ".join(caption), *told]


def _alike(kind: type[Effect], of: Example | None) -> list[str]:
    """What the effect's file knows of others that look like it."""
    said = []
    same = [k for k in CATALOGUE.values() if k is not kind and kind.resembles and k.resembles == kind.resembles]
    if isinstance(kind.resembles, str) and kind.resembles:
        beside = f", as {listed([_link(k) for k in same])}" if same else ""
        said.append(f"{RESEMBLES[kind.resembles]}{beside}.")
    equal = dict.fromkeys(type(effect) for effect, _ in of.effect.equivalents(of.theta)) if of else {}
    if equal:
        said.append(f"Over part of the range it has the same law as {listed([_link(k) for k in equal])}.")
    return ["## What looks alike", " ".join(said)] if said else []


def _link(kind: type[Effect]) -> str:
    return f"[{words(kind.name)}]({kind.name}.md)"


def _uses(kind: type[Effect]) -> list[str]:
    uses = [
        kind.__module__.startswith("rrr_oc.") and f"[Source](../../{kind.__module__.replace('.', '/')}.py).",
        issubclass(kind, ListedSpring)
        and f"Recordings list it as `{kind.listing.key}` ([recordings.json](../reference/recordings.md)).",
        issubclass(kind, DesignSpring) and f"A co-design uses it in `{kind.design.label}` ([task.json](../reference/task.md)).",
        issubclass(kind, ExportTwin) and "MuJoCo has its law as an element of its own ([export](../export.md)).",
        kind.recorded_as == ("command",) and "A diagnosis looks for it where commands are recorded in place of torques.",
        "command" not in kind.recorded_as
        and "A diagnosis does not look for it where commands are recorded in place of torques.",
        kind.energy is not Effect.energy and "It stores energy.",
    ]
    return ["\n".join(f"- {use}" for use in uses if use)]
