"""Many independent calls at once, on the cores of this machine or on a Dask cluster.

A program says where its calls run, once, by `with workers(jobs, where)`; the functions that make them, `ordered` and `unordered`,
take no such argument, and what they compute does not depend on it. Outside of `workers` they run one after the other.
"""

import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from threading import Thread
from typing import Any, TypeVar, cast

from rrr_oc.errors import UserError

_T = TypeVar("_T")
LOCAL = "local"
SCHEDULER_TIMEOUT = 30.0  # [s] after which a scheduler that does not answer is an error; doubled, a wrong address takes longer
DEATHS = 3  # of worker processes with no call done between them, from which on a call is taken to be what kills them
WATCH = 1.0  # [s] between two looks of a worker process whether its program still runs; doubled, it may outlive it by as much
KEPT = 6  # values of `once_per_process`; doubled, work of many kinds in turn is faster and takes more memory
_made: dict[str, Any] = {}  # what `once_per_process` keeps in this process, that asked for last at the end


@contextmanager
def workers(jobs: int = -1, where: str = LOCAL) -> Iterator[None]:
    """Run `ordered` and `unordered` on `jobs` processes of this machine (-1: one a core), or on the Dask cluster of the scheduler at
    the address `where`, as in tcp://host:8786, whose workers need this package and the same file system.

    Raises `UserError` for an unusable number, and where Dask is not installed, no scheduler answers or its workers die.
    """
    if jobs == 0 or jobs < -1:
        raise UserError(f"--jobs is {jobs}; allowed are 1 or more, and -1 for all cores")
    import joblib  # here and below, since it takes a moment, and help needs none of it

    # Ctrl-C abandons calls that still run, as it should; joblib warns of the work that is lost.
    warnings.filterwarnings("ignore", ".*You could benefit from adjusting the input task", UserWarning)
    if where == LOCAL:
        with joblib.parallel_config("loky", n_jobs=jobs, initializer=_end_with, initargs=(os.getpid(),)):
            yield
        return
    try:
        from dask.distributed import Client, KilledWorker
    except ImportError:
        raise UserError("a Dask cluster needs two more packages: pip install dask distributed") from None
    try:
        client = Client(where, timeout=SCHEDULER_TIMEOUT)
    except (OSError, ValueError) as error:
        address = "give 'local' or an address as tcp://host:8786"
        raise UserError(f"no Dask scheduler answers at {where!r} ({error}); {address}") from None
    try:
        with client, joblib.parallel_config(backend="dask"):
            yield
    except KilledWorker as error:
        raise UserError(
            f"workers of the cluster at {where!r} ended while they worked, as for want of memory: {error}"
        ) from None


def unordered(function: Callable, arguments: Iterable[Sequence[Any]]) -> Iterator[Any]:
    """Results of `function(*a)` for each a in `arguments`, in the order in which they finish."""
    for _, found in _numbered(function, arguments):
        yield found


def ordered(function: Callable, arguments: Iterable[Sequence[Any]]) -> list[Any]:
    """Results of `function(*a)` for each a in `arguments`, in their order."""
    found = dict(_numbered(function, arguments))
    return [found[i] for i in range(len(found))]


def _numbered(function: Callable, arguments: Iterable[Sequence[Any]]) -> Iterator[tuple[int, Any]]:
    """(number, result) of each call as it finishes. Calls that were lost with a worker process are made again."""
    import joblib

    left, deaths = dict(enumerate(arguments)), 0
    if len(left) == 1:
        yield _call(0, function, left[0])
        return
    while left:
        pool = joblib.Parallel(return_as="generator_unordered", batch_size=cast(Any, 1))
        calls = [joblib.delayed(_call)(number, function, a) for number, a in left.items()]
        try:
            for number, found in cast(Iterator[Any], pool(calls)):
                del left[number]
                deaths = 0
                yield number, found
        except BrokenExecutor:
            deaths += 1
            if deaths == DEATHS:
                reason = f"worker processes ended {DEATHS} times before they were done, as for want of memory"
                raise UserError(f"{reason}; fewer --jobs need less") from None


def _call(number: int, function: Callable, arguments: Sequence[Any]) -> tuple[int, Any]:
    """One call, while other processes use the other cores."""
    import joblib

    with one_thread(), joblib.parallel_config(backend="sequential"):
        return number, function(*arguments)


def _end_with(program: int) -> None:
    """Have this new worker process end when its program, a process number, was killed; by itself it would wait for calls for minutes."""

    def watch() -> None:
        while os.getppid() == program:
            time.sleep(WATCH)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra (BLAS) on one thread of this process: on matrices of some hundred columns, more threads mostly wait."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


def once_per_process(key: str, make: Callable[[], _T]) -> _T:
    """The value of `make`, computed once in each process for a key and kept until `KEPT` other keys were asked for since. Keys must be
    unique to the work, as those of uuid4 are, because worker processes outlive it."""
    if key not in _made:
        while len(_made) >= KEPT:
            del _made[next(iter(_made))]
        _made[key] = make()
    _made[key] = _made.pop(key)  # the last that was asked for is the last to go
    return _made[key]
