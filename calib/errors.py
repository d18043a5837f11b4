"""What can go wrong in a calibration.

CalibError
├── BadDataset       the data are not what they should be: the message names the row and the reason
├── BadCalibration   a file is not a calibration that this version can read
├── TooFewSamples    the sensor sends too slowly to be averaged
└── NotObservable    the poses cannot determine the parameters: the message says what is missing
"""


class CalibError(Exception):
    """Base of all errors of the solver core."""


class BadDataset(CalibError):
    """The data are not what they should be."""


class BadCalibration(CalibError):
    """A stored calibration cannot be read."""


class TooFewSamples(CalibError):
    """The sensor sends too slowly to be averaged."""


class NotObservable(CalibError):
    """The poses cannot determine what was asked."""
