"""A Universal Robots arm.

`reading.py` reads the arm, and a control path (`control.py`) moves it. The dashboard server or the Robot API can stop
the arm even if both fail.

Ref: Universal Robots, URScript manual, `is_steady`.
Checked on hardware: no.
"""

import logging
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from math import radians
from typing import Final, Literal

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.follow import Follow
from ftdrivers.interfaces import (
    ArmState,
    ArmStates,
    ArmStatus,
    ControllerSettings,
    DeviceInfo,
    Diagnosis,
    Fact,
    Guard,
    RobotArm,
)
from ftdrivers.sweep import Sweep
from ftdrivers.ur.control import CONTROL_SETTINGS, STOP_RAD_S2, Control, ControlSetting
from ftdrivers.ur.controller_settings import checked_gravity, checked_payload, read_controller_settings
from ftdrivers.ur.kinematics import MODELS, model_named
from ftdrivers.ur.opening import SIMULATORS, Opening, OwnProgram, path_for
from ftdrivers.ur.reading import Reader
from ftdrivers.ur.sample import PROGRAM_PLAYING, PROGRAM_STOPPED, ROBOT_RUNNING, Sample
from ftdrivers.ur.services import ROBOT_API_PORT as API_PORT
from ftdrivers.ur.timing import STRICT, UrTiming

log = logging.getLogger(__name__)

_ARRIVED_RAD: Final = 1e-3
# Set-point speed, rad/s, up to which an arm counts as at rest; an arm at rest reports exactly zero.
_STANDING_RAD_S: Final = 1e-6
_STILL_RAD_S: Final = 0.002
# Time-out from the end of a sweep to standstill, s.
_SETTLES_S: Final = 5.0


class UrArm(RobotArm):
    """A Universal Robots arm: CB3 generation, e-Series, or PolyScope X.

    Parameters
    ----------
    host
        Address of the controller.
    model
        Model with which poses are compared, such as "UR5e". None selects the model that the controller reports.
    speed_rad_s, acceleration_rad_s2
        Default speed and acceleration of the leading joint in `move_to`. The speed slider of the pendant reduces them.
    stop_rad_s2
        Deceleration of the fastest joint in a stop, on every control path.
    control
        Control path: "ur-rtde", "script", or "auto", which selects ur_rtde if it is installed and the controller has a
        dashboard server.
    api_port
        TCP port of the Robot API of PolyScope X.
    clock
        Clock of the time stamps and time-outs; an emulated cell has a clock of its own.
    timing
        Time-outs. By default they are those of a real or an emulated cell, according to `clock`.
    """

    def __init__(  # noqa: PLR0913 - one for each setting of the arm
        self,
        host: str,
        *,
        model: str | None = None,
        speed_rad_s: float = radians(30),
        acceleration_rad_s2: float = radians(40),
        stop_rad_s2: float = STOP_RAD_S2,
        control: ControlSetting = "auto",
        api_port: int = API_PORT,
        clock: Clock = REAL,
        timing: UrTiming = STRICT,
    ) -> None:
        _check_speed(speed_rad_s, acceleration_rad_s2)
        if not radians(60) <= stop_rad_s2 <= radians(300):
            raise ValueError(
                f"stop_rad_s2 is {stop_rad_s2}; choose 1.05 to 5.23 (60 to 300 degrees per second squared)."
            )
        if control not in CONTROL_SETTINGS:
            raise ValueError(f"control is {control!r}; choose one of {', '.join(CONTROL_SETTINGS)}.")
        if model is not None and model_named(model, 0) is None:
            raise ValueError(f"model {model!r} is unknown; choose one of {', '.join(MODELS)}.")
        self._host = host
        self._model = None if model is None else model_named(model, 0)
        self._speed_rad_s = float(speed_rad_s)
        self._acceleration_rad_s2 = float(acceleration_rad_s2)
        self._stop_rad_s2 = float(stop_rad_s2)
        self._clock = clock
        self._timing = timing
        self._moves_at_rad_s = self._speed_rad_s
        self._setting = control
        self._api_port = api_port
        self._reader: Reader | None = None
        self._control: Control | None = None
        self._program = OwnProgram(self._timing)
        self._goal: list[float] | None = None
        self._stop_requested = threading.Event()

    # ------------------------------------------------------------------ opening and closing

    def open(self, *, control: bool = False) -> None:
        """Connect, read-only unless `control` is requested, and reopen lost connections. It takes at most 5 s.

        Reading has no side effects and needs no remote control. Taking control starts a program on the controller,
        which zeroes the sensor in an e-Series wrist. A program that plays or is paused is never stopped, unless this
        object started it. The operator has to clear a safety stop first; an interrupted move is not
        continued. If `ConnectError` is raised, the arm is closed.
        """
        try:
            self._drop_what_is_lost(control)
            self._connect(control)
        except (StreamBroken, DeviceTimeout, DeviceFault, ProtocolError) as error:
            self.close()
            raise ConnectError(f"cannot connect to the arm at {self._host}: {error.found}", error.fix) from error
        except BaseException:
            self.close()
            raise

    def _drop_what_is_lost(self, control: bool) -> None:
        if self._reader is None:
            return
        try:
            look = self._reader.look()
        except DeviceError as error:
            log.info("%s is reopened: %s", self._host, error)
            self.close()
            return
        if look.program_state == PROGRAM_STOPPED:
            self._program.is_stopped()
        if not control or self._control is None:
            return
        plays = self._control.alive and not look.program_fault()
        if plays and (look.safety_fault() or self._is_ours(self._control, timeout_s=self._timing.ours_again_s)):
            return
        self._control.kill()
        self._control = None

    def _connect(self, control: bool) -> None:
        if self._reader is None:
            self._reader = self._new_reader()
        if control and self._control is None:
            self._control = self._opening(self._reader).open()
        if self._reader.look().robot_mode == ROBOT_RUNNING and (self._reader.reports_tcp or self._control is not None):
            self.state()  # also checks the model of the arm

    def _new_reader(self, **rate: float) -> Reader:
        return Reader(self._host, self._model, clock=self._clock, timing=self._timing, api_port=self._api_port, **rate)

    def _opening(self, reader: Reader) -> Opening:
        return Opening(self._host, self._setting, reader, self._program, self._stop_rad_s2, self._clock, self._timing)

    def close(self) -> None:
        """Stop the arm and the control program, then disconnect. Idempotent. It takes at most 1.5 s."""
        control, self._control = self._control, None
        reader, self._reader = self._reader, None
        self._goal = None
        if control is not None:
            self._end_program(control, reader)
        if self._program.left_behind:
            self._program.stop()
        if reader is not None:
            reader.close()

    def _end_program(self, control: Control, reader: Reader | None) -> None:
        """End the control program through its control path, if that can be confirmed to work."""
        try:
            look = None if reader is None else reader.look(limit_s=self._timing.glance_s)
            if control.has_ended:
                self._program.is_gone()
            if look and control.alive and look.program_state == PROGRAM_PLAYING and not look.safety_fault():
                if self._is_ours(control, timeout_s=self._timing.ours_closing_s):
                    if control.quit(timeout_s=self._timing.quit_s):
                        self._program.is_gone()
                elif not self._program.left_behind:
                    log.warning("%s runs another program; it is not stopped", self._host)
        except DeviceError as error:
            log.info("%s: %s", self._host, error)
        finally:
            control.kill()

    def identify(self) -> DeviceInfo:
        """Return model, serial number and PolyScope version, as read when the arm was opened, and the control path."""
        reader = self._reading()
        path, why = path_for(self._setting, reader.version)
        source: Literal["configured", "assumed"] = "assumed" if self._setting == "auto" else "configured"
        return replace(reader.info, facts={**reader.info.facts, "control": Fact(f"{path}: {why}", source)})

    def state(self) -> ArmState:
        """Read a new, consistent state. The flange is the mechanical flange and does not depend on the active TCP.

        Raises `DeviceTimeout` if the controller's clock stands still for 0.2 s, `StreamBroken` if the connection was
        lost, `DeviceFault` if the joints are not measured (no power) or the pose does not fit the model, and
        `ConnectError` if the controller is too old to report its TCP and the arm was opened without control.
        """
        reader = self._reading()
        if not reader.reports_tcp and self._control is None:
            raise ConnectError(
                f"the controller {self._host} is too old to report its active TCP, so the flange pose is unknown",
                "update it, or open the arm with control, as a calibration does",
            )
        return reader.state(lambda: self._in_control().call("tcp_offset"))

    def follow(self) -> AbstractContextManager[Follow[ArmStates]]:
        """Read every sample from now on as flange poses, 500 Hz (CB3: 125 Hz); see `RobotArm`.

        Before the first call the arm is read at 125 Hz, which is enough for a session and needs a quarter of the CPU
        time. The first call replaces the reader; a `state` or `status` that waits in another thread then raises
        `StreamBroken`. Late samples are included, see `t_device_s`. Samples of an arm without power are left out, and a
        read without other samples raises `DeviceFault`. A controller that is too old to report its TCP is polled.
        """
        reader = self._reading()
        if not reader.reports_tcp:
            return super().follow()
        if not reader.reads_all:
            quick = self._new_reader(rate_Hz=math.inf)
            self._reader = quick
            reader.close()
            reader = quick
        return reader.follow()

    def status(self) -> ArmStatus:
        """Return modes and settings of the controller, which are updated with every sample; see `RobotArm`."""
        return self._reading().status()

    def controller_settings(self) -> ControllerSettings:
        """Read payload, inertia and gravity over a separate connection, which takes a few milliseconds.

        The payload is reported since PolyScope 5.6 and 3.11, the inertia since 5.11 and 3.15, and gravity by recent
        versions only.
        """
        self._reading()
        return read_controller_settings(self._host, timeout_s=self._timing.connect_s, clock=self._clock)

    def in_remote_control(self) -> bool | None:
        """Return whether the robot is in remote control, from the dashboard server or the Robot API.

        The result is None before PolyScope 5.6 and on PolyScope X before 10.12, which do not report it, and at the
        addresses of URSim, which does not need remote control. Raises `NoDashboard` if the server does not answer.
        """
        reader = self._reading()
        if reader.version[:2] < (5, 6) or self._host in SIMULATORS:
            return None
        return reader.services.ask(lambda services: services.in_remote_control(), timeout_s=self._timing.connect_s)

    def reported_program(self) -> str | None:
        """Return state and name of the program on the controller; None if the controller does not answer.

        Not checked on hardware: a program that a client has sent may be reported with the name of the loaded program.
        """
        return self._reading().reported_program()

    def diagnose(self) -> list[Diagnosis]:
        """Check what control needs: a control path, the version, free RTDE registers, an open port for programs."""
        return self._opening(self._reading()).diagnose()

    # ------------------------------------------------------------------ moving

    def within_safety_limits(self, q_rad: Sequence[float]) -> bool:
        """Return whether the controller accepts these joint angles (6,). Needs control.

        The controller checks its own limits and planes, but does not know the obstacles in the cell. Raises
        `DeviceFault` or `StreamBroken` if it cannot be asked.
        """
        q = _joints(q_rad)
        return bool(self._ask(self._in_control(), "within_safety_limits", q))

    def set_payload(
        self, mass_kg: float, p_flange_com_m: Sequence[float], inertia_kg_m2: Sequence[float] = (0.0,) * 6
    ) -> None:
        """Set the payload, see `RobotArm`. The controller also zeroes the sensor in an e-Series wrist.

        The arm may move slightly, because the change is instantaneous. Raises `DeviceFault` or `StreamBroken` if the
        change is not confirmed, and `ValueError` for impossible values. PolyScope before 5.10 accepts no inertia.
        """
        mass, com, inertia = checked_payload(mass_kg, p_flange_com_m, inertia_kg_m2)
        version = self._reading().version[:2]
        takes_inertia = version >= (5, 10)
        if any(inertia) and not takes_inertia:
            raise DeviceFault(
                "PolyScope {}.{} does not accept the inertia of the payload from a program".format(*version),
                "set the payload on the pendant",
            )
        self._set("payload", mass, com, inertia if takes_inertia else None)

    def set_gravity(self, up_base_m_s2: Sequence[float]) -> None:
        """Set gravity, see `RobotArm`. Raises the exceptions of `set_payload`."""
        self._set("gravity", checked_gravity(up_base_m_s2))

    def _set(self, what: str, *values: object) -> None:
        """Let the control program call a setter of the controller. Raise if another program runs instead."""
        control = self._in_control()
        self._look_out()
        self._check_ours(control)
        if not self._ask(control, f"set_{what}", *values):
            raise self._fault() or DeviceFault(
                f"the controller did not confirm the {what} that was sent", "read the pendant's log"
            )

    def _ask(self, control: Control, name: str, *values: object) -> object:
        """Call the control program. A fault that the controller reports is raised instead of the error of the call."""
        try:
            return control.call(name, *values, look_out=self._look_out)
        except DeviceError as error:
            if fault := self._fault():
                raise fault from error
            raise

    def move_to(
        self,
        q_rad: Sequence[float],
        *,
        timeout_s: float,
        guard: Guard,
        speed_rad_s: float | None = None,
        acceleration_rad_s2: float | None = None,
    ) -> None:
        """Move all joints to `q_rad` (6,) and return when they have arrived; see `RobotArm` for the speed.

        `guard` is called about 100 times per second. Each of these exceptions stops the arm before it is raised:
        `DeviceFault` (protective, emergency or safeguard stop, program ended, arm not at the goal), `StreamBroken`,
        `DeviceTimeout` (silent controller, or `timeout_s` has passed), an exception of the guard, KeyboardInterrupt.
        A safety stop is never reset. After a failure the control program is ended, so the move cannot be resumed.
        """
        q = _joints(q_rad)
        speed = self._speed_rad_s if speed_rad_s is None else float(speed_rad_s)
        acceleration = self._acceleration_rad_s2 if acceleration_rad_s2 is None else float(acceleration_rad_s2)
        _check_speed(speed, acceleration)

        def begin(control: Control) -> bool:
            return bool(control.call("move", q, speed, acceleration, look_out=self._look_out))

        self._travel(begin, q, speed, f"the move to {_degrees(q)}", timeout_s=timeout_s, guard=guard)

    def sweep(self, sweep: Sweep, *, guard: Guard) -> None:
        """Follow a sweep from its first posture, see `RobotArm`. Guard and exceptions are those of `move_to`.

        The control program evaluates the sweep in every cycle of the controller. This is not possible on the path
        "ur-rtde": its set-points would come from this computer, and the arm would not stop if the computer fails.
        """
        centre = _joints(sweep.centre_rad)
        speed = float(sweep.largest(1).max())
        _check_speed(speed, float(sweep.largest(2).max()))
        if not self._in_control().stops_itself:
            raise DeviceFault(
                "the control path ur-rtde cannot follow a sweep, because its program cannot evaluate one",
                "select the other path: --control script, or [robot] control",
            )

        def begin(control: Control) -> bool:
            waves = sweep.waves.reshape(-1, 3).tolist()
            sent = all(control.call("wave", k, *wave, look_out=self._look_out) for k, wave in enumerate(waves))
            numbers = (centre, sweep.duration_s, sweep.ramp_s)
            return sent and bool(control.call("sweep", *numbers, look_out=self._look_out))

        self._travel(begin, centre, speed, "the sweep", timeout_s=sweep.duration_s + _SETTLES_S, guard=guard)

    def _travel(
        self,
        begin: Callable[[Control], bool],
        q: list[float],
        speed_rad_s: float,
        what: str,
        *,
        timeout_s: float,
        guard: Guard,
    ) -> None:
        """Start a motion that ends at `q`, and return when the arm has arrived."""
        control = self._in_control()
        self._stop_requested.clear()
        self._goal = None
        with self._stopping_on_error():
            self._look_out()
        self._check_ours(control)  # a program of another client is not stopped
        guard()
        self._moves_at_rad_s = speed_rad_s
        with self._stopping_on_error():
            with self._reporting_stop():
                if not begin(control):
                    raise self._fault() or DeviceFault(f"the controller rejected {what}", "read the pendant's log")
            checked_s = self._clock.now_s()
            for look in self._watch(timeout_s, guard, f"{what} has not ended", self._look_out_moving):
                with self._reporting_stop():
                    if self._has_ended(control):
                        self._check_arrival(look, q)
                        self._goal = q
                        return
                    if self._clock.now_s() - checked_s > self._timing.ours_every_s:
                        self._check_ours(control)
                        checked_s = self._clock.now_s()

    def _has_ended(self, control: Control) -> bool:
        if self._stop_requested.is_set():
            raise _stopped()
        ended, unwatched = control.call("progress", timeout_s=self._timing.progress_s, look_out=self._look_out)
        if unwatched:
            raise DeviceTimeout(
                f"this program did not watch the move for {self._timing.unwatched_s} s, so its control path "
                "stopped the arm",
                "keep the computer awake and reduce its load, then move again",
            )
        return bool(ended)

    def _check_arrival(self, look: Sample, q: list[float]) -> None:
        # The control process may report the end of the move before the last set-points arrive over RTDE.
        deadline_s = self._clock.now_s() + self._timing.reason_s
        while not _near(look.target_q_rad, q):
            if self._clock.now_s() > deadline_s:
                raise self._fault() or DeviceFault(
                    f"the move ended at {_degrees(look.target_q_rad)} instead of {_degrees(q)}",
                    "read the reason on the pendant",
                )
            look = self._reading().look()

    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        """Return when the joints have been at rest for so long that vibrations of the structure have decayed.

        For 0.3 s without interruption, the arm must be at the target of `move_to`, its target velocity must be zero and
        each measured joint speed below 0.002 rad/s. (The controller's own `is_steady` requires 0.5 s of zero target
        velocity; the mean force over 1 s is the same.) Exceptions are those of `move_to`; without control, safety stops
        raise none.
        """
        still_since_s: float | None = None
        with self._stopping_on_error():
            for look in self._watch(timeout_s, guard, "the arm has not come to rest", self._look_out):
                still = (
                    max(map(abs, look.target_qd_rad_s)) <= _STANDING_RAD_S
                    and max(map(abs, look.qd_rad_s)) < _STILL_RAD_S
                    and (self._goal is None or _near(look.target_q_rad, self._goal))
                )
                if not still:
                    still_since_s = None
                elif still_since_s is None:
                    still_since_s = look.t_device_s
                elif look.t_device_s - still_since_s >= self._timing.still_s:
                    return

    def stop(self) -> None:
        """Stop the arm; `move_to` then raises `DeviceFault`. May be called from any thread. Needs control."""
        if self._control is not None:
            self._stop_requested.set()
            self._halt()

    def _watch(self, timeout_s: float, guard: Guard, what: str, look_out: Callable[[], Sample]) -> Iterator[Sample]:
        """Yield each new sample until the time-out; raise any fault of the arm."""
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            look = look_out()
            guard()
            yield look
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeout(
                    f"{what} within {timeout_s:.1f} s; set-points are at {_degrees(look.target_q_rad)}",
                    "check the speed slider, and whether something else moves the arm",
                )

    @contextmanager
    def _reporting_stop(self) -> Iterator[None]:
        """Raise the requested stop instead of the failure that it caused, if another thread has called `stop`."""
        try:
            yield
        except DeviceError as error:
            if self._stop_requested.is_set():
                raise _stopped() from error
            raise

    def _look_out(self) -> Sample:
        """Return a new sample; raise any fault of the arm, the control program or the connections."""
        try:
            look = self._reading().look()
        except (DeviceTimeout, StreamBroken) as error:
            if self._control is None:
                raise
            raise self._control.explained(error) from error
        if self._control is not None:
            if fault := self._fault(look):
                raise fault
            self._in_control()
        return look

    def _look_out_moving(self) -> Sample:
        with self._reporting_stop():
            return self._look_out()

    def _fault(self, look: Sample | None = None) -> DeviceError | None:
        """Return the reason why the arm does not move, or None if the controller reports none."""
        reader = self._reading()
        look = look or reader.look()
        deadline_s = self._clock.now_s() + self._timing.reason_s
        while not look.safety_fault() and look.program_fault() and self._clock.now_s() < deadline_s:
            look = reader.look()
        fault = look.safety_fault() or look.program_fault()
        if fault is None:
            return None
        if self._control is not None and not look.safety_fault() and (reason := self._control.end_reason()):
            return reason
        return DeviceFault(f"the arm at {self._host} stopped: {fault.found}", f"{fault.fix}, then open the arm again")

    @contextmanager
    def _stopping_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._halt()
            raise

    def _halt(self) -> None:
        """Stop the arm with `stopJ`; if that fails, end the control program. Never raises."""
        # TCP detects a lost controller much later than the time-out of 0.2 s. Therefore the control process is killed,
        # and dashboard server or Robot API are asked to stop the program.
        control = self._control
        if control is None:
            return
        stopped = False
        try:
            stopped = self._stop_softly(control)
        finally:  # this also runs after a second Ctrl-C
            if not stopped:
                control.kill()  # on a lost link ur_rtde would restart the program repeatedly
                if control.has_ended:
                    self._program.is_gone()
                else:
                    self._program.stop(silent=self._reader is not None and self._reader.silent)

    def _stop_softly(self, control: Control) -> bool:
        try:
            if self._reading().silent:
                return False
            glance_s = self._timing.glance_s
            look = self._reading().look(limit_s=glance_s)
            if not control.alive or look.safety_fault() or look.program_fault():
                return False
            limit_s = self._timing.braking_s + self._moves_at_rad_s / self._stop_rad_s2
            control.call("stop", timeout_s=limit_s, look_out=self._look_out)
            for _ in range(10):  # ur_rtde does not report success
                if max(map(abs, self._reading().look(limit_s=glance_s).target_qd_rad_s)) <= _STANDING_RAD_S:
                    return True
        except DeviceError as error:
            log.info("%s: stopJ failed: %s", self._host, error)
        return False

    def _check_ours(self, control: Control) -> None:
        """Raise `DeviceFault` if another program runs instead of the control program."""
        # Another program may look the same: it plays, and the registers hold the last values of ours. Only the control
        # program answers a request for its TCP offset.
        if not self._is_ours(control, timeout_s=self._timing.ours_s, look_out=self._look_out):
            raise (
                control.end_reason()
                or self._fault()
                or DeviceFault(
                    f"the control program on {self._host} does not answer: another program may be running, or the "
                    "controller or this computer is overloaded",
                    "check the program on the pendant, then open the arm again",
                )
            )

    def _is_ours(self, control: Control, *, timeout_s: float, look_out: Callable[[], object] = lambda: None) -> bool:
        # Writes nothing: the registers of another program mean something else.
        try:
            control.call("tcp_offset", timeout_s=timeout_s, look_out=look_out)
        except DeviceTimeout as error:
            if control.alive:
                raise  # raised by `look_out`: the controller sends nothing
            log.info("%s: the control program does not answer: %s", self._host, error)
            self._program.is_gone()  # another program has probably replaced it
            return False
        except DeviceError as error:
            log.info("%s: the control program cannot be queried: %s", self._host, error)
            return False
        return True

    def _in_control(self) -> Control:
        if self._control is None:
            raise ConnectError(f"the arm at {self._host} was opened for reading only", "open it with control")
        if not self._control.alive:
            raise self._control.end_reason() or StreamBroken(
                f"the control of {self._host} has ended", "check the robot, then open the arm again"
            )
        return self._control

    def _reading(self) -> Reader:
        reader = self._reader  # one read, because another thread may close the arm
        if reader is None:
            raise ConnectError(f"the arm at {self._host} is not open", "open it first")
        return reader


def _stopped() -> DeviceFault:
    return DeviceFault("a stop was requested before the arm arrived")


def _check_speed(speed_rad_s: float, acceleration_rad_s2: float) -> None:
    if not radians(0.5) <= speed_rad_s <= radians(180):
        raise ValueError(f"speed_rad_s is {speed_rad_s}; choose 0.0087 to 3.14 (0.5 to 180 degrees per second).")
    if not radians(1) <= acceleration_rad_s2 <= radians(300):
        raise ValueError(
            f"acceleration_rad_s2 is {acceleration_rad_s2}; choose 0.0175 to 5.24 (1 to 300 degrees per second "
            "squared)."
        )


def _joints(q_rad: Sequence[float]) -> list[float]:
    """Check joint angles, because ur_rtde checks neither their number nor their values."""
    q = [float(angle) for angle in q_rad]
    if len(q) != 6 or not all(math.isfinite(angle) for angle in q):
        raise ValueError(f"q_rad is {q}; give six finite angles in radians.")
    if max(map(abs, q)) > 2 * math.pi + 1e-9:
        raise ValueError(f"q_rad is {_degrees(q)}, and the limit of every joint is 360 degrees; give radians.")
    return q


def _near(a_rad: Sequence[float], b_rad: Sequence[float]) -> bool:
    return max(abs(a - b) for a, b in zip(a_rad, b_rad, strict=True)) < _ARRIVED_RAD


def _degrees(q_rad: Sequence[float]) -> str:
    return "(" + ", ".join(f"{math.degrees(angle):.1f}" for angle in q_rad) + ") degrees"
