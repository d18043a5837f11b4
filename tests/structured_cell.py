"""A simulated cell with errors that have a structure: an arm with joints, a load, a sensor, dwells.

Independent of the estimator: nothing of it is used. The errors are functions of joints, load and time. Sizes are those
of `Sizes` at 1:

gain          3x3 gain of the force, entries of 1.2 %; cross-talk from force to torque, 0.6 % of 50 mm
load          gain depends on the load: 0.1 N at 20 N, 0.5 % of torque, squares and cubes of axes and between them
cable         a smooth function of q4 to q6, 0.08 N and 0.02 N·m at 90°
kinematics    joint offsets and axis twists of 0.06°, eccentricity of each encoder of 0.04°
compliance    mount 0.1° at 1.2 N·m, joints 4 to 20 kN·m/rad under the weight of arm and load
hum           a line of 0.2 N and 4 mN·m, whose alias is slow
coloured      noise with time constants of 0.02, 0.3 and 5 s
temperature   bias goes 0.5 N and 20 mN·m away, exponentially in about 20 min
hysteresis    play of 0.02 N and 0.5 mN·m in each channel, backlash of 0.01° in each joint
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Generator = np.random.Generator

G_M_S2 = 9.80665
DEG = np.pi / 180
HOME = np.array([0.3, -1.6, 1.7, -1.6, -1.5, 0.4])
"""The flange points down."""
TURNED_BY_WRIST = slice(3, 6)

# UR5e: parameters of the links as the vendor publishes them, standard Denavit-Hartenberg, m, kg.
A_M = np.array([0, -0.425, -0.3922, 0, 0, 0])
D_M = np.array([0.1625, 0, 0, 0.1333, 0.0997, 0.0996])
ALPHA = np.array([1, 0, 0, 1, -1, 0]) * np.pi / 2
LINK_KG = np.array([3.761, 8.058, 2.846, 1.37, 1.3, 0.365])
LINK_COM_M = np.array(
    [
        [0, -0.02561, 0.00193],
        [0.2125, 0, 0.11336],
        [0.15, 0, 0.0265],
        [0, -0.0018, 0.01634],
        [0, 0.0018, 0.01634],
        [0, 0, -0.001159],
    ]
)

RATE_HZ, DWELL_S, POSE_S = 125.0, 1.0, 10.0
"""Samples of a dwell, its length, and the time from pose to pose."""
NOISE = np.repeat([0.08, 3e-3], 3)
"""White noise of a sample, N and N·m."""
COLOURS = ((0.02, 0.05), (0.3, 0.03), (5.0, 0.02))
"""Time constant, s, and standard deviation, N; torques have it times `LEVER_M`."""
LEVER_M = 0.02
_PER_N = np.repeat([1.0, LEVER_M], 3)


@dataclass(frozen=True)
class Sizes:
    """Factor of each disturbance."""

    gain: float = 0.0
    load: float = 0.0
    cable: float = 0.0
    kinematics: float = 0.0
    compliance: float = 0.0
    hum: float = 0.0
    coloured: float = 0.0
    temperature: float = 0.0
    hysteresis: float = 0.0


CELLS: Mapping[str, Sizes] = {
    "white": Sizes(),
    **{each.name: Sizes(**{each.name: 1.0}) for each in fields(Sizes)},
    "all": Sizes(**{each.name: 0.5 for each in fields(Sizes)}),
}


def turned(v: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return np.asarray(Rotation.from_rotvec(v).as_matrix())


def unit(rng: Generator, n: int = 3) -> Array:
    """Draw a direction."""
    v = rng.standard_normal(n)
    return np.asarray(v / np.linalg.norm(v))


def chain(q: Array, alpha: Array = ALPHA) -> tuple[Array, Array]:
    """Orientation (n, 7, 3, 3) and origin (n, 7, 3) of the base and of the frame behind each joint."""
    n = len(q)
    R, p = np.zeros((n, 7, 3, 3)), np.zeros((n, 7, 3))
    R[:, 0] = np.eye(3)
    ca, sa = np.cos(alpha), np.sin(alpha)
    for k in range(6):
        c, s, o = np.cos(q[:, k]), np.sin(q[:, k]), np.zeros(n)
        link = np.array([[c, -s * ca[k], s * sa[k]], [s, c * ca[k], -c * sa[k]], [o, o + sa[k], o + ca[k]]])
        R[:, k + 1] = R[:, k] @ link.transpose(2, 0, 1)
        p[:, k + 1] = p[:, k] + np.einsum("nij,nj->ni", R[:, k], np.column_stack([A_M[k] * c, A_M[k] * s, o + D_M[k]]))
    return R, p


def flange(q: Array) -> Array:
    """Orientations R_base_flange (n, 3, 3) that the controller reports at joints (n, 6)."""
    return np.asarray(chain(q)[0][:, 6])


def postures(rng: Generator, n: int, where: str) -> Array:
    """Joints (n, 6): "whole" of the workspace, or "wrist" about `HOME` with the shoulder at rest."""
    if where == "wrist":
        return np.asarray(HOME + np.hstack([np.zeros((n, 3)), 75 * DEG * rng.uniform(-1, 1, (n, 3))]))
    middle = np.array([0, -90, 90, -90, -90, 0]) * DEG
    return np.asarray(middle + np.array([120, 40, 45, 110, 120, 170]) * DEG * rng.uniform(-1, 1, (n, 6)))


def tour(rng: Generator, n: int, where: str) -> Array:
    """Joints (n, 6) as chosen by a person: of many postures, those with the most different directions of gravity."""
    some = postures(rng, 30 * n, where)
    down = flange(some)[:, 2]
    chosen = [0]
    nearest = np.full(len(some), np.inf)
    for _ in range(n - 1):
        nearest = np.minimum(nearest, np.linalg.norm(down - down[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return np.asarray(some[rng.permutation(chosen)])


def dwell_times(n: int, start_s: float) -> Array:
    """Times (n, 125) of the samples of n dwells."""
    return np.asarray(start_s + POSE_S * np.arange(n)[:, None] + np.arange(round(RATE_HZ * DWELL_S)) / RATE_HZ)


@dataclass(frozen=True)
class Load:
    """Mass, kg, centre of mass in sensor axes, m, and inertia about it, kg m²."""

    kg: float
    p_sensor_com_m: Array
    inertia_kg_m2: Array

    @classmethod
    def drawn(cls, rng: Generator) -> "Load":
        """Draw one of 0.6 to 3 kg with a lever of 20 to 150 mm."""
        kg, lever_m = rng.uniform(0.6, 3.0), rng.uniform(0.02, 0.15)
        along = np.array([0, 0, 1.0]) + 0.4 * rng.standard_normal(3)
        points = rng.standard_normal((8, 3)) * rng.uniform(0.02, 0.05, 3)
        points -= points.mean(axis=0)
        inertia = kg * np.mean([p @ p * np.eye(3) - np.outer(p, p) for p in points], axis=0)
        return cls(float(kg), lever_m * along / np.linalg.norm(along), inertia)


class _Polynomial:
    """Squares and cubes of three values and products of them: of norm 1, root mean square, over the unit sphere."""

    def __init__(self, rng: Generator) -> None:
        self._powers = [c for k in (2, 3) for c in combinations_with_replacement(range(3), k)]
        self._factors = rng.standard_normal((len(self._powers), 3))
        v = rng.standard_normal((500, 3))
        self._factors /= np.sqrt(np.mean(np.sum(self(v / np.linalg.norm(v, axis=1)[:, None]) ** 2, axis=1)))

    def __call__(self, v: Array) -> Array:
        return np.asarray(np.column_stack([v[:, list(c)].prod(axis=1) for c in self._powers]) @ self._factors)


class Cell:
    """Arm, mounting and sensor, drawn at once whatever the sizes: cells of one seed differ in the disturbance alone.

    Parameters
    ----------
    seed : sequence of int
    sizes : Sizes
    """

    def __init__(self, seed: list[int], sizes: Sizes) -> None:
        rng = np.random.default_rng(seed)
        self.sizes, self._seed = sizes, seed
        self.load = Load.drawn(rng)
        self.R_flange_sensor = turned(np.r_[0, 0, rng.uniform(-3, 3)]) @ turned(2 * DEG * rng.standard_normal(3))
        self.gravity_m_s2 = turned(DEG * rng.standard_normal(3)) @ [0, 0, -G_M_S2]
        self.bias = rng.standard_normal(6) * np.repeat([5.0, 0.3], 3)
        self.height_m = rng.uniform(0.02, 0.06)
        self.delay_s = rng.uniform(0, 8e-3)
        self._gain = 0.012 * rng.standard_normal((3, 3))
        self._cross_talk_m = 0.006 * 0.05 * rng.standard_normal((3, 3))
        self._of_force, self._of_torque = _Polynomial(rng), _Polynomial(rng)
        cable = rng.standard_normal((2, 6, 3))
        self._cable = np.hstack(
            [size * part / np.linalg.norm(part) for size, part in zip((0.08, 0.02), cable, strict=True)]
        )
        self._offset, self._twist = 0.06 * DEG * rng.standard_normal((2, 6))
        self._eccentric = 0.04 * DEG / np.sqrt(2) * rng.standard_normal((2, 6))
        self._mount_per_Nm = 0.1 * DEG / 1.2 * np.array([1, 1, 0.5])
        self._joint_Nm = 1e3 * np.r_[rng.uniform(12, 20, 3), rng.uniform(4, 8, 3)]
        self._hum_hz, self._hum_phase = rng.uniform(0.3, 1.5), rng.uniform(0, 2 * np.pi)
        self._hum = np.r_[0.2 * unit(rng), 0.2 * LEVER_M * unit(rng)]
        self._warming = np.r_[0.5 * unit(rng), 0.02 * unit(rng)]
        self._warming_s = rng.uniform(600, 1800)

    # -- at rest -------------------------------------------------------------------------------------------------------

    def frames(self, q: Array, load: Load) -> tuple[Array, Array]:
        """True orientations (n, 3, 3) and places (n, 3) of the flange."""
        s = self.sizes
        true = q + s.kinematics * (self._offset + self._eccentric[0] * np.sin(q) + self._eccentric[1] * np.cos(q))
        if s.compliance or s.hysteresis:
            pull_Nm = self._joint_torques(q, load)
            true = true + s.compliance * pull_Nm / self._joint_Nm + s.hysteresis * 0.01 * DEG * np.tanh(pull_Nm)
        R, p = chain(true, ALPHA + s.kinematics * self._twist)
        return R[:, 6], p[:, 6]

    def _joint_torques(self, q: Array, load: Load) -> Array:
        """Moments (n, 6) of the weight of arm and load about each joint, N·m."""
        R, p = chain(q)
        places = [p[:, k + 1] + R[:, k + 1] @ LINK_COM_M[k] for k in range(6)]
        places.append(p[:, 6] + R[:, 6] @ (self.R_flange_sensor @ load.p_sensor_com_m + [0, 0, self.height_m]))
        masses = np.r_[LINK_KG, load.kg]
        torques = np.zeros((len(q), 6))
        for k in range(6):
            arm = sum(m * (c - p[:, k]) for m, c in zip(masses[k:], places[k:], strict=True))
            torques[:, k] = np.einsum("ni,ni->n", R[:, k, :, 2], np.cross(arm, self.gravity_m_s2))
        return torques

    def axes(self, q: Array, load: Load) -> Array:
        """True orientations R_base_sensor (n, 3, 3): the mount gives way."""
        R = self.frames(q, load)[0] @ self.R_flange_sensor
        if self.sizes.compliance:
            u = load.kg * self.gravity_m_s2 @ R
            R = R @ turned(self.sizes.compliance * self._mount_per_Nm * np.cross(load.p_sensor_com_m, u))
        return R

    def readings(self, q: Array, load: Load | None = None) -> Array:
        """Readings (n, 6) at rest without noise and bias, in the order of the poses."""
        load = load or self.load
        u = load.kg * self.gravity_m_s2 @ self.axes(q, load)
        return self._with_play(self.sensed(np.hstack([u, np.cross(load.p_sensor_com_m, u)])) + self.cable(q))

    def sensed(self, wrench: Array) -> Array:
        """What the sensor makes of a wrench (n, 6)."""
        s, F, T = self.sizes, wrench[:, :3], wrench[:, 3:]
        full_Nm = 20.0 * np.linalg.norm(self.load.p_sensor_com_m)
        F_read = F + s.gain * F @ self._gain.T + s.load * 0.1 * self._of_force(F / 20.0)
        T_read = T + s.gain * F @ self._cross_talk_m.T + s.load * 0.005 * full_Nm * self._of_torque(T / full_Nm)
        return np.hstack([F_read, T_read])

    def cable(self, q: Array) -> Array:
        """Wrench (n, 6) of the cable: part of it saturates, part is harmonic."""
        d = (q - HOME)[:, TURNED_BY_WRIST]
        return np.asarray(
            self.sizes.cable * np.hstack([np.tanh(2 * d / np.pi) / np.tanh(1), 1 - np.cos(d)]) @ self._cable
        )

    def _with_play(self, y: Array) -> Array:
        play = self.sizes.hysteresis * np.repeat([0.02, 5e-4], 3)
        if not self.sizes.hysteresis:
            return y
        read, at = np.empty_like(y), y[0]
        for k, now in enumerate(y):
            at = np.clip(at, now - play, now + play)
            read[k] = at
        return read

    def warmed(self, t_s: Array) -> Array:
        """Change of the bias (n, 6) since the first sample."""
        return np.asarray(self.sizes.temperature * (1 - np.exp(-t_s / self._warming_s))[:, None] * self._warming)

    def hum(self, t_s: Array) -> Array:
        """The line (n, 6) as the sampled reading has it."""
        return np.asarray(
            self.sizes.hum * np.sin(2 * np.pi * self._hum_hz * t_s + self._hum_phase)[:, None] * self._hum
        )

    def noise(self, rng: Generator, gaps: list[int], n: int, rate_Hz: float) -> Array:
        """Noise (len(gaps), n, 6) of stretches of samples, each behind a gap of so many samples."""
        y = NOISE * rng.standard_normal((len(gaps), n, 6))
        if not self.sizes.coloured:
            return y
        for tau_s, sigma_N in COLOURS:
            keep = np.exp(-1 / (rate_Hz * tau_s))
            state = rng.standard_normal(6)
            for k, gap in enumerate(gaps):
                past = keep**gap
                state = past * state + np.sqrt(1 - past**2) * rng.standard_normal(6)
                driven = np.sqrt(1 - keep**2) * rng.standard_normal((n, 6))
                walk = lfilter([1.0], [1.0, -keep], driven, axis=0, zi=keep * state[None])[0]
                state = walk[-1]
                y[k] += self.sizes.coloured * sigma_N * _PER_N * walk
        return y

    def dwells(self, q: Array, start_s: float, *, load: Load | None = None, kind: int = 0) -> tuple[Array, Array]:
        """Times (n,) of dwells at joints (n, 6), and their samples (n, 125, 6); `kind` gives other noise."""
        t = dwell_times(len(q), start_s)
        gaps = [round(RATE_HZ * (POSE_S - DWELL_S))] * len(q)
        moving = (self.warmed(t.ravel()) + self.hum(t.ravel())).reshape(*t.shape, 6)
        rng = np.random.default_rng([*self._seed, 1000 + kind])
        shared = self.readings(q, load)[:, None] + self.bias + moving
        return t[:, 0], shared + self.noise(rng, gaps, t.shape[1], RATE_HZ)
