"""Exception hierarchy: every error that a user of the library can fix is a `FtdriveError`.

FtdriveError
├── UsageError        an argument, an option or a configuration cannot be used
├── DeviceError       a robot, a sensor or its stream has failed
├── DataError         a file, or the data in it, cannot be used
│   ├── BadDataset        the data are invalid: the message names the row and the reason
│   └── BadCalibration    a file is not a calibration that this version can read
└── AcceptanceError   the measured data are not good enough, or a check failed
    ├── TooFewSamples     the sensor sends too few samples for an average
    └── NotObservable     the poses do not determine the parameters: the message names what is missing

`ftdrivers.errors` and `ftdrive.errors` derive further classes from these four. Python's `ValueError` and `TypeError`
mean a defect of the calling program.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ftcalib.findings import Finding


class FtdriveError(Exception):
    """Base class of all errors of ftdrive that a user can fix; the message says what happened and what to do.

    A file that is missing or cannot be written raises Python's `OSError` instead.

    Examples
    --------
    >>> import ftdrive
    >>> try:
    ...     ftdrive.open_sensor("emulated://scale")
    ... except ftdrive.FtdriveError as error:
    ...     print(type(error).__name__)
    ConfigError
    """


class UsageError(FtdriveError):
    """An argument, an option or a configuration cannot be used.

    Examples
    --------
    >>> import ftdrive
    >>> try:
    ...     ftdrive.plan_tour("ur5e", [(0, 200, 100)], poses=7)
    ... except ftdrive.UsageError as error:
    ...     print(error)
    there is no plan of 7 poses: choose one of 24, 12, 6
    """


class DeviceError(FtdriveError):
    """A robot, a sensor or its stream has failed. The error text is "found; fix".

    Parameters
    ----------
    found
        What happened, with the value; without initial capital and full stop.
    fix
        What to do next, beginning with a verb; empty if unknown.

    Examples
    --------
    >>> import ftdrive
    >>> try:
    ...     ftdrive.open_sensor("bota:///dev/no-such-port")
    ... except ftdrive.DeviceError as error:
    ...     print(bool(error.found), bool(error.fix))
    True True
    """

    def __init__(self, found: str, fix: str = "") -> None:
        super().__init__(f"{found}; {fix}" if fix else found)  # one argument, because `OSError` interprets two
        self.found = found
        self.fix = fix


class DataError(FtdriveError):
    """A file, or the data in it, cannot be used.

    Examples
    --------
    >>> import ftdrive, numpy as np
    >>> try:
    ...     ftdrive.CalibrationDataset.of(np.zeros((4, 3, 3)), np.zeros((4, 6)))
    ... except ftdrive.DataError as error:
    ...     print(str(error).partition(",")[0])
    row 1: the orientation is not a rotation matrix
    """


class AcceptanceError(FtdriveError):
    """The measured data are not good enough, or a check failed.

    Examples
    --------
    >>> import ftdrive, numpy as np
    >>> try:
    ...     ftdrive.solve(ftdrive.CalibrationDataset.of([np.eye(3)] * 4, np.ones((4, 6))))
    ... except ftdrive.AcceptanceError as error:
    ...     print(type(error).__name__)
    NotObservable
    """


class TooFewSamples(AcceptanceError):
    """The sensor sends too few samples for an average."""


class BadDataset(DataError):
    """The data of a file or an argument are invalid."""


class BadCalibration(DataError):
    """A stored calibration cannot be read by this version."""


class NotObservable(AcceptanceError):
    """The poses do not determine the parameters; `finding` is a mistake in the data that explains this, if any."""

    def __init__(self, message: str, finding: "Finding | None" = None) -> None:
        super().__init__(message)
        self.finding = finding
