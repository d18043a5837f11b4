"""Errors of the application, derived from those in `ftcalib.errors`, and the exit code for each error."""

import platform
import sys
from errno import ENOSPC
from pathlib import Path

from ftcalib.errors import AcceptanceError, DataError, DeviceError, FtdriveError, TooFewSamples, UsageError
from ftdrivers.errors import ConnectError, DeviceFault


class ConfigError(UsageError):
    """The configuration of the cell or the combination of options is not usable."""


class BadPlan(DataError):
    """A file does not contain a valid plan of a tour or sweep."""


class BadRecording(DataError):
    """A file does not contain a recording that this version can read. If known, its path begins the message."""

    def __init__(self, problem: str, path: Path | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")
        self.problem = problem


class BadStore(DataError):
    """The store of results cannot be read or written."""


class BadBundle(DataError):
    """A file is not a bundle that this version can read."""


class RecordingHasGaps(DataError):
    """A recording is complete, but samples within it are missing."""


class NotAccepted(AcceptanceError):
    """A check has failed, a result is rejected, or it differs from the expected one."""


class PlanRefused(NotAccepted):
    """No motion can be proven clear, or a plan was made for another cell."""


class Declined(FtdriveError):
    """The operator answered no, or the input ended before an answer."""


class SupervisorGone(FtdriveError):
    """The operator, or the program that answers in their place, no longer follows the session.

    `why` states what was closed, such as the terminal; `effect` states the consequence and what to do.
    """

    def __init__(self, why: str, effect: str = "the session ends with the arm at rest; continue with --resume") -> None:
        super().__init__(f"{why}: {effect}")


# Exit codes by class of error. The first class that matches an error determines its code.
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
        return 2  # a module of Python that this system lacks, as Windows lacks `termios`
    return next((code for kind, code in _EXIT_CODES if isinstance(error, kind)), None)


def in_a_sentence(error: BaseException) -> str:
    """Return an error's message; for one of the operating system or a missing module, add file and what to do."""
    if isinstance(error, ModuleNotFoundError):
        return f"Python on {platform.system()} has no module {error.name}, which is needed here: use Linux"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}: check this path and its permissions"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return f"{error.strerror}: free space for the output"
    return str(error)
