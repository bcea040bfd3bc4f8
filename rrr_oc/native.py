"""Effects as C inside MuJoCo: code that casadi generates from the effects' own expressions, run as its passive callback.

One library serves every model with the same effects on the same joints. The values (theta, widths) stand in the mjModel
itself, in a custom numeric field whose name is the library's marker, and the payload is the mass of its body `PAYLOAD`; so
models with different values run side by side, in any number of threads. A model without the marker is left alone.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
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

from rrr_oc.effects import Signals
from rrr_oc.errors import UserError
from rrr_oc.model import Model

PAYLOAD = "rrr_oc:payload"
_FLAGS = ("-O2", "-fPIC", "-shared", "-fvisibility=hidden")
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
    key = "\0".join([code, _WRAPPER, mujoco.__version__, platform.system(), platform.machine(), *_FLAGS])
    digest = hashlib.sha256(key.encode()).hexdigest()[:24]
    marker = f"rrr_oc:{digest}"
    path = cache_folder() / f"effects-{digest}.so"
    if not path.is_file():
        sizes = {k: max(1, getattr(function, k)()) for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
        wrapper = _WRAPPER.format(marker=marker, payload=PAYLOAD, n=model.robot.n, n_theta=len(model.parameters), **sizes)
        _compile(_compiler(), code + wrapper, path)
    return Native(marker, _load(path))


def cache_folder() -> Path:
    """Where compiled effects are kept: `rrr_oc` in $XDG_CACHE_HOME (if that is an absolute path) or in ~/.cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".cache") / "rrr_oc"


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


def _compiler() -> tuple[str, ...]:
    chosen = os.environ.get("CC")
    for command in [shlex.split(chosen)] if chosen else [["cc"], ["gcc"], ["clang"]]:
        if command and shutil.which(command[0]):
            return tuple(command)
    tried = f"$CC = {chosen!r} is not on PATH" if chosen else "none of cc, gcc, clang is on PATH"
    raise UserError(f"effects='generated' needs a C compiler, but {tried}; install one or use effects='native'")


def _compile(command: tuple[str, ...], source: str, path: Path) -> None:
    headers = Path(str(mujoco.__file__)).parent / "include"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            code, library = Path(folder) / "effects.c", Path(folder) / "effects.so"
            code.write_text(source)
            line = [*command, *_FLAGS, f"-I{headers}", str(code), "-o", str(library), "-lm"]
            done = subprocess.run(line, capture_output=True, text=True)
            if done.returncode:
                raise UserError(f"{shlex.join(command)} cannot compile the effects: {done.stderr.strip()[:600]}")
            os.replace(library, path)
    except OSError as error:
        raise UserError(f"cannot keep compiled effects in {path.parent}: {error}; XDG_CACHE_HOME chooses another") from None


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
