"""Errors of the application, derived from those in `ftcalib.errors`, and the exit code for each error."""

import platform
import sys
from errno import ENOSPC
from pathlib import Path

from ftcalib.errors import AcceptanceError, DataError, DeviceError, FtdriveError, TooFewSamples, UsageError
from ftdrivers.errors import ConnectError, DeviceFault


class ConfigError(UsageError):
    """The configuration or the combination of options is not usable."""


class BadPlan(DataError):
    """A file does not contain a valid plan."""


class BadRecording(DataError):
    """A file does not contain a recording that this version can read; the message begins with its path."""

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
    """A check failed, or a result is rejected or differs from the expected one."""


class PlanRefused(NotAccepted):
    """No motion can be proven clear, or a plan was made for another cell."""


class Declined(FtdriveError):
    """The operator answered no, or the input ended before an answer."""


class SupervisorGone(FtdriveError):
    """The operator, or the program in their place, no longer follows the session.

    `why` names what was closed, `effect` the consequence and the remedy.
    """

    def __init__(self, why: str, effect: str = "the session ends with the arm at rest; continue with --resume") -> None:
        super().__init__(f"{why}: {effect}")


# The first class that matches determines the code.
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
        return 2  # a module that this system lacks, such as `termios` on Windows
    return next((code for kind, code in _EXIT_CODES if isinstance(error, kind)), None)


def in_a_sentence(error: BaseException) -> str:
    """Return the message of an error; for an operating-system error, add the file and what to check."""
    if isinstance(error, ModuleNotFoundError):
        return f"Python on {platform.system()} has no module {error.name}, which is needed here: use Linux"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}: check this path and its permissions"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return f"{error.strerror}: free space for the output"
    return str(error)
