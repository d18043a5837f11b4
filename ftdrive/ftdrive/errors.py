"""Errors of the application itself, below those of `ftcalib.errors`, and the exit code of each error."""

import platform
import sys
from errno import ENOSPC
from pathlib import Path

from ftcalib.errors import AcceptanceError, DataError, DeviceError, FtdriveError, TooFewSamples, UsageError
from ftdrivers.errors import ConnectError, DeviceFault


class ConfigError(UsageError):
    """The configuration or the combination of options cannot be used."""


class BadPlan(DataError):
    """A file does not contain a valid plan."""


class BadRecording(DataError):
    """A file does not contain a recording that this version can read; its path stands before the problem."""

    def __init__(self, problem: str, path: Path | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")
        self.problem = problem


class BadStore(DataError):
    """The store of results cannot be read or written."""


class BadBundle(DataError):
    """A file is not a bundle that this version can read."""


class RecordingHasGaps(DataError):
    """Samples are missing in a recording that is otherwise complete."""


class NotAccepted(AcceptanceError):
    """A check failed, or a result is rejected or differs from the one it must equal."""


class PlanRefused(NotAccepted):
    """No motion is proven clear, or a plan was made for another cell."""


class Declined(FtdriveError):
    """The operator answered no, or the input ended before an answer."""


class SupervisorGone(FtdriveError):
    """The operator, or the program in their place, does not follow the session any more.

    `why` says what was closed, and `effect` what happens therefore and what to do.
    """

    def __init__(self, why: str, effect: str = "the session ends, the arm at rest; continue it with --resume") -> None:
        super().__init__(f"{why}: {effect}")


# The first kind that fits counts.
_EXIT_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (UsageError, 2),
    (ConnectError, 3),
    (DeviceFault, 5),
    (DeviceError, 4),
    (RecordingHasGaps, 8),
    (DataError, 6),
    (OSError, 6),
    (TooFewSamples, 4),
    (AcceptanceError, 7),
    (SupervisorGone, 9),
)


def exit_code(error: BaseException) -> int | None:
    """Return the exit code of an error that a user can fix; None for a defect of ftdrive."""
    if isinstance(error, ModuleNotFoundError) and error.name in sys.stdlib_module_names:
        return 2  # not on this system, as `termios` on Windows
    return next((code for kind, code in _EXIT_CODES if isinstance(error, kind)), None)


def in_a_sentence(error: BaseException) -> str:
    """Return the message of an error; for an error of the system also its file and what to check."""
    if isinstance(error, ModuleNotFoundError):
        return f"Python on {platform.system()} has no module {error.name}, which this needs: use Linux"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}: check this path, and who may read and write there"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return f"{error.strerror}: make room where the output goes"
    return str(error)
