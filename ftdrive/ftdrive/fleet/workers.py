"""Workers that run calls: processes of this computer, or the workers of a Dask cluster."""

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

# Time-out for the answer of a scheduler, and for its first worker, s.
CONNECT_S: Final = 10.0
# Time without an answer after which the workers are counted again, s.
CHECK_S: Final = 5.0
# Packages whose versions must be equal in a cluster, because the last digits depend on them.
SAME: Final = ("ftdrive", "numpy", "scipy")

# One BLAS thread per worker: more threads than cores are slow, and their number can change the last digits.
_ONE_THREAD: Final = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
_LOGS: Final = ("distributed", "distributed.client", "tornado.application")
# Length of the client's log for developers of Dask; the default of 1000 messages with datasets needs 130 MB.
_SHORT_LOG: Final = {"distributed.admin.low-level-log-length": 10}
# A recording of 40 s at 1 kHz exceeds the default threshold of a warning that does not help users.
_LARGE_CALLS: Final = {"distributed.admin.large-graph-warning-threshold": "1TB"}
_DIED: Final = "every worker that solved this run died: run `ftdrive solve` on it to see the cause"

# Return value of a call that a worker made, or the exception that the call raised.
Answer = bytes | BaseException
# A call that a worker is to make: a function and its arguments.
Call = tuple[Callable[..., bytes], *tuple[Any, ...]]


class WorkerDied(FtdriveError):
    """Raised if every worker that received a call ended without an answer."""


class OtherVersion(ConfigError):
    """Raised if a worker has another version of ftdrive than the calling computer."""


def require_version(version: str) -> None:
    """Raise `OtherVersion` in a worker without this version of ftdrive."""
    if version != __version__:
        raise OtherVersion(
            f"a worker has ftdrive {__version__}, but this computer has ftdrive {version}: install the same version on "
            "both"
        )


def folder_of_worker() -> str | None:
    """Return the folder of a Dask worker, which Dask removes even if the worker is killed; None in other processes."""
    try:
        from distributed import get_worker

        return str(get_worker().local_directory)
    except (ImportError, ValueError):
        return None


def describe_error(error: BaseException) -> str:
    """Describe, as one sentence, the exception that a worker's call raised."""
    expected = isinstance(error, FtdriveError | OSError)
    return str(error) if expected else f"unexpected {type(error).__name__}: {error}"


@dataclass(frozen=True, slots=True)
class Workers:
    """Worker processes, of this computer or a Dask cluster, that run several calls at a time."""

    count: int
    submit: Callable[..., "Future[bytes]"]
    """Starts a call on a worker and returns its future; takes a function and the arguments of the function."""
    death: type[Exception]
    """Type of the exception that a future raises if its worker has died."""
    share_files: bool = False
    """Whether all workers have the same file system."""
    require_one: Callable[[], None] = lambda: None
    """Raises `StreamBroken` if no worker is left."""


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Workers]:
    """Yield worker processes, by default one per usable core; they end at once with the context."""
    if count is None:
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    context = get_context("spawn")  # a fork would copy the state of running threads
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
    """Initialize a worker process: one BLAS thread, no reaction to Ctrl-C, and end with the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ |= _ONE_THREAD  # numpy is not imported yet

    def end() -> None:
        try:
            lifeline.poll(None)  # until the parent closes its end or is killed
        finally:
            os._exit(1)

    Thread(target=end, daemon=True).start()


@contextmanager
def cluster_workers(address: str, *, timeout_s: float = CONNECT_S) -> Iterator[Workers]:
    """Yield the workers of the Dask cluster at a scheduler address dask://HOST:PORT.

    Raises `ConfigError` for another form of address, or a worker with another version of ftdrive, numpy or scipy;
    `Unreachable` if no scheduler answers or it has no worker; `StreamBroken` if the cluster is lost during calls.
    """
    match = re.fullmatch(r"dask://([^/:@]+|\[[0-9a-fA-F:]+\]):(\d{1,5})/?", address)
    if match is None:
        raise ConfigError(f"--cluster is '{address}': give the address of a Dask scheduler, such as dask://host:8786")
    try:
        import distributed
        from dask import config
    except ModuleNotFoundError as error:
        raise ConfigError(missing_extra("`fleet`", error.name or "", "fleet")) from None
    for name in _LOGS:
        # A lost cluster is reported in one sentence, not by several tracebacks.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    dask: Any = distributed  # mostly without type annotations
    try:
        with config.set(_SHORT_LOG):
            client = dask.Client(f"tcp://{match[1]}:{match[2]}", timeout=timeout_s, set_as_default=False)
    # The answer of another kind of server may be read as a huge length.
    except (OSError, ValueError, MemoryError) as error:
        raise Unreachable(
            f"no Dask scheduler answers at {address} ({error})", "start the scheduler, or correct --cluster"
        ) from error
    with config.set(_LARGE_CALLS), client:
        start = f"start one: dask worker tcp://{match[1]}:{match[2]} --nthreads 1"

        # `dask worker` replaces a worker that died.
        def require_one() -> None:
            try:
                client.wait_for_workers(1, timeout=timeout_s)
            except OSError as error:
                raise StreamBroken(
                    f"the cluster {address} has no worker left", f"{start}, and repeat the command"
                ) from error

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


def _require_same_versions(versions: Any, address: str) -> None:
    """Raise `ConfigError` for a worker with another version; `versions` is from `distributed.Client.get_versions`."""
    ours = versions["client"]["packages"]
    for worker, theirs in versions["workers"].items():
        for name in SAME:
            if (other := theirs["packages"].get(name)) != ours[name]:
                raise ConfigError(
                    f"the worker {worker} of the cluster {address} has {name} {other or '(none)'}, but this computer "
                    f"has {ours[name]}: install {name} {ours[name]} there"
                )


def answers(call_of: Callable[[Path], Call], items: Iterable[Path], workers: Workers) -> Iterator[tuple[Path, Answer]]:
    """Make one call per item, a few at a time to limit memory; yield item and answer when an answer arrives.

    A call whose worker died is repeated alone, because the death of a process also breaks other running calls. A second
    death is then due to the call itself.
    """
    died = yield from _round(call_of, items, workers, 2 * workers.count)
    died = yield from _round(call_of, died, workers, 1)
    for item in died:
        yield item, WorkerDied(_DIED)


def _round(
    call_of: Callable[[Path], Call], items: Iterable[Path], workers: Workers, at_once: int
) -> Generator[tuple[Path, Answer], None, list[Path]]:
    """Make each call once, `at_once` calls at a time; yield the answers, and return the items whose worker died."""
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
