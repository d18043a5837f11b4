"""Selection of poses that the arm can reach: a set, the next pose, poses of a verification, and Yu's sets A to H.

The criteria are traces of a covariance C: a pose with whitened Jacobian J reduces trace(M C) by
trace((1 + J C J^T)^-1 J C M C J^T), so one array operation ranks all candidates. All functions are deterministic.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ftcalib.model import BIASES, Array, Parameters, predict
from ftcalib.poses.information import (
    Guess,
    TOOL_DOWN_R_base_flange,
    force_rows,
    prediction_weights,
    second_basin,
    special,
    whitened_jacobian,
)

Indices = NDArray[np.intp]

# Information about every parameter before the first pose, in the units of `Guess.scale`: almost none.
PRIOR = 1e-4
# Weight of the second term of the criterion of `choose`, which penalises gravity directions in one plane.
WEIGHT_OF_PLANE = 0.3
# Smallest number of poses with which all parameters can be determined.
FEWEST = 4
# Gap to the second solution (see `second_basin`) from which no poses are added to widen it.
LEAST_GAP = 0.05
MOST_SWEEPS = 20
LEAST_GAIN = 1e-6
CLEARLY_WIDER = 1.1


def cone_candidates(
    half_angle_rad: float, spins: int = 8, directions: int = 150, down_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Array:
    """Return orientations with the tool axis (flange z) within a cone about straight down, turned about that axis.

    Parameters
    ----------
    half_angle_rad : float
        Half angle of the cone, between 0 and pi; pi is the whole sphere.
    spins : int
        Number of rotations about the tool axis for each direction.
    directions : int
        Approximate number of directions of the tool axis, on evenly spaced rings, the outermost on the rim.
    down_base : array_like, shape (3,)
        Direction of gravity in base, a unit vector.

    Returns
    -------
    array, shape (m, 3, 3)
        R_base_flange; in the first `spins` orientations the tool points straight down.
    """
    if not (0 < half_angle_rad <= np.pi and spins > 0 and directions > 0):
        raise ValueError(f"a cone of {half_angle_rad} rad with {directions} directions and {spins} spins is empty")
    area = 2 * np.pi * (1 - np.cos(half_angle_rad))
    rings = max(1, round(half_angle_rad * np.sqrt(directions / area)))
    tilts = half_angle_rad * np.arange(rings + 1) / rings
    counts = np.maximum(1, np.rint(2 * np.pi * np.sin(tilts) * rings / half_angle_rad)).astype(int)
    tilt = np.repeat(np.repeat(tilts, counts), spins)
    azimuth = np.repeat(np.concatenate([2 * np.pi * np.arange(count) / count for count in counts]), spins)
    spin = np.tile(2 * np.pi * np.arange(spins) / spins, counts.sum())
    return _tilted(azimuth, tilt, spin, down_base)


def tilted_candidates(
    tilts_rad: ArrayLike, azimuths: int, spin_rad: float, down_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Array:
    """Return R_base_flange (k * azimuths, 3, 3) with the tool axis (flange z) tilted by k angles from straight down.

    Each tilt has `azimuths` evenly spaced directions. The rotation about the tool axis is `spin_rad` everywhere.
    `down_base` is the direction of gravity in base axes, a unit vector.
    """
    tilt = np.repeat(np.asarray(tilts_rad, dtype=np.float64), azimuths)
    azimuth = np.resize(2 * np.pi * np.arange(azimuths) / azimuths, len(tilt))
    return _tilted(azimuth, tilt, np.full(len(tilt), spin_rad), down_base)


def _tilted(azimuth: Array, tilt: Array, spin: Array, down_base: ArrayLike) -> Array:
    """Return R_base_flange (m, 3, 3) of a tool that points down, tilted towards an azimuth and spun about its axis."""
    tilted = Rotation.from_euler("ZYZ", np.column_stack([azimuth, tilt, spin - azimuth]))
    down = np.asarray(down_base, dtype=np.float64)
    normal = np.cross([0.0, 0.0, -1.0], down)
    sine = float(np.linalg.norm(normal))
    turn_rad = np.arctan2(sine, -down[2])
    mounted = Rotation.from_rotvec(turn_rad * (normal / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])))
    return np.asarray((mounted * tilted).as_matrix() @ TOOL_DOWN_R_base_flange)


def choose(R_candidates: Array, n: int, guess: Guess) -> Indices:
    """Return n poses chosen greedily, then by exchanging one at a time while the criterion improves.

    They minimise the sum of the variances of rotation, weight and force bias, plus a term that penalises gravity
    directions in one plane, for LROM. Poses that contradict the second solution are added until the gap reaches
    `LEAST_GAP`. If this is impossible, as in a narrow cone, the set with the widest gap is returned.

    Parameters
    ----------
    R_candidates : array, shape (m, 3, 3)
        Orientations R_base_flange that the arm can reach.
    n : int
        Number of poses, 4 or more.

    Returns
    -------
    int array, shape (n,)
        Indices of candidates, all different, in the order of selection.
    """
    R_candidates = np.asarray(R_candidates, dtype=np.float64)
    if not FEWEST <= n <= len(R_candidates):
        raise ValueError(f"cannot choose {n} of {len(R_candidates)} candidates: choose {FEWEST} or more poses")
    u = predict(guess.parameters, R_candidates)[:, None, :3] / guess.weight_N
    u1 = np.concatenate([u, np.ones((len(u), 1, 1))], axis=2)
    terms = (force_rows(R_candidates, guess), np.eye(9)), (u1, WEIGHT_OF_PLANE * np.eye(4))

    def gains(chosen: list[int]) -> Array:
        total = np.zeros(len(R_candidates))
        for candidates, M in terms:  # each term of the criterion has the form trace(M C) with a covariance C
            rows = candidates[chosen].reshape(-1, len(M))
            total += _gains(candidates, _covariance_from(PRIOR * np.eye(len(M)) + rows.T @ rows), M)
        return total

    pinned: list[int] = []
    widest, best = -1.0, np.zeros(0, dtype=np.intp)
    while len(pinned) <= n // 2:
        chosen = greedy_and_exchange(gains, n, pinned)
        gap, other = second_basin(R_candidates[chosen], guess)
        if gap > CLEARLY_WIDER * widest:
            widest, best = gap, chosen
        if gap >= LEAST_GAP or other is None:
            break
        contradiction = _contradiction(R_candidates, guess, other)
        strong = [int(i) for i in chosen if contradiction[i] > contradiction.max() / 2]
        contradiction[chosen] = -1.0
        # Pinned poses stay, because the exchange would otherwise remove them again.
        pinned = [*dict.fromkeys([*pinned, *strong, int(contradiction.argmax())])]
    return best


def next_pose(R_done: Array, R_candidates: Array, guess: Guess) -> Indices:
    """Rank candidates for the next pose by the improvement of force and torque compensation over all orientations.

    If a second solution fits the completed poses almost as well, the improvement is multiplied by the squared distance
    of the forces that both solutions predict for the candidate.

    Parameters
    ----------
    R_done : array, shape (n, 3, 3)
        Orientations R_base_flange of the completed poses; n may be 0.
    R_candidates : array, shape (m, 3, 3)

    Returns
    -------
    int array, shape (m,)
        Indices of candidates, the best first.
    """
    R_done, R_candidates = np.asarray(R_done, dtype=np.float64), np.asarray(R_candidates, dtype=np.float64)
    if not len(R_candidates):
        raise ValueError("no candidates for the next pose: pass orientations that the arm can reach")
    done = whitened_jacobian(R_done, guess).reshape(-1, 15)
    C = _covariance_from(PRIOR * np.eye(15) + done.T @ done)
    weight = sum(prediction_weights(special(range(1, 25)), guess), np.zeros((15, 15)))
    worth = _gains(whitened_jacobian(R_candidates, guess), C, weight)
    if len(R_done) >= FEWEST - 1:
        gap, other = second_basin(R_done, guess)
        if gap < LEAST_GAP and other is not None:
            worth = worth * _contradiction(R_candidates, guess, other)
    return np.argsort(-worth, kind="stable")


def greedy_and_exchange(gains: Callable[[list[int]], Array], n: int, pinned: Sequence[int] = ()) -> Indices:
    """Return n candidates chosen greedily, then by exchanging one at a time while it helps; pinned ones come first.

    `gains` returns the improvement (m,) by each candidate in addition to chosen ones. Pinned candidates stay chosen.
    """
    chosen = list(pinned)

    def best_addition() -> tuple[int, Array]:
        gain = gains(chosen)
        free = gain.copy()
        free[chosen] = -np.inf
        return int(free.argmax()), gain

    while len(chosen) < n:
        chosen.append(best_addition()[0])
    for _ in range(MOST_SWEEPS):
        changed = False
        for i in range(len(pinned), n):
            out = chosen.pop(i)
            candidate, gain = best_addition()
            better = bool(gain[candidate] > gain[out] * (1 + LEAST_GAIN))
            chosen.insert(i, candidate if better else out)
            changed |= better
        if not changed:
            break
    return np.array(chosen)


def _contradiction(R_candidates: Array, guess: Guess, other: Parameters) -> Array:
    """Return the squared distance (m,) between the forces predicted by the guess and by another solution, N²."""
    difference = predict(other, R_candidates) - predict(guess.parameters, R_candidates)
    return np.asarray((difference[:, :3] ** 2).sum(axis=1))


def _gains(rows: Array, C: Array, M: Array) -> Array:
    """Return the decrease (m,) of trace(M C) that each candidate with the Jacobian rows (m, r, p) would cause."""
    JC = rows @ C
    solved = np.linalg.solve(JC @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1]), JC)
    return np.asarray(np.einsum("mrp,mrp->m", solved, JC @ M))


def _covariance_from(information: Array) -> Array:
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


# Selection of poses for a verification: far from the poses of the fit, and able to identify what has changed.

FEWEST_TO_VERIFY = 2
# Share of the candidates, those farthest from the poses of the fit, from which verification poses are chosen.
FARTHER_SHARE = 0.5
# Tool that the choice of verification poses assumes; the choice hardly depends on it.
TOOL = Guess(mass_kg=1.0, sigma_force_N=0.02, sigma_torque_Nm=0.001)
# (15,) usual changes of mounting, gravity force, force bias, centre of mass and torque bias, one standard deviation.
USUAL_CHANGE = np.repeat([np.deg2rad(1.0), TOOL.weight_N * np.deg2rad(0.5), 0.5, 3e-3, 0.02], 3)

# Indices of the error coordinates of mounting, gravity force (base or payload), centre of mass, and bias.
CAUSES = (range(3), range(3, 6), range(9, 12), BIASES)


def choose_verification_poses(
    candidates: Array, fitted: Array, n: int, *, gravity_direction_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Indices:
    """Return poses for a verification, chosen greedily, then by exchanging one at a time while it helps.

    They are chosen from the half of the candidates whose gravity directions in flange axes are farthest from those of
    the fit. They maximise the determinant of the information about each pair of causes of a change, with a prior of
    the usual size of a change. The poses then differ in tilt, and any two causes can be distinguished.

    Parameters
    ----------
    candidates : array, shape (m, 3, 3)
        Orientations R_base_flange that the arm can reach.
    fitted : array, shape (k, 3, 3)
        R_base_flange of the poses of the calibration.
    n : int
        Number of poses, 2 or more.
    gravity_direction_base : array_like, shape (3,)
        Direction of gravity in base axes, -z for a robot on a table.

    Returns
    -------
    int array, shape (n,)
        Indices of candidates, all different.
    """
    candidates, fitted = np.asarray(candidates, dtype=np.float64), np.asarray(fitted, dtype=np.float64)
    if not FEWEST_TO_VERIFY <= n <= len(candidates):
        raise ValueError(f"cannot choose {n} of {len(candidates)} candidates: choose {FEWEST_TO_VERIFY} or more poses")
    down = np.asarray(gravity_direction_base, dtype=np.float64)
    nearest = np.max((down @ candidates) @ (down @ fitted).T, axis=1, initial=-np.inf)  # cosine, in flange axes
    count = max(n, round(FARTHER_SHARE * len(candidates)))
    far = np.sort(np.argsort(nearest, kind="stable")[:count])
    rows = whitened_jacobian(candidates[far], TOOL) / TOOL.scale * USUAL_CHANGE
    pairs = [rows[..., [*a, *b]] for a, b in combinations(CAUSES, 2)]

    def gains(chosen: list[int]) -> Array:
        """Return the increase (m,) of log det(1 + sum of J'J), summed over the pairs of causes."""
        total = np.zeros(len(far))
        for J in pairs:
            done = J[chosen].reshape(-1, J.shape[2])
            covariance = np.linalg.inv(np.eye(J.shape[2]) + done.T @ done)
            total += np.linalg.slogdet(np.eye(6) + J @ covariance @ np.swapaxes(J, 1, 2))[1]
        return total

    return np.asarray(far[greedy_and_exchange(gains, n)])


# The sets of orientations A to H of Yu, Shi, Lou 2021 (Fig. 6), by which the cases of Table III are named.
#
# The figure gives kinds and counts of orientations, but no values. Set A is the paper's; the others are drawn here with
# a fixed seed. In the limited workspace of E the tool points forwards and down: its axis (flange z) is within 60° of
# the direction halfway between straight down and forwards. F is on the opposite side, backwards and down.

# Number of orientations of each set. H is the first half of E.
COUNTS: Mapping[str, int] = {"A": 24, "B": 12, "C": 12, "D": 150, "E": 24, "F": 24, "G": 48, "H": 12}
# The sets that Table III of Yu et al. requires.
EVERY_SET = "A+B+C+D+E+F+G"
_HALF_ANGLE_RAD = np.pi / 3
_SIDES = {"E": 1.0, "F": -1.0, "G": 1.0, "H": 1.0}


def paper_set(name: str, *, spare: int = 0, down_base: ArrayLike = (0.0, 0.0, -1.0)) -> Array:
    """Return the orientations of one set.

    Parameters
    ----------
    name : str
        Name of the set, A to H.
    spare : int
        Number of additional orientations of the same kind, for an arm that cannot reach all of them; not for A.
    down_base : array_like, shape (3,)
        Direction of gravity in base axes, a unit vector. Forwards is base x, or base z if gravity is along x.

    Returns
    -------
    array, shape (n, 3, 3)
        R_base_flange.

    Raises
    ------
    ValueError
        There is no such set.

    Examples
    --------
    >>> from ftcalib.poses.selection import paper_set
    >>> paper_set("E").shape
    (24, 3, 3)
    """
    if name not in COUNTS:
        raise ValueError(f"there is no set {name}: choose {', '.join(COUNTS)}")
    if name == "A":
        return special(range(1, 25))
    count, rng = COUNTS[name] + spare, np.random.default_rng(ord("E" if name == "H" else name))
    if name not in _SIDES:
        return np.asarray(Rotation.random(count, rng=rng).as_matrix())
    down = np.asarray(down_base, dtype=np.float64)
    forwards = np.eye(3)[0 if abs(down[0]) < 0.9 else 2]
    forwards -= forwards @ down * down
    axis = down + _SIDES[name] * forwards / np.linalg.norm(forwards)
    drawn = Rotation.random(8 * count + 100, rng=rng).as_matrix()  # a quarter of all directions is inside the cone
    inside = drawn[:, :, 2] @ axis / np.linalg.norm(axis) >= np.cos(_HALF_ANGLE_RAD)
    return np.asarray(drawn[inside][:count])


def set_names(sets: str) -> Sequence[str]:
    """Return the names in a string such as "A+E"; raise `ValueError` for an unknown or repeated set, or E with H."""
    names = sets.split("+")
    if unknown := [name for name in names if name not in COUNTS]:
        raise ValueError(f"there is no set '{unknown[0]}': choose {', '.join(COUNTS)}, or several, such as A+E")
    if len(set(names)) < len(names) or {"E", "H"} <= set(names):
        raise ValueError(f"{sets} contains a set twice (H is half of E): leave one of them out")
    return names


def set_numbers(name: str) -> NDArray[np.intp]:
    """Return the pose numbers of one set: those of the paper for A, 1001 to 1012 for B, 2001 and above for C, etc."""
    return np.arange(1, COUNTS[name] + 1) + 1000 * "ABCDEFG".index("E" if name == "H" else name)
