"""Errors of the application itself."""

from pathlib import Path


class ConfigError(Exception):
    """The configuration or the combination of options cannot be used."""


class NotAccepted(Exception):
    """A check failed, or a result is rejected or differs from the one it must equal."""


class BadPlan(Exception):
    """A file does not contain a valid plan."""


class BadRecording(Exception):
    """A file does not contain a recording that this version can read.

    Parameters
    ----------
    problem : str
    path : Path, optional
        Of the file; it stands before the problem.
    """

    def __init__(self, problem: str, path: Path | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")
        self.problem = problem


class BadStore(Exception):
    """The store of results cannot be read or written."""


class BadBundle(Exception):
    """A file is not a bundle that this version can read."""


class RecordingHasGaps(Exception):
    """Samples are missing in a recording that is otherwise complete."""


class PlanRefused(NotAccepted):
    """No motion is proven clear, or a plan was made for another cell."""


class Declined(Exception):
    """The operator answered no, or the input ended before an answer."""
