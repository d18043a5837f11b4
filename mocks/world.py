"""The truth of one robot cell: arm, gravity, payload, sensor mounting, bias and noise.

Everything a calibration has to find out is drawn or set here and nowhere else. Model and signs: a wrench is what is
exerted *on the sensor* by what hangs on it or pushes on it, about the sensor origin, force first. A sensor whose z axis
points down reads ``+m g`` on z.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mocks.kinematics import Array, Dh, Vector6, cross, forward, rotation

MOUNTS_RAD = {"floor": 0.0, "wall": math.pi / 2, "ceiling": math.pi}
"""Tilt beta of the base for each mounting."""

_MINUTE_NS = 60_000_000_000


def _zero3() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class Truth:
    """What is really there. Angles in rad, SI units, axes in the names; noise is the deviation of one reading."""

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

    @classmethod
    def drawn(cls, seed: int, mount: str = "floor") -> "Truth":
        """A plausible cell: 0.5 to 2.5 kg, centre of mass 30 to 100 mm away, any yaw, base up to 2 degrees off."""
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
        )

    @property
    def weight_N(self) -> float:
        """Weight of what hangs on the sensor."""
        return self.mass_kg * self.g_m_s2

    @property
    def gravity_m_s2(self) -> Array:
        """Acceleration of gravity in base axes, (3,): ``R_base_gravity = Ry(beta) Rx(alpha)`` applied to -z."""
        a, b = self.tilt_alpha_rad, self.tilt_beta_rad
        down = np.array([math.cos(a) * math.sin(b), -math.sin(a), math.cos(a) * math.cos(b)])
        return -self.g_m_s2 * down

    @property
    def gravity_force_base_N(self) -> Array:
        """Weight as a force vector in base axes, (3,)."""
        return self.mass_kg * self.gravity_m_s2

    def to_json(self) -> dict[str, Any]:
        """The truth as plain numbers and row-major lists."""
        return {
            "mass_kg": self.mass_kg,
            "weight_N": self.weight_N,
            "gravity_force_base_N": self.gravity_force_base_N.tolist(),
            "R_flange_sensor": self.R_flange_sensor.tolist(),
            "force_bias_N": self.force_bias_N.tolist(),
            "torque_bias_Nm": self.torque_bias_Nm.tolist(),
            "p_sensor_com_m": self.p_sensor_com_m.tolist(),
            "tilt_alpha_rad": self.tilt_alpha_rad,
            "tilt_beta_rad": self.tilt_beta_rad,
            "noise_force_N": self.noise_force_N,
            "noise_torque_Nm": self.noise_torque_Nm,
            "force_drift_N_min": self.force_drift_N_min.tolist(),
            "torque_drift_Nm_min": self.torque_drift_Nm_min.tolist(),
            "g_m_s2": self.g_m_s2,
        }


def _on_circle(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-math.pi, math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


class World:
    """The cell at this instant. The arm emulator writes `q`; sensor emulators call `measure` from their own threads.

    Parameters
    ----------
    truth
        What is really there.
    dh
        The real arm, calibration deviations included.
    q
        Joint angles (rad) to start with.
    seed
        Seed of the noise.
    clock_ns
        Time for the bias drift; drift is in real minutes whatever the speed of the arm.
    """

    def __init__(
        self, truth: Truth, dh: Dh, q: Vector6, seed: int = 0, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.truth = truth
        self.dh = dh
        self.q = q
        """Actual joint angles (rad); replaced as a whole, so a reader in another thread sees one instant."""
        self.contact_wrench: Array = np.zeros(6)
        """What pushes on the sensor besides gravity, (6,): sensor axes, about its origin; replaced as a whole."""
        self._clock_ns = clock_ns
        self._t0_ns = clock_ns()
        self._lock = threading.Lock()
        self._noise = np.random.default_rng([seed, 2])
        self._noise_sd = np.repeat([truth.noise_force_N, truth.noise_torque_Nm], 3)
        self._load: tuple[Vector6, Array] | None = None

    def true_wrench(self) -> Array:
        """Wrench on the sensor without noise, (6,): N and N·m, sensor axes, bias and drift included."""
        truth = self.truth
        minutes = (self._clock_ns() - self._t0_ns) / _MINUTE_NS
        force_bias_N = truth.force_bias_N + minutes * truth.force_drift_N_min
        torque_bias_Nm = truth.torque_bias_Nm + minutes * truth.torque_drift_Nm_min
        return self.load_wrench() + self.contact_wrench + np.concatenate((force_bias_N, torque_bias_Nm))

    def load_wrench(self) -> Array:
        """What gravity alone does to the sensor, (6,), sensor axes, about the sensor origin."""
        q, known = self.q, self._load
        if known is not None and known[0] is q:
            return known[1]
        R_base_sensor = forward(self.dh, q)[:3, :3] @ self.truth.R_flange_sensor
        force_N = R_base_sensor.T @ self.truth.gravity_force_base_N
        load = np.concatenate((force_N, cross(self.truth.p_sensor_com_m, force_N)))
        self._load = (q, load)
        return load

    def measure(self, n: int) -> Array:
        """`n` successive noisy readings at this instant, (n, 6): N and N·m, sensor axes. Thread-safe."""
        with self._lock:
            noise = self._noise.standard_normal((n, 6))
        readings: Array = self.true_wrench() + noise * self._noise_sd
        return readings

    def push(self, wrench: Sequence[float]) -> None:
        """Let something push on the sensor: (6,) N and N·m in sensor axes about the sensor origin; zeros let go."""
        self.contact_wrench = np.array(wrench, dtype=float).reshape(6)
