"""Modes that the controller reports: program, robot and safety modes, and their status bits.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", and "Dashboard Server e-Series, port 29999" (names).
Safety modes above 9: datatypes of its client library, and the message SafetyStatus of its ROS 2 driver.

Chosen here, where the sources are silent: which of the safety modes above 9 hold a program, and their status bits.
"""

from enum import IntEnum


class Runtime(IntEnum):
    """RTDE runtime_state, without transitional states."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class RobotMode(IntEnum):
    """RTDE robot_mode. The arm only moves in RUNNING."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """RTDE safety_mode and safety_status. The meaning of 21 is unknown."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED_SAFETY_MODE = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    SYSTEM_THREE_POSITION_ENABLING_STOP = 13
    TP_THREE_POSITION_ENABLING_STOP = 14
    IMMI_EMERGENCY_STOP = 15
    IMMI_SAFEGUARD_STOP = 16
    PROFISAFE_WAITING_FOR_PARAMETERS = 17
    PROFISAFE_AUTOMATIC_MODE_SAFEGUARD_STOP = 18
    PROFISAFE_SAFEGUARD_STOP = 19
    PROFISAFE_EMERGENCY_STOP = 20
    SAFETY_API_SAFEGUARD_STOP = 22
    IO_PLANE_STOP = 23


POWERED = frozenset({RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING})
PERMITTED = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})
"""Safety modes in which a program may move the arm."""
SAFEGUARDED = frozenset(
    {
        SafetyMode.SAFEGUARD_STOP,
        SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP,
        SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP,
        SafetyMode.TP_THREE_POSITION_ENABLING_STOP,
        SafetyMode.IMMI_SAFEGUARD_STOP,
        SafetyMode.PROFISAFE_AUTOMATIC_MODE_SAFEGUARD_STOP,
        SafetyMode.PROFISAFE_SAFEGUARD_STOP,
        SafetyMode.SAFETY_API_SAFEGUARD_STOP,
        SafetyMode.IO_PLANE_STOP,
    }
)
EMERGENCY = frozenset(
    {
        SafetyMode.SYSTEM_EMERGENCY_STOP,
        SafetyMode.ROBOT_EMERGENCY_STOP,
        SafetyMode.IMMI_EMERGENCY_STOP,
        SafetyMode.PROFISAFE_EMERGENCY_STOP,
    }
)
PAUSING = SAFEGUARDED | {SafetyMode.PROTECTIVE_STOP}
"""Safety modes that pause a program. Other modes that are not permitted end it."""
POWERLESS = EMERGENCY | {SafetyMode.VIOLATION, SafetyMode.FAULT}
"""Safety modes that cut the power of the arm."""

_STOPPED = 0x400
SAFETY_BITS = {
    **dict.fromkeys(SafetyMode, _STOPPED),
    **dict.fromkeys(SAFEGUARDED, 0x410),
    **dict.fromkeys(EMERGENCY, 0x4A0),
    SafetyMode.NORMAL: 0x001,
    SafetyMode.REDUCED: 0x002,
    SafetyMode.PROTECTIVE_STOP: 0x404,
    SafetyMode.RECOVERY: 0x008,
    SafetyMode.ROBOT_EMERGENCY_STOP: 0x4C0,
    SafetyMode.VIOLATION: 0x500,
    SafetyMode.FAULT: 0x600,
}
"""RTDE safety_status_bits of each mode: one bit for the mode, bit 7 for any emergency stop, bit 10 for any stop."""

JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.POWER_ON: 255, RobotMode.BACKDRIVE: 238}
JOINT_POWER_OFF = 239
"""RTDE joint_mode by robot mode. In other modes the joints are off."""
