"""Errors of the solver core.

CalibError
├── BadDataset       the data are invalid: the message names the row and the reason
├── BadCalibration   a file is not a calibration that this version can read
├── TooFewSamples    the sensor sends too few samples for an average
└── NotObservable    the poses do not determine the parameters: the message names what is missing
"""


class CalibError(Exception):
    """Base of all errors of the solver core."""


class BadDataset(CalibError):
    """The data are invalid."""


class BadCalibration(CalibError):
    """A stored calibration cannot be read."""


class TooFewSamples(CalibError):
    """The sensor sends too few samples for an average."""


class NotObservable(CalibError):
    """The poses do not determine the parameters."""
