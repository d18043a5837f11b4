"""The controller without its sockets: arm, modes, safety, program and registers, advanced once per control cycle.

Time: a cycle takes one control period of the cell's clock, in which the time of the controller (clock, motion,
settling, waiting times) advances by `time_scale` control periods. The watchdog of a client uses the cell's time, as
does the controller's clock if the arm's own sensor is the sensor of the station.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from ftmocks.arrays import Array
from ftmocks.imperfections import FRICTION_RAD_S, Ringing, WarmUp
from ftmocks.kinematics import (
    ZERO6,
    Dh,
    JointState,
    Vector3,
    Vector6,
    cross,
    elbow,
    forward,
    jacobian,
    matrix_of,
    pose_of,
    vector6,
)
from ftmocks.ur.controller_program import ControllerProgram, Place, ScriptError, error_at
from ftmocks.ur.events import Event
from ftmocks.ur.modes import PAUSING, PERMITTED, POWERED, POWERLESS, RobotMode, Runtime, SafetyMode
from ftmocks.ur.motion import Arm, CannotFollow, HandMove, MotionError
from ftmocks.ur.rtde import Value
from ftmocks.world import World

UNLOCK_AFTER_S = 5.0
STEADY_AFTER_S = 0.5
PROGRAM_START_S = 0.1
POWER_STEP_S = 0.5
COMMAND_REGISTERS = {"input_int_register_0", "input_int_register_24"}
STOP_SCRIPT = 255
"""Command that ends the control script when a client writes it into a command register."""
HAND_ACCELERATION_RAD_S2 = 1.5
NO_ERROR: Array = np.zeros(6)
INSTALLED_G_M_S2 = 9.82
"""Gravitational acceleration that an installation contains, m/s², the same at every place on Earth."""


@dataclass(frozen=True)
class Limits:
    """Safety limits of the installation.

    Parameters
    ----------
    dh
        Kinematics of the real arm.
    joint_rad
        Largest absolute angle of each joint.
    plane
        ``(nx, ny, nz, d)`` in the base: ``n · p >= d`` (m) for flange, TCP and elbow; None for no plane.
    """

    dh: Dh
    joint_rad: float = 2 * np.pi
    plane: tuple[float, float, float, float] | None = None

    def allow(self, q: Vector6, X_flange_tcp: Array) -> bool:
        """Return whether the arm may be at `q`."""
        if any(abs(v) > self.joint_rad for v in q):
            return False
        if self.plane is None:
            return True
        normal, distance = np.array(self.plane[:3]), self.plane[3]
        flange = forward(self.dh, q)
        points = (elbow(self.dh, q), flange[:3, 3], (flange @ X_flange_tcp)[:3, 3])
        return all(float(normal @ p) >= distance for p in points)


@dataclass(frozen=True)
class RobotSettings:
    """Identity and installation of the emulated arm.

    Parameters
    ----------
    model
        Name of the arm, as in `ftmocks.kinematics.MODELS`.
    polyscope
        Software version, three numbers.
    tcp
        Active TCP at power-up as a UR pose, m and rad.
    gravity_m_s2
        (3,) negative gravitational acceleration in base axes, according to the mounting in the installation.
    unknown_outputs
        RTDE outputs that this controller reports as NOT_FOUND although its version has them.
    time_scale
        Factor by which the physics is faster than real time.
    """

    model: str = "UR5e"
    polyscope: tuple[int, int, int] = (5, 15, 0)
    serial_number: str = "20225500001"
    tcp: Vector6 = ZERO6
    payload_kg: float = 0.0
    payload_cog_m: Vector3 = (0.0, 0.0, 0.0)
    gravity_m_s2: Vector3 = (0.0, 0.0, INSTALLED_G_M_S2)
    joint_limit_rad: float = 2 * np.pi
    plane: tuple[float, float, float, float] | None = None
    unknown_outputs: frozenset[str] = frozenset()
    time_scale: float = 1.0


@dataclass
class Signals:
    """Digital and analog signals, and the boolean registers that programs write.

    Parameters
    ----------
    inputs, outputs
        Bits as in RTDE: eight standard signals, eight configurable ones, two of the tool.
    analog_outputs
        Levels, 0 to 1.
    registers
        Bits of the boolean output registers.
    """

    inputs: int = 0
    outputs: int = 0
    analog_outputs: list[float] = field(default_factory=lambda: [0.0, 0.0])
    registers: int = 0


class Robot:
    """State of the controller and the arm, advanced by `tick`.

    Parameters
    ----------
    world
        The physical world, to which joint angles are written in every cycle, and whose clock is used.
    arm
        The arm; None creates one at the joint angles of the world.
    """

    popup: str | None = None
    """Text of the popup that a program shows, until the operator closes it."""
    popup_answer: bool | float | str | None = None
    """Value that the operator entered in the last popup."""

    def __init__(self, world: World, settings: RobotSettings, arm: Arm | None = None) -> None:
        self.world = world
        self.clock = world.clock
        self.settings = settings
        imperfections = world.imperfections
        self.arm = arm or Arm(world.dh, world.q, imperfections.servo_lag_s)
        self._ringing = Ringing.at_rest(imperfections, world.seed)
        self._joint_noise = np.random.default_rng([world.seed, 9])
        self._wrist_drift = WarmUp(imperfections.wrist_drift_N, world.now_s)
        self.reported_dh: Dh | None = world.dh
        """Kinematics that the primary interface sends to clients; None if it sends none."""
        self.limits = Limits(world.dh, settings.joint_limit_rad, settings.plane)
        self.frequency_hz = 125 if settings.polyscope[0] <= 3 else 500
        self.period_s = 1.0 / self.frequency_hz
        self.cycle = 0
        self.cycle_s = world.now_s
        """Time of the current cycle on the cell's clock."""
        self.runtime = Runtime.STOPPED
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.remote_switches = 0
        """Number of changes between local and remote control on the pendant."""
        self.loaded_program: str | None = None  # path of the program file, as the dashboard reports it
        self.payload_kg = settings.payload_kg
        self.payload_cog_m = settings.payload_cog_m
        self.payload_inertia: Vector6 = ZERO6
        self.target_gravity_m_s2 = settings.gravity_m_s2
        """Negative gravitational acceleration that the controller assumes, in base axes."""
        self.tcp_offset = settings.tcp
        self.inputs: dict[str, Value] = {}
        self.output_ints = [0] * 48
        self.output_doubles = [0.0] * 48
        self.signals = Signals()
        self.events: list[Event] = []
        """Event log: accepted and refused commands, program, safety, start and end of motion. The newest is last."""
        self.hand: Iterator[None] | None = None
        """Motion of the operator who guides the arm by hand; each `next` runs one control cycle. None without one."""
        self._remote_control = True
        self._reduced = False
        self._program: ControllerProgram | None = None
        self.wrist_sensor: Callable[[int], Array] | None = None
        """Returns n readings (n, 6) of the wrist sensor with bias and noise; without it, `ft_raw_wrench` is exact."""
        self._physical_s = self._stopped_at_s = self._watchdog_age_s = 0.0
        self._later: list[tuple[float, Callable[[], object]]] = []
        self._watchdog: tuple[str, float] | None = None
        self._ft_zero = np.zeros(6)
        self._measured: tuple[int, Vector6] | None = None
        self._reading: tuple[int, Vector6] | None = None
        self._wrench: tuple[tuple[object, ...], Vector6] | None = None
        self._poses: dict[str, tuple[Vector6, Vector6, Vector6]] = {}

    @property
    def timestamp_s(self) -> float:
        """Time that the controller sends. If it stamps samples of the station's sensor, it is the cell's time."""
        scale = 1.0 if self.wrist_sensor else self.settings.time_scale
        return 100.0 + self.cycle * self.period_s * scale

    def tick(self, t_s: float | None = None) -> None:
        """Run a control cycle at `t_s` of the cell's clock (None: now): first the program, then the motion."""
        self.cycle_s = self.clock.now_s() if t_s is None else t_s
        self.cycle += 1
        dt = self.period_s * self.settings.time_scale
        self._physical_s += dt
        due = [action for when, action in self._later if when <= self._physical_s]
        self._later = [(when, action) for when, action in self._later if when > self._physical_s]
        for action in due:
            action()
        self._watch()
        if self.hand is not None:
            next(self.hand, None)
        if self.runtime == Runtime.PLAYING and self._program is not None:
            try:
                if not self._program.step():
                    self.stop_program("ended")
            except (ScriptError, MotionError, ArithmeticError, ValueError) as error:
                self.crash(str(error))
        before, stood = self.arm.q, self.arm.at_rest
        try:
            self.arm.step(dt, self.cycle_s)
        except CannotFollow as error:
            self.protective_stop(str(error))
        if self.arm.q is not before and self._leaves_limits(before):
            self.protective_stop("safety limit reached")
        if stood != self.arm.at_rest:
            self.note("arm", "moves" if stood else "stands", q_rad=list(self.arm.q))
        self._move_world(dt)

    def _move_world(self, dt: float) -> None:
        """Set the motion of the arm in the world, whose time is `time_scale` times slower, including ringing links."""
        begun_s, scale, motion, q = self.cycle_s, self.settings.time_scale, self.arm.motion, self.arm.actual_q
        ringing = self._ringing = self._ringing.after(dt, ZERO6 if motion is None else motion.at(0.0).qdd)

        def at(t_s: float) -> JointState:
            t = (t_s - begun_s) * scale
            state = JointState(q) if motion is None else motion.at(t)
            if ringing.amplitudes is None:
                return state
            return state._replace(qdd=vector6([a + b for a, b in zip(state.qdd, ringing.at(t).tolist(), strict=True)]))

        self.world.move(begun_s, q, None if motion is None and ringing.amplitudes is None else at)
        self.world.swing(dt, self.arm.actual_qd)

    @property
    def measured_q(self) -> Vector6:
        """Joint angles that the controller reports as actual, rad: the true ones with new noise in every cycle."""
        sd_rad = self.world.imperfections.joint_noise_rad
        if not sd_rad:
            return self.arm.actual_q
        if self._measured is None or self._measured[0] != self.cycle:
            noise = self._joint_noise.normal(scale=sd_rad, size=6).tolist()
            measured = vector6([q + n for q, n in zip(self.arm.actual_q, noise, strict=True)])
            self._measured = (self.cycle, measured)
        return self._measured[1]

    def note(self, by: str, what: str, *, accepted: bool = True, why: str = "", **detail: Any) -> None:
        """Add an entry to the event log of the controller."""
        self.events.append(Event(self.clock.now_ns(), self.timestamp_s, by, what, accepted, why, detail))

    def _leaves_limits(self, before: Vector6) -> bool:
        """Return whether the last step crossed a safety limit outwards. A move back inside is allowed."""
        X = self.X_flange_tcp
        return not self.limits.allow(self.arm.q, X) and self.limits.allow(before, X)

    def _watch(self) -> None:
        """Advance the watchdog by a cycle; stop the program if its client has not written in time."""
        if self._watchdog is None or self.runtime != Runtime.PLAYING:
            return
        self._watchdog_age_s += self.period_s
        name, period_s = self._watchdog
        if self._watchdog_age_s > period_s:
            self.stop_program(f"watchdog: {name} not written for {period_s:.3f} s")

    def _after(self, seconds: float, action: Callable[[], object]) -> None:
        self._later.append((self._physical_s + seconds, action))

    @property
    def program_name(self) -> str:
        """Name of the program, as the dashboard shows it."""
        return self._program.name if self._program is not None else PurePosixPath(self.loaded_program or "unnamed").name

    @property
    def remote_control(self) -> bool:
        """Whether the pendant is switched to remote control."""
        return self._remote_control

    @remote_control.setter
    def remote_control(self, on: bool) -> None:
        self.remote_switches += on != self._remote_control
        self._remote_control = on

    @property
    def obstacle(self) -> str | None:
        """Reason why no program may start now, as text; None if one may."""
        if self.robot_mode != RobotMode.RUNNING:
            return f"robot mode {self.robot_mode.name}"
        if self.safety_mode not in PERMITTED:
            return f"safety mode {self.safety_mode.name}"
        return self.arm.obstacle

    def start_soon(self, program: ControllerProgram, *, by: str, obstacle: str | None, **detail: Any) -> bool:
        """Start a program, which replaces the running one, unless there is an obstacle; return whether it started."""
        self.note(by, f"program {program.name}", accepted=obstacle is None, why=obstacle or "", **detail)
        if obstacle is None:
            self.stop_program("replaced")
            self._after(PROGRAM_START_S, lambda: self._start(program))
        return obstacle is None

    def _start(self, program: ControllerProgram) -> None:
        if self.obstacle is not None:
            self.note("program", f"started {program.name}", accepted=False, why=self.obstacle)
            return
        self.stop_program("replaced")
        self._program = program
        self.runtime = Runtime.PLAYING
        self.arm.paused = False
        self.zero_ft()  # e-Series zeroes its sensor at every program start
        self.note("program", f"started {program.name}")

    def crash(self, error: str) -> bool:
        """End the program with a run-time error and log its position; return False if no program was running."""
        place = Place() if self._program is None else self._program.place
        return self.stop_program(f"run-time error: {error}", **error_at(place, error))

    def stop_program(self, reason: str, **detail: Any) -> bool:
        """End the program. A moving arm comes to rest. Return False if no program was running."""
        program, self._program = self._program, None
        if program is not None:
            program.close()
            self.note("program", f"stopped {program.name}", why=reason, **detail)
        self.popup = None
        self.arm.release()
        self.arm.paused = self.safety_mode not in PERMITTED
        self.runtime = Runtime.STOPPED
        self._watchdog = None
        return program is not None

    def pause(self, reason: str) -> bool:
        """Pause the program and hold the arm on its path; return False if no program plays."""
        if self.runtime != Runtime.PLAYING:
            return False
        self.runtime = Runtime.PAUSED
        self.arm.paused = True
        self.note("program", f"paused {self.program_name}", why=reason)
        return True

    def play(self) -> bool:
        """Resume a paused program or start the loaded one; return False if neither is possible."""
        if self.obstacle is not None:
            return False
        if self.runtime == Runtime.PAUSED:
            self.runtime = Runtime.PLAYING
            self.arm.paused = False
            self.note("program", f"resumed {self.program_name}")
            return True
        if self.loaded_program is None or self.runtime == Runtime.PLAYING:
            return False
        self._start(ControllerProgram(self.program_name))
        return True

    @property
    def hand_obstacle(self) -> str | None:
        """Reason why the arm cannot be moved by hand now, as text; None if it can."""
        return "a program plays" if self.runtime == Runtime.PLAYING else self.obstacle

    def hand_move(self, q: Vector6, speed_rad_s: float) -> None:
        """Move the arm by hand, as in freedrive: no program plays, and the set-point follows the joints.

        Raises
        ------
        ValueError
            A program plays, or the arm has no power.
        """
        if self.hand_obstacle:
            raise ValueError(f"the arm cannot be moved by hand: {self.hand_obstacle}")
        self.arm.start(HandMove(self.arm.dh, q, speed_rad_s, HAND_ACCELERATION_RAD_S2), "hand")

    def protective_stop(self, reason: str) -> None:
        """Come to rest on the path and pause the program."""
        if self.safety_mode in PERMITTED:
            self._stopped_at_s = self._physical_s
            self.set_safety(SafetyMode.PROTECTIVE_STOP, reason)

    def unlock(self) -> bool:
        """Leave the protective stop, while the program remains paused; return False if it is too early."""
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP:
            return True
        if self._physical_s - self._stopped_at_s < UNLOCK_AFTER_S:
            return False
        self.set_safety(SafetyMode.NORMAL, "unlocked")
        return True

    def safeguard_stop(self, on: bool) -> None:
        """Open or close the safeguard input. Closing it resumes the paused program."""
        if on and self.safety_mode in PERMITTED:
            self.set_safety(SafetyMode.SAFEGUARD_STOP, "safeguard opened")
        elif not on and self.safety_mode == SafetyMode.SAFEGUARD_STOP:
            self.set_safety(SafetyMode.NORMAL, "safeguard closed")
            if self.runtime == Runtime.PAUSED:
                self.play()

    def reduced_mode(self, on: bool) -> None:
        """Switch to reduced safety limits or back. Programs continue."""
        self._reduced = on
        if self.safety_mode in PERMITTED:
            self.set_safety(SafetyMode.NORMAL, "reduced limits" if on else "normal limits")

    def emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency stop, which cuts the power and ends the program."""
        if pressed:
            self.set_safety(SafetyMode.ROBOT_EMERGENCY_STOP, "emergency stop pressed")
        elif self.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.set_safety(SafetyMode.NORMAL, "emergency stop released")

    def restart_safety(self) -> None:
        """Restart the safety system after a violation or fault. The arm has no power afterwards."""
        if self.safety_mode in (SafetyMode.VIOLATION, SafetyMode.FAULT):
            self.set_safety(SafetyMode.NORMAL, "safety restarted")
            self.set_mode(RobotMode.POWER_OFF)

    def set_safety(self, mode: SafetyMode, reason: str) -> None:
        """Enter a safety mode, with its effects on program and power. While reduced mode is on, NORMAL is REDUCED."""
        if mode in PERMITTED:
            mode = SafetyMode.REDUCED if self._reduced else SafetyMode.NORMAL
        self.safety_mode = mode
        self.note("safety", mode.name, why=reason)
        if mode in PERMITTED:
            self.arm.paused = self.runtime == Runtime.PAUSED
        elif mode in PAUSING:
            self.arm.paused = True
            self.pause(mode.name)
        elif mode in POWERLESS:
            self.set_mode(RobotMode.POWER_OFF)
        else:
            self.stop_program(mode.name)

    def set_mode(self, mode: RobotMode) -> None:
        """Enter a robot mode. Any mode except RUNNING ends the program, and a loss of power cancels pending changes."""
        if mode != RobotMode.RUNNING:
            self.stop_program(f"robot mode {mode.name}")
        if mode not in POWERED:
            self._later.clear()
        self.robot_mode = mode
        self.note("power", mode.name)

    def power_off(self) -> None:
        """Stop the program, brake, cut the power."""
        self.set_mode(RobotMode.POWER_OFF)

    def power_on(self) -> bool:
        """Change from off to idle, with closed brakes; return False if the safety mode does not allow it."""
        if self.safety_mode in POWERLESS:
            return False
        if self.robot_mode == RobotMode.POWER_OFF:
            self.set_mode(RobotMode.POWER_ON)
            self._after(POWER_STEP_S, lambda: self.set_mode(RobotMode.IDLE))
        return True

    def brake_release(self) -> bool:
        """Change to running from any mode; return False if the safety mode does not allow it."""
        if not self.power_on():
            return False
        if self.robot_mode == RobotMode.POWER_ON:
            self._after(POWER_STEP_S, self.brake_release)
        elif self.robot_mode == RobotMode.IDLE:
            self._after(POWER_STEP_S, lambda: self.set_mode(RobotMode.RUNNING))
        return True

    def set_watchdog(self, name: str, min_frequency_hz: float) -> None:
        """Stop the program if input `name` is written at a lower rate than this, Hz."""
        if not min_frequency_hz > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {min_frequency_hz} must be positive")
        self._watchdog = (name, 1.0 / min_frequency_hz)
        self._watchdog_age_s = 0.0

    def write_inputs(self, fields: dict[str, Value]) -> None:
        """Store the values of RTDE input variables that a client has written."""
        self._note_lost_command(fields)
        self.inputs.update(fields)
        if self._watchdog is not None and self._watchdog[0] in fields:
            self._watchdog_age_s = 0.0
        fraction = fields.get("speed_slider_fraction")
        if isinstance(fraction, float) and fields.get("speed_slider_mask"):
            self.arm.speed_fraction = min(1.0, max(0.0, fraction))

    def _note_lost_command(self, fields: dict[str, Value]) -> None:
        """Log a command that a client wrote into the registers while no program reads it."""
        for name in COMMAND_REGISTERS & fields.keys():
            command = fields[name]
            reader = self._program if self.runtime == Runtime.PLAYING else None
            listening = reader is not None and reader.reads_registers
            if not listening and command not in (0, STOP_SCRIPT, self.inputs.get(name)):
                why = f"no control script reads commands (state {self.runtime.name}, program {self.program_name})"
                self.note("rtde", f"command {command}", accepted=False, why=why)

    def input_int(self, index: int) -> int:
        """Return the value of input_int_register_`index`."""
        value = self.inputs.get(f"input_int_register_{index}", 0)
        return value if isinstance(value, int) else 0

    def input_double(self, index: int) -> float:
        """Return the value of input_double_register_`index`."""
        value = self.inputs.get(f"input_double_register_{index}", 0.0)
        return value if isinstance(value, float) else 0.0

    @property
    def tcp_offset(self) -> Vector6:
        """Pose of the active TCP in the flange as a UR pose, m and rad."""
        return self._tcp_offset

    @tcp_offset.setter
    def tcp_offset(self, pose: Vector6) -> None:
        self._tcp_offset = pose
        self.X_flange_tcp = matrix_of(pose)

    def tcp_pose(self, which: str) -> Vector6:
        """Return the UR pose of the active TCP in the base, at the "actual" or the "target" joint angles."""
        q = self.measured_q if which == "actual" else self.arm.q
        known = self._poses.get(which)
        if known is None or known[0] is not q or known[1] is not self._tcp_offset:
            known = (q, self._tcp_offset, pose_of(forward(self.arm.dh, q) @ self.X_flange_tcp))
            self._poses[which] = known
        return known[2]

    def tcp_speed(self, which: str) -> Vector6:
        """Return velocity of the active TCP and angular velocity in base axes, m/s and rad/s."""
        arm = self.arm
        q, qd = (arm.actual_q, arm.actual_qd) if which == "actual" else (arm.q, arm.qd)
        if not any(qd):
            return ZERO6
        twist = jacobian(arm.dh, q) @ qd
        lever = forward(arm.dh, q)[:3, :3] @ self.X_flange_tcp[:3, 3]
        return vector6(np.concatenate((twist[:3] + cross(twist[3:], lever), twist[3:])))

    @property
    def steady(self) -> bool:
        """Whether the set-point has been at rest for 0.5 s."""
        return self.arm.still_s >= STEADY_AFTER_S

    def flange_wrench(self) -> Array:
        """Return the wrench (6,) of tool and sensor on the arm's own sensor, in flange axes about the flange origin."""
        truth = self.world.truth
        world, t_s = self.world, self.cycle_s
        felt = world.load_wrench(t_s) + world.contact_wrench(t_s) + world.ripple_wrench(np.array([t_s]))[0]
        force = truth.R_flange_sensor @ felt[:3]
        torque = truth.R_flange_sensor @ felt[3:] + cross(truth.p_flange_sensor_m, force)
        wrench: Array = np.concatenate((force, torque)) + self.world.sensor_load(self.cycle_s)
        return wrench + self.wrist_error()

    def wrist_error(self) -> Array:
        """Return the error (6,) of the arm's own sensor due to friction and drift, in flange axes."""
        if not (self.world.imperfections.wrist_drift_N or self.arm.actual_qd[5]):
            return NO_ERROR
        turning = math.tanh(self.arm.actual_qd[5] / FRICTION_RAD_S)
        friction = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -turning * self.world.imperfections.wrist_friction_Nm])
        error: Array = self._wrist_drift.at(self.cycle_s) + friction
        return error

    def raw_wrench(self) -> Vector6:
        """Return ft_raw_wrench: a new reading in every cycle, in flange axes."""
        if self.wrist_sensor is None:
            return vector6(self.flange_wrench())
        if self._reading is None or self._reading[0] != self.cycle:
            self._reading = (self.cycle, vector6(self.wrist_sensor(1)[0]))
        return self._reading[1]

    def tcp_wrench(self) -> Vector6:
        """Return actual_TCP_force: the wrench on the tool at the TCP in base axes, compensated for payload and zero."""
        world = self.world
        load, contact = world.load_wrench(self.cycle_s), world.contact_wrench(self.cycle_s)
        felt_now = (world.q, load, contact, self.wrist_error())
        assumed = (self.payload_kg, self.payload_cog_m, self.target_gravity_m_s2)
        key = (*felt_now, *assumed, self._tcp_offset, self._ft_zero)
        if self._wrench is None or any(a is not b for a, b in zip(self._wrench[0], key, strict=True)):
            felt = self._compensated() - self._ft_zero
            R_base_flange = forward(self.arm.dh, world.q)[:3, :3]
            torque = felt[3:] - cross(self.X_flange_tcp[:3, 3], felt[:3])
            self._wrench = (key, vector6(np.concatenate((R_base_flange @ felt[:3], R_base_flange @ torque))))
        return self._wrench[1]

    def zero_ft(self) -> None:
        """zero_ftsensor: subtract the current reading from later ones."""
        self._ft_zero = self._compensated()

    def _compensated(self) -> Array:
        R = forward(self.arm.dh, self.world.q)[:3, :3]
        weight = R.T @ np.array(self.target_gravity_m_s2) * -self.payload_kg
        rest: Array = self.flange_wrench() - np.concatenate((weight, cross(self.payload_cog_m, weight)))
        return rest
