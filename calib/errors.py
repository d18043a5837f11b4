"""What can go wrong in a calibration.

CalibError
├── BadDataset       the data are not what they should be: the message names the row and the reason
└── NotObservable    the poses cannot determine the parameters: the message says what is missing
"""


class CalibError(Exception):
    """Base of all errors of the solver core."""


class BadDataset(CalibError):
    """The data are not what they should be."""


class NotObservable(CalibError):
    """The poses cannot determine what was asked."""
