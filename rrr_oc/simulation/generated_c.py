"""Effects as C inside MuJoCo: code that casadi generates from the effects' own expressions, run as its passive callback.

One library serves every model with the same effects on the same joints. The values (theta, widths, …) stand in the mjModel
itself, in a custom numeric field whose name is the library's marker, and the payload is the mass of its body `PAYLOAD`; so
models with different values run side by side, in any number of threads. A model without the marker is not changed.

The callback runs at every evaluation of the dynamics, so at every stage of RK4, before the engine knows accelerations. Effects
that depend on them or on the load torque need them: the code solves the equations of motion for them, with the actuators' torque
and the friction and armature of the joints in the engine; behind an elastic gear it uses the accelerations of one step before.
Internal states are activations of actuators without force; the callback sets their controls, which are the states' rates.

Without a C compiler the callback is one of Python, and CasADi's virtual machine evaluates the same expressions: some 50 times slower.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import ctypes
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, cast

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.compiler import available, digest, library
from rrr_oc.effects import MotionShift, Signals, WithStates
from rrr_oc.errors import UserError
from rrr_oc.model.parameters import offsets
from rrr_oc.model.symbolic_model import Model

PAYLOAD = "rrr_oc:payload"
STIFF = 0.5  # share of a state that decays in a step, above which the step is exponential instead of explicit; at 2 it diverges
NEWTON_STEPS = 4  # for the load torque; the load's signs are right after two
_WRAPPER = """
#include <string.h>
#include <mujoco/mjdata.h>
#include <mujoco/mjmodel.h>

typedef void (*passive)(const mjModel*, mjData*);
__attribute__((visibility("default"))) passive rrr_oc_next = 0;  /* written only under the lock of generated_c.py */

static int find(const mjModel* m, const int* address, int count, const char* name) {{
  for (int i = 0; i < count; i++)
    if (!strcmp(m->names + address[i], name)) return i;
  return -1;
}}

static void add_effects(const mjModel* m, mjData* d, const mjtNum* values) {{
  const mjtNum *widths = values + {n_theta}, *extra = widths + {n_widths}, *inertial = extra + 1;
  int body = find(m, m->name_bodyadr, (int)m->nbody, "{payload}");
  mjtNum payload = body < 0 ? 0 : m->body_mass[body] - *extra, motor[{n}], link[{n}], drive[{n}], rate[{n_states} + 1], w[{sz_w}];
  mjtNum q[{n}], dq[{n}], twist[2 * {n}], before[2 * {n}], damping[{n}], armature[{n}], dry[{n}];
  long long iw[{sz_iw}];
  int at[{n}], gear[{n}];
  for (int i = 0; i < {n}; i++) {{  /* actuators of engine_model.py: activation, position and speed feedback, limits */
    int joint = m->actuator_trnid[2 * i], k = at[i] = m->jnt_dofadr[joint];
    gear[i] = joint + 1 < m->njnt && m->jnt_bodyid[joint + 1] == m->jnt_bodyid[joint];  /* the joint's twist comes next */
    q[i] = d->qpos[k], dq[i] = d->qvel[k], before[i] = d->qacc_warmstart[k];
    twist[i] = gear[i] ? d->qpos[k + 1] : 0, twist[{n} + i] = gear[i] ? d->qvel[k + 1] : 0;
    before[{n} + i] = gear[i] ? d->qacc_warmstart[k + 1] : 0;
    damping[i] = m->dof_damping[k], armature[i] = m->dof_armature[k], dry[i] = m->dof_frictionloss[k];
    const mjtNum *bias = m->actuator_biasprm + i * mjNBIAS, *range = m->actuator_forcerange + 2 * i;
    motor[i] = d->act[i] + bias[1] * q[i] + bias[2] * dq[i];
    if (m->actuator_forcelimited[i]) motor[i] = motor[i] < range[0] ? range[0] : motor[i] > range[1] ? range[1] : motor[i];
  }}
  const mjtNum* arg[{sz_arg}] = {{q, dq, &d->time, &m->opt.timestep, &payload, motor, d->act + {n}, damping, armature, dry,
                                twist, before, values, widths, inertial}};
  mjtNum* res[{sz_res}] = {{link, drive, rate}};
  effects(arg, res, iw, w, 0);
  for (int i = 0; i < {n}; i++) {{
    d->qfrc_damper[at[i]] += drive[i];
    d->qfrc_passive[at[i]] += drive[i];
    for (int k = at[i]; k <= at[i] + gear[i]; k++) {{
      d->qfrc_spring[k] += link[i];
      d->qfrc_passive[k] += link[i];
    }}
  }}
  for (int i = 0; i < {n_states}; i++) d->ctrl[{n} + i] = rate[i];
}}

__attribute__((visibility("default"))) void rrr_oc_passive(const mjModel* m, mjData* d) {{
  int i = find(m, m->name_numericadr, (int)m->nnumeric, "{marker}");
  if (i >= 0) add_effects(m, d, m->numeric_data + m->numeric_adr[i]);
  if (rrr_oc_next) rrr_oc_next(m, d);
}}
"""


@dataclass(frozen=True)
class EffectLibrary:
    """The compiled effects of a model.

    Attributes:
        marker: Name of the custom numeric field that holds the effects' values in models with these effects.
        library: The loaded library, which stays loaded; None without a C compiler, where
        law: is evaluated instead, see `law`.
        sizes: Numbers of parameters and of widths.
    """

    marker: str
    library: ctypes.CDLL | None = field(compare=False)
    law: ca.Function = field(compare=False)
    sizes: tuple[int, int] = field(compare=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, compare=False, repr=False)

    @cached_property
    def _buffers(self) -> tuple[list[np.ndarray], list[np.ndarray], Callable[[], None], Any]:
        """Arguments and results of the law, what evaluates it with them, and what keeps them: a call takes a microsecond so."""
        buffer, run = cast(Any, self.law.buffer())
        given = [np.zeros(max(1, self.law.nnz_in(i))) for i in range(self.law.n_in())]
        found = [np.zeros(max(1, self.law.nnz_out(i))) for i in range(self.law.n_out())]
        for i, array in enumerate(given):
            buffer.set_arg(i, memoryview(cast(Any, array)))
        for i, array in enumerate(found):
            buffer.set_res(i, memoryview(cast(Any, array)))
        return given, found, run, buffer

    def add(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """What `add_effects` of `_WRAPPER` does, evaluated by CasADi: slower."""
        at = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, self.marker)
        if at < 0:
            return
        n, values = self.law.size1_in(0), m.numeric_data[m.numeric_adr[at] :]
        body, extra = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, PAYLOAD), sum(self.sizes)
        payload = 0.0 if body < 0 else m.body_mass[body] - values[extra]
        joints = m.actuator_trnid[:n, 0]
        k, following = m.jnt_dofadr[joints], np.minimum(joints + 1, m.njnt - 1)
        gear = (following > joints) & (m.jnt_bodyid[following] == m.jnt_bodyid[joints])
        beyond = k + gear
        q, dq, bias = d.qpos[k], d.qvel[k], m.actuator_biasprm[:n]
        motor = d.act[:n] + bias[:, 1] * q + bias[:, 2] * dq
        limits = m.actuator_forcerange[:n].T
        motor = np.where(m.actuator_forcelimited[:n], np.minimum(np.maximum(motor, limits[0]), limits[1]), motor)
        twist = (x[beyond] * gear for x in (d.qpos, d.qvel, d.qacc_warmstart))
        angle, speed, acceleration = twist
        joint = (m.dof_damping[k], m.dof_armature[k], m.dof_frictionloss[k])
        states = (np.r_[angle, speed], np.r_[d.qacc_warmstart[k], acceleration])
        numbers = (values[: self.sizes[0]], values[self.sizes[0] : extra], values[extra + 1 : extra + 1 + 10 * n])
        with self._lock:  # threads may take turns within
            given, found, run, _ = self._buffers
            for array, value in zip(
                given, (q, dq, d.time, m.opt.timestep, payload, motor, d.act[n:], *joint, *states, *numbers), strict=True
            ):
                if np.size(value):
                    array[:] = value
            run()
            link, drive, rates = (x.copy() for x in found)
        d.qfrc_damper[k] += drive
        d.qfrc_passive[k] += drive
        for where, torque in ((k, link), (beyond[gear], link[gear])):
            d.qfrc_spring[where] += torque
            d.qfrc_passive[where] += torque
        if m.nu > n:
            d.ctrl[n : n + len(rates)] = rates


def compile_effects(model: Model, inside: Sequence[bool] | None = None) -> EffectLibrary:
    """Effects of a model as a library, from the cache where it has been compiled before; without a C compiler as CasADi evaluates them.

    The smoothed laws, with q, dq and time from mjData. Torques on the links are added to qfrc_passive and qfrc_spring, those in
    the drives to qfrc_passive and qfrc_damper.

    Args:
        inside: Which of the effects, of the sides "link" and "drive", the library has. Default: those on the links.

    Raises:
        UserError: $CC is no compiler, the compiler fails, or the cache cannot be written.
    """
    function = law(model, [e.side == "link" for e in model.effects] if inside is None else inside)
    generator = ca.CodeGenerator("effects", {"with_header": False})
    generator.add(function)
    code = generator.dump()
    flags = ("-O2", f"-I{Path(str(mujoco.__file__)).parent / 'include'}")
    name = digest(code, _WRAPPER, mujoco.__version__, *flags)
    marker = f"rrr_oc:{name}"
    counts = len(model.parameters), len(model.widths)
    if not available():
        return EffectLibrary(marker, None, function, counts)
    sizes = {k: max(1, getattr(function, k)()) for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    sizes |= {"n_theta": len(model.parameters), "n_widths": len(model.widths), "n_states": len(model.states)}
    wrapper = _WRAPPER.format(marker=marker, payload=PAYLOAD, n=model.robot.n, **sizes)
    return EffectLibrary(marker, _load(library(f"effects-{name}", code + wrapper, flags)), function, counts)


@contextmanager
def installed(*libraries: EffectLibrary) -> Iterator[None]:
    """Within this context MuJoCo's passive callback runs the libraries, or what CasADi evaluates; after it, the callback is restored.

    Contexts nest; libraries of different models run beside each other and beside a C callback that was installed before.

    Raises:
        UserError: A Python callback is installed, which C code cannot call.
    """
    with _lock:
        _add(libraries)
    try:
        yield
    finally:
        with _lock:
            for library in libraries:
                _active.remove(library)
            _link()
            for library in set(libraries).difference(_active):
                _set_next(library, None)


_lock = threading.Lock()
_active: list[EffectLibrary] = []
_before: list[Any] = [None]


def _add(libraries: tuple[EffectLibrary, ...]) -> None:
    if not _active:
        before = mujoco.get_mjcb_passive()
        if before is not None and not isinstance(before, ctypes._CFuncPtr):
            raise UserError(
                f"MuJoCo's passive callback is a Python function, {before!r}; remove it with set_mjcb_passive(None)"
            )
        _before[0] = before
    _active.extend(libraries)
    _link()


def _link() -> None:
    """Each active library calls the next one, the last one the callback that was installed before; laws that are evaluated come first."""
    chain = list(dict.fromkeys(_active))
    compiled = [one for one in chain if one.library is not None]
    functions = [*(one.library.rrr_oc_passive for one in compiled if one.library is not None), _before[0]]
    for one, following in zip(compiled, functions[1:], strict=True):
        _set_next(one, following)
    evaluated = [one for one in chain if one.library is None]
    mujoco.set_mjcb_passive(_evaluating(evaluated, functions[0]) if evaluated else functions[0])


def _evaluating(laws: Sequence[EffectLibrary], following: Any) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """A callback that adds the laws, and calls the function of C that follows."""

    def passive(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        for one in laws:
            one.add(m, d)
        if following is not None:
            following(ctypes.c_void_p(m._address), ctypes.c_void_p(d._address))

    return passive


def _set_next(one: EffectLibrary, function: Any) -> None:
    if one.library is not None:
        address = None if function is None else ctypes.cast(function, ctypes.c_void_p).value
        ctypes.c_void_p.in_dll(one.library, "rrr_oc_next").value = address


def law(model: Model, inside: Sequence[bool]) -> ca.Function:
    """The function that the library evaluates, dense.

    (q, dq, time, step, payload, motor, states, damping, armature, frictionloss, twist, before, theta, widths, inertial) -> (link, drive,
    rates): torque of the chosen effects on the links (n,) and in the drives (n,) [Nm], and rates of all internal states. `motor` is
    the actuators' torque [Nm], `damping`, `armature` and `frictionloss` the joints' own in the engine, each (n,), `twist` (2 n,)
    positions and speeds of links less those of their drives, `before` (2 n,) accelerations one step before, of the drives and of the
    links less those: behind an elastic gear the equations of motion of the links do not give the drives'. A state that decays at a rate
    s of its own does so as exp(−s step) over the engine's `step` [s] where that is fast: its explicit step would diverge.
    """
    n = model.robot.n
    q, dq, motor, damping, armature, dry = (
        ca.SX.sym(k, n) for k in ("q", "dq", "motor", "damping", "armature", "frictionloss")
    )
    time, step, payload = ca.SX.sym("time"), ca.SX.sym("step"), ca.SX.sym("payload")
    states = ca.SX.sym("states", len(model.states))
    theta, widths = ca.SX.sym("theta", len(model.parameters)), ca.SX.sym("widths", len(model.widths))
    inertial, ddq, load = ca.SX.sym("inertial", 10, n), ca.SX.sym("ddq", n), ca.SX.sym("load", n)
    twist, before = ca.SX.sym("twist", 2 * n), ca.SX.sym("before", 2 * n)
    signals = Signals(q, dq, ddq, load=load, time=time, payload=payload, states=states)
    links = replace(signals, q=q + shift(model, theta) + twist[:n], dq=dq + twist[n:])

    def total(side: str, at: Signals, chosen: Sequence[bool]) -> ca.SX:
        torques = zip(model.effects, chosen, model.effect_torques(at, theta, widths), strict=True)
        return sum((t for e, yes, t in torques if yes and e.side == side), ca.SX.zeros(n))

    link, drive = total("link", links, inside), total("drive", signals, inside)
    stateful = (one for one in model.with_signals(signals, theta, widths) if isinstance(one[0], WithStates))
    rates = ca.vertcat(*(r for e, s, named, width in stateful for r in e.rate(s, named, width)))
    if model.states:
        fading = ca.fmax(-step * ca.diag(ca.jacobian(rates, states)), 1e-9)
        rates = ca.if_else(fading > STIFF, rates * (1 - ca.exp(-fading)) / fading, rates)
    if any(ca.depends_on(x, y) for x in (link, drive, rates) for y in (load, ddq)):
        carried, gravity = model.rigid(inertial, payload, theta, widths)
        bias = model.body.inverse_dynamics(links.q, links.dq, ca.SX.zeros(n), carried, gravity)
        own = -damping * dq - dry * ca.sign(dq) - armature * ddq
        mass = model.body.mass_matrix(links.q, carried)
        # the engine's own springs too
        needed = mass @ ddq + bias - total("link", links, [True] * len(inside))
        if any(e.moves_link for e in model.effects):
            of_drives, of_links = before[:n], before[:n] + before[n:]
        else:
            of_drives = of_links = _root(needed - motor - ca.substitute(drive + own, load, needed), ddq)
        carrying = ca.substitute(needed, ddq, of_links)
        link = ca.substitute(link, ddq, of_links)
        drive, rates = (ca.substitute(x, ca.vertcat(load, ddq), ca.vertcat(carrying, of_drives)) for x in (drive, rates))
    arguments = [q, dq, time, step, payload, motor, states, damping, armature, dry, twist, before, theta, widths, inertial]
    return ca.Function("effects", arguments, [ca.densify(link), ca.densify(drive), ca.densify(rates)])


def _root(residual: ca.SX, x: ca.SX) -> ca.SX:
    """The x where a residual vanishes, by Newton's method: in one step for friction in |load| once the load's signs are right."""
    step, found = x - ca.solve(ca.jacobian(residual, x), residual), ca.SX.zeros(x.shape)
    for _ in range(NEWTON_STEPS):
        found = ca.substitute(step, x, found)
    return found


def shift(model: Model, theta) -> ca.SX:
    """Position of the links less that of their encoders, without elastic gears, (n,) [rad]."""
    result = ca.SX.zeros(model.robot.n)
    for effect, first in zip(model.effects, offsets(model.effects), strict=False):
        named = {p.name: theta[first + k] for k, p in enumerate(effect.parameters)}
        if isinstance(effect, MotionShift):
            for j, value in zip(effect.joints, effect.shift(Signals(ca.SX.zeros(model.robot.n)), named, None), strict=True):
                result[j] += value
    return result


@cache
def _load(path: Path) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise UserError(f"{path} is not a usable library ({error}); delete it and it will be compiled anew") from None
    library.rrr_oc_passive.restype = None
    return library


def values(theta: np.ndarray, widths: np.ndarray, extra_mass: float, inertial: np.ndarray) -> np.ndarray:
    """Content of the marker's numeric field; `extra_mass` is that of `PAYLOAD` beyond the listed payload [kg], `inertial` (10, n)."""
    return np.concatenate([theta, widths, [extra_mass], np.asarray(inertial).reshape(-1, order="F")])
