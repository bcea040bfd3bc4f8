"""Many independent calls at once, on all cores of this machine or on a Dask cluster."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import joblib
from threadpoolctl import threadpool_limits

from rrr_oc.errors import UserError

_T = TypeVar("_T")
LOCAL = "local"
SCHEDULER_TIMEOUT = 30.0  # [s] after which a scheduler that does not answer is an error; doubled, a wrong address takes longer
_made: dict[str, Any] = {}  # the one value of this process that `once_per_process` keeps


def check_jobs(jobs: int) -> None:
    """Raise `UserError` unless `jobs` is a positive number of processes, or -1."""
    if jobs == 0 or jobs < -1:
        raise UserError(f"--jobs is {jobs}; allowed are 1 or more, and -1 for all cores")


def unordered(function: Callable, arguments: Iterable[Sequence[Any]], jobs: int = -1) -> Iterator[Any]:
    """Results of `function(*a)` for each a in `arguments`, in the order in which they finish, from `jobs` processes (-1: one a core)."""
    pool = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=cast(Any, 1))
    return cast(Iterator[Any], pool(joblib.delayed(_on_one_thread)(function, a) for a in arguments))


def ordered(function: Callable, arguments: Iterable[Sequence[Any]], jobs: int = -1) -> list[Any]:
    """Results of `function(*a)` for each a in `arguments`, in their order, from `jobs` processes (-1: one a core)."""
    pool = joblib.Parallel(n_jobs=jobs, batch_size=cast(Any, 1))
    return cast(list[Any], pool(joblib.delayed(_on_one_thread)(function, a) for a in arguments))


def _on_one_thread(function: Callable, arguments: Sequence[Any]) -> Any:
    """The call, while other processes use the other cores."""
    with one_thread():
        return function(*arguments)


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra (BLAS) on one thread of this process: on matrices of some hundred columns, more threads mostly wait."""
    with threadpool_limits(1, user_api="blas"):
        yield


def once_per_process(key: str, make: Callable[[], _T]) -> _T:
    """The value of `make`, computed once in each process for a key and kept until another key is asked for. Keys must be unique to
    the work, as those of uuid4 are, because worker processes outlive it."""
    if key not in _made:
        _made.clear()
        _made[key] = make()
    return _made[key]


@contextmanager
def workers(where: str = LOCAL) -> Iterator[None]:
    """Run `ordered` and `unordered` on processes of this machine ("local"), or on the Dask cluster of the scheduler at the address
    `where`, as in tcp://host:8786, whose workers need this package and the same file system.

    Raises `UserError` where Dask is not installed or no scheduler answers.
    """
    if where == LOCAL:
        yield
        return
    try:
        from dask.distributed import Client
    except ImportError:
        raise UserError("a Dask cluster needs the package distributed: pip install 'rrr_oc[cluster]'") from None
    try:
        client = Client(where, timeout=SCHEDULER_TIMEOUT)
    except (OSError, ValueError) as error:
        address = "give 'local' or an address as tcp://host:8786"
        raise UserError(f"no Dask scheduler answers at {where!r} ({error}); {address}") from None
    with client, joblib.parallel_config(backend="dask"):
        yield
