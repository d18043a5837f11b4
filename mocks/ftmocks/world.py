"""The true state of a robot cell: arm, gravity, payload, mounting of the sensor, bias and noise.

Every quantity that a calibration estimates is drawn or set in this module only. A wrench is exerted *on the sensor* by
its load and by contacts, about the sensor origin, force first. A sensor whose z axis points down reads ``+m g`` on z.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.disturbances import Contact, SensorDrift
from ftmocks.hung_load import HungLoad
from ftmocks.imperfections import IDEAL, Imperfections, Ripple
from ftmocks.inertia import Body, drawn_gyration, moved_load
from ftmocks.kinematics import Dh, FlangeMotion, JointState, Vector6, cross, flange_motion, forward, jacobian, rotation
from ftmocks.sensor_errors import PERFECT, SensorErrors

MOUNTS_RAD = {"floor": 0.0, "wall": math.pi / 2, "ceiling": math.pi}
"""Tilt beta of the base for each mounting."""

AHEAD_S = 0.02
"""Time, s, for which a motion is extrapolated without a new control cycle; after it, the arm stands still."""
BURST_GAP_S = 0.001
"""Largest gap, s, between two bursts of readings for which the true wrench at the end of the first is used again."""
REMEMBERED = 16
"""Number of control cycles whose motion is stored, because a sensor may be later than the controller."""
WRIST_BIAS_N, WRIST_BIAS_SPREAD = (1800.0, 400.0, 25400.0), 0.1
WRIST_BIAS_NM, WRIST_BIAS_SPREAD_NM = (-76.0, 0.0, 0.0), 3.0
WRIST_NOISE_N = 0.1
_MINUTE_S = 60.0
_NOTHING: Array = np.zeros(6)


def _zero3() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class Truth:
    """True quantities of the cell, in SI units and rad. Names state the axes; noise is that of one reading."""

    mass_kg: float
    p_sensor_com_m: Array
    R_flange_sensor: Array
    tilt_alpha_rad: float
    tilt_beta_rad: float
    force_bias_N: Array
    torque_bias_Nm: Array
    noise_force_N: float = 0.05
    noise_torque_Nm: float = 0.002
    force_drift_N_min: Array = field(default_factory=_zero3)
    torque_drift_Nm_min: Array = field(default_factory=_zero3)
    g_m_s2: float = 9.80665
    p_flange_sensor_m: Array = field(default_factory=_zero3)
    gyration_m2: Array | None = None
    """(3, 3) inertia tensor per mass about the centre of mass, sensor axes; None for a payload without inertia."""
    sensor_mass_kg: float = 0.0
    """Mass of sensor and adapter, which the sensor does not measure: a point midway from flange to sensor origin."""
    sensor_errors: SensorErrors = PERFECT

    @classmethod
    def drawn(cls, seed: int, mount: str = "floor") -> "Truth":
        """Draw a plausible cell: 0.5 to 2.5 kg, centre of mass at 30 to 100 mm, any yaw, base tilted by up to 2°."""
        rng = np.random.default_rng([seed, 1])
        reach = rng.uniform(0.030, 0.100)
        direction = np.append(rng.normal(scale=0.15, size=2), 1.0)
        tilt = np.radians(rng.uniform(0.0, 2.0)) * _on_circle(rng)
        lean = rotation(np.append(np.radians(rng.uniform(0.0, 3.0)) * _on_circle(rng), 0.0))
        return cls(
            mass_kg=float(rng.uniform(0.5, 2.5)),
            p_sensor_com_m=reach * direction / np.linalg.norm(direction),
            R_flange_sensor=rotation([0.0, 0.0, rng.uniform(-math.pi, math.pi)]) @ lean,
            tilt_alpha_rad=float(tilt[0]),
            tilt_beta_rad=math.remainder(MOUNTS_RAD[mount] + float(tilt[1]), 2 * math.pi),
            force_bias_N=rng.uniform(-15.0, 15.0, 3),
            torque_bias_Nm=rng.uniform(-1.0, 1.0, 3),
            gyration_m2=drawn_gyration(np.random.default_rng([seed, 5]), reach),
        )

    def with_wrist_sensor(self, seed: int) -> "Truth":
        """Return the cell with the sensor in the wrist of a UR5e, whose ft_raw_wrench has a large bias."""
        rng = np.random.default_rng([seed, 10])
        return replace(
            self,
            R_flange_sensor=np.eye(3),
            sensor_mass_kg=0.0,
            force_bias_N=np.array(WRIST_BIAS_N) * (1.0 + WRIST_BIAS_SPREAD * rng.standard_normal(3)),
            torque_bias_Nm=np.array(WRIST_BIAS_NM) + WRIST_BIAS_SPREAD_NM * rng.standard_normal(3),
            noise_force_N=WRIST_NOISE_N,
        )

    @property
    def weight_N(self) -> float:
        """Weight of the load on the sensor, N."""
        return self.mass_kg * self.g_m_s2

    @property
    def inertia_kg_m2(self) -> Array | None:
        """(3, 3) inertia tensor about the centre of mass, kg·m², sensor axes; None for a payload without inertia."""
        return None if self.gyration_m2 is None else self.mass_kg * self.gyration_m2

    @property
    def gravity_m_s2(self) -> Array:
        """(3,) gravitational acceleration in base axes: ``R_base_gravity = Ry(beta) Rx(alpha)`` applied to -z."""
        return -self.g_m_s2 * up_of(self.tilt_alpha_rad, self.tilt_beta_rad)

    @property
    def gravity_force_base_N(self) -> Array:
        """(3,) gravity force of the load in base axes, N."""
        return self.mass_kg * self.gravity_m_s2

    @property
    def p_flange_sensor_com_m(self) -> Array:
        """(3,) centre of mass of sensor and adapter in flange coordinates, m."""
        return self.p_flange_sensor_m / 2

    @property
    def payload_kg(self) -> float:
        """Mass of all that is mounted on the flange: tool, sensor and adapter."""
        return self.mass_kg + self.sensor_mass_kg

    @property
    def payload_cog_m(self) -> Array:
        """(3,) centre of mass of all that is mounted on the flange, in flange coordinates; zeros if there is none."""
        p_flange_tool_m = self.p_flange_sensor_m + self.R_flange_sensor @ self.p_sensor_com_m
        moment = self.mass_kg * p_flange_tool_m + self.sensor_mass_kg * self.p_flange_sensor_com_m
        return moment / (self.payload_kg or 1.0)

    def in_sensor(self, p_flange_m: Array) -> Array:
        """Return a point (3,) in sensor coordinates that is given in flange coordinates."""
        return np.asarray(self.R_flange_sensor.T @ (p_flange_m - self.p_flange_sensor_m))

    def holding(self, part: Body) -> "Truth":
        """Return the true quantities of the cell after a part was added to the payload, held in the gripper."""
        own_m2 = self.gyration_m2
        tool = Body(self.mass_kg, self.p_sensor_com_m, np.zeros((3, 3)) if own_m2 is None else own_m2)
        mass_kg, com_m, gyration_m2 = tool.joined(part)
        return replace(self, mass_kg=mass_kg, p_sensor_com_m=com_m, gyration_m2=None if own_m2 is None else gyration_m2)

    def to_json(self) -> dict[str, Any]:
        """Return the true quantities as numbers and row-major lists."""
        return {
            "mass_kg": self.mass_kg,
            "weight_N": self.weight_N,
            "gravity_force_base_N": self.gravity_force_base_N.tolist(),
            "R_flange_sensor": self.R_flange_sensor.tolist(),
            "force_bias_N": self.force_bias_N.tolist(),
            "torque_bias_Nm": self.torque_bias_Nm.tolist(),
            "p_sensor_com_m": self.p_sensor_com_m.tolist(),
            "inertia_kg_m2": None if self.inertia_kg_m2 is None else self.inertia_kg_m2.tolist(),
            "p_flange_sensor_m": self.p_flange_sensor_m.tolist(),
            "sensor_mass_kg": self.sensor_mass_kg,
            "payload_kg": self.payload_kg,
            "payload_cog_m": self.payload_cog_m.tolist(),
            "tilt_alpha_rad": self.tilt_alpha_rad,
            "tilt_beta_rad": self.tilt_beta_rad,
            "noise_force_N": self.noise_force_N,
            "noise_torque_Nm": self.noise_torque_Nm,
            "force_drift_N_min": self.force_drift_N_min.tolist(),
            "torque_drift_Nm_min": self.torque_drift_Nm_min.tolist(),
            "g_m_s2": self.g_m_s2,
            "sensor_error": self.sensor_errors.error.tolist(),
            "sensor_nonlinearity": self.sensor_errors.nonlinearity.tolist(),
        }


def up_of(alpha_rad: float, beta_rad: float) -> Array:
    """Return the direction (3,) opposite to gravity in the axes of a tilted base."""
    a, b = alpha_rad, beta_rad
    return np.array([math.cos(a) * math.sin(b), -math.sin(a), math.cos(a) * math.cos(b)])


def _on_circle(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-math.pi, math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


class Cycle(NamedTuple):
    """Motion of the arm from the start of a control cycle on."""

    t_s: float
    """Time of the cycle on the cell's clock."""
    q: Vector6
    motion: Callable[[float], JointState] | None
    """Function that returns the joint state at a time of the cell's clock; None if the arm stands at `q`."""


class World:
    """The current state of the cell. The emulated arm moves it; emulated sensors call `measure` from their threads.

    A change replaces a value as a whole, so other threads read a consistent state.

    Parameters
    ----------
    truth
        The true quantities.
    dh
        Kinematics of the real arm, with its deviations from the model.
    q
        Initial joint angles, rad.
    seed
        Seed of noise and imperfections.
    clock
        Clock of the cell, for drift and contacts, which do not depend on the speed of the arm; None creates one.
    imperfections
        Imperfections of arm and sensors.
    """

    def __init__(
        self,
        truth: Truth,
        dh: Dh,
        q: Vector6,
        seed: int = 0,
        clock: CellClock | None = None,
        imperfections: Imperfections = IDEAL,
    ) -> None:
        self.clock = clock or CellClock()
        self.truth = truth
        self.dh = dh
        self.seed = seed
        self.imperfections = imperfections
        self.q = q
        self.contacts: dict[str, Contact] = {}
        """Contacts of the tool by name."""
        self.drifts: tuple[SensorDrift, ...] = ()
        """Drifts of the bias in addition to the drift in `truth`."""
        self.hung: HungLoad | None = None
        """The load on a string, which is also one of the contacts."""
        self.wrist_error: Callable[[], Array] | None = None
        """Returns the error (6,) that friction and drift add to each reading of the sensor in the wrist."""
        self._t0_s = self.now_s
        self._lock = threading.Lock()
        self._ripple = Ripple(imperfections, seed)
        self._noise = np.random.default_rng([seed, 2])
        self._noise_sd = np.repeat([truth.noise_force_N, truth.noise_torque_Nm], 3)
        self._still: tuple[Vector6, Truth, tuple[Array, Array]] | None = None
        self._moved: tuple[JointState, FlangeMotion] | None = None
        self._override: Array | None = None
        self._known: tuple[float, Array] = (-math.inf, _NOTHING)
        """Time and true wrench at the end of the last burst of readings, at which the next burst begins."""

    @property
    def now_s(self) -> float:
        """Time of the cell's clock, s."""
        return self.clock.now_s()

    @property
    def q(self) -> Vector6:
        """Actual joint angles in the last control cycle, rad. Setting them stops the arm there."""
        return self._cycles[-1].q

    @q.setter
    def q(self, q: Vector6) -> None:
        self._cycles: tuple[Cycle, ...] = (Cycle(-math.inf, q, None),)
        self._joints_at: dict[float, tuple[JointState, bool]] = {}

    def move(self, t_s: float, q: Vector6, motion: Callable[[float], JointState] | None) -> None:
        """Set the motion of the arm, starting at a control cycle, see `Cycle`."""
        last = self._cycles[-1]
        if motion is not None or last.motion is not None or last.q is not q:
            self._cycles = (*self._cycles[1 - REMEMBERED :], Cycle(t_s, q, motion))
            self._joints_at = {}

    def true_wrench(self, t_s: float | None = None) -> Array:
        """Return the wrench (6,) on the sensor without noise, N and N·m, in sensor axes, including bias and drift.

        Parameters
        ----------
        t_s
            Time on the cell's clock, near the current time; None for the current time.
        """
        t_s = self.now_s if t_s is None else t_s
        wrench: Array = self._without_ripple(t_s) + self.ripple_wrench(np.array([t_s]))[0]
        return wrench

    def _without_ripple(self, t_s: float) -> Array:
        return self.load_wrench(t_s) + self.contact_wrench(t_s) + self.bias(t_s)

    def bias(self, t_s: float) -> Array:
        """Return the bias (6,) with its drift, in sensor axes."""
        truth = self.truth
        minutes = (t_s - self._t0_s) / _MINUTE_S
        force_bias_N = truth.force_bias_N + minutes * truth.force_drift_N_min
        torque_bias_Nm = truth.torque_bias_Nm + minutes * truth.torque_drift_Nm_min
        return np.concatenate((force_bias_N, torque_bias_Nm)) + sum((d.at(t_s) for d in self.drifts), _NOTHING)

    def _joints(self, t_s: float) -> tuple[JointState, bool]:
        """Return the joint state at a time of the cell's clock, and whether the joints move."""
        known = self._joints_at
        if t_s not in known:
            if len(known) >= REMEMBERED:
                self._joints_at = known = {}
            known[t_s] = self._joints_of(self._cycles, t_s)
        return known[t_s]

    @staticmethod
    def _joints_of(cycles: tuple[Cycle, ...], t_s: float) -> tuple[JointState, bool]:
        cycle = next((cycle for cycle in reversed(cycles) if cycle.t_s <= t_s), cycles[0])
        if cycle.motion is None or t_s > cycle.t_s + AHEAD_S:
            return JointState(cycle.q), False
        return cycle.motion(t_s), True

    def load_wrench(self, t_s: float | None = None) -> Array:
        """Return the wrench (6,) of gravity and inertia on the sensor, in sensor axes about the sensor origin."""
        joints, moves = self._joints(self.now_s if t_s is None else t_s)
        if not moves:
            return self._still_loads(joints.q)[0]
        truth = self.truth
        if truth.gyration_m2 is None:
            return _weight(truth, forward(self.dh, joints.q)[:3, :3])
        load: Array = truth.mass_kg * moved_load(
            self._motion(joints),
            truth.gravity_m_s2,
            truth.R_flange_sensor,
            truth.p_flange_sensor_m,
            truth.p_sensor_com_m,
            truth.gyration_m2,
        )
        return load

    def ripple_wrench(self, t_s: Array) -> Array:
        """Return the wrench (n, 6) or (1, 6) of the vibration of rotating joints, at increasing times (n,)."""
        first_s, last_s = float(t_s[0]), float(t_s[-1])
        (first, moved), (last, moves) = self._joints(first_s), self._joints(last_s)
        if not (self.imperfections.ripple and (moved or moves)):
            return _NOTHING[None]
        share = ((t_s - first_s) / ((last_s - first_s) or 1.0))[:, None]
        q, qd = (np.array(a) + share * np.subtract(b, a) for a, b in zip(first[:2], last[:2], strict=True))
        x, y, z = self.truth.p_sensor_com_m.tolist()
        force_and_torque = [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]]
        wrenches: Array = self._ripple.at(q, qd) @ np.multiply(force_and_torque, self.truth.mass_kg)
        return wrenches

    def sensor_load(self, t_s: float) -> Array:
        """Return the wrench (6,) of sensor and adapter on the flange, in flange axes about the flange origin."""
        joints, moves = self._joints(t_s)
        truth = self.truth
        if not moves or truth.gyration_m2 is None:
            return self._still_loads(joints.q)[1]
        at_flange = np.eye(3), np.zeros(3), truth.p_flange_sensor_com_m, np.zeros((3, 3))
        load: Array = truth.sensor_mass_kg * moved_load(self._motion(joints), truth.gravity_m_s2, *at_flange)
        return load

    def _still_loads(self, q: Vector6) -> tuple[Array, Array]:
        """Return two wrenches of gravity: of the load on the sensor, and of sensor and adapter on the flange."""
        truth, known = self.truth, self._still
        if known is not None and known[0] is q and known[1] is truth:
            return known[2]
        R_base_flange = forward(self.dh, q)[:3, :3]
        sensor_N = truth.sensor_mass_kg * R_base_flange.T @ truth.gravity_m_s2
        sensor_load = np.concatenate((sensor_N, cross(truth.p_flange_sensor_com_m, sensor_N)))
        loads = (_weight(truth, R_base_flange), sensor_load)
        self._still = (q, truth, loads)
        return loads

    def _motion(self, joints: JointState) -> FlangeMotion:
        """Return the motion of the flange; it is stored, because a control cycle needs it several times."""
        known = self._moved
        if known is None or known[0] != joints:
            self._moved = known = (joints, flange_motion(self.dh, joints))
        return known[1]

    def contact_wrench(self, t_s: float | None = None) -> Array:
        """Return the wrench (6,) of all contacts, in sensor axes about the sensor origin."""
        contacts = self.contacts
        if not contacts:
            return _NOTHING
        t_s = self.now_s if t_s is None else t_s
        q = self._joints(t_s)[0].q
        R_base_sensor = forward(self.dh, q)[:3, :3] @ self.truth.R_flange_sensor
        felt = {name: contact.wrench(t_s, q, R_base_sensor) for name, contact in contacts.items()}
        return sum((wrench for wrench in felt.values() if wrench is not None), _NOTHING)

    def measure(self, n: int) -> Array:
        """Return `n` noisy readings (n, 6) at the current time, N and N·m, in sensor axes. Thread-safe."""
        return self.measure_at(np.full(n, self.now_s))

    def measure_at(self, t_s: Array) -> Array:
        """Return noisy readings (n, 6) at increasing times, N and N·m, in sensor axes. Thread-safe.

        Parameters
        ----------
        t_s
            (n,) times on the cell's clock, near the current time. The wrench without ripple is computed at both ends of
            a burst and interpolated linearly.
        """
        override = self._override
        if override is not None:
            return np.tile(override, (len(t_s), 1))
        t_s = t_s - self.imperfections.wrench_delay_s
        with self._lock:
            noise = self._noise.standard_normal((len(t_s), 6))
            readings: Array = self._true_wrenches(t_s)
            if (errors := self.truth.sensor_errors) is not PERFECT:
                readings = readings + errors.of(readings - self.bias(float(t_s[-1])))
            readings = readings + noise * self._noise_sd
        return readings if self.wrist_error is None else readings + self.wrist_error()

    def _true_wrenches(self, t_s: Array) -> Array:
        """Return the wrench on the sensor at these times (n, 6), or (6,) if it is constant."""
        first_s, last_s = float(t_s[0]), float(t_s[-1])
        last = self._without_ripple(last_s)
        if first_s == last_s:
            return last + self.ripple_wrench(t_s)
        if not (self._joints(last_s)[1] or self.contacts):
            return last
        known_s, known = self._known
        if not 0.0 <= first_s - known_s < BURST_GAP_S:
            known_s, known = first_s, self._without_ripple(first_s)
        self._known = (last_s, last)
        wrenches: Array = known + np.outer((t_s - known_s) / (last_s - known_s), last - known)
        return wrenches + self.ripple_wrench(t_s)

    def touch(self, name: str, contact: Contact | None) -> None:
        """Set the contact with this name; None removes it."""
        others = {key: value for key, value in self.contacts.items() if key != name}
        self.contacts = others if contact is None else {**others, name: contact}

    def hang(self, mass_kg: float, p_flange_hook_m: Array, string_m: float, swing_rad: float) -> None:
        """Hang a load on a string, in place of any other; it is let go `swing_rad` off the vertical."""
        _, hook_m = self._hook(p_flange_hook_m)
        gravity_m_s2 = self.truth.gravity_m_s2
        # a horizontal direction, drawn from the seed of the cell
        aside = cross(gravity_m_s2, np.random.default_rng([self.seed, 13]).normal(size=3))
        aside *= swing_rad / np.linalg.norm(aside)
        p_sensor_hook_m = self.truth.in_sensor(p_flange_hook_m)
        self.hung = HungLoad(mass_kg, p_flange_hook_m, p_sensor_hook_m, string_m, gravity_m_s2, hook_m, aside)
        self.touch("load", self.hung)

    def unhang(self) -> None:
        """Remove the load from its hook."""
        self.hung = None
        self.touch("load", None)

    def swing(self, seconds: float, qd: Vector6) -> None:
        """Move the load on the string for a control cycle; `qd` are the joint speeds at its end, rad/s."""
        if self.hung is None:
            return
        lever_m, hook_m = self._hook(self.hung.p_flange_hook_m)
        velocity_m_s = np.zeros(3)
        if any(qd):
            twist = jacobian(self.dh, self.q) @ qd
            velocity_m_s = twist[:3] + cross(twist[3:], lever_m)
        self.hung.follow(seconds, hook_m, velocity_m_s)

    def _hook(self, p_flange_hook_m: Array) -> tuple[Array, Array]:
        """Return the position (3,) of a hook relative to the flange and to the base, in base axes."""
        X = forward(self.dh, self.q)
        lever_m = X[:3, :3] @ p_flange_hook_m
        return lever_m, X[:3, 3] + lever_m

    def change_load(self, truth: Truth, name: str, contact: Contact) -> None:
        """Set true quantities and a contact in one step, so that a grasped part and its support appear together."""
        with self._lock:
            self.truth = truth
            self.touch(name, contact)

    def shift_payload(self, mass_kg: float | None, p_sensor_com_m: Array | None) -> None:
        """Change the true payload suddenly, as if a part had been lost or added, or had slipped in the gripper."""
        if mass_kg is not None:
            self.truth = replace(self.truth, mass_kg=mass_kg)
        if p_sensor_com_m is not None:
            self.truth = replace(self.truth, p_sensor_com_m=p_sensor_com_m)

    def read_always(self, reading: Array | None) -> None:
        """Return this reading (6,) for every measurement from now on; with None, measure again."""
        self._override = reading


def _weight(truth: Truth, R_base_flange: Array) -> Array:
    """Return the wrench (6,) of gravity, in sensor axes about the sensor origin."""
    R_base_sensor = R_base_flange @ truth.R_flange_sensor
    force_N = R_base_sensor.T @ truth.gravity_force_base_N
    return np.concatenate((force_N, cross(truth.p_sensor_com_m, force_N)))
