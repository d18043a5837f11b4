"""The closed-form methods of Yu, Shi, Lou 2021: SROM (24 special orientations), LROM (any), and a mix of both.

Source: "Bias Estimation and Gravity Compensation for Wrist-Mounted Force/Torque Sensor", eqs 14-48. In this module
A (n, 3, 3) is the paper's e_bR, base to flange, which is `R_base_flange` transposed, and the estimated R is s_eR,
flange to sensor. Docstrings name the misprints of the paper.
"""

from collections.abc import Iterator
from itertools import chain, combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ftcalib.errors import NotObservable
from ftcalib.likelihood.rotation_minima import com_and_torque_bias
from ftcalib.model import Array, Parameters, SPECIAL_R_flange_base, nearest_rotation

Indices = NDArray[np.intp]

# Deviation of a pose from its special orientation that is always accepted: more than the error of a calibrated arm.
TOLERANCE_RAD = np.deg2rad(1.0)
# A deviation from the special orientation that is larger than rounding causes; it is reported as a note.
ROUNDING_RAD = np.deg2rad(0.05)

# Largest accepted deviation: 1.3 times the tolerance, because the estimated rotation of the base is uncertain too.
_RECOGNISED_RAD = 1.3 * TOLERANCE_RAD
# Poses 2° apart differ by this much in the invariants of `_likely_members`.
_NEIGHBOURS = 0.065

# Numbers of the orientations whose forces are added and subtracted: p_kj for k, j = 1, 2, 3 (eqs 17-23).
_SUMS = (
    (((1, 2, 3, 4), (5, 6, 7, 8)), ((9, 10, 11, 12), (13, 14, 15, 16)), ((17, 18, 19, 20), (21, 22, 23, 24))),
    (((9, 13, 17, 21), (10, 14, 18, 22)), ((1, 5, 19, 23), (2, 6, 20, 24)), ((3, 7, 11, 15), (4, 8, 12, 16))),
    (((11, 16, 20, 23), (12, 15, 19, 24)), ((4, 7, 17, 22), (3, 8, 18, 21)), ((1, 6, 10, 13), (2, 5, 9, 14))),
)


def srom(R_base_flange: Array, wrench: Array, numbered: tuple[Indices, Array] | None = None) -> Parameters:
    """Return the parameters from the 24 special orientations, in any order, possibly all turned by one rotation.

    The gravity force is that of the nominal orientations (eqs 14-23); the rest is from the actual ones (eqs 36-45).

    Parameters
    ----------
    R_base_flange : array, shape (24, 3, 3)
    wrench : array, shape (24, 6)
        N and N·m, in the sensor frame.
    numbered : tuple, optional
        Result of `special_numbers` for these orientations.

    Raises
    ------
    NotObservable
        As in `special_numbers`.
    """
    return _from_special(R_base_flange, wrench, *(numbered or special_numbers(R_base_flange)))


def mixed(R_base_flange: Array, wrench: Array, numbered: tuple[Indices, Array] | None = None) -> Parameters:
    """Return parameters with the gravity force from the 24 special orientations, and the others from all poses.

    This is case 8 of Table III. The 24 are recognised among the poses. Forces of repeated orientations are averaged.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    numbered : tuple, optional
        What `special_numbers` returns for these orientations, with `others`.

    Raises
    ------
    NotObservable
        As in `special_numbers` with `others`.
    """
    return _from_special(R_base_flange, wrench, *(numbered or special_numbers(R_base_flange, others=True)))


def _from_special(R_base_flange: Array, wrench: Array, number: Indices, Y: Array) -> Parameters:
    special = number >= 0
    force_N = np.zeros((24, 3))
    np.add.at(force_N, number[special], wrench[special, :3])
    force_N /= np.bincount(number[special], minlength=24)[:, None]
    # With A_i = R_i Y.T the published formulas give the gravity force in the turned base, Y.T F_b.
    return _remaining_steps(R_base_flange, wrench, Y @ srom_gravity_force(force_N))


def lrom(R_base_flange: Array, wrench: Array) -> Parameters:
    """Return the parameters from at least five orientations: eqs 24-34.

    Eq 34 chooses the sign from the mounting of the robot. Lines 1 and 2 of the rule are correct for the alpha of eq 48
    as printed. With the corrected eq 48 (`ftcalib.model.weight_and_tilt`) alpha is another angle, and an upright robot
    would get the wrong sign. The condition det R > 0 is used instead and does not depend on the mounting.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.

    Raises
    ------
    NotObservable
        Fewer than five poses, or poses for which the linear equations have several solutions.
    """
    n, A = len(wrench), np.swapaxes(R_base_flange, 1, 2)
    if n < 5:
        raise NotObservable(f"LROM needs at least 5 poses, there are {n}: record more, or use ML, which needs 4.")
    # R^T F_i - A_i F_b - R^T F0 = 0 for x9, the rows of R^T, and x6 = (F_b, R^T F0), which is eliminated.
    A9 = np.einsum("kl,ni->nkli", np.eye(3), wrench[:, :3]).reshape(3 * n, 9)
    A6 = np.concatenate([-A, np.broadcast_to(-np.eye(3), A.shape)], axis=2).reshape(3 * n, 6)
    x6_of_x9 = -np.linalg.lstsq(A6, A9)[0]
    H = np.linalg.qr(A9 + A6 @ x6_of_x9, mode="r")  # triangular factor: the same norm in at most nine rows
    _, singular, Vt = np.linalg.svd(H)
    if singular[7] <= 1e-9 * singular[0]:
        raise NotObservable("LROM has several solutions for these poses: tilt the tool in more directions, or use ML.")
    x9 = np.sqrt(3) * Vt[8]
    if np.linalg.det(x9.reshape(3, 3)) < 0:
        x9 = -x9
    return _remaining_steps(R_base_flange, wrench, np.asarray((x6_of_x9 @ x9)[:3]))


def _remaining_steps(R_base_flange: Array, wrench: Array, gravity_force_base_N: Array) -> Parameters:
    """Return all parameters for a known gravity force: Wahba's problem (eqs 36-42 and 39), then eqs 43-45.

    The text after eq 42 mentions a case "rank D = 1, det D < 0", which is impossible: det D is 0 below rank 3.
    """
    force_N, gravity_flange_N = wrench[:, :3], gravity_force_base_N @ R_base_flange
    D = (force_N - force_N.mean(axis=0)).T @ (gravity_flange_N - gravity_flange_N.mean(axis=0))
    R = nearest_rotation(D)
    force_bias_N = force_N.mean(axis=0) - R @ gravity_flange_N.mean(axis=0)
    p_sensor_com_m, torque_bias_Nm = com_and_torque_bias(force_N - force_bias_N, wrench[:, 3:])
    return Parameters(R.T, gravity_force_base_N, force_bias_N, p_sensor_com_m, torque_bias_Nm)


def special_numbers(R_base_flange: Array, *, others: bool = False) -> tuple[Indices, Array]:
    """Return the number of the special orientation of each pose, and the common rotation of the base.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    others : bool
        Whether further poses are accepted, such as other orientations or repetitions of the 24.

    Returns
    -------
    number : int array, shape (n,)
        Row i is orientation number[i] + 1 of the paper, or none of the 24 if number[i] is -1.
    Y : array, shape (3, 3)
        Rotation with R_base_flange[i] = Y @ SPECIAL_R_flange_base[number[i]].T approximately; the identity if it fits.

    Raises
    ------
    NotObservable
        An orientation is missing or deviates too much, or is repeated without `others`. The message gives the numbers.
        Up to 1° is always accepted and more than 1.3° never, because Y is itself uncertain.
    """
    match = _Match(R_base_flange, np.eye(3))
    if match.seen < 24 or match.angle_rad[match.number >= 0].max() > ROUNDING_RAD:
        match = _best_match(R_base_flange)
    if match.seen < 24 or not (others or len(R_base_flange) == 24):
        raise NotObservable(match.refusal_of_mixed() if others else match.refusal())
    kept = match.of_the_24(R_base_flange)
    if kept.all():
        return match.number, match.Y
    number = np.full(len(R_base_flange), -1)
    number[kept], Y = special_numbers(R_base_flange[kept], others=True)
    return number, Y


def special_deviation_rad(R_base_flange: Array, number: Indices, Y: Array) -> float:
    """Return the largest angle between a pose (n, 3, 3) and its special orientation, as `special_numbers` found it."""
    special = number >= 0
    nominal = Y @ np.swapaxes(SPECIAL_R_flange_base[number[special]], 1, 2)
    return float(Rotation.from_matrix(np.swapaxes(nominal, 1, 2) @ R_base_flange[special]).magnitude().max())


class _Match:
    """Match of each pose with its nearest special orientation, for a base that is turned by Y."""

    def __init__(self, R_base_flange: Array, Y: Array, tolerance_rad: float = _RECOGNISED_RAD) -> None:
        trace = (Y.T @ R_base_flange).reshape(-1, 9) @ np.swapaxes(SPECIAL_R_flange_base, 1, 2).reshape(24, 9).T
        self.Y = Y
        self.nearest: Indices = trace.argmax(axis=1)
        self.angle_rad = np.arccos(np.clip((trace.max(axis=1) - 1) / 2, -1, 1))
        self.number: Indices = np.where(self.angle_rad <= tolerance_rad, self.nearest, -1)
        self.times_seen = np.bincount(self.number[self.number >= 0], minlength=24)
        self.seen = int(np.count_nonzero(self.times_seen))

    def of_the_24(self, R_base_flange: Array) -> NDArray[np.bool_]:
        """Return which poses (n,) are one of the 24 or a repetition, or are far from all of them.

        False for a pose of another set that is only near one of the 24.
        """
        order = np.argsort(self.angle_rad)
        first_of_each = np.unique(self.number[order], return_index=True)[1][-24:]  # without number -1, which is first
        nearest = R_base_flange[order[first_of_each]][self.number]
        apart = Rotation.from_matrix(np.swapaxes(R_base_flange, 1, 2) @ nearest).magnitude()
        return np.asarray((self.number < 0) | (apart <= ROUNDING_RAD))

    def refusal(self) -> str:
        if not self.seen:
            return "SROM needs its 24 orientations, and no pose has one of them: use LROM or ML."
        problems = []
        if self.seen < 24:
            problems.append(f"missing {_list(np.flatnonzero(self.times_seen == 0))}")
        if self.times_seen.max() > 1:
            problems.append(f"repeated {_list(np.flatnonzero(self.times_seen > 1))}")
        strays = np.flatnonzero(self.number < 0)
        if strays.size:
            problems.append(f"row {_list(strays)} not among them ({self._worst(strays)})")
        advice = "Use LROM or ML" if self.seen < 24 else "Use mixed, which accepts additional poses, or LROM or ML"
        return f"SROM needs its 24 orientations once each: {'; '.join(problems)}. {advice} instead."

    def refusal_of_mixed(self) -> str:
        missing = np.flatnonzero(self.times_seen == 0)
        near = np.flatnonzero((self.number < 0) & np.isin(self.nearest, missing) & (self.angle_rad < np.deg2rad(10)))
        off = f" ({self._worst(near)})" if near.size else ""
        return (
            f"mixed needs each of the 24 orientations of SROM at least once: missing {_list(missing)}{off}. "
            "Record these orientations, or use LROM or ML."
        )

    def _worst(self, rows: Indices) -> str:
        row = rows[self.angle_rad[rows].argmax()]
        angle_deg, number = np.rad2deg(self.angle_rad[row]), self.nearest[row] + 1
        return f"row {row + 1} is {angle_deg:.2f}° from orientation {number}, 1° is allowed"


def _best_match(R_base_flange: Array) -> _Match:
    """Return the `_Match` whose common rotation of the base recognises most of the 24 orientations."""
    matches = list[_Match]()
    for seed in chain([np.eye(3)], _likely_members(R_base_flange)):
        matches.append(_Match(R_base_flange, _common_rotation(R_base_flange, seed)))
        if matches[-1].seen == 24:
            break
    return max(matches, key=lambda match: match.seen)


def _likely_members(R_base_flange: Array, most: int = 12) -> Iterator[Array]:
    """Yield one pose (3, 3) of each of the largest groups of poses that differ by rotations of the cube.

    Trying each pose as a member of the 24 would cost O(n^2). Sums of fourth-order products over the columns of a
    rotation are invariant to a rotation of the cube on its right, so these sums put poses of one group close together.
    """
    i, j, k, m = np.array(list(combinations_with_replacement(range(3), 4))).T
    R = R_base_flange
    invariant = np.sum(R[:, i] * R[:, j] * R[:, k] * R[:, m], axis=2)
    neighbours = KDTree(invariant).query_ball_point(invariant, _NEIGHBOURS)
    size = np.array([len(rows) for rows in neighbours])
    for _ in range(most):
        if not size.any():
            return
        fullest = size.argmax()
        size[neighbours[fullest]] = 0
        yield R[fullest]


def _common_rotation(R_base_flange: Array, seed: Array) -> Array:
    """Return Y estimated from all poses in the group of `seed`: the smallest of 24 equivalent rotations."""
    Y = seed
    for tolerance_rad in (4 * TOLERANCE_RAD, 2 * TOLERANCE_RAD, _RECOGNISED_RAD):  # `seed` may deviate more
        number = _Match(R_base_flange, Y, tolerance_rad).number
        near = number >= 0
        if near.any():
            Y = nearest_rotation(np.einsum("nij,njk->ik", R_base_flange[near], SPECIAL_R_flange_base[number[near]]))
    equivalents = Y @ SPECIAL_R_flange_base
    rounded = equivalents.round(4)  # makes ties, for example at 45°, independent of the order of rows
    smallest = min(range(24), key=lambda i: (-np.trace(rounded[i]), *rounded[i].ravel()))
    return np.asarray(equivalents[smallest])


def _list(indices: Indices, most: int = 6) -> str:
    shown = ", ".join(str(i + 1) for i in indices[:most].tolist())
    return shown if len(indices) <= most else f"{shown} and {len(indices) - most} more"


def srom_gravity_force(force_N: Array) -> Array:
    """Return the gravity force (3,) in base from the forces (24, 3) in the sensor frame, in the paper's order.

    The formulas are eqs 14-23.
    """
    F_b = np.empty(3)
    for k, sums in enumerate(_SUMS):
        p = [
            (force_N[np.array(plus) - 1].sum(axis=0) - force_N[np.array(minus) - 1].sum(axis=0)) / 8
            for plus, minus in sums
        ]
        F_b[k] = np.cbrt(np.linalg.det(np.column_stack(p)))  # [p_k1 p_k2 p_k3] = f_bk R and det R = 1
    return F_b
