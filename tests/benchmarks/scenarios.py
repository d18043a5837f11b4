"""Simulated calibrations with known truth: pose sets, tools, readings, and the bound on any estimator.

An implementation of the model of its own, so that a mistake in `ftcalib.model` shows: here R is `s_eR`, flange to
sensor, and A = `e_bR` is the transpose of a robot pose, as in Yu, Shi, Lou 2021, eqs 12-13. Derivatives are numeric.
"""

from dataclasses import astuple, dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.model import Array

Rng = np.random.Generator

WEIGHT_N, ARM_M, TILT_DEG = 20.0, 0.08, 2.0
LEVER_M = 0.025
"""Torque noise over force noise."""
BLOCKS = ("R", "F_b", "F0", "P", "T0")
SETS = (
    "srom24", "haar12", "haar6", "cone60_24", "cone40_24", "cone20_24", "ball60_24", "ball40_24", "ball20_24",
)  # fmt: skip
DOWN = Rotation.from_rotvec([np.pi, 0.0, 0.0])
CUBE = np.array(
    [
        M
        for p in permutations(range(3))
        for s in product((1.0, -1.0), repeat=3)
        if np.linalg.det(M := np.diag(s)[list(p)]) > 0
    ]
)
"""The 24 rotations of the cube: SROM's orientations, and exact for means over all rotations up to second degree."""
STEP = 1e-5


@dataclass(frozen=True)
class Truth:
    """The true parameters."""

    R: Array
    """(3, 3) flange to sensor."""
    b: Array
    """(3,) weight in base, N."""
    F0: Array
    P: Array
    T0: Array

    def moved(self, x: Array) -> "Truth":
        """Apply an error vector (15,): R <- R exp([x]), all others by addition."""
        return Truth(
            self.R @ Rotation.from_rotvec(x[:3]).as_matrix(),
            self.b + x[3:6],
            self.F0 + x[6:9],
            self.P + x[9:12],
            self.T0 + x[12:15],
        )


def direction(rng: Rng) -> Array:
    """Draw a unit vector."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def tool(rng: Rng, *, R: Array | None = None, tilt_deg: float = TILT_DEG) -> Truth:
    """Draw a tool of 20 N, 80 mm away from the sensor in any direction, on a base that is not level."""
    azimuth = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.deg2rad(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0]))
    mount = Rotation.random(rng=rng).as_matrix()
    b = tilt.apply([0, 0, -WEIGHT_N])
    return Truth(mount if R is None else R, b, 5 * rng.normal(size=3), ARM_M * direction(rng), 0.3 * rng.normal(size=3))


def sigma(snr: float) -> Array:
    """(6,) noise of one pose."""
    return np.repeat([1.0, LEVER_M], 3) * WEIGHT_N / snr


def poses(name: str, rng: Rng) -> Array:
    """R_base_flange (n, 3, 3): srom24, haar<n>, cone<deg>_<n> with free wrist, or ball<deg>_<n> about tool down."""
    if name == "srom24":
        return CUBE
    if name.startswith("haar"):
        return Rotation.random(int(name[4:]), rng=rng).as_matrix()
    half_angle, n = np.deg2rad(float(name[4:6])), int(name[7:])
    if name.startswith("cone"):
        lean, azimuth = np.arccos(rng.uniform(np.cos(half_angle), 1, n)), rng.uniform(0, 2 * np.pi, n)
        return leaning(lean, azimuth, rng.uniform(0, 2 * np.pi, n))
    turn = np.array([direction(rng) for _ in range(n)]) * (half_angle * np.cbrt(rng.uniform(size=n)))[:, None]
    return (Rotation.from_rotvec(turn) * DOWN).as_matrix()


def leaning(lean: Array, azimuth: Array, spin: Array) -> Array:
    """R_base_flange (n, 3, 3) with the tool axis off the vertical by `lean`, turned about itself by `spin`, rad."""
    tilt = Rotation.from_rotvec(np.stack([lean * np.cos(azimuth), lean * np.sin(azimuth), 0 * lean], axis=1))
    return (tilt * DOWN * Rotation.from_rotvec(np.stack([0 * spin, 0 * spin, spin], axis=1))).as_matrix()


def readings(truth: Truth, R_base_flange: Array) -> Array:
    """Wrench (n, 6) without noise."""
    weight = np.einsum("ab,ncb,c->na", truth.R, R_base_flange, truth.b)
    return np.concatenate([weight + truth.F0, np.cross(truth.P, weight) + truth.T0], axis=1)


def derivative(truth: Truth, R_base_flange: Array) -> Array:
    """(n, 6, 15) of `readings` by the error vector, by central differences."""
    columns = [
        (readings(truth.moved(x), R_base_flange) - readings(truth.moved(-x), R_base_flange)) / (2 * STEP)
        for x in STEP * np.eye(15)
    ]
    return np.stack(columns, axis=2)


def bound(truth: Truth, R_base_flange: Array, cov: Array) -> Array:
    """Cramér-Rao bound (15, 15) for independent poses with noise (6, 6) or (n, 6, 6)."""
    J = derivative(truth, R_base_flange)
    return np.linalg.inv(np.einsum("nki,nkl,nlj->ij", J, np.broadcast_to(np.linalg.inv(cov), (len(J), 6, 6)), J))


def error(truth: Truth, estimate: Parameters) -> Array:
    """Error vector (15,) that takes the estimate to the truth."""
    R = estimate.R_flange_sensor.T
    return np.concatenate(
        [
            Rotation.from_matrix(R.T @ truth.R).as_rotvec(),
            truth.b - estimate.gravity_force_base_N,
            truth.F0 - estimate.force_bias_N,
            truth.P - estimate.p_sensor_com_m,
            truth.T0 - estimate.torque_bias_Nm,
        ]
    )


def as_truth(estimate: Parameters) -> Truth:
    """Convert an estimate to the form of this module."""
    return Truth(
        estimate.R_flange_sensor.T,
        estimate.gravity_force_base_N,
        estimate.force_bias_N,
        estimate.p_sensor_com_m,
        estimate.torque_bias_Nm,
    )


def prediction_square(truth: Truth, estimate: Parameters) -> Array:
    """(2,) squared error of predicted force and torque, N² and (N·m)², mean over all orientations, exactly."""
    e = readings(truth, CUBE) - readings(as_truth(estimate), CUBE)
    return np.asarray((e**2).reshape(24, 2, 3).sum(axis=2).mean(axis=0))


def blocks(x: Array) -> Array:
    """Sum (..., 15) over the five parameter blocks (..., 5)."""
    return np.asarray(x.reshape(*x.shape[:-1], 5, 3).sum(axis=-1))


def with_inexact_orientations(R_base_flange: Array, sigma_rad: float, rng: Rng) -> Array:
    """Reported orientations with a random error about each axis."""
    return np.asarray(
        R_base_flange @ Rotation.from_rotvec(sigma_rad * rng.normal(size=(len(R_base_flange), 3))).as_matrix()
    )


def walk(n: int, q_N: float, rng: Rng) -> tuple[Array, Array]:
    """Random walk (n, 6) minus its mean, and that mean, which is the bias of a calibration."""
    path = np.cumsum(rng.normal(size=(n, 6)), axis=0) * q_N * np.repeat([1.0, LEVER_M], 3)
    mean = path.mean(axis=0)
    return path - mean, mean


def bumps(n: int, rng: Rng) -> Array:
    """Contact wrenches (n, 6): up to the weight of the tool in any direction, some 80 mm away."""
    force = np.array([rng.uniform(0, WEIGHT_N) * direction(rng) for _ in range(n)]).reshape(n, 3)
    return np.concatenate([force, np.cross(ARM_M * rng.normal(size=(n, 3)), force)], axis=1)


# The lowest point, by brute force


def lowest(
    R_base_flange: Array, wrench: Array, noise: Array, starts: list[Truth], random: int, rng: Rng
) -> tuple[float, Truth]:
    """Cost and parameters of the lowest minimum of the plain joint least squares over all starts.

    Parameters
    ----------
    R_base_flange, wrench : array, shape (n, 3, 3) and (n, 6)
    noise : array, shape (6,)
        Standard deviations, the same in all poses.
    starts : list of Truth
    random : int
        So many more, with random rotations.
    """
    phi = np.concatenate([R_base_flange.reshape(-1, 9), np.ones((len(wrench), 1))], axis=1)
    Q, triangle = np.linalg.qr(phi)  # the part of the readings that no parameters can explain is the same everywhere
    y = Q.T @ wrench
    rest = float((((wrench - Q @ y) / noise) ** 2).sum())
    turned = Rotation.random(random, rng=rng).as_matrix()
    force = wrench[:, :3] - wrench[:, :3].mean(axis=0)
    for R in turned:  # the rest is linear, force first
        A = np.einsum("ab,ncb->nac", R, R_base_flange)
        b = np.linalg.lstsq((A - A.mean(axis=0)).reshape(-1, 3), force.ravel(), rcond=1e-9)[0]
        u = A @ b
        spread = u - u.mean(axis=0)
        normal = (spread**2).sum() * np.eye(3) - spread.T @ spread
        torque = wrench[:, 3:] - wrench[:, 3:].mean(axis=0)
        P = np.linalg.lstsq(normal, np.cross(spread, torque).sum(axis=0), rcond=1e-9)[0]
        mean = wrench.mean(axis=0)
        starts = [*starts, Truth(R, b, mean[:3] - u.mean(axis=0), P, mean[3:] - np.cross(P, u.mean(axis=0)))]
    R, b, F0, P, T0 = (np.array(values) for values in zip(*(astuple(s) for s in starts), strict=True))
    linear = np.concatenate([b, F0, P, T0], axis=1)
    damping = np.full(len(R), 1e-3)
    r, J = _residual(R, linear, triangle, y, noise)
    cost = (r**2).sum(axis=1)
    moving = np.arange(len(R))
    for _ in range(60):
        H = np.swapaxes(J, 1, 2) @ J
        diagonal = np.einsum("bii->bi", H)
        g = np.einsum("bki,bk->bi", J, r)
        ridge = damping[moving, None] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True)
        step = -np.linalg.solve(H + ridge[:, :, None] * np.eye(15), g[..., None])[..., 0]
        R_trial = R[moving] @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        linear_trial = linear[moving] + step[:, 3:]
        r_trial, J_trial = _residual(R_trial, linear_trial, triangle, y, noise)
        trial = (r_trial**2).sum(axis=1)
        better = trial < cost[moving]
        arrived = np.abs(cost[moving] - trial) < 1e-9 * (rest + trial)
        won = moving[better]
        R[won], linear[won], cost[won] = R_trial[better], linear_trial[better], trial[better]
        damping[moving] *= np.where(better, 0.1, 5.0)
        r, J = np.where(better[:, None], r_trial, r), np.where(better[:, None, None], J_trial, J)
        moving, r, J = moving[~arrived], r[~arrived], J[~arrived]
        if not len(moving):
            break
    i = int(cost.argmin())
    return float(cost[i]) + rest, Truth(R[i], *linear[i].reshape(4, 3))


_GENERATORS = np.array([np.cross(np.eye(3)[i], np.eye(3)).T for i in range(3)])


def _residual(R: Array, linear: Array, triangle: Array, y: Array, noise: Array) -> tuple[Array, Array]:
    """Whitened residuals (B, 60) of the compressed readings, and their derivative (B, 60, 15)."""
    B, m = len(R), len(y)
    b, F0, P, T0 = (linear[:, 3 * k : 3 * k + 3] for k in range(4))

    def cross(p: Array, X: Array) -> Array:
        return np.cross(p[:, :, None], X, axis=1)

    force = np.einsum("bck,bj->bcjk", R, b).reshape(B, 3, 9)
    theta = np.zeros((B, 6, 10))
    theta[:, :3, :9], theta[:, 3:, :9] = force, cross(P, force)
    theta[:, :3, 9], theta[:, 3:, 9] = F0, T0
    d = np.zeros((B, 15, 6, 10))
    for i in range(3):
        d[:, i, :3, :9] = np.einsum("bck,bj->bcjk", R @ _GENERATORS[i], b).reshape(B, 3, 9)
        d[:, 3 + i, :3, 3 * i : 3 * i + 3] = R
        d[:, 6 + i, i, 9] = d[:, 12 + i, 3 + i, 9] = 1.0
        d[:, 9 + i, 3:, :9] = cross(np.broadcast_to(np.eye(3)[i], (B, 3)), force)
    for k in range(6):
        d[:, k, 3:, :9] = cross(P, d[:, k, :3, :9])
    r = (theta @ triangle.T - y.T) / noise[:, None]
    J = (d @ triangle.T) / noise[:, None]
    return r.reshape(B, 6 * m), np.swapaxes(J.reshape(B, 15, 6 * m), 1, 2)


def ten_parameters(R_base_flange: Array, wrench: Array) -> Parameters:
    """Mass, centre of mass and bias by one linear least squares, like the ROS packages.

    Source: D. Vougioukas, "Bias estimation and gravity compensation for force-torque sensors", 2001, with the axes of
    sensor and flange taken as the same and gravity along -z of the base.
    """
    down = -R_base_flange[:, 2]  # in flange axes
    columns = np.zeros((len(wrench), 6, 10))
    columns[:, :3, 0] = down
    columns[:, :3, 1:4] = columns[:, 3:, 7:10] = np.eye(3)
    columns[:, 3:, 4:7] = -np.cross(down[:, :, None], np.eye(3)[None], axis=1)
    weight, *rest = np.linalg.lstsq(columns.reshape(-1, 10), wrench.ravel(), rcond=None)[0]
    F0, moment, T0 = np.array(rest).reshape(3, 3)
    return Parameters(np.eye(3), np.array([0, 0, -weight]), F0, moment / weight, T0)
