"""The modes the controller reports: program, robot and safety modes, and their status bits.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", and "Dashboard Server e-Series, port 29999" (names).
"""

from enum import IntEnum


class Runtime(IntEnum):
    """RTDE runtime_state, without the transitional ones."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class RobotMode(IntEnum):
    """RTDE robot_mode; the arm moves in RUNNING only."""

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
    """RTDE safety_mode."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


POWERED = frozenset({RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING})
PERMITTED = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})
"""Safety modes in which a program may move the arm."""
PAUSING = frozenset({SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP})
"""Safety modes that hold a program where it is; the others that are not permitted end it."""
POWERLESS = frozenset(
    {
        SafetyMode.SYSTEM_EMERGENCY_STOP,
        SafetyMode.ROBOT_EMERGENCY_STOP,
        SafetyMode.VIOLATION,
        SafetyMode.FAULT,
    }
)
"""Safety modes that cut the power of the arm."""

SAFETY_BITS = {
    SafetyMode.NORMAL: 0x001,
    SafetyMode.REDUCED: 0x002,
    SafetyMode.PROTECTIVE_STOP: 0x404,
    SafetyMode.RECOVERY: 0x008,
    SafetyMode.SAFEGUARD_STOP: 0x410,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 0x4A0,
    SafetyMode.ROBOT_EMERGENCY_STOP: 0x4C0,
    SafetyMode.VIOLATION: 0x500,
    SafetyMode.FAULT: 0x600,
}
"""RTDE safety_status_bits of each mode: one bit for the mode, 7 any emergency stop, 10 stopped due to safety."""

JOINT_MODES = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255, RobotMode.POWER_ON: 255, RobotMode.BACKDRIVE: 238}
JOINT_POWER_OFF = 239
"""RTDE joint_mode of each robot mode; joints without an entry are off."""
