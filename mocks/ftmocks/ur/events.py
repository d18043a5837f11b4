"""Entries of the controller's event log."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """One entry of the event log.

    Parameters
    ----------
    t_host_ns
        Time on the cell's clock.
    t_robot_s
        Time on the controller's clock, as it is sent.
    by
        Source: ``dashboard``, ``api``, ``script port``, ``primary port``, ``rtde`` (clients), ``operator``,
        ``network`` (control channel), ``program``, ``safety``, ``power``, ``arm`` (the controller itself).
    what
        Name of the event.
    accepted
        False if the controller refused the command.
    why
        Reason or reply.
    detail
        Further fields by name.
    """

    t_host_ns: int
    t_robot_s: float
    by: str
    what: str
    accepted: bool
    why: str
    detail: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return the entry as one flat JSON object."""
        return {
            "t_host_ns": self.t_host_ns,
            "t_robot_s": self.t_robot_s,
            "by": self.by,
            "what": self.what,
            "accepted": self.accepted,
            "why": self.why,
            **self.detail,
        }
