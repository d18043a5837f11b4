"""Mistakes in the data of a bad fit: orientations, pairing, axes. They are reported only if a correction helps."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from ftcalib.findings import Finding
from ftcalib.judge import units
from ftcalib.judge.observability import RECOMMENDED_POSES
from ftcalib.likelihood.rotation_minima import com_and_torque_bias, force_cost, given_rotation, minima
from ftcalib.model import UP_IN_BASE, Array, Parameters, SPECIAL_R_flange_base, gravity_wrench, predict

# Differences between readings below this share of the largest reading are rounding errors.
ROUNDING = 1e-9
READINGS = {
    "orientations_inverted": "inverted orientations",
    "quaternion_order": "quaternions in the order ({order})",
    "euler_angles": "Euler angles in the order {order}",
}
# Orders of rotations by three angles about base axes; rotations about tool axes have the reverse order.
EULER_ORDERS = tuple("".join(axes) for axes in permutations("xyz"))
# Interpretations of the orientations whose scores differ by less than this are equally good.
EQUAL = 0.1
# A mistake counts as found if its correction reduces the residual (of force or torque) to this share or less.
COLLAPSE = 0.4
# The correction of a mistake in force or torque must not increase the residual of the other by more than this factor.
NO_WORSE = 1.2
# After the correction of a mistake, the force residual must be below this share of the weight.
CORRECTED = 0.1
# Penalty, in the logarithm of the residuals, of a weight that pulls sideways, and of a tool inside the flange.
IMPLAUSIBLE = 1.0
# If the residuals of two explanations differ by a smaller factor, the simpler explanation is preferred.
TIED = 1.3
# Force residuals, as shares of the weight, above which the poses are suspected, and above which they are taken for
# other poses rather than inaccurate ones. Largest radial share of the residual if the wrenches are those of a weight.
OFF_POSES, OTHER_POSES, OF_A_WEIGHT = 0.015, 0.15, 0.1
# A force that is constant in base axes counts as a weight within this angle of straight down.
IN_BASE_RAD = np.deg2rad(10.0)
# Largest relative variation of a force that counts as constant over the poses.
STEADY = 0.05
# Smallest number of poses with the same extreme reading of a saturated channel.
FEWEST_SATURATED = 3
# Smallest number of degrees of freedom of the regression that predicts the readings of a channel.
FEWEST_TO_PREDICT = 4
# Without a regression, equal readings are unexpected if their orientations predict a spread above this share of all.
UNEQUAL = 0.05
# False-alarm probability, per reading, of a deviation from its prediction.
BY_CHANCE = 1e-6
CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")
# Largest number of poses in which quantisation steps of the readings are searched for.
FOR_STEPS = 1000
# Smallest number of different readings that shows steps: a weight along the axes alone reads -weight, 0 and +weight.
FEWEST_STEPS = 4
# Largest number of decimal places that is searched for in written readings.
DECIMALS = 9
# Rounding of readings matters if its standard deviation exceeds this share of their spread.
COARSE = 0.005


def rough_fit(R_base_flange: Array, wrench: Array) -> Parameters:
    """Return parameters fitted to the forces alone, with centre of mass and torque bias by linear least squares."""
    n, force_N, torque_Nm = len(wrench), wrench[:, :3], wrench[:, 3:]
    best = minima(force_cost(R_base_flange, force_N, np.ones(n)))[0]
    F_b, F0 = given_rotation(best.R, R_base_flange, force_N, np.ones(n))
    P, T0 = com_and_torque_bias((F_b @ R_base_flange) @ best.R.T, torque_Nm)
    return Parameters(best.R.T, F_b, F0, P, T0)


def _least_rms(R_base_flange: Array, force_N: Array) -> float:
    """Return a lower bound of the rms force residual (N) over all mountings: that of any matrix of the same norm."""
    Q = force_cost(R_base_flange, force_N, np.ones(len(force_N)))
    return float(np.sqrt(3 * max(np.linalg.eigvalsh(Q)[0], 0.0) / len(force_N)))


@dataclass(frozen=True, slots=True, eq=False)
class _Rough:
    parameters: Parameters
    weight_sensor_N: Array
    """(n, 3) predicted weight in the sensor frame."""
    force_rms_N: float
    torque_rms_Nm: float
    shares: tuple[float, float]
    """Rms residual of the forces relative to the weight, and of the torques relative to their spread."""

    @classmethod
    def of(cls, R_base_flange: Array, wrench: Array) -> Self:
        p = rough_fit(R_base_flange, wrench)
        gravity, torque_Nm = gravity_wrench(p, R_base_flange), wrench[:, 3:]
        e = wrench - predict(p, R_base_flange)
        force_rms_N, torque_rms_Nm = (
            float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) + ROUNDING * float(np.abs(read).max())
            for part, read in zip(np.hsplit(e, 2), np.hsplit(wrench, 2), strict=True)
        )
        weight_N, spread_Nm = p.weight_N, _vector_norm(torque_Nm.std(axis=0))
        shares = force_rms_N / (weight_N or 1.0), torque_rms_Nm / (spread_Nm or 1.0)
        return cls(p, gravity[:, :3], force_rms_N, torque_rms_Nm, shares)

    @property
    def outwards(self) -> bool:
        """Whether the centre of mass lies on the tool's side of the sensor."""
        return bool(self.parameters.p_sensor_com_m @ self.parameters.R_flange_sensor[2] >= 0)

    def score(self, up_in_base: Array) -> float:
        """Return the logarithm of the residuals plus a penalty of implausible results; lower is better.

        The penalty decides between interpretations that fit equally well with different mountings of robot and sensor.
        """
        p = self.parameters
        cosine = -float(p.gravity_force_base_N @ up_in_base) / (p.weight_N * _vector_norm(up_in_base) or 1.0)
        implausible = (1 - cosine) / 2 + 0.5 * (not self.outwards)
        return float(np.log(self.force_rms_N * self.torque_rms_Nm)) + IMPLAUSIBLE * implausible


def faults(R_base_flange: Array, wrench: Array, up_in_base: ArrayLike = UP_IN_BASE, written: str = "") -> list[Finding]:
    """Return the mistake that explains a bad fit: form of orientations, zeroing, pairing of wrench and pose, or axes.

    Reversing all three axes of force or torque is not detected here: it only mirrors the centre of mass.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Orientations in the order of the poses.
    wrench : array, shape (n, 6)
    up_in_base : array_like, shape (3,)
        Expected up direction.
    written : str
        Form in which the orientations were given: quaternion, matrix, vector, joints, or the order of three angles in
        the notation of scipy, such as "xyz" or "ZYX". Empty if unknown. Only mistakes of this form are tried.
    """
    if len(wrench) < RECOMMENDED_POSES + 1:
        return []
    if constant := constant_weight(wrench, up_in_base):
        return constant
    up = np.asarray(up_in_base, dtype=np.float64)
    as_read = _Rough.of(R_base_flange, wrench)
    explanations = []
    for code, values, R, y in _readings(R_base_flange, wrench, written):
        # A lower bound of the residual avoids the search over rotations.
        if code != "columns_swapped" and _least_rms(R, y[:, :3]) > COLLAPSE * as_read.force_rms_N:
            continue
        trial = _Rough.of(R, y)
        (force, torque), limit = trial.shares, min(COLLAPSE * as_read.shares[0], CORRECTED)
        smaller = trial.force_rms_N < COLLAPSE * as_read.force_rms_N or code == "columns_swapped"
        if smaller and force < limit and torque < NO_WORSE * as_read.shares[1]:
            explanations.append((trial.score(up), code, values, trial.force_rms_N))
    if explanations:
        least = min(score for score, *_ in explanations)
        equal = [explanation for explanation in explanations if explanation[0] < least + EQUAL]
        # Of the mistakes that explain the data equally well, the simplest is reported.
        _, code, values, corrected_N = equal[0]
        also = dict.fromkeys(READINGS[name].format(**own) for _, name, own, _ in equal[1:] if name in READINGS)
        if code in READINGS:
            values = {**values, "also": [*also]}
        return [Finding.of(code, **values, residual_N=as_read.force_rms_N, corrected_N=corrected_N)]
    return _axis_faults(as_read, wrench[:, 3:], up)


def other_poses(R_base_flange: Array, wrench: Array) -> list[Finding]:
    """Return a finding for wrenches that a weight exerts in other poses: forces on a sphere, with matching torques.

    The sphere does not depend on the orientations, so this detects wrong orders or forms that `faults` cannot correct.
    """
    if len(wrench) < RECOMMENDED_POSES + 1:
        return []
    as_read, force_N, torque_Nm = _Rough.of(R_base_flange, wrench), wrench[:, :3], wrench[:, 3:]
    design = np.column_stack([2 * force_N, np.ones(len(force_N))])
    solution = np.linalg.lstsq(design, np.sum(force_N**2, axis=1))[0]
    center_N = solution[:3]
    weight_N = float(np.sqrt(max(float(solution[3] + center_N @ center_N), 0.0)))
    radial_N = np.linalg.norm(force_N - center_N, axis=1) - weight_N
    radial_rms_N = float(np.sqrt(np.sum(radial_N**2) / (len(force_N) - len(solution))))
    torque_rms_Nm = _torque_rms(force_N - center_N, torque_Nm, *com_and_torque_bias(force_N - center_N, torque_Nm))
    elsewhere = as_read.force_rms_N > OFF_POSES * weight_N and radial_rms_N < OF_A_WEIGHT * as_read.force_rms_N
    if not elsewhere or torque_rms_Nm > COLLAPSE * as_read.torque_rms_Nm:
        return []
    values = {"weight_N": weight_N, "radial_N": radial_rms_N, "residual_N": as_read.force_rms_N}
    if as_read.force_rms_N > OTHER_POSES * weight_N:
        return [Finding.of("pairing_or_rotations", **values)]
    turn_deg = float(np.degrees(as_read.force_rms_N / weight_N))
    return [Finding.of("orientations_off", "limit", **values, turn_deg=turn_deg)]


def no_weight(R_base_flange: Array, wrench: Array) -> list[Finding]:
    """Return a finding for wrenches without weight: already compensated, or zeroed at each pose."""
    rough = _Rough.of(R_base_flange, wrench)
    p = rough.parameters
    return units.too_light(p.weight_N, _vector_norm(p.p_sensor_com_m), rough.force_rms_N)


def constant_weight(wrench: Array, up_in_base: ArrayLike = UP_IN_BASE) -> list[Finding]:
    """Return a finding for a weight given in base axes without bias: the force is the same in all poses."""
    mean, up = wrench[:, :3].mean(axis=0), np.asarray(up_in_base, dtype=np.float64)
    size_N = float(np.linalg.norm(mean))
    downwards = float(-mean @ up) > np.cos(IN_BASE_RAD) * size_N * float(np.linalg.norm(up))
    if not downwards or float(wrench[:, :3].std(axis=0).max()) > STEADY * size_N:
        return []
    return [Finding.of("constant_force", force_N=mean)]


# Code and values of a mistake, and the corrected orientations and wrenches.
_Reading = tuple[str, Mapping[str, Any], Array, Array]


def _readings(R: Array, wrench: Array, written: str) -> Iterator[_Reading]:
    """Yield possible mistakes, the simplest first: code and values, and the corrected data."""
    if written.lower() in EULER_ORDERS:
        yield from _euler_orders(R, wrench, written)
    if written != "joints":
        yield "orientations_inverted", {}, np.swapaxes(R, 1, 2), wrench
    yield "columns_swapped", {}, R, np.roll(wrench, 3, axis=1)
    if written in ("", "quaternion"):
        quaternions = Rotation.from_matrix(R).as_quat()
        for shift, order, read_as in ((-1, "w, x, y, z", "x, y, z, w"), (1, "x, y, z, w", "w, x, y, z")):
            exchanged = Rotation.from_quat(np.roll(quaternions, shift, axis=1)).as_matrix()
            yield "quaternion_order", {"order": order, "read_as": read_as}, exchanged, wrench
    # Rotation matrices are often computed from angles.
    for read_as in EULER_ORDERS if written in ("", "matrix") else []:
        yield from _euler_orders(R, wrench, read_as)
    in_flange = np.concatenate([np.einsum("nji,nj->ni", R, part) for part in (wrench[:, :3], wrench[:, 3:])], axis=1)
    yield "wrench_in_base", {}, R, in_flange
    for side, own, other in (("before", slice(None, -1), slice(1, None)), ("after", slice(1, None), slice(None, -1))):
        yield "pairing_shifted", {"neighbour": side}, R[own], wrench[other]
    # The model is linear in the orientation, so it also applies to differences between two poses.
    yield "zeroed_each_pose", {}, np.diff(R, axis=0), wrench[1:]


def _euler_orders(R: Array, wrench: Array, read_as: Any) -> Iterator[_Reading]:
    """Yield orientations from the same angles about x, y and z in the other orders.

    Programs write the middle angle within 90°. If it is larger in another order, the equivalent angles are used.
    """
    extrinsic: Any = read_as if read_as.islower() else read_as[::-1].lower()
    with warnings.catch_warnings():  # gimbal lock: one of the angles is arbitrary
        warnings.simplefilter("ignore")
        angles = dict(zip(extrinsic, Rotation.from_matrix(R).as_euler(extrinsic).T, strict=True))
    same = {axis: np.pi - angle if axis == extrinsic[1] else angle + np.pi for axis, angle in angles.items()}
    for order in EULER_ORDERS:
        if order != extrinsic:
            beyond = np.cos(angles[order[1]]) < 0
            turns = np.stack([np.where(beyond, same[axis], angles[axis]) for axis in order], axis=1)
            values = {"order": order, "read_as": read_as}
            yield "euler_angles", values, Rotation.from_euler(order, turns).as_matrix(), wrench


def _axis_faults(as_read: _Rough, torque_Nm: Array, up: Array) -> list[Finding]:
    fits = []
    for Q in SPECIAL_R_flange_base:
        P, T0 = com_and_torque_bias(as_read.weight_sensor_N, torque_Nm @ Q.T)
        rms = _torque_rms(as_read.weight_sensor_N, torque_Nm @ Q.T, P, T0)
        outside = 1.0 if P @ as_read.parameters.R_flange_sensor[2] >= 0 else -1.0  # the tool hangs outside the flange
        changed = int(np.count_nonzero(np.diag(outside * Q) != 1)) + int(np.count_nonzero(np.diag(Q) == 0))
        fits.append((rms, changed, outside * Q))
    least = min(fits, key=lambda fit: fit[0])[0]
    rms, _, Q = min((fit for fit in fits if fit[0] <= TIED * least), key=lambda fit: fit[1])
    if rms >= COLLAPSE * as_read.torque_rms_Nm:
        return []
    upwards, mirrored = bool(as_read.parameters.gravity_force_base_N @ up > 0), bool(np.linalg.det(Q) < 0)
    by_force, by_torque = ("force", channels(Q.T)), ("torque", channels(Q))
    corrections = [by_torque] if mirrored or upwards else [by_torque, by_force]
    if mirrored and upwards:  # a mirrored force reads like a weight that pulls upwards
        corrections = [by_force]
    return [Finding.of("axes_disagree", corrections=corrections, residual_Nm=as_read.torque_rms_Nm, corrected_Nm=rms)]


def channels(Q: Array) -> Sequence[str]:
    """Return the names of the channels from which x, y and z should be taken, for a signed permutation (3, 3)."""
    return [("-" if row[k] < 0 else "") + "xyz"[k] for row in Q for k in [int(np.abs(row).argmax())]]


def _vector_norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))


def _torque_rms(weight_sensor_N: Array, torque_Nm: Array, P: Array, T0: Array) -> float:
    e = torque_Nm - np.cross(P, weight_sensor_N) - T0
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1)))) + ROUNDING * float(np.abs(torque_Nm).max())


def broken_channels(wrench: Array, R_base_flange: Array) -> list[Finding]:
    """Return findings for stuck, coarsely quantised or saturated channels, and for copied rows.

    Equal readings are reported only if the orientations predict different ones.
    """
    spread = np.ptp(wrench, axis=0)
    group = np.repeat([spread[:3].max(), spread[3:].max()], 3)
    stuck = [name for name, own, all_ in zip(CHANNELS, spread, group, strict=True) if own == 0 < all_]
    findings = [Finding.of("stuck_channels", channels=stuck)] if stuck else []
    coarse = [_coarse_step(part[:FOR_STEPS]) for part in np.hsplit(wrench, 2)]
    if any(coarse):
        # Coarse steps cause equal readings, so the data are not searched for copies and saturation.
        return [*findings, Finding.of("quantised", step_N=coarse[0], step_Nm=coarse[1])]
    distinct = len(np.unique(wrench[:, np.argmax(spread)])) == len(wrench)
    copied = [] if distinct else _copies(wrench)
    # A channel that varies only in the last decimal places has equal readings anyway.
    fine = spread > FEWEST_STEPS * np.repeat([_last_place(part) for part in np.hsplit(wrench, 2)], 3)
    ties = [(k, tied) for k in np.flatnonzero(fine & (spread > 0)) for tied in _tied(wrench[:, k])]
    repeated: list[NDArray[np.intp]] = []
    for rows in copied:
        same = bool(np.ptp(R_base_flange[rows], axis=0).max() == 0)
        if same or _unexpected(R_base_flange, wrench, rows, np.flatnonzero(spread)):
            repeated.append(rows)
            findings.append(Finding.of("repeated_poses" if same else "repeated_wrenches", poses=rows + 1))
    again = [row for rows in repeated for row in rows[1:]]
    for k, tied in ties:
        once = tied[~np.isin(tied, again)]
        if len(once) >= FEWEST_SATURATED and _unexpected(R_base_flange, wrench, once, np.array([k])):
            findings.append(Finding.of("saturated", channel=CHANNELS[k], poses=once + 1))
    return findings


def _tied(readings: Array) -> list[NDArray[np.intp]]:
    """Return the rows that share the smallest reading, and those that share the largest, if enough for saturation."""
    limits = [np.flatnonzero(readings == limit) for limit in (readings.min(), readings.max())]
    return [rows for rows in limits if len(rows) >= FEWEST_SATURATED]


def _unexpected(R_base_flange: Array, wrench: Array, rows: NDArray[np.intp], channels: NDArray[np.intp]) -> bool:
    """Whether the equal readings of the channels in `rows` contradict their prediction from the other poses.

    Each channel is linear in the direction of gravity in flange axes. Rounded readings of poses with the same direction
    are rightly equal, for example of four of the 24 special orientations on a level base.
    """
    others = np.setdiff1d(np.arange(len(wrench)), rows)
    dof = len(others) - 4
    if dof < FEWEST_TO_PREDICT:
        expected = predict(rough_fit(R_base_flange, wrench), R_base_flange[rows])
        return bool((np.ptp(expected, axis=0) > UNEQUAL * np.ptp(wrench, axis=0))[channels].any())
    F_b = rough_fit(R_base_flange[others], wrench[others]).gravity_force_base_N
    design = np.column_stack([F_b @ R_base_flange / (_vector_norm(F_b) or 1.0), np.ones(len(wrench))])
    X = design[others]
    slope = np.linalg.lstsq(X, wrench[others])[0]
    squares = np.sum((wrench[others] - X @ slope) ** 2, axis=0).reshape(2, 3).sum(axis=1)
    noise = np.repeat(np.sqrt(squares / (3 * dof)), 3)  # of force, then of torque
    leverage = np.einsum("ni,ij,nj->n", design[rows], np.linalg.pinv(X.T @ X), design[rows])
    limit = -stdtrit(3 * dof, BY_CHANCE) * noise * np.sqrt(1 + leverage)[:, None] + _channel_steps(wrench)
    return bool((np.abs(design[rows] @ slope - wrench[rows]) > limit)[:, channels].any())


def _channel_steps(wrench: Array) -> Array:
    """Return the resolution (6,) of the readings: the smallest difference in each channel, within plausible limits."""
    gaps = [np.diff(np.unique(channel)).min(initial=np.inf) for channel in wrench.T]
    finest, coarsest = ROUNDING * np.abs(wrench).max(axis=0), np.sqrt(12) * COARSE * np.ptp(wrench, axis=0)
    return np.asarray(np.maximum(np.minimum(gaps, coarsest), finest))


def written_step(wrench: Array) -> Array:
    """Return the value (6,) of the last decimal place of forces and torques that were written rounded, such as 0.01.

    It is 0 if they were not rounded, or if the rounding is so coarse that `broken_channels` reports it.
    """
    steps = []
    for part in np.hsplit(wrench, 2):
        spread = float(np.linalg.norm(part.std(axis=0)))
        step = _last_place(part)
        steps.append(step if step < np.sqrt(12) * COARSE * spread else 0.0)
    return np.repeat(steps, 3)


def _last_place(part: Array) -> float:
    """Return the value of the last decimal place of forces or torques (n, 3); 0 for more than `DECIMALS` places."""
    places = (10.0**-k for k in range(DECIMALS) if np.abs(part - np.round(part, k)).max() < 1e-3 * 10.0**-k)
    return next(places, 0.0)


def _coarse_step(readings: Array) -> float:
    """Return the quantisation step of readings (n, 3); 0 if there is none, or if it is too small to matter."""
    distinct = [np.unique(channel) for channel in readings.T]
    if max(map(len, distinct)) < FEWEST_STEPS:
        return 0.0
    gaps = np.concatenate([np.diff(values) for values in distinct])
    step, spread = float(gaps.min()), float(np.linalg.norm(readings.std(axis=0)))
    even = np.abs(gaps / step - np.round(gaps / step)).max() < 1e-6
    return step if even and step > np.sqrt(12) * COARSE * spread else 0.0


def _copies(wrench: Array) -> list[NDArray[np.intp]]:
    """Return a group of rows for each wrench that occurs in more than one row."""
    _, first, count = np.unique(wrench, axis=0, return_index=True, return_counts=True)
    return [np.flatnonzero((wrench == wrench[row]).all(axis=1)) for row in np.sort(first[count > 1])]
