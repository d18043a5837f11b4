"""A simulated arm that moves a load: poses and wrenches at their own rates, with the errors of real ones.

Independent of the estimator: the load is a set of point masses, whose positions are differentiated along the path of
the joints. No formula of a rigid body is used.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.motion.samples import Means
from ftmocks.kinematics import MODELS

Array = NDArray[np.float64]
Joints = Callable[[Array], Array]
"""From times (n,) to joint angles (n, 6)."""

HOME = np.array([0.3, -1.6, 1.7, -1.6, -1.5, 0.4])
_STEP_S = 1e-3
_ARM = MODELS["UR5e"]


def flange(q: Array) -> tuple[Array, Array]:
    """Orientation (n, 3, 3) and position (n, 3) of the flange of a UR5e in base."""
    R, p = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    for k in range(6):
        c, s = np.cos(q[:, k]), np.sin(q[:, k])
        ca, sa, o, one = np.cos(_ARM.alpha[k]), np.sin(_ARM.alpha[k]), np.zeros(len(q)), np.ones(len(q))
        link = np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [o, sa * one, ca * one]]).transpose(2, 0, 1)
        p = p + np.einsum("nij,nj->ni", R, np.column_stack([_ARM.a[k] * c, _ARM.a[k] * s, _ARM.d[k] * one]))
        R = R @ link
    return R, p


def sweep(
    seconds: float,
    amplitude_rad: tuple[float, float, float] = (1.2, 1.3, 1.5),
    hz: tuple[float, float, float] = (0.13, 0.21, 0.31),
    phase: tuple[float, float, float] = (0.0, 1.0, 2.0),
) -> Joints:
    """Sines of the three wrist joints, from rest to rest within a second each."""

    def joints(t: Array) -> Array:
        x = np.clip(np.minimum(t, seconds - t) / 1.0, 0, 1)
        envelope = x**3 * (10 - 15 * x + 6 * x**2)
        moved = np.array(amplitude_rad) * np.sin(2 * np.pi * np.outer(t, hz) + phase)
        return np.asarray(HOME + np.column_stack([np.zeros((len(t), 3)), envelope[:, None] * moved]))

    return joints


def programme(seed: int, seconds: float, *, reach_rad: float = 0.9, dwell_s: float = 1.5) -> tuple[Joints, Array]:
    """Moves with a smooth start and end between random postures, and the times (k, 2) of the stops."""
    rng = np.random.default_rng([seed, 7])
    q, at, knots, stops = HOME, 0.0, [(0.0, HOME)], []
    while at < seconds:
        stop = rng.uniform(0.5, dwell_s)
        stops.append((at, at + stop))
        knots.append((at + stop, q))
        new = HOME + rng.uniform(-1, 1, 6) * np.array([0.4, 0.2, 0.2, 1, 1, 1.3]) * reach_rad
        at += stop + max(1.5, 1.9 * float(np.abs(new - q).max()) / 1.5)
        q = new
        knots.append((at, q))
    times, postures = np.array([k[0] for k in knots]), np.array([k[1] for k in knots])

    def joints(t: Array) -> Array:
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        x = np.clip((t - times[k]) / (times[k + 1] - times[k]), 0, 1)
        return np.asarray(postures[k] + (postures[k + 1] - postures[k]) * (x**3 * (10 - 15 * x + 6 * x**2))[:, None])

    return joints, np.array(stops)


@dataclass(frozen=True)
class Truth:
    """The load, the sensor and the errors of both devices."""

    mass_kg: float = 1.2
    inertia_kg_m2: Array = field(
        default_factory=lambda: np.array([[2.0, 0.1, -0.2], [0.1, 2.4, 0.15], [-0.2, 0.15, 1.4]]) * 1e-3
    )
    p_sensor_com_m: Array = field(default_factory=lambda: np.array([0.012, -0.008, 0.065]))
    mounting_rotvec: Array = field(default_factory=lambda: np.array([0.03, -0.02, 0.8]))
    height_m: float = 0.04
    bias: Array = field(default_factory=lambda: np.array([4.0, -2.0, 7.0, 0.1, -0.2, 0.05]))
    gravity_m_s2: Array = field(default_factory=lambda: np.array([0.17, -0.1, -9.80]) * 9.80665 / 9.801984)
    delay_s: float = 3e-3
    gain: Array = field(default_factory=lambda: np.zeros((3, 3)))
    cross_talk_m: Array = field(default_factory=lambda: np.zeros((3, 3)))
    noise: tuple[float, float] = (0.05, 0.002)
    vibration: tuple[float, float] = (0.5, 0.03)
    vibrates_at_rest: bool = True
    joint_noise_rad: float = 2e-5
    posture_error_rad: float = 0.0
    """Error of the reported orientation, rms per axis: smooth in the joint angles, as of inexact link parameters."""
    drift_N_per_s: float = 0.0
    """Of the random walk of each force's bias after 1 s; torques walk by 20 mm times it."""

    @property
    def R_flange_sensor(self) -> Array:
        """(3, 3)"""
        return Rotation.from_rotvec(self.mounting_rotvec).as_matrix()

    def to_dict(self) -> dict[str, Any]:
        """Return the true values by the names of a result."""
        return {
            "R_flange_sensor": self.R_flange_sensor,
            "gravity_force_base_N": self.mass_kg * self.gravity_m_s2,
            "force_bias_N": self.bias[:3],
            "p_sensor_com_m": self.p_sensor_com_m,
            "torque_bias_Nm": self.bias[3:],
        }

    def masses(self) -> tuple[Array, Array]:
        """Point masses (7,) and their positions (7, 3) in sensor axes with this mass, centre and inertia."""
        second = np.trace(self.inertia_kg_m2) / 2 * np.eye(3) - self.inertia_kg_m2
        moments, axes = np.linalg.eigh(second)
        share = 0.1 * self.mass_kg
        offsets = axes.T * np.sqrt(moments / (2 * share))[:, None]
        masses = np.r_[self.mass_kg - 6 * share, np.full(6, share)]
        return masses, self.p_sensor_com_m + np.concatenate([np.zeros((1, 3)), offsets, -offsets])

    def wrench(self, joints: Joints, t: Array) -> Array:
        """Wrench (n, 6) on the sensor, without the errors of the sensor."""
        masses, points = self.masses()
        Q = self.R_flange_sensor
        at_flange = points @ Q.T + [0, 0, self.height_m]

        def places(t: Array) -> Array:
            R, p = flange(joints(t))
            return np.asarray(p[:, None] + np.einsum("nij,kj->nki", R, at_flange))

        before, now, after = places(t - _STEP_S), places(t), places(t + _STEP_S)
        pulls = masses[:, None] * (self.gravity_m_s2 - (before - 2 * now + after) / _STEP_S**2)
        R, p = flange(joints(t))
        lever = now - (p + R @ np.array([0, 0, self.height_m]))[:, None]
        axes = R @ Q
        return np.hstack([np.einsum("nji,nj->ni", axes, part.sum(axis=1)) for part in (pulls, np.cross(lever, pulls))])


@dataclass(frozen=True)
class Recorded:
    """What the two devices send."""

    t_s: Array
    wrench: Array
    t_pose_s: Array
    R_base_flange: Array
    p_base_flange_m: Array


def record(
    truth: Truth,
    joints: Joints,
    seconds: float,
    seed: int,
    *,
    rates_Hz: tuple[float, float] = (500.0, 500.0),
    contacts: Mapping[tuple[float, float], Any] | None = None,
) -> Recorded:
    """Simulate sensor and arm at their rates; `contacts` are wrenches (6,) by start and end."""
    rng = np.random.default_rng([seed, 28])
    t, t_pose = (np.arange(round(seconds * rate)) / rate + rng.uniform(0, 1) / rate for rate in rates_Hz)
    q = joints(t_pose)
    R, p = flange(q + truth.joint_noise_rad * rng.standard_normal(q.shape))
    if truth.posture_error_rad:
        waves = rng.uniform(0.5, 1.5, (6, 6)) * rng.choice([-1, 1], (6, 6))
        error = np.sin(q @ waves + rng.uniform(0, 2 * np.pi, 6)) @ rng.standard_normal((6, 3)) / np.sqrt(3)
        R = R @ Rotation.from_rotvec(truth.posture_error_rad * error).as_matrix()
    happened = t - truth.delay_s
    y = truth.wrench(joints, happened)
    if not truth.vibrates_at_rest:
        speed = np.linalg.norm(joints(happened + 1e-3) - joints(happened - 1e-3), axis=1) / 2e-3
    size = 1.0 if truth.vibrates_at_rest else np.minimum(speed / 1.0, 1.5)[:, None]
    y[:, :3] += size * truth.vibration[0] * _band(rng, len(t), rates_Hz[0])
    y[:, 3:] += size * truth.vibration[1] * _band(rng, len(t), rates_Hz[0])
    for (start, end), wrench in (contacts or {}).items():
        y[(t >= start) & (t < end)] += wrench
    torque = y[:, 3:] + y[:, :3] @ truth.cross_talk_m.T
    y = np.hstack([y[:, :3] @ (np.eye(3) + truth.gain).T, torque]) + truth.bias
    walk = np.cumsum(rng.standard_normal(y.shape), axis=0) / np.sqrt(rates_Hz[0])
    y += truth.drift_N_per_s * np.r_[1, 1, 1, 0.02, 0.02, 0.02] * (walk - walk[-1])  # the bias is that of the end
    y += np.repeat(truth.noise, 3) * rng.standard_normal(y.shape)
    return Recorded(t, y, t_pose, R, p)


def means_of(recorded: Recorded, *, positions: bool = True) -> tuple[Means, Means]:
    """Return the two streams as the estimator takes them."""
    wrench, poses = Means(), Means()
    wrench.add(recorded.t_s, recorded.wrench)
    R = recorded.R_base_flange.reshape(-1, 9)
    poses.add(recorded.t_pose_s, np.hstack([R, recorded.p_base_flange_m]) if positions else R)
    return wrench, poses


def _band(rng: np.random.Generator, n: int, rate_Hz: float) -> Array:
    """Noise (n, 3) of unit variance between 8 and 15 Hz."""
    hz = np.fft.rfftfreq(n, 1 / rate_Hz)
    spectrum = np.fft.rfft(rng.standard_normal((n, 3)), axis=0) * ((hz > 8) & (hz < 15))[:, None]
    noise = np.fft.irfft(spectrum, n, axis=0)
    return np.asarray(noise / noise.std(axis=0))
