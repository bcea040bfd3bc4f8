"""Many independent calls at once, on all cores."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, cast

import joblib

from rrr_oc.errors import UserError


def check_jobs(jobs: int) -> None:
    """Raise `UserError` where `jobs` is no number of processes."""
    if jobs == 0 or jobs < -1:
        raise UserError(f"--jobs is {jobs}; allowed are 1 or more, and -1 for all cores")


def unordered(function: Callable, arguments: Iterable[Sequence[Any]], jobs: int = -1) -> Iterator[Any]:
    """Results of `function(*a)` for each a in `arguments`, as they come, from `jobs` processes (-1: one a core)."""
    pool = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=cast(Any, 1))
    return cast(Iterator[Any], pool(joblib.delayed(function)(*a) for a in arguments))


def ordered(function: Callable, arguments: Iterable[Sequence[Any]], jobs: int = -1) -> list[Any]:
    """The same, in the order of the arguments."""
    pool = joblib.Parallel(n_jobs=jobs, batch_size=cast(Any, 1))
    return cast(list[Any], pool(joblib.delayed(function)(*a) for a in arguments))
