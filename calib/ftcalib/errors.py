"""Errors of the solver core.

CalibError
├── BadDataset       the data are invalid: the message names the row and the reason
├── BadCalibration   a file is not a calibration that this version can read
├── TooFewSamples    the sensor sends too few samples for an average
└── NotObservable    the poses do not determine the parameters: the message names what is missing
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ftcalib.findings import Finding


class CalibError(Exception):
    """Base of all errors of the solver core."""


class BadDataset(CalibError):
    """The data are invalid."""


class BadCalibration(CalibError):
    """A stored calibration cannot be read."""


class TooFewSamples(CalibError):
    """The sensor sends too few samples for an average."""


class NotObservable(CalibError):
    """The poses do not determine the parameters; `finding` is the mistake in the data that explains it, if any."""

    def __init__(self, message: str, finding: "Finding | None" = None) -> None:
        super().__init__(message)
        self.finding = finding
