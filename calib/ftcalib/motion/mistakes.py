"""Mistakes in a recording in motion, found before the load is fitted and then corrected in the rows.

The quantities of `fit_freely` separate the mistakes. The scale of the acceleration relative to gravity shows a wrong
clock or unit of the positions, its sign reversed forces, the sign of the moments of inertia reversed torques, and the
lever the point to which the poses belong. Angular velocities alone show neither: inertia and lever absorb the scale.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.ndimage import median_filter

from ftcalib.findings import Finding, Severity
from ftcalib.judge import units
from ftcalib.judge.described_cell import INSIDE_M
from ftcalib.judge.faults import faults
from ftcalib.judge.units import FAR_COM_M
from ftcalib.judge.verdict import SIGNIFICANT_SIGMAS
from ftcalib.model import Array, nearest_rotation
from ftcalib.motion.estimate import FreeFit, MotionFit, robust_weights
from ftcalib.motion.model import HEIGHT, INERTIA, SECOND_MOMENTS, SIZE, PoseError
from ftcalib.motion.samples import MotionRows

# Positions that spread over more than this are in another unit if the scale of the acceleration agrees with it.
_FARTHEST_M: Final = 3.0
_LENGTHS_M: Final[Mapping[str, float]] = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254}
# Largest relative difference between the scale of the acceleration and a unit.
_SAME_UNIT: Final = 0.2
# Residuals as shares of the change of force and torque: the largest ones of a fit that explains the data, and those
# above which wrong axes are suspected.
_EXPLAINED: Final = np.array([0.15, 0.3])
_SUSPECT: Final = 0.05
# A weight below this share of the inertial mass means that the wrench was gravity-compensated.
COMPENSATED: Final = 0.2
# A pose error counts as a mistake above this many sigmas and the errors of a calibrated arm, which sigma lacks.
_SIGMAS: Final = 6.0
_CLOCK_SHARE: Final = 0.03
_ASIDE_M: Final = 0.01
# The signs of channels are certain if scale and moment are this many sigmas above 0.
_SIGNED: Final = 3.0
# A clock rate wrong by this share, but with only so many sigmas, is not corrected. Found alone, it limits a result.
_DOUBTFUL_SIGMAS, _DOUBTFUL_SHARE = 4.5, 0.15
# Largest plausible distance between the axes of sensor and flange.
_FAR_ASIDE_M: Final = 0.03
# Largest and smallest plausible height of the sensor origin above the flange.
_HIGHEST_M: Final = 0.5
_LOWEST_M: Final = -5e-3
# A reference point of the torques beyond the centre of mass is taken for a TCP from this height above the flange, m.
_TCP_M: Final = 0.1
# Tolerance of negative second moments of mass: 3 sigma plus the mass times the square of this radius of gyration.
_GYRATION_M: Final = 0.01
# Number of 10 ms means that are averaged on each side of a step of the readings, and number within the step.
_BESIDE, _WITHIN = 5, 1
# A step is a zeroing if it reduces the readings to this share, is this many times the usual change among so many means
# around it, and is at least this force (N).
_ZERO_SHARE, _STEPS, _AROUND, _LEAST_STEP_N = 0.25, 4.0, 101, 1.0
# A zeroing must step the bias by this share of the step of the reading; the end of a contact does not step the bias.
_STAYS: Final = 0.6
# Indices of the sensor's position (lateral offset, height) in the covariance of a `FreeFit`.
_POINT: Final = np.r_[SIZE + 1, SIZE + 2, HEIGHT]

# Number of rows of a motion that are judged like static poses.
JUDGED_ROWS: Final = 300
# Codes of findings about wrong axes and orientations; each explains all other findings.
OF_AXES: Final = frozenset(
    ("orientations_inverted", "quaternion_order", "wrench_in_base", "constant_force", "axes_disagree")
)

Correction = Callable[[MotionRows], MotionRows]
"""Function that removes the found mistakes from rows of a motion."""


def unchanged(rows: MotionRows) -> MotionRows:
    """Return the rows as they are: the correction of data without mistakes."""
    return rows


Stream = tuple[Array, Array]
"""Times (n,), s, and values (n, k) of a recorded stream of wrenches or poses."""


# ------------------------------------------------------------------------------------------------------------- zeroing


def find_zeroings(wrench: Stream) -> tuple[Array, Array]:
    """Return the times (k,) at which all channels step to about 0, and the steps (k, 6) of the reading.

    Either the sensor was zeroed at that time, or a contact ended in a pose in which the sensor had been zeroed before.
    """
    t_s, y = wrench
    if len(t_s) < 4 * (_BESIDE + _WITHIN):
        return np.zeros(0), np.zeros((0, 6))
    sums = np.cumsum(np.vstack([np.zeros(6), y]), axis=0)
    means = (sums[_BESIDE:] - sums[:-_BESIDE]) / _BESIDE
    apart = _BESIDE + 2 * _WITHIN
    after, steps = means[apart:], means[apart:] - means[:-apart]
    left, sizes = (np.linalg.norm(each.reshape(-1, 2, 3), axis=2) for each in (after, steps))
    usual = median_filter(sizes, (_AROUND, 1))
    # The reading after a zeroing is small: at most a share of the step, or the usual change between two averages.
    to_zero = (left < np.maximum(_ZERO_SHARE * sizes, usual)).all(axis=1)
    steep = np.flatnonzero(to_zero & (sizes[:, 0] > np.maximum(_STEPS * usual[:, 0], _LEAST_STEP_N)))
    groups = np.split(steep, np.flatnonzero(np.diff(steep) > 2 * apart) + 1) if len(steep) else []
    # Several successive times show one step; the middle one has the averages on both sides of it.
    best = np.array([group[len(group) // 2] for group in groups], np.intp)
    return t_s[best + _BESIDE + _WITHIN], steps[best]


def fit_bias_steps(rows: MotionRows, at_s: Array) -> Array:
    """Return the steps (k, 6) of the bias at the times (k,), from a robust fit that is linear in the motion."""
    apart = np.abs(rows.t_s[:, None] - at_s).min(axis=1) > 4 * rows.row_s
    X = np.column_stack([np.ones(len(rows)), rows.motion.columns(), rows.t_s[:, None] > at_s])[apart]
    y, weight, limit = rows.wrench[apart], np.ones(int(apart.sum())), np.inf
    solution = np.zeros((X.shape[1], 6))
    for _ in range(25):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(root * X, root * y, rcond=1e-9)[0]
        _, weight, limit = robust_weights(y - X @ solution, limit, alike=1)
    return np.asarray(solution[-len(at_s) :])


def are_bias_steps(steps: Array, seen: Array) -> Array:
    """Return which steps `seen` (k, 6) of the reading are steps of the bias, given the fitted `steps` (k, 6)."""
    agree = np.sum(steps[:, :3] * seen[:, :3], axis=1)
    return np.asarray(agree > _STAYS * np.sum(seen[:, :3] ** 2, axis=1))


def without_steps(wrench: Stream, at_s: Array, steps: Array) -> Stream:
    """Return the wrench without bias steps: the bias is that after the last step throughout."""
    t_s, y = wrench
    return t_s, y + (t_s[:, None] <= at_s).astype(np.float64) @ steps


# ----------------------------------------------------------------------------------------------------- signs and poses


def find_motion_mistakes(rows: MotionRows, free: FreeFit, spread_m: float) -> tuple[list[Finding], Correction]:
    """Find mistakes of signs, clock and poses that explain the rows; also return the correction of any rows.

    If no such mistake explains the rows, axes and orientations are judged by the linear function of the motion that
    fits best. Their mistakes are not corrected.

    Parameters
    ----------
    free : FreeFit
        Fit to these rows.
    spread_m : float
        Spread of the positions.
    """
    change = np.sqrt(np.mean(rows.wrench.reshape(-1, 2, 3).var(axis=0), axis=1))
    if (free.residual > _SUSPECT * change).any() and (named := _axis_findings(rows, change)):
        return named, unchanged
    # If the wrench contains no weight, the fitted scale of the acceleration is arbitrary.
    if (free.residual > _EXPLAINED * change).any() or abs(free.error.scale) > 1 / COMPENSATED:
        return [], unchanged
    load, Q, sigma = free.load, free.load.static.R_flange_sensor, np.sqrt(np.diag(free.covariance))
    moment = float(load.inertia[:3].sum())
    sigma_moment = float(np.sqrt(free.covariance[INERTIA, INERTIA][:3, :3].sum()))
    signs = np.where([free.error.scale < -_SIGMAS * sigma[SIZE], moment < -_SIGMAS * sigma_moment], -1.0, 1.0)
    findings = list[Finding]()
    if (signs < 0).any():
        names = np.array(["forces", "torques"])[signs < 0]
        findings.append(Finding.of("reversed_in_motion", channels=" and ".join(names)))
    scale = turning = 1.0
    fitted, sigma_scale = abs(free.error.scale), float(sigma[SIZE])
    factor = 1 / float(np.sqrt(max(fitted, 1e-12)))
    off, share = abs(fitted - 1) / max(sigma_scale, 1e-12), abs(factor - 1)
    values = {"factor": factor, "sigma": factor * sigma_scale / max(fitted, 1e-12) / 2, "rate": 1 / factor}
    # A weight too small for the acceleration means a partly compensated wrench or wrong times; the former is likelier.
    weight_N = load.static.weight_N
    parted = {"weight_N": weight_N, "mass_kg": fitted * weight_N / load.g_m_s2} if fitted > 1 else None
    if off > _SIGMAS and share > _CLOCK_SHARE:
        scale, unit = fitted, _position_unit(fitted, spread_m)
        turning = 1.0 if unit else fitted
        if unit:
            findings.append(Finding.of("positions_unit", unit=unit, spread_m=spread_m))
        else:
            findings += _by_clock("reject", values, parted)
    # Forces show the lever from the recorded point to the centre of mass, torques that from their reference point.
    seen = Q @ load.static.p_sensor_com_m
    to_com, com = signs[0] * (np.append(free.error.aside_m, load.height_m) + seen) / turning, signs.prod() * seen
    of_com = np.sqrt(np.diag(Q @ free.covariance[9:12, 9:12] @ Q.T))
    are_signed = abs(moment) > _SIGNED * sigma_moment and fitted > _SIGNED * sigma_scale
    # Counts only if the centre of mass lies behind the sensor rather than beside it.
    behind_m = max(INSIDE_M, SIGNIFICANT_SIGMAS * of_com[2], float(np.linalg.norm(com[:2])))
    behind = are_signed and bool(-com[2] > behind_m)
    other = _other_point(to_com, com, sigma[_POINT] / turning, behind=behind, upright=bool(Q[2, 2] > 0))
    aside_m = (to_com - com)[:2] if other else np.zeros(2)
    findings += other
    if not findings and off > _DOUBTFUL_SIGMAS and share > _DOUBTFUL_SHARE:
        findings += _by_clock("limit", values, parted)
    error, signs = PoseError(scale, aside_m, turning), np.repeat(signs, 3)
    return findings, lambda rows: replace(error.corrected(rows), wrench=rows.wrench * signs) if findings else rows


def _by_clock(severity: Severity, of_clock: Mapping[str, float], parted: Mapping[str, float] | None) -> list[Finding]:
    """Return findings for a wrong clock, preceded by a partly compensated weight where that is possible too."""
    compensated = [] if parted is None else [Finding.of("wrench_compensated", severity, **parted)]
    return [*compensated, Finding.of("clock_rate", severity, **of_clock)]


def _axis_findings(rows: MotionRows, change: Array) -> list[Finding]:
    """Find wrong axes and orientations from the wrench, after the effect of acceleration was removed."""
    static, left = static_wrench(rows)
    if (left > _EXPLAINED * change).any():
        return []
    some = slice(None, None, max(1, len(rows) // JUDGED_ROWS))
    named = faults(nearest_rotation(rows.motion.R_base_flange)[some], static[some])
    return [finding for finding in named if finding.code in OF_AXES]


def static_wrench(rows: MotionRows) -> tuple[Array, Array]:
    """Return the wrench (n, 6) without the effect of acceleration, and the median residuals (2,) of force and torque.

    The effect of acceleration is that of the best linear function of the motion, whatever the axes and signs.
    """
    X = np.column_stack([np.ones(len(rows)), rows.motion.columns()])
    linear = np.linalg.lstsq(X, rows.wrench, rcond=1e-9)[0]
    left = np.median(np.abs(rows.wrench - X @ linear).reshape(-1, 2, 3), axis=(0, 2))
    return np.asarray(rows.wrench - X[:, 10:] @ linear[10:]), np.asarray(left)


def _position_unit(scale: float, spread_m: float) -> str | None:
    near = (unit for unit, size in _LENGTHS_M.items() if abs(scale / size - 1) < _SAME_UNIT)
    return next(near, None) if spread_m > _FARTHEST_M else None


def _other_point(to_com: Array, com: Array, sigma: Array, *, behind: bool, upright: bool) -> list[Finding]:
    """Find poses that are not those of the flange, or torques that are not about the sensor origin.

    `to_com` and `com` are the vectors to the centre of mass from the point of the poses and from the reference point
    of the torques, in the axes of the poses, and `sigma` is the standard deviation of their difference. `behind` means
    that the centre of mass lies on the robot's side though no channel is reversed, `upright` that the z axes agree.
    """
    point = to_com - com
    aside_m, height_m = float(np.linalg.norm(point[:2])), float(point[2])
    beside = aside_m > max(_ASIDE_M, _SIGMAS * float(sigma[:2].max()))
    elsewhere = not _is_height(height_m, float(sigma[2]))
    # A very distant centre of mass means wrong units, which the verdict reports.
    if not (beside or elsewhere or behind) or np.linalg.norm(com) > FAR_COM_M:
        return []
    along = height_m > _LOWEST_M - SIGNIFICANT_SIGMAS * sigma[2] and (not beside or height_m > aside_m)
    near = not elsewhere and (height_m < _TCP_M if behind else True) and (not beside or aside_m < _FAR_ASIDE_M)
    severity: Severity = "limit" if near else "reject"
    if behind and upright and along:
        return [Finding.of("torques_about_tcp", severity, point_mm=1e3 * point)]
    return [Finding.of("poses_of_tcp", severity, point_mm=1e3 * point, units=_wrong_units(to_com, com))]


def _wrong_units(to_com: Array, com: Array) -> list[tuple[str, str]]:
    """Return pairs of force and torque units with which the sensor would lie on the flange axis."""
    suspects = []
    for force, torque in units.by_com(float(np.linalg.norm(com))):
        point = to_com - com * units.TORQUE_UNITS_NM[torque] / units.FORCE_UNITS_N[force]
        if np.linalg.norm(point[:2]) < _ASIDE_M and _LOWEST_M < point[2] < _TCP_M:
            suspects.append((force, torque))
    return suspects


def _is_height(height_m: float, sigma_m: float) -> bool:
    slack_m = SIGNIFICANT_SIGMAS * sigma_m
    return _LOWEST_M - slack_m < height_m < _HIGHEST_M + slack_m


# ----------------------------------------------------------------------------------------------------- impossible body


def find_impossible_body(best: MotionFit) -> list[Finding]:
    """Find an inertia that no body can have, and a height that no sensor has."""
    findings, sigma_m = list[Finding](), float(np.sqrt(best.covariance[HEIGHT, HEIGHT]))
    moments, axes = np.linalg.eigh(np.tensordot(best.load.inertia, SECOND_MOMENTS, 1))
    # The smallest second moment of mass is negative if one principal moment exceeds the sum of the others.
    along = np.einsum("i,kij,j->k", axes[:, 0], SECOND_MOMENTS, axes[:, 0])
    sigma = float(np.sqrt(along @ best.covariance[INERTIA, INERTIA] @ along))
    if moments[0] < -SIGNIFICANT_SIGMAS * sigma - best.load.mass_kg * _GYRATION_M**2:
        principal = np.linalg.eigvalsh(best.load.inertia_kg_m2)
        findings.append(Finding.of("inertia_impossible", principal_gm2=1e3 * principal, sigma_gm2=1e3 * sigma))
    if not _is_height(best.load.height_m, sigma_m):
        findings.append(Finding.of("height_impossible", height_mm=1e3 * best.load.height_m, sigma_mm=1e3 * sigma_m))
    return findings
