"""Looking at a Universal Robots arm: fresh, consistent samples and a flange pose that no TCP setting can spoil.

ur_rtde repeats the last values for ever once a link is lost, and goes through old ones after this process has been
suspended. So a sample is believed only if it is as new as one that a reader of our own has waited for. The TCP offset
is read with the controller's time stamp before and after each pose and taken off again, and the flange pose that
results is compared with the nominal forward kinematics.

Ref: ur_rtde 1.6.5, API reference of `RTDEReceiveInterface`; Universal Robots, "Real-Time Data Exchange (RTDE) Guide"
(modes, states and safety status bits).
Checked on hardware: no.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np

from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, ModelUnknown, StreamBroken
from drivers.interfaces import NOT_REPORTED, ArmState, ArmStatus, DeviceInfo
from drivers.ur.kinematics import MODELS, Pose, forward, model_named
from drivers.ur.library import Dashboard, Receive, ask_dashboard, connect_receive, require, retire
from drivers.ur.live import LiveReader

log = logging.getLogger(__name__)

CONNECT_S: Final = 2.0
STALE_S: Final = 0.2
_STATUS_S: Final = 0.05
_YOUNGER: Final = {"tcp_offset", "payload", "payload_cog"}
"""What some controllers that ur_rtde can read from do not tell yet."""
_MODEL_POSITION_M: Final = 0.005
_MODEL_ANGLE_RAD: Final = radians(0.5)

PROGRAM_STOPPED: Final = 1
PROGRAM_PLAYING: Final = 2
ROBOT_IDLE: Final = 5
ROBOT_RUNNING: Final = 7
_MEASURING: Final = (ROBOT_IDLE, 6, ROBOT_RUNNING)
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
}
_SAFETY: Final = (  # the first that applies says most
    (0b0_1110_0000, "emergency stop", "make the cell safe, release the button, power the arm on at the pendant"),
    (0b0_0000_0100, "protective stop", "find and remove its cause, then clear it at the pendant"),
    (0b0_0001_0000, "safeguard stop", "close the safeguard and reset it"),
    (0b0_0000_1000, "recovery mode", "move the arm back inside its limits at the pendant"),
    (0b11_0000_0000, "safety violation or fault", "read the pendant's log and restart the arm"),
    (0b100_0000_0000, "stop for a safety reason", "read the pendant's log"),
)


@dataclass(frozen=True, slots=True)
class Look:
    """One sample of the controller."""

    t_host_ns: int
    t_device_s: float
    q_rad: list[float]
    qd_rad_s: list[float]
    target_q_rad: list[float]
    target_qd_rad_s: list[float]
    tcp_pose: list[float]
    robot_mode: int
    safety_bits: int
    program_state: int

    def safety_fault(self) -> DeviceFault | None:
        """Say why the arm may not move, as far as the arm itself is concerned."""
        return _safety_fault(self.safety_bits, self.robot_mode)

    def program_fault(self) -> DeviceFault | None:
        """Say why our program on the controller does not move the arm."""
        if self.program_state == PROGRAM_PLAYING:
            return None
        state = _PROGRAM_STATES.get(self.program_state, "unknown")
        return DeviceFault(
            f"the control program was ended or paused by somebody else (state {self.program_state}, {state})",
            "leave the arm to this program",
        )


def _safety_fault(safety_bits: int, robot_mode: int) -> DeviceFault | None:
    for bits, meaning, cure in _SAFETY:
        if safety_bits & bits:
            return DeviceFault(f"{meaning} (safety status bits 0x{safety_bits:x})", cure)
    if robot_mode != ROBOT_RUNNING:
        mode = _ROBOT_MODES.get(robot_mode, "unknown")
        cure = "release its brakes" if robot_mode == ROBOT_IDLE else "power the arm on and release its brakes"
        return DeviceFault(f"robot mode {robot_mode} ({mode})", f"{cure} at the pendant")
    return None


class Reader:
    """The reading side of one arm; connected while it exists.

    Raises `ConnectError` when the arm cannot be reached, or is not the `model` (a key of `MODELS`) it should be.
    """

    def __init__(self, host: str, model: str | None) -> None:
        self._host = host
        self._live = LiveReader(host)
        self._receive: Receive | None = None
        require()
        try:
            self._live.open(timeout_s=CONNECT_S)
            self.version = self._live.version
            """Of the controller: major, minor, bugfix, build."""
            self.info = self._identify(model)
            self._receive = connect_receive(host)
        except BaseException:
            self.close()
            raise

    def _identify(self, model: str | None) -> DeviceInfo:
        major = self.version[0]
        if major > 5:
            raise ConnectError(
                f"{self._host} runs PolyScope X (version {major}), which has no dashboard server to stop the arm with",
                "PolyScope 5 or the CB3 generation is needed",
            )

        if lacking := sorted(self._live.missing - _YOUNGER):
            raise ConnectError(f"{self._host} does not tell {', '.join(lacking)} over RTDE", "update its PolyScope")

        def ask(dashboard: Dashboard) -> tuple[str, str, str]:
            told = dashboard.getRobotModel().strip()
            try:
                serial = dashboard.getSerialNumber()
            except RuntimeError as error:  # the question is younger than some controllers
                log.info("%s does not tell its serial number: %s", self._host, error)
                serial = NOT_REPORTED
            return told, serial, dashboard.polyscopeVersion().strip()

        told, serial, polyscope = ask_dashboard(self._host, ask, timeout_s=CONNECT_S)
        says = model_named(told, major)
        if model is None and says is None:
            raise ModelUnknown(
                f"{self._host} says {told!r} to the question for its model, which is no known one (CB3 before 3.12 "
                "and e-Series before 5.6 do not tell it)",
                "name the model of the arm",
            )
        if model is not None and says is not None and MODELS[says] != MODELS[model]:
            raise ConnectError(f"{self._host} is a {says}, not a {model}", "check the address and the model")
        return DeviceInfo(model=model or says or told, serial=serial, firmware=polyscope)

    @property
    def tells_tcp(self) -> bool:
        """Whether the controller tells its TCP offset without being controlled; old ones do not."""
        return self._live.tells_tcp

    @property
    def silent(self) -> bool:
        """Whether nothing has come since `look` or another call said that the controller's clock stands still."""
        return self._live.silent

    def status(self) -> ArmStatus:
        """Tell the controller's modes and settings, as one sample has them. Raises as `look`."""
        sample = self._live.live(max_age_s=_STATUS_S, limit_s=STALE_S)
        told = sample.outputs
        robot_mode, safety_mode, bits, program = (
            int(told[name][0]) for name in ("robot_mode", "safety_mode", "safety_status_bits", "runtime_state")
        )
        return ArmStatus(
            t_host_ns=sample.t_host_ns,
            t_device_s=sample.t_device_s,
            robot_mode=_ROBOT_MODES.get(robot_mode, f"unknown ({robot_mode})"),
            safety_mode=_SAFETY_MODES.get(safety_mode, f"unknown ({safety_mode})"),
            program=_PROGRAM_STATES.get(program, f"unknown ({program})"),
            fault=_safety_fault(bits, robot_mode),
            speed_slider=told["target_speed_fraction"][0],
            speed_scaling=told["speed_scaling"][0],
            payload_kg=told.get("payload", (None,))[0],
            p_flange_payload_m=told.get("payload_cog"),
            tcp_offset=told.get("tcp_offset"),
        )

    def close(self) -> None:
        """Let the connections go. Idempotent."""
        self._live.close()
        receive, self._receive = self._receive, None
        if receive is not None:
            retire(receive)

    def look(self, *, since_s: float | None = None, limit_s: float = STALE_S) -> Look:
        """Wait for a sample taken after this call, or at `since_s` or later.

        Raises `StreamBroken` once the loss of a connection is known, and `DeviceTimeout` when the controller is silent
        for `limit_s`.
        """
        if since_s is None:
            since_s = self._live.now_s(limit_s=limit_s)
        silent_s = 0.0
        while (look := self._newest()).t_device_s < since_s:
            if silent_s > limit_s:
                raise DeviceTimeout(
                    f"samples of {self._host} have stayed away for {silent_s:.2f} s",
                    "check the robot and the network, and press the emergency stop if the arm moves",
                )
            t0 = time.monotonic()
            time.sleep(0.001)
            silent_s += min(time.monotonic() - t0, 0.05)  # as in `LiveReader`
        return look

    def _newest(self) -> Look:
        receive = self._receive
        if receive is None or not receive.isConnected():
            raise StreamBroken(
                f"the connection to {self._host} was lost", "check the robot and the cable, then open the arm again"
            )
        self._live.check()
        for _ in range(100):  # ur_rtde has no snapshot: read again when a new sample came in between
            t_device_s = receive.getTimestamp()
            look = Look(
                t_host_ns=time.monotonic_ns(),
                t_device_s=t_device_s,
                q_rad=receive.getActualQ(),
                qd_rad_s=receive.getActualQd(),
                target_q_rad=receive.getTargetQ(),
                target_qd_rad_s=receive.getTargetQd(),
                tcp_pose=receive.getActualTCPPose(),
                robot_mode=receive.getRobotMode(),
                safety_bits=receive.getSafetyStatusBits(),
                program_state=receive.getRuntimeState(),
            )
            if receive.getTimestamp() == t_device_s:
                return look
        raise DeviceTimeout(f"no consistent sample of {self._host} could be read", "give this computer less to do")

    def state(self, ask_tcp: Callable[[], Sequence[float]]) -> ArmState:
        """Read a state; `ask_tcp` tells the TCP offset (6,) where the controller does not. Errors as `UrArm.state`."""
        for _ in range(5):
            t_before_s, before = self._tcp_offset(self._live.now_s(limit_s=STALE_S), ask_tcp)
            look = self.look(since_s=t_before_s)
            _, after = self._tcp_offset(look.t_device_s, ask_tcp)
            if tuple(before) == tuple(after):  # so this TCP was active when the pose was taken
                break
        else:
            raise DeviceFault(f"the TCP of {self._host} changes all the time", "find out what sets it")
        if look.robot_mode not in _MEASURING and (fault := look.safety_fault()):
            raise DeviceFault(f"{self._host} does not measure its joints: {fault.found}", fault.cure)
        flange = Pose.from_ur(look.tcp_pose) @ Pose.from_ur(before).inverse()
        self._check_model(look, flange)
        return ArmState(
            t_host_ns=look.t_host_ns,
            t_device_s=look.t_device_s,
            q_rad=np.array(look.q_rad),
            qd_rad_s=np.array(look.qd_rad_s),
            R_base_flange=flange.R,
            p_base_flange_m=flange.p_m,
        )

    def _tcp_offset(self, since_s: float, ask_tcp: Callable[[], Sequence[float]]) -> tuple[float, Sequence[float]]:
        if self.tells_tcp:
            sample = self._live.newest(since_s=since_s, limit_s=STALE_S)
            return sample.t_device_s, sample.outputs["tcp_offset"]
        return since_s, ask_tcp()

    def _check_model(self, look: Look, flange: Pose) -> None:
        nominal = forward(MODELS[self.info.model], look.q_rad)
        distance_m = float(np.linalg.norm(flange.p_m - nominal.p_m))
        angle_rad = flange.angle_to_rad(nominal)
        if distance_m > _MODEL_POSITION_M or angle_rad > _MODEL_ANGLE_RAD:
            raise DeviceFault(
                f"the flange is {1e3 * distance_m:.1f} mm and {math.degrees(angle_rad):.2f} degrees from where a "
                f"{self.info.model} has it with these joint angles: the arm at {self._host} is another model, or its "
                "TCP was changed this moment",
                "check both and read again",
            )
