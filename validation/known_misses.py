"""Does the diagnosis find what it is known to miss?

    python validation/known_misses.py --out results/known_misses

Each case is a few recordings of a made-up plant, or real ones, of which a maintainer knows what a diagnosis should say and, when the
case was added, did not. What it says now is compared with that; a case that is right becomes a test unless it takes minutes. A case
takes one process and is ended after `--longest` seconds of processor time. One that is done is not done again unless the code has changed.
"""

import json
import multiprocessing
import os
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# pyright: reportAttributeAccessIssue=false
# (a diagnosis's effects have attributes of their own)

from rrr_oc.calibration.calibrated_model import nominal_term
from rrr_oc.calibration.parameter_vector import widened
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.result import Diagnosis, Finding
from rrr_oc.effects import BlackBox
from rrr_oc.effects.black_box.empirical import STRAIGHT, Empirical
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.effects.friction.coulomb_asymmetry import CoulombAsymmetry
from rrr_oc.effects.priors import Priors
from rrr_oc.errors import UserError, entry_point
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.tables import markdown
from rrr_oc.storage import Made, write_json, write_text
from tests.helpers import chains
from tests.helpers.recorded import Plant, as_set, by_engine, point_to_point, record
from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case

ROOT = Path(__file__).resolve().parents[1]
MADE_WITH = [Path(__file__), ROOT / "tests" / "helpers", ROOT / "validation" / "concealed"]
Key = tuple[str, tuple[int, ...]]  # an effect's name and joints


@dataclass(frozen=True)
class Known:
    """A case of which it is known what should be found.

    Attributes:
        hidden: What the recordings hold.
        wanted: What should be said of them.
        judge: What was found, in words, and whether it is that; gets a folder for files.
    """

    hidden: str
    wanted: str
    judge: Callable[[Path], tuple[str, bool]]


def claims(found: Diagnosis) -> str:
    """Its findings in words."""

    def one(finding: Finding) -> str:
        joints = " and ".join(str(j + 1) for j in finding.term.effect.joints)
        words = f"{finding.term.effect.name}{f' of joint {joints}' if joints else ''}"
        return words + f" in {len(finding.term.groups)} recordings" * bool(finding.term.groups)

    counts = Counter(map(one, found.findings))
    return ", ".join(f"{words}{f' {count} times' * (count > 1)}" for words, count in counts.items()) or "nothing"


def diagnosed(make: Callable[[Path], RecordingSet], right: Callable[[Diagnosis], bool], folder: Path) -> tuple[str, bool]:
    """Make recordings and diagnose them."""
    found = diagnose(make(folder))
    return claims(found), right(found)


def single(found: Diagnosis, right: Callable[[Finding], bool]) -> bool:
    """Whether there is one finding, which is right."""
    return len(found.findings) == 1 and right(found.findings[0])


def near(value: float, true: float, share: float) -> bool:
    return abs(value - true) <= share * abs(true)


# --- recordings ---


def pendulum(folder: Path, joints: int = 1) -> Plant:
    """A plant of so many joints whose axes are horizontal and parallel."""
    (folder / "arm.urdf").write_text(chains.arm(joints))
    return Plant(folder / "arm.urdf", np.ones(joints), np.ones(joints), 0.1 * np.ones(joints))


def paper_arm() -> Plant:
    return Plant("rrr", np.ones(3), np.ones(3), 0.1 * np.ones(3))


def concealed(key: str, robot: str, *effects: Concealed) -> Callable[[Path], RecordingSet]:
    """Of a short sealed case."""

    def make(folder: Path) -> RecordingSet:
        case = Case(key, "test", 11, robot, effects, short=True)
        write_case(build(case), folder)
        return load_recordings(folder / case.id / "data")

    return make


def faint_friction(folder: Path) -> RecordingSet:
    plant, rng, made = pendulum(folder), np.random.default_rng(0), []
    for i in range(4):
        r = record(plant, f"{i}.csv", rng, 15.0, 0.05)
        friction = np.cos(3.8 * r.q - 2.9) * np.tanh(r.dq / plant.width)
        made.append(replace(r, tau=r.tau - 0.012 * r.tau.std() * friction))
    return as_set(plant, made)


def ripple_of_few_cycles(folder: Path) -> RecordingSet:
    """Between one and two in the range of the recordings."""
    plant, rng, made = pendulum(folder), np.random.default_rng(6), []
    for i in range(4):
        t = np.arange(1000) / 100
        w, phase = rng.uniform(0.8, 2.5, (2, 1)), rng.uniform(0, 6, (2, 1))
        sines = np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase)
        motion = tuple(0.25 * np.sum(x, axis=0, keepdims=True) for x in sines)
        r = record(plant, f"{i}.csv", rng, 10.0, 0.01, motion)
        made.append(replace(r, tau=r.tau + 1.5 * np.sin(8 * motion[0] + 1)))
    return as_set(plant, made)


def bump(folder: Path) -> RecordingSet:
    plant, rng = pendulum(folder), np.random.default_rng(9)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(4)]
    middle = float(np.mean(np.concatenate([r.q[0] for r in made])))
    return as_set(plant, [replace(r, tau=r.tau + 0.4 * np.exp(-(((r.q - middle) / 0.08) ** 2) / 2)) for r in made])


def cushion(folder: Path) -> RecordingSet:
    """At the end of a range, between the places that are tried first."""
    plant, rng = pendulum(folder), np.random.default_rng(3)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.01) for i in range(4)]
    return as_set(plant, [replace(r, tau=r.tau + 20 * np.maximum(r.q - _cushioned(made)[0], 0) ** 3) for r in made])


def _cushioned(recordings) -> tuple[float, float]:
    """Where the cushion begins, and the range of positions [rad]."""
    every = np.concatenate([r.q[0] for r in recordings])
    return float(every.min() + 0.73 * np.ptp(every)), float(np.ptp(every))


def preloaded_spring(_: Path) -> RecordingSet:
    """About an upright axis nothing but the spring says where the joint is."""
    plant, rng = paper_arm(), np.random.default_rng(2)
    made = [record(plant, f"{i}.csv", rng, 8.0, pea={0: (12.0, 0.42)}) for i in range(4)]
    listed = ((ParallelSpring((0,)), {"stiffness": 12.0, "equilibrium": 0.3}),)
    return as_set(plant, [replace(r, springs=listed) for r in made])


def sticking(folder: Path) -> RecordingSet:
    """Dry friction of 2 Nm that holds a joint for a moment where it reverses, by MuJoCo."""
    plant, rng = pendulum(folder), np.random.default_rng(1)
    return as_set(plant, [by_engine(plant, f"{i}.csv", rng, 2.0) for i in range(4)])


def asymmetric(folder: Path) -> RecordingSet:
    """Friction that is larger in one direction, from point to point."""
    plant = replace(pendulum(folder), width=0.02)
    return as_set(plant, point_to_point(plant, 0.2, 0.0))


def stiffer_spring(folder: Path) -> RecordingSet:
    plant, rng = pendulum(folder), np.random.default_rng(14)  # by chance, a second spring fits a little better
    made = [record(plant, f"{i}.csv", rng, 10.0, pea={0: (6.0 + 2.0 * (i % 2), 0.4)}) for i in range(4)]
    springs = tuple((effect, {**theta, "stiffness": 6.0}) for effect, theta in made[0].springs)
    return as_set(plant, [replace(r, springs=springs) for r in made])


def engaged_spring(seconds: float, _: Path) -> RecordingSet:
    """In every other recording, where it is always engaged."""
    plant, rng = paper_arm(), np.random.default_rng(2)
    made = [record(plant, f"{i}.csv", rng, seconds, pea={1: (12.0, 3.0)} if i % 2 else None) for i in range(6)]
    return as_set(plant, [replace(r, springs=()) for r in made])


def one_way(way: int, folder: Path) -> RecordingSet:
    """A torque that is there while the joint moves one way; a harness and friction over position together equal it."""
    plant, rng = pendulum(folder, 2), np.random.default_rng(3)
    made = [record(plant, f"{i}.csv", rng, 12.0) for i in range(4)]
    pull = [np.array([[0.0], [0.5]]) * (r.q - 0.3) * (1 + way * np.tanh(r.dq / plant.width)) / 2 for r in made]
    return as_set(plant, [replace(r, tau=r.tau + p) for r, p in zip(made, pull, strict=True)])


def servo(_: Path) -> RecordingSet:
    """Where a pendulum moves slowly, load is a function of position."""
    shared = Path(os.environ.get("RRR_OC_SHARED", ROOT.parent / "shared"))
    whole = load_recordings(shared / "recordings" / "xl330_pendulum")
    return replace(whole, recordings=tuple(r for r in whole.recordings if "sin_sin" in r.file or "up_and_down" in r.file))


# --- what is right ---


def named(*names: str) -> Callable[[Diagnosis], bool]:
    """Whether these effects, and no others, are found."""
    return lambda found: {f.term.effect.name for f in found.findings} == set(names)


def one_named(name: str) -> Callable[[Diagnosis], bool]:
    return lambda found: single(found, lambda f: f.term.effect.name == name)


def right_ripple(found: Diagnosis) -> bool:
    def right(f: Finding) -> bool:
        if f.key != ("torque_ripple", (0,)):
            return False
        amplitude, order, phase = f.term.values
        return near(amplitude, 1.5, 0.03) and near(order, 8.0, 0.03) and abs(phase) <= np.pi

    return single(found, right) and found.held_out[1][0] < 0.2 * found.held_out[0][0]


def right_bump(found: Diagnosis) -> bool:
    effects = [f.term.effect for f in found.findings]
    ripples = [e for e in effects if e.name == "torque_ripple"]
    variables = [e.depends_on for e in effects if isinstance(e, BlackBox)]
    return (("q", 0),) in variables and not ripples and found.held_out[1][0] < 0.3 * found.held_out[0][0]


def right_cushion(found: Diagnosis) -> bool:
    begin, width = _cushioned(found.recordings.recordings)

    def right(f: Finding) -> bool:
        effect = f.term.effect
        if not isinstance(effect, Empirical) or effect.depends_on != (("q", 0),) or len(effect.edges) != 1:
            return False
        (side, edge, power), low, high = effect.edges[0], effect.low[0], effect.high[0]
        return (side, power) == (1, 3) and abs(low + edge * (high - low) - begin) < 0.01 * width

    return single(found, right)


def right_preload(found: Diagnosis) -> bool:
    same: set[Key] = {("spring_preload", (0,)), ("encoder_offset", (0,))}
    return single(found, lambda f: {f.key, *f.rivals} >= same and near(f.term.values[0], 0.12, 0.05))


def right_stiffness(found: Diagnosis) -> bool:
    def right(f: Finding) -> bool:
        there = f.term.effect.name == "spring_stiffness" and f.term.groups == ("1.csv", "3.csv")
        return there and near(f.term.values[0], 8 / 6, 0.02) and ("parallel_spring", (0,)) in f.rivals

    return single(found, right)


def right_spring(found: Diagnosis) -> bool:
    def right(f: Finding) -> bool:
        if f.key != ("parallel_spring", (1,)) or set(f.term.groups) != {"1.csv", "3.csv", "5.csv"}:
            return False
        stiffness, rest = f.term.named["stiffness"], f.term.named["equilibrium"]
        return near(stiffness, 12.0, 0.05) and abs(rest - 3.0) < 0.1 and ("cable_harness", (1,)) in f.rivals

    return single(found, right)


def right_direction(way: int, found: Diagnosis) -> bool:
    def right(f: Finding) -> bool:
        effect = f.term.effect
        if not isinstance(effect, Empirical) or effect.direction != ("upwards" if way > 0 else "downwards"):
            return False
        if set(effect.depends_on) != {("q", 1), ("sign", 1)} or effect.edges != STRAIGHT:
            return False
        at_high, at_low = f.term.values
        return near((at_high - at_low) / (effect.high[0] - effect.low[0]), -0.5, 0.05)

    return single(found, right)


def right_echo(truth: float, found: Diagnosis) -> bool:
    """Whether nothing but what follows the past of the load is found, with the frequency [rad/s] within 15 %."""
    echoes = [f.term.named["frequency"] for f in found.findings if f.term.effect.name == "echo"]
    return len(echoes) == len(found.findings) and any(near(w, truth, 0.15) for w in echoes)


def sloshing(folder: Path) -> tuple[str, bool]:
    found = diagnose(concealed("sloshing", "arm3", Concealed("sloshing_payload", 3.0))(folder))
    (file,) = (folder / "sealed").glob("*.json")
    return claims(found), right_echo(json.loads(file.read_text())["effects"][0]["parameters"]["omega"]["value"], found)


def right_servo(found: Diagnosis) -> bool:
    first = found.findings[0].term if found.findings else None
    return (
        first is not None
        and first.effect.name == "load_dependent_friction"
        and not first.groups
        and 0.3 < first.values[0] < 0.6
    )


def width_from(begin: float, folder: Path) -> tuple[str, bool]:
    """Fit dry friction and its asymmetry, which change sign over the same width, from another width."""
    plant, rng = pendulum(folder), np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, 10.0) for i in range(3)]
    uneven = [replace(r, tau=r.tau + np.tanh(r.dq / plant.width) ** 2) for r in made]
    _, fitter, _, model = ready(as_set(plant, uneven), Priors())
    laws = (*model.terms, nominal_term(CoulombAsymmetry((0,))))
    wrong = replace(model, terms=tuple(widened(t, {(0,): begin}) for t in laws))
    terms = fitter.fit(wrong, fitter.data.links.none).model.terms
    widths = [t.width for t in terms if t.width is not None]
    words = ", ".join(f"{w:.3g} rad/s" for w in widths) + f"; amplitude {terms[-1].values[0]:.3g} Nm"
    return words, all(near(w, plant.width, 0.02) for w in widths) and near(terms[-1].values[0], 2.0, 0.03)


def _of(make: Callable[[Path], RecordingSet], right: Callable[[Diagnosis], bool]) -> Callable[[Path], tuple[str, bool]]:
    return partial(diagnosed, make, right)


PAIR = (Concealed("payload_mass", 2.0), Concealed("payload_com", 2.0))


def without_gravity(folder: Path) -> RecordingSet:
    """Efforts without gravity, of light links."""
    names, axes = ["base", "l1", "l2"], ["0 0 1", "0 -1 0"]
    parts = [chains.link(name, mass) for name, mass in zip(names, (0.0, 1.0, 1.0), strict=True)]
    parts += [chains.joint(f"j{i + 1}", names[i], names[i + 1], axis=axes[i]) for i in range(2)]
    (folder / "upright.urdf").write_text(chains.robot(*parts))
    plant = Plant(folder / "upright.urdf", np.full(2, 0.1), np.full(2, 0.05), np.full(2, 0.01))
    rng = np.random.default_rng(33)
    made = [record(plant, f"{i}.csv", rng, 10.0, 0.003) for i in range(3)]
    still = np.zeros(made[0].q.shape)
    return as_set(plant, [replace(r, tau=r.tau - plant.load(r.q, still, still)) for r in made])


LAWS = (Concealed("parallel_spring", 3.0), Concealed("quadratic_drag", 3.0))
CASES = {
    "gravity": Known("efforts without gravity, light links", "missing_gravity", _of(without_gravity, named("missing_gravity"))),
    "payload": Known(
        "a payload's mass and centre, three joints",
        "payload_mass and payload_com rather than one effect that equals both",
        _of(concealed("payload", "arm3", *PAIR), named("payload_mass", "payload_com")),
    ),
    "laws": Known(
        "a spring and quadratic drag, one joint",
        "both laws rather than a series that explains more than each",
        _of(concealed("laws", "arm1", *LAWS), named("parallel_spring", "quadratic_drag")),
    ),
    "faint-friction": Known(
        "friction over position of 1.2 % of the torque under noise of 5 %",
        "position_dependent_friction rather than a series",
        _of(faint_friction, one_named("position_dependent_friction")),
    ),
    "few-cycles": Known("a ripple of 1 to 2 cycles", "torque_ripple with its order", _of(ripple_of_few_cycles, right_ripple)),
    "bump": Known("a bump over position", "a torque over position, no ripples", _of(bump, right_bump)),
    "cushion": Known("a cushion at the end of a range", "a torque that begins there", _of(cushion, right_cushion)),
    "preload": Known(
        "a listed spring with another preload, upright axis",
        "spring_preload, equal to encoder_offset",
        _of(preloaded_spring, right_preload),
    ),
    "sticking": Known("nothing; dry friction holds the joint", "nothing", _of(sticking, named())),
    "asymmetry": Known(
        "friction larger in one direction, noise 20 %", "coulomb_asymmetry", _of(asymmetric, one_named("coulomb_asymmetry"))
    ),
    "stiffer": Known(
        "a listed spring that is stiffer in two recordings",
        "spring_stiffness there, a second spring as a rival",
        _of(stiffer_spring, right_stiffness),
    ),
    **{
        f"engaged-{seconds:g}": Known(
            f"a spring that is always engaged, in every other recording of {seconds:g} s",
            "parallel_spring there, a harness as a rival",
            _of(partial(engaged_spring, seconds), right_spring),
        )
        for seconds in (6.0, 10.0)
    },
    **{
        f"one-way-{words}": Known(
            f"a pull over position while the joint moves {words}",
            "a torque over position in this direction",
            _of(partial(one_way, way), partial(right_direction, way)),
        )
        for way, words in ((1, "upwards"), (-1, "downwards"))
    },
    "sloshing": Known("a payload that sloshes, three joints", "nothing but an echo of the load at its frequency", sloshing),
    "servo": Known(
        "a real servo, `xl330_pendulum`", "load_dependent_friction first, in all recordings", _of(servo, right_servo)
    ),
    **{
        f"width-{begin:g}": Known(
            f"friction that changes sign over 0.05 rad/s, fitted from {begin:g}",
            "0.05 rad/s, an asymmetry of 2 Nm",
            partial(width_from, begin),
        )
        for begin in (0.01, 0.1)
    },
}


# --- command line ---


def _judge(name: str, folder: Path, longest: int) -> None:
    """In a process of its own: judge a case and write what came out."""
    resource.setrlimit(resource.RLIMIT_CPU, (longest, longest + 10))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    begin = time.process_time()
    found, right = CASES[name].judge(folder)
    write_json(folder / "found.json", {"found": found, "right": bool(right), "processor_s": time.process_time() - begin})


def judged(name: str, out: Path, longest: int) -> None:
    """Write what came out of a case to its file; raises `UserError` where it failed."""
    folder, file = out / name, out / f"{name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "found.json").unlink(missing_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_judge, args=(name, folder, longest))
    process.start()
    process.join()
    if (folder / "found.json").exists():
        result = json.loads((folder / "found.json").read_text())
    elif process.exitcode == -signal.SIGXCPU:
        result = {"found": f"ended after {longest} s", "right": False, "processor_s": float(longest)}
    else:
        raise UserError(f"{name}: its process ended with {process.exitcode}")
    write_json(file, {"case": name, "hidden": CASES[name].hidden, "wanted": CASES[name].wanted} | result)


def table(out: Path) -> str:
    """All cases that are done, in Markdown."""
    done = [json.loads((out / f"{name}.json").read_text()) for name in CASES if (out / f"{name}.json").exists()]
    rows = [
        [r["case"], r["hidden"], r["wanted"], r["found"], "yes" if r["right"] else "no", f"{r['processor_s']:.1f}"]
        for r in done
    ]
    return markdown(["case", "hidden", "wanted", "found", "right", "processor time [s]"], rows)


def main(
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/known_misses"),
    only: Annotated[str, typer.Option(help="part of a case's name")] = "",
    longest: Annotated[int, typer.Option(min=1, help="processor time after which a case is ended [s]")] = 300,
) -> None:
    """Judge the known cases and write known_misses.md and a JSON file of each."""
    names = [name for name in CASES if only in name]
    if not names:
        raise UserError(f"--only is {only!r}; the cases are {', '.join(CASES)}")
    for name in track(names, "cases"):
        Made([out / f"{name}.json"], {"case": name, "longest_s": longest}, MADE_WITH).once(partial(judged, name, out, longest))
        write_text(out / "known_misses.md", table(out))
    print(table(out))


entry = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    entry()
