"""The controller without its sockets: arm, modes, safety, program and registers, one step per control cycle.

Time: a cycle takes one control period of real time; the controller and its arm live through `time_scale` times as much
in it (clock, motion, settling, the waiting times of the controller). The watchdog, which watches us, keeps real time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mocks.kinematics import ZERO6, Array, Dh, Vector6, cross, forward, jacobian, matrix_of, pose_of, vector6
from mocks.ur.motion import Arm, CannotFollow, MotionError
from mocks.ur.rtde import Value
from mocks.ur.script import ControlScript, ForeignProgram, ScriptError, Upload
from mocks.world import World

UNLOCK_AFTER_S = 5.0
STEADY_AFTER_S = 0.5
PROGRAM_START_S = 0.1
POWER_STEP_S = 0.5
WATCHDOG_STEP_S = 0.01  # a stall of this process may age the watchdog by no more than this

Vector3 = tuple[float, float, float]


class Runtime(IntEnum):
    """RTDE runtime_state."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class RobotMode(IntEnum):
    """RTDE robot_mode, as far as modelled."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """RTDE safety_mode, as far as modelled."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


SAFETY_BITS = {SafetyMode.NORMAL: 0x001, SafetyMode.PROTECTIVE_STOP: 0x404, SafetyMode.ROBOT_EMERGENCY_STOP: 0x4C0}
"""RTDE safety_status_bits of each mode."""


@dataclass(frozen=True)
class Limits:
    """Safety limits of the installation.

    Parameters
    ----------
    dh
        The real arm.
    joint_rad
        Largest angle of any joint either way.
    plane
        ``(nx, ny, nz, d)`` in base: flange, TCP and elbow must keep ``n · p >= d`` (m); None for no plane.
    """

    dh: Dh
    joint_rad: float = 2 * np.pi
    plane: tuple[float, float, float, float] | None = None

    def allow(self, q: Vector6, X_flange_tcp: Array) -> bool:
        """Whether the arm may stand at `q`."""
        if any(abs(v) > self.joint_rad for v in q):
            return False
        if self.plane is None:
            return True
        normal, distance = np.array(self.plane[:3]), self.plane[3]
        flange = forward(self.dh, q)
        points = (forward(self.dh, q, joints=2), flange, flange @ X_flange_tcp)
        return all(float(normal @ X[:3, 3]) >= distance for X in points)


@dataclass(frozen=True)
class RobotSettings:
    """Identity and installation of the emulated arm.

    Parameters
    ----------
    model
        Name of the arm, as in `mocks.kinematics.MODELS`.
    polyscope
        Software version, three numbers.
    tcp
        Active TCP at power-up as a UR pose, m and rad.
    time_scale
        How many times faster than real the physics runs.
    """

    model: str = "UR5e"
    polyscope: tuple[int, int, int] = (5, 15, 0)
    serial_number: str = "20225500001"
    tcp: Vector6 = ZERO6
    payload_kg: float = 0.0
    payload_cog_m: Vector3 = (0.0, 0.0, 0.0)
    joint_limit_rad: float = 2 * np.pi
    plane: tuple[float, float, float, float] | None = None
    time_scale: float = 1.0


class Robot:
    """State of the controller and the arm, advanced by `tick`.

    Parameters
    ----------
    world
        The shared truth; its `q` is written in every cycle.
    """

    def __init__(self, world: World, settings: RobotSettings) -> None:
        self.world = world
        self.settings = settings
        self.arm = Arm(world.dh, world.q)
        self.limits = Limits(world.dh, settings.joint_limit_rad, settings.plane)
        self.frequency_hz = 125 if settings.polyscope[0] <= 3 else 500
        self.period_s = 1.0 / self.frequency_hz
        self.cycle = 0
        self.runtime = Runtime.STOPPED
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.remote_control = True
        self.loaded_program: str | None = None
        self.payload_kg = settings.payload_kg
        self.payload_cog_m = settings.payload_cog_m
        self.payload_inertia: Vector6 = ZERO6
        down = world.truth.gravity_m_s2
        self.gravity_m_s2: Vector3 = (float(-down[0]), float(-down[1]), float(-down[2]))
        self.tcp_offset = settings.tcp
        self.inputs: dict[str, Value] = {}
        self.output_ints = [0] * 48
        self.output_doubles = [0.0] * 48
        self.events: list[str] = []
        """What happened, newest last: program starts, stops and errors, safety stops."""
        self._program: ControlScript | ForeignProgram | None = None
        self._physical_s = 0.0
        self._stopped_at_s = 0.0
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._watchdog: tuple[str, float] | None = None
        self._watchdog_age_s = 0.0
        self._ft_zero = np.zeros(6)
        self._wrench: tuple[tuple[object, ...], Vector6] | None = None
        self._poses: dict[str, tuple[Vector6, Vector6, Vector6]] = {}

    # -- time ---------------------------------------------------------------------------------------------------------

    @property
    def timestamp_s(self) -> float:
        """Controller clock on the wire."""
        return 100.0 + self.cycle * self.period_s * self.settings.time_scale

    def tick(self) -> None:
        """One control cycle: program, then motion."""
        self.cycle += 1
        dt = self.period_s * self.settings.time_scale
        self._physical_s += dt
        due = [action for when, action in self._later if when <= self._physical_s]
        self._later = [(when, action) for when, action in self._later if when > self._physical_s]
        for action in due:
            action()
        if self.runtime == Runtime.PLAYING and self._program is not None:
            try:
                if not self._program.step():
                    self.stop_program("ended")
            except (ScriptError, MotionError, ArithmeticError, ValueError) as error:
                self.stop_program(f"run-time error: {error}")
        before = self.arm.q
        try:
            self.arm.step(dt)
        except CannotFollow as error:
            self.protective_stop(str(error))
        if self.arm.q is not before and self._leaves_limits(before):
            self.protective_stop("safety limit reached")
        self.world.q = self.arm.actual_q

    def _leaves_limits(self, before: Vector6) -> bool:
        """Whether the last step crossed a safety limit outwards; the way back is free."""
        X = self.X_flange_tcp
        return not self.limits.allow(self.arm.q, X) and self.limits.allow(before, X)

    def skip(self, cycles: int) -> None:
        """Let wire time pass in which the controller did nothing."""
        self.cycle += cycles

    def watch(self, elapsed_s: float) -> None:
        """Age the watchdog by real time; a program whose client is silent is stopped."""
        if self._watchdog is None or self.runtime != Runtime.PLAYING:
            return
        self._watchdog_age_s += min(elapsed_s, WATCHDOG_STEP_S)
        name, period_s = self._watchdog
        if self._watchdog_age_s > period_s:
            self.stop_program(f"watchdog: {name} not written for {period_s:.3f} s")

    def _after(self, seconds: float, action: Callable[[], None]) -> None:
        self._later.append((self._physical_s + seconds, action))

    # -- program ------------------------------------------------------------------------------------------------------

    @property
    def program_name(self) -> str:
        """Name of the program, as the dashboard shows it."""
        return self._program.name if self._program is not None else self.loaded_program or "unnamed"

    @property
    def can_run(self) -> bool:
        """Whether a program may start: powered, brakes released, no safety stop, remote control."""
        return self.robot_mode == RobotMode.RUNNING and self.safety_mode == SafetyMode.NORMAL and self.remote_control

    def upload(self, upload: Upload) -> None:
        """Take a program from the script port: it replaces the running one."""
        if upload.secondary:
            self.events.append(f"secondary program {upload.name} not interpreted")
            return
        if not self.can_run:
            self.events.append(f"program {upload.name} refused")
            return
        self.stop_program("replaced")
        program: ControlScript | ForeignProgram
        if upload.is_control_script:
            program = ControlScript(self, upload.register_offset("int"), upload.register_offset("float"))
        else:
            program = ForeignProgram()
        self._after(PROGRAM_START_S, lambda: self._start(program, upload.name))

    def _start(self, program: ControlScript | ForeignProgram, name: str) -> None:
        if self.can_run:
            self.stop_program("replaced")
            self._program = program
            self.runtime = Runtime.PLAYING
            self.arm.paused = False
            self.zero_ft()  # e-Series zeroes its sensor at every program start
            self.events.append(f"program {name} started")

    def stop_program(self, reason: str) -> None:
        """End the program if there is one; a moving arm comes to rest by itself."""
        if self._program is not None:
            self._program.close()
            self._program = None
            self.events.append(f"program stopped: {reason}")
        self.arm.release()
        self.arm.paused = self.safety_mode != SafetyMode.NORMAL
        self.runtime = Runtime.STOPPED
        self._watchdog = None

    def pause(self) -> bool:
        """Dashboard pause; False when no program plays."""
        if self.runtime != Runtime.PLAYING:
            return False
        self.runtime = Runtime.PAUSED
        self.arm.paused = True
        return True

    def play(self) -> bool:
        """Dashboard play: go on where the program paused, or start the loaded one; False when it cannot."""
        if not self.can_run:
            return False
        if self.runtime == Runtime.PAUSED:
            self.runtime = Runtime.PLAYING
            self.arm.paused = False
            return True
        if self.loaded_program is None:
            return False
        self._start(ForeignProgram(), self.loaded_program)
        return True

    # -- safety and power ---------------------------------------------------------------------------------------------

    def protective_stop(self, reason: str) -> None:
        """Come to rest on the path and pause the program."""
        if self.safety_mode != SafetyMode.NORMAL:
            return
        self.events.append(f"protective stop: {reason}")
        self.safety_mode = SafetyMode.PROTECTIVE_STOP
        self._stopped_at_s = self._physical_s
        self.arm.paused = True
        if self.runtime == Runtime.PLAYING:
            self.runtime = Runtime.PAUSED

    def unlock(self) -> bool:
        """Leave the protective stop; False when it is too early."""
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP:
            return True
        if self._physical_s - self._stopped_at_s < UNLOCK_AFTER_S:
            return False
        self.events.append("protective stop unlocked")
        self.safety_mode = SafetyMode.NORMAL
        self.arm.paused = self.runtime == Runtime.PAUSED
        return True

    def emergency_stop(self, pressed: bool) -> None:
        """Press or release the emergency stop: power is gone, the program has ended."""
        self.events.append(f"emergency stop {'pressed' if pressed else 'released'}")
        if pressed:
            self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
            self.power_off()
        elif self.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety_mode = SafetyMode.NORMAL
            self.arm.paused = False

    def power_off(self) -> None:
        """Stop the program, brake, cut the power."""
        self.stop_program("power off")
        self.robot_mode = RobotMode.POWER_OFF
        self._later.clear()

    def power_on(self) -> None:
        """From off to idle, brakes still closed."""
        if self.robot_mode == RobotMode.POWER_OFF and self.safety_mode != SafetyMode.ROBOT_EMERGENCY_STOP:
            self.robot_mode = RobotMode.POWER_ON
            self._after(POWER_STEP_S, lambda: self._set_mode(RobotMode.IDLE))

    def brake_release(self) -> None:
        """Up to running, from wherever it is."""
        self.power_on()
        if self.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE):
            self._after(2 * POWER_STEP_S, lambda: self._set_mode(RobotMode.RUNNING))

    def _set_mode(self, mode: RobotMode) -> None:
        self.robot_mode = mode

    def set_watchdog(self, name: str, min_frequency_hz: float) -> None:
        """Stop the program when input `name` is not written at least this often (Hz)."""
        if not min_frequency_hz > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {min_frequency_hz} must be positive")
        self._watchdog = (name, 1.0 / min_frequency_hz)
        self._watchdog_age_s = 0.0

    # -- registers ----------------------------------------------------------------------------------------------------

    def write_inputs(self, fields: dict[str, Value]) -> None:
        """Take over input variables from a client."""
        self.inputs.update(fields)
        if self._watchdog is not None and self._watchdog[0] in fields:
            self._watchdog_age_s = 0.0
        fraction = fields.get("speed_slider_fraction")
        if isinstance(fraction, float) and fields.get("speed_slider_mask"):
            self.arm.speed_fraction = min(1.0, max(0.0, fraction))

    def input_int(self, index: int) -> int:
        """Present value of input_int_register_`index`."""
        value = self.inputs.get(f"input_int_register_{index}", 0)
        return value if isinstance(value, int) else 0

    def input_double(self, index: int) -> float:
        """Present value of input_double_register_`index`."""
        value = self.inputs.get(f"input_double_register_{index}", 0.0)
        return value if isinstance(value, float) else 0.0

    # -- tool ---------------------------------------------------------------------------------------------------------

    @property
    def tcp_offset(self) -> Vector6:
        """Active TCP as a UR pose in the flange frame, m and rad."""
        return self._tcp_offset

    @tcp_offset.setter
    def tcp_offset(self, pose: Vector6) -> None:
        self._tcp_offset = pose
        self.X_flange_tcp = matrix_of(pose)

    def tcp_pose(self, which: str) -> Vector6:
        """UR pose in base of the active TCP, at the "actual" joints or at their "target"."""
        q = self.arm.actual_q if which == "actual" else self.arm.q
        known = self._poses.get(which)
        if known is None or known[0] is not q or known[1] is not self._tcp_offset:
            known = (q, self._tcp_offset, pose_of(forward(self.arm.dh, q) @ self.X_flange_tcp))
            self._poses[which] = known
        return known[2]

    def tcp_speed(self, which: str) -> Vector6:
        """Velocity of the active TCP and angular velocity, m/s and rad/s, base axes."""
        arm = self.arm
        q, qd = (arm.actual_q, arm.actual_qd) if which == "actual" else (arm.q, arm.qd)
        if not any(qd):
            return ZERO6
        twist = jacobian(arm.dh, q) @ qd
        lever = forward(arm.dh, q)[:3, :3] @ self.X_flange_tcp[:3, 3]
        return vector6(np.concatenate((twist[:3] + cross(twist[3:], lever), twist[3:])))

    @property
    def steady(self) -> bool:
        """Whether the set-point has stood still for half a second."""
        return self.arm.still_s >= STEADY_AFTER_S

    def flange_wrench(self) -> Array:
        """What the arm's own sensor feels, (6,): N and N·m, exerted on the flange, its axes and origin."""
        R = self.world.truth.R_flange_sensor
        felt = self.world.load_wrench() + self.world.contact_wrench
        return np.concatenate((R @ felt[:3], R @ felt[3:]))

    def tcp_wrench(self) -> Vector6:
        """actual_TCP_force: payload-compensated and zeroed, base axes, at the TCP, exerted on the tool."""
        world = self.world
        key = (world.q, world.contact_wrench, self.payload_kg, self.payload_cog_m, self._tcp_offset, self._ft_zero)
        if self._wrench is None or any(a is not b for a, b in zip(self._wrench[0], key, strict=True)):
            felt = self._compensated() - self._ft_zero
            R_base_flange = forward(self.arm.dh, world.q)[:3, :3]
            torque = felt[3:] - cross(self.X_flange_tcp[:3, 3], felt[:3])
            self._wrench = (key, vector6(np.concatenate((R_base_flange @ felt[:3], R_base_flange @ torque))))
        return self._wrench[1]

    def zero_ft(self) -> None:
        """zero_ftsensor: take the present reading as zero."""
        self._ft_zero = self._compensated()

    def _compensated(self) -> Array:
        R = forward(self.arm.dh, self.world.q)[:3, :3]
        weight = R.T @ np.array(self.gravity_m_s2) * -self.payload_kg
        rest: Array = self.flange_wrench() - np.concatenate((weight, cross(self.payload_cog_m, weight)))
        return rest
