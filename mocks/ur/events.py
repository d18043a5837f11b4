"""What happened in the controller, in order, for whoever asserts on it afterwards."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """One entry of the controller's diary.

    Parameters
    ----------
    t_host_ns
        The cell's clock, which every process on this machine can read.
    t_robot_s
        The controller's own clock, as on the wire.
    by
        Who: ``dashboard``, ``script port``, ``rtde`` (clients), ``operator``, ``network`` (control channel),
        ``program``, ``safety``, ``power``, ``arm`` (the controller itself).
    what
        What, in fixed words.
    accepted
        False when the controller refused it.
    why
        The reason or the reply, in words.
    detail
        More, by name.
    """

    t_host_ns: int
    t_robot_s: float
    by: str
    what: str
    accepted: bool
    why: str
    detail: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """As one flat JSON object."""
        return {
            "t_host_ns": self.t_host_ns,
            "t_robot_s": self.t_robot_s,
            "by": self.by,
            "what": self.what,
            "accepted": self.accepted,
            "why": self.why,
            **self.detail,
        }
