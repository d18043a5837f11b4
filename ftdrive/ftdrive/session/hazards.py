"""The rows of the hazard table (docs/reference/hazards.md), by name; the values are the numbers of its rows."""

from enum import IntEnum


class Hazard(IntEnum):
    """What can go wrong while the arm moves."""

    CABLE_PULL = 1
    SELF_COLLISION = 2
    WORKCELL_COLLISION = 3
    UNDESCRIBED_OBSTACLE = 4
    APPROACH = 5
    SINGULARITY = 6
    WRONG_PAYLOAD = 7
    WRONG_TCP = 8
    WRONG_MODEL = 9
    PROTECTIVE_STOP = 10
    EMERGENCY_STOP = 11
    """A safeguard stop too."""
    SAFETY_MODE = 12
    OVERLOAD = 13
    CONTACT = 14
    SENSOR_LOST = 15
    CONTROLLER_LOST = 16
    INTERRUPT = 17
    UNGUARDED = 18
    """The program, its guards or the computer failed."""
    FREEDRIVE = 19
    PEOPLE = 20
    OTHER_CLIENT = 21
    STALL = 22
    """The speed slider is at 0, or something holds the arm."""
    LOOSE_TOOL = 23
    LOOSE_BASE = 24
    WRONG_PLAN = 25
    DISK_FULL = 26
