"""One sample from a Universal Robots controller, and the meaning of its numbers.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide" (outputs, modes, states and safety status bits);
`ur/datatypes.h` of Universal Robots' client library (safety modes 12 to 22).
Checked on hardware: no.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ftdrivers.errors import DeviceFault
from ftdrivers.interfaces import ArmStatus
from ftdrivers.ur.kinematics import Pose, flange_poses

OUTPUTS: Final = MappingProxyType(
    {
        "timestamp": "DOUBLE",
        "actual_q": "VECTOR6D",
        "actual_qd": "VECTOR6D",
        "target_q": "VECTOR6D",
        "target_qd": "VECTOR6D",
        "actual_TCP_pose": "VECTOR6D",
        "robot_mode": "INT32",
        "safety_mode": "INT32",
        "safety_status_bits": "UINT32",
        "runtime_state": "UINT32",
        "speed_scaling": "DOUBLE",
        "target_speed_fraction": "DOUBLE",
        "tcp_offset": "VECTOR6D",
        "payload": "DOUBLE",
        "payload_cog": "VECTOR3D",
    }
)
"""Names and types of the RTDE outputs that the reader subscribes to."""
OPTIONAL: Final = frozenset({"tcp_offset", "payload", "payload_cog"})
"""RTDE outputs that older controllers do not know."""

PROGRAM_STOPPED: Final = 1
PROGRAM_PLAYING: Final = 2
ROBOT_IDLE: Final = 5
ROBOT_RUNNING: Final = 7
MEASURING: Final = (ROBOT_IDLE, ROBOT_RUNNING)
"""First and last robot mode in which the controller measures the joints, which needs power."""
_ROBOT_MODES: Final = {
    -1: "no controller",
    0: "disconnected",
    1: "safety not confirmed",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    6: "backdrive",
    7: "running",
    8: "updating firmware",
}
_PROGRAM_STATES: Final = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}
_SAFETY_MODES: Final = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "violation",
    9: "fault",
    10: "joint identification",
    11: "undefined",
    12: "automatic mode safeguard stop",
    13: "three-position enabling stop",
    14: "three-position enabling stop of the pendant",
    15: "IMMI emergency stop",
    16: "IMMI safeguard stop",
    17: "PROFIsafe waiting for parameters",
    18: "PROFIsafe automatic mode safeguard stop",
    19: "PROFIsafe safeguard stop",
    20: "PROFIsafe emergency stop",
    22: "safety API safeguard stop",
}
_ENABLING: Final = "hold the enabling device in its middle position, or switch to automatic mode on the pendant"
# Fixes for safety modes whose source is not shown by the status bits.
_MODE_FIXES: Final = {
    12: "close the safeguard of automatic mode and reset it",
    13: _ENABLING,
    14: _ENABLING,
    15: "release the emergency stop of the moulding machine, then power the arm on from the pendant",
    16: "close the safeguard of the moulding machine and reset it",
    17: "start the safety PLC, and check its PROFIsafe connection",
    18: "clear the safeguard stop of automatic mode in the safety PLC",
    19: "clear the safeguard stop in the safety PLC",
    20: "clear the emergency stop in the safety PLC, then power the arm on from the pendant",
    22: "clear the stop in the program that uses the safety API",
}
_SAFETY: Final = (  # the first row with a set bit is the most specific one
    (0b0_1110_0000, "emergency stop", "make the cell safe, release the button, power the arm on from the pendant"),
    (0b0_0000_0100, "protective stop", "find and remove its cause, then clear it on the pendant"),
    (0b0_0001_0000, "safeguard stop", "close the safeguard and reset it"),
    (0b0_0000_1000, "recovery mode", "move the arm back inside its limits from the pendant"),
    (0b11_0000_0000, "safety violation or fault", "read the pendant's log and restart the arm"),
    (0b100_0000_0000, "stop for a safety reason", "read the pendant's log"),
)


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample from the controller. Vectors are tuples in rad and m; orientations are rotation vectors."""

    t_host_ns: int
    t_device_s: float
    q_rad: tuple[float, ...]
    qd_rad_s: tuple[float, ...]
    target_q_rad: tuple[float, ...]
    target_qd_rad_s: tuple[float, ...]
    tcp_pose: tuple[float, ...]
    robot_mode: int
    safety_mode: int
    safety_bits: int
    program_state: int
    speed_scaling: float
    speed_slider: float
    tcp_offset: tuple[float, ...] | None
    payload_kg: float | None
    p_flange_payload_m: tuple[float, ...] | None

    @classmethod
    def of(cls, t_host_ns: int, outputs: Mapping[str, NDArray[Any]]) -> Self:
        """Build the last of n samples from outputs by their names. The outputs in `OPTIONAL` may be missing."""
        last: dict[str, Any] = {name: column[-1].tolist() for name, column in outputs.items()}

        def vector(name: str) -> tuple[float, ...]:
            return tuple(last[name])

        return cls(
            t_host_ns,
            last["timestamp"],
            vector("actual_q"),
            vector("actual_qd"),
            vector("target_q"),
            vector("target_qd"),
            vector("actual_TCP_pose"),
            last["robot_mode"],
            last["safety_mode"],
            last["safety_status_bits"],
            last["runtime_state"],
            last["speed_scaling"],
            last["target_speed_fraction"],
            vector("tcp_offset") if "tcp_offset" in last else None,
            last.get("payload"),
            vector("payload_cog") if "payload_cog" in last else None,
        )

    @property
    def measures(self) -> bool:
        """Whether the controller measures the joints, which needs power."""
        return MEASURING[0] <= self.robot_mode <= MEASURING[1]

    def safety_fault(self) -> DeviceFault | None:
        """Return the reason why the safety system or the robot mode prevents motion, or None."""
        if fix := _MODE_FIXES.get(self.safety_mode):
            return DeviceFault(f"{_SAFETY_MODES[self.safety_mode]} (safety mode {self.safety_mode})", fix)
        for bits, meaning, fix in _SAFETY:
            if self.safety_bits & bits:
                return DeviceFault(f"{meaning} (safety status bits 0x{self.safety_bits:x})", fix)
        if self.robot_mode != ROBOT_RUNNING:
            mode = _ROBOT_MODES.get(self.robot_mode, "unknown")
            fix = "release its brakes" if self.robot_mode == ROBOT_IDLE else "power the arm on and release its brakes"
            return DeviceFault(f"robot mode {self.robot_mode} ({mode})", f"{fix} on the pendant")
        return None

    def program_fault(self) -> DeviceFault | None:
        """Return the reason why the control program does not move the arm, or None."""
        if self.program_state == PROGRAM_PLAYING:
            return None
        state = f"(state {self.program_state}, {_PROGRAM_STATES.get(self.program_state, 'unknown')})"
        if self.program_state <= PROGRAM_STOPPED:
            return DeviceFault(
                f"the control program ended by itself or was stopped from outside {state}", "read the pendant's log"
            )
        return DeviceFault(
            f"the control program was stopped or paused from outside {state}", "end other programs for this arm"
        )

    def flange(self, tcp_offset: Sequence[float]) -> Pose:
        """Return the pose of the flange in the base: `tcp_pose` without the TCP offset (6,)."""
        R, p_m = flange_poses(np.array([self.tcp_pose]), np.array([tcp_offset]))
        return Pose(R[0], p_m[0])

    def status(self) -> ArmStatus:
        """Return modes and settings as text."""
        return ArmStatus(
            t_host_ns=self.t_host_ns,
            t_device_s=self.t_device_s,
            robot_mode=_ROBOT_MODES.get(self.robot_mode, f"unknown ({self.robot_mode})"),
            safety_mode=_SAFETY_MODES.get(self.safety_mode, f"unknown ({self.safety_mode})"),
            program=_PROGRAM_STATES.get(self.program_state, f"unknown ({self.program_state})"),
            fault=self.safety_fault(),
            speed_slider=self.speed_slider,
            speed_scaling=self.speed_scaling,
            payload_kg=self.payload_kg,
            p_flange_payload_m=self.p_flange_payload_m,
            tcp_offset=self.tcp_offset,
        )
