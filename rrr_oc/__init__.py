"""Optimal control and system identification of robot arms with elastic actuation.

In Python: `load`, `calibrate`, `diagnose`, `design`, `simulate`, `export` and `compare` (docs/python.md). They are imported when they are first
used, so that `import rrr_oc` takes no time.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rrr_oc.python import calibrate, compare, design, diagnose, export, load, simulate

__version__ = "0.1.0"
__all__ = ["__version__", "calibrate", "compare", "design", "diagnose", "export", "load", "simulate"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from rrr_oc import python

        return getattr(python, name)
    raise AttributeError(f"module 'rrr_oc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
