"""Effects as C inside MuJoCo: code that casadi generates from the effects' own expressions, run as its passive callback.

One library serves every model with the same effects on the same joints. The values (theta, widths) stand in the mjModel
itself, in a custom numeric field whose name is the library's marker, and the payload is the mass of its body `PAYLOAD`; so
models with different values run side by side, in any number of threads. A model without the marker is left alone.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import mujoco
import numpy as np

from rrr_oc.c_library import digest, library
from rrr_oc.effects import Signals
from rrr_oc.errors import UserError
from rrr_oc.model import Model

PAYLOAD = "rrr_oc:payload"
_WRAPPER = """
#include <string.h>
#include <mujoco/mjdata.h>
#include <mujoco/mjmodel.h>

typedef void (*passive)(const mjModel*, mjData*);
__attribute__((visibility("default"))) passive rrr_oc_next = 0;  /* written only under native.py's lock */

static int find(const mjModel* m, const int* address, int count, const char* name) {{
  for (int i = 0; i < count; i++)
    if (!strcmp(m->names + address[i], name)) return i;
  return -1;
}}

static void add_effects(const mjModel* m, mjData* d, const mjtNum* values) {{
  int body = find(m, m->name_bodyadr, (int)m->nbody, "{payload}");
  mjtNum payload = body < 0 ? 0 : m->body_mass[body], tau[{n}], w[{sz_w}];
  long long iw[{sz_iw}];
  const mjtNum* arg[{sz_arg}] = {{d->qpos, d->qvel, &d->time, &payload, values, values + {n_theta}}};
  mjtNum* res[{sz_res}] = {{tau}};
  effects(arg, res, iw, w, 0);
  for (int i = 0; i < {n}; i++) {{
    d->qfrc_spring[i] += tau[i];
    d->qfrc_passive[i] += tau[i];
  }}
}}

__attribute__((visibility("default"))) void rrr_oc_passive(const mjModel* m, mjData* d) {{
  int i = find(m, m->name_numericadr, (int)m->nnumeric, "{marker}");
  if (i >= 0) add_effects(m, d, m->numeric_data + m->numeric_adr[i]);
  if (rrr_oc_next) rrr_oc_next(m, d);
}}
"""


@dataclass(frozen=True)
class Native:
    """The compiled effects of a model.

    Attributes:
        marker: Name of the custom numeric field that holds (theta, widths) in models that want these effects.
        library: The loaded library; it stays loaded.
    """

    marker: str
    library: ctypes.CDLL


def compile_effects(model: Model) -> Native:
    """The link-side effects of a model as a library, from the cache where it has been compiled before.

    The smoothed law, with q, dq and time from mjData. The torques are added to qfrc_passive and to qfrc_spring.

    Raises:
        UserError: There is no C compiler ($CC, cc, gcc or clang), it fails, or the cache cannot be written.
    """
    function = _torque(model)
    generator = ca.CodeGenerator("effects", {"with_header": False})
    generator.add(function)
    code = generator.dump()
    flags = ("-O2", f"-I{Path(str(mujoco.__file__)).parent / 'include'}")
    name = digest(code, _WRAPPER, mujoco.__version__, *flags)
    marker = f"rrr_oc:{name}"
    sizes = {k: max(1, getattr(function, k)()) for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    wrapper = _WRAPPER.format(marker=marker, payload=PAYLOAD, n=model.robot.n, n_theta=len(model.parameters), **sizes)
    return Native(marker, _load(library(f"effects-{name}", code + wrapper, flags, " or use effects='native'")))


@contextmanager
def installed(*libraries: Native) -> Iterator[None]:
    """MuJoCo's passive callback runs the libraries within this context, and is what it was before after it.

    Contexts nest, and libraries of different models run beside each other and beside a C callback that was there before.

    Raises:
        UserError: A Python callback is installed: C code cannot pass a model on to it.
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
_active: list[Native] = []
_before: list[Any] = [None]


def _add(libraries: tuple[Native, ...]) -> None:
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
    """Each active library calls the next one, the last one the callback that was there before."""
    chain = list(dict.fromkeys(_active))
    functions = [*(native.library.rrr_oc_passive for native in chain), _before[0]]
    for native, following in zip(chain, functions[1:], strict=True):
        _set_next(native, following)
    mujoco.set_mjcb_passive(functions[0])


def _set_next(native: Native, function: Any) -> None:
    address = None if function is None else ctypes.cast(function, ctypes.c_void_p).value
    ctypes.c_void_p.in_dll(native.library, "rrr_oc_next").value = address


def _torque(model: Model) -> ca.Function:
    """(q, dq, time, payload, theta, widths) -> torque of all link-side effects (n,) [Nm], dense."""
    n = model.robot.n
    q, dq, time, payload = ca.SX.sym("q", n), ca.SX.sym("dq", n), ca.SX.sym("time"), ca.SX.sym("payload")
    theta, widths = ca.SX.sym("theta", len(model.parameters)), ca.SX.sym("widths", len(model.widths))
    torques = model.effect_torques(Signals(q, dq, time=time, payload=payload), theta, widths)
    total = sum((t for e, t in zip(model.effects, torques, strict=True) if e.side == "link"), ca.SX.zeros(n))
    return ca.Function("effects", [q, dq, time, payload, theta, widths], [ca.densify(total)])


@cache
def _load(path: Path) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise UserError(f"{path} is not a usable library ({error}); delete it and it will be compiled anew") from None
    library.rrr_oc_passive.restype = None
    return library


def values(theta: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """What the marker's numeric field holds; the last number means nothing, as MuJoCo refuses an empty field."""
    return np.concatenate([theta, widths, [0.0]])
