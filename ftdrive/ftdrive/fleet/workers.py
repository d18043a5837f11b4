"""Processes of this computer, or the workers of a Dask cluster: both take calls and give futures."""

import logging
import os
import re
import signal
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any, Final

from ftcalib.errors import FtdriveError
from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrivers.errors import StreamBroken, Unreachable
from ftdrivers.installation import missing_extra

# For a scheduler to answer, and for its first worker.
CONNECT_S: Final = 10.0
# Without an answer, before the workers are counted again.
CHECK_S: Final = 5.0
# Packages whose versions a cluster must share, because the last digits depend on them.
SAME: Final = ("ftdrive", "numpy", "scipy")

# More threads than cores are slow, and their number can change the last digits.
# One BLAS thread also for one worker, so that all bytes are equal.
_ONE_THREAD: Final = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
_LOGS: Final = ("distributed", "distributed.client", "tornado.application")
# Messages that a client keeps for developers of Dask: 1000 by default, with their datasets 130 MB.
_SHORT_LOG: Final = {"distributed.admin.low-level-log-length": 10}
# A recording of 40 s at 1 kHz exceeds the default, and its warning means nothing to a user.
_LARGE_CALLS: Final = {"distributed.admin.large-graph-warning-threshold": "1TB"}
_DIED: Final = "each worker that was given it died: `ftdrive solve` may show the cause"

# What a call returned or raised.
Answer = bytes | BaseException
# A function and its arguments.
Call = tuple[Callable[..., bytes], *tuple[Any, ...]]


class WorkerDied(FtdriveError):
    """Each worker that was given this call ended without an answer."""


class OtherVersion(ConfigError):
    """A worker has another version of ftdrive than the computer that calls it."""


def require_version(version: str) -> None:
    """Raise `OtherVersion`, in a worker, unless it has this version of ftdrive."""
    if version != __version__:
        raise OtherVersion(
            f"a worker has ftdrive {__version__}, but this computer has ftdrive {version}: install the same version on "
            "both"
        )


def folder_of_worker() -> str | None:
    """Return the folder of a Dask worker, which Dask removes also if the worker was killed; None elsewhere."""
    try:
        from distributed import get_worker

        return str(get_worker().local_directory)
    except (ImportError, ValueError):
        return None


def describe_error(error: BaseException) -> str:
    """Return why a call failed."""
    expected = isinstance(error, FtdriveError | OSError)
    return str(error) if expected else f"unexpected {type(error).__name__}: {error}"


@dataclass(frozen=True, slots=True)
class Workers:
    """Where calls run at once."""

    count: int
    submit: Callable[..., "Future[bytes]"]
    """Takes a function and its arguments."""
    death: type[Exception]
    """Exception of a future whose worker ended without an answer."""
    share_files: bool = False
    """Whether a path means the same file to each worker."""
    require_one: Callable[[], None] = lambda: None
    """Raises `StreamBroken` if none is left, so that no call would ever be answered."""


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Workers]:
    """Start processes, by default one for each core that this program may use; they end with the context, at once."""
    if count is None:
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    context = get_context("spawn")  # a fork would copy threads, and numpy with its threads
    lifeline, ours = context.Pipe(duplex=False)
    new_pool = partial(ProcessPoolExecutor, count, context, _begin_worker, (lifeline,))
    pool = new_pool()

    def submit(*call: Any) -> "Future[bytes]":
        nonlocal pool
        try:
            return pool.submit(*call)
        except BrokenExecutor:  # a worker was killed
            pool = new_pool()
            return pool.submit(*call)

    try:
        yield Workers(count, submit, BrokenExecutor, share_files=True)
    finally:
        ours.close()
        pool.shutdown(cancel_futures=True)
        lifeline.close()


def _begin_worker(lifeline: Connection) -> None:
    """Prepare a process: one thread of BLAS, Ctrl-C is left to the parent, and the end of the parent ends it too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ |= _ONE_THREAD  # numpy is not imported yet

    def end() -> None:
        try:
            lifeline.poll(None)  # until the parent closes its end, or was killed
        finally:
            os._exit(1)

    Thread(target=end, daemon=True).start()


@contextmanager
def cluster_workers(address: str, *, timeout_s: float = CONNECT_S) -> Iterator[Workers]:
    """Connect to the Dask cluster of a scheduler, dask://HOST:PORT.

    Raises `ConfigError` for another form, or a worker with another version of ftdrive, numpy or scipy; `Unreachable`
    if no scheduler answers there, or it has no worker; `StreamBroken` if it was lost while calls were running.
    """
    found = re.fullmatch(r"dask://([^/:@]+|\[[0-9a-fA-F:]+\]):(\d{1,5})/?", address)
    if found is None:
        raise ConfigError(f"--cluster is '{address}': give the address of a Dask scheduler, such as dask://host:8786")
    try:
        import distributed
        from dask import config
    except ModuleNotFoundError as error:
        raise ConfigError(missing_extra("`fleet`", error.name or "", "fleet")) from None
    for name in _LOGS:
        # A lost cluster is one sentence, not several tracebacks.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    dask: Any = distributed  # most of it has no types
    try:
        with config.set(_SHORT_LOG):
            client = dask.Client(f"tcp://{found[1]}:{found[2]}", timeout=timeout_s, set_as_default=False)
    # The answer of another server may look like a huge length.
    except (OSError, ValueError, MemoryError) as error:
        raise Unreachable(
            f"no Dask scheduler answers at {address} ({error})", "start it, or correct --cluster"
        ) from error
    with config.set(_LARGE_CALLS), client:
        start = f"start one: dask worker tcp://{found[1]}:{found[2]} --nthreads 1"

        # `dask worker` starts another one in place of one that died.
        def require_one() -> None:
            try:
                client.wait_for_workers(1, timeout=timeout_s)
            except OSError as error:
                raise StreamBroken(f"the cluster {address} has no worker any more", f"{start}, and repeat") from error

        try:
            require_one()
        except StreamBroken as error:
            raise Unreachable(f"the cluster {address} has no worker", start) from error
        _require_same_versions(client.get_versions(packages=list(SAME)), address)
        try:
            submit = client.get_executor(pure=False).submit
            yield Workers(sum(client.ncores().values()), submit, dask.KilledWorker, require_one=require_one)
        except CancelledError as error:
            raise StreamBroken(f"the cluster {address} was lost", "start it, and repeat the command") from error


def _require_same_versions(found: Any, address: str) -> None:
    """Raise `ConfigError` for a worker of another version; `found` is as `distributed.Client.get_versions` has it."""
    ours = found["client"]["packages"]
    for worker, theirs in found["workers"].items():
        for name in SAME:
            if (other := theirs["packages"].get(name)) != ours[name]:
                raise ConfigError(
                    f"the worker {worker} of the cluster {address} has {name} {other or '(none)'}, this computer has "
                    f"{ours[name]}: install {name} {ours[name]} there"
                )


def answers(call_of: Callable[[Path], Call], items: Iterable[Path], workers: Workers) -> Iterator[tuple[Path, Answer]]:
    """Make a call for each item, when it is its turn so that few are in memory; yield item and answer as they come.

    A call whose worker died is repeated alone, because the death of a process also breaks the calls that run beside it.
    The cause of a second death is then the call itself.
    """
    died = yield from _round(call_of, items, workers, 2 * workers.count)
    died = yield from _round(call_of, died, workers, 1)
    for item in died:
        yield item, WorkerDied(_DIED)


def _round(
    call_of: Callable[[Path], Call], items: Iterable[Path], workers: Workers, at_once: int
) -> Generator[tuple[Path, Answer], None, list[Path]]:
    """Make each call once, some at a time; return the items whose worker died."""
    waiting, running, died = iter(items), dict["Future[bytes]", Path](), list[Path]()
    while True:
        while len(running) < at_once and (item := next(waiting, None)) is not None:
            try:
                running[workers.submit(*call_of(item))] = item
            except (FtdriveError, OSError) as error:
                yield item, error
        if not running:
            return died
        while not (done := wait(running, CHECK_S, FIRST_COMPLETED).done):
            workers.require_one()
        for future in done:
            item, raised = running.pop(future), future.exception()
            if isinstance(raised, workers.death):
                died.append(item)
            else:
                yield item, raised or future.result()
