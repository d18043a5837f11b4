"""Selection of poses from those that the arm can reach: a whole set, the next pose, a verification, the papers' sets.

Criteria are traces of a covariance C: a pose with whitened Jacobian J lowers trace(M C) by
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
# Weight of the second term of the criterion, against gravity directions in one plane.
WEIGHT_OF_PLANE = 0.3
# Smallest number of poses that determines all parameters.
FEWEST = 4
# To the second solution (`second_basin`); above it, that solution does not matter.
LEAST_GAP = 0.05
MOST_SWEEPS = 20
LEAST_GAIN = 1e-6
CLEARLY_WIDER = 1.1


def cone_candidates(
    half_angle_rad: float, spins: int = 8, directions: int = 150, down_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Array:
    """Orientations with the tool axis (flange z) within a cone about straight down, and any turn about that axis.

    Parameters
    ----------
    half_angle_rad : float
        Between 0 and pi; pi is the whole sphere.
    spins : int
        Turns about the tool axis for each direction.
    directions : int
        About how many directions of the tool axis: evenly spaced rings, the outermost on the rim.
    down_base : array_like, shape (3,)
        Direction of gravity in base, a unit vector.

    Returns
    -------
    array, shape (m, 3, 3)
        R_base_flange; the first `spins` have the tool straight down.
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
    """R_base_flange (k * azimuths, 3, 3) with the tool axis (flange z) at these k angles from straight down.

    Each tilt has so many evenly spaced directions, and all have one turn about the tool axis, `spin_rad`. `down_base`
    is the direction of gravity in base, a unit vector.
    """
    tilt = np.repeat(np.asarray(tilts_rad, dtype=np.float64), azimuths)
    azimuth = np.resize(2 * np.pi * np.arange(azimuths) / azimuths, len(tilt))
    return _tilted(azimuth, tilt, np.full(len(tilt), spin_rad), down_base)


def _tilted(azimuth: Array, tilt: Array, spin: Array, down_base: ArrayLike) -> Array:
    """R_base_flange (m, 3, 3) of a tool that points down, tilted towards the azimuth and turned about its axis."""
    tilted = Rotation.from_euler("ZYZ", np.column_stack([azimuth, tilt, spin - azimuth]))
    down = np.asarray(down_base, dtype=np.float64)
    normal = np.cross([0.0, 0.0, -1.0], down)
    sine = float(np.linalg.norm(normal))
    turn_rad = np.arctan2(sine, -down[2])
    mounted = Rotation.from_rotvec(turn_rad * (normal / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])))
    return np.asarray((mounted * tilted).as_matrix() @ TOOL_DOWN_R_base_flange)


def choose(R_candidates: Array, n: int, guess: Guess) -> Indices:
    """Choose n poses: greedily, then exchanging one at a time as long as it helps.

    They minimise the summed variances of rotation, weight and force bias, plus a term against gravity directions in one
    plane, for LROM. Poses that contradict the second solution are added until `LEAST_GAP` is reached. If a narrow cone
    cannot reach it, the set with the widest gap is returned.

    Parameters
    ----------
    R_candidates : array, shape (m, 3, 3)
        Orientations R_base_flange that the arm can reach.
    n : int
        4 or more.
    guess : Guess

    Returns
    -------
    int array, shape (n,)
        Indices of candidates, all different, in the order of selection.
    """
    R_candidates = np.asarray(R_candidates, dtype=np.float64)
    if not FEWEST <= n <= len(R_candidates):
        raise ValueError(f"cannot choose {n} poses of {len(R_candidates)}: {FEWEST} or more, of at least as many")
    u = predict(guess.parameters, R_candidates)[:, None, :3] / guess.weight_N
    u1 = np.concatenate([u, np.ones((len(u), 1, 1))], axis=2)
    terms = (force_rows(R_candidates, guess), np.eye(9)), (u1, WEIGHT_OF_PLANE * np.eye(4))

    def gains(chosen: list[int]) -> Array:
        total = np.zeros(len(R_candidates))
        for candidates, M in terms:  # trace(M C), with C the covariance of some parameters
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
        # Pinned poses stay, or the exchange would take the contradiction out again.
        pinned = [*dict.fromkeys([*pinned, *strong, int(contradiction.argmax())])]
    return best


def next_pose(R_done: Array, R_candidates: Array, guess: Guess) -> Indices:
    """Rank candidates for the next pose by the improvement of force and torque compensation in all orientations.

    While the completed poses fit a second solution almost as well, the improvement is multiplied by the contradiction
    of the candidate to that solution.

    Parameters
    ----------
    R_done : array, shape (n, 3, 3)
        Orientations R_base_flange of the completed poses; n may be 0.
    R_candidates : array, shape (m, 3, 3)
    guess : Guess

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
    """Choose n candidates greedily, then exchange one at a time as long as it helps; return them, pinned ones first.

    `gains` returns what each candidate (m,) improves, added to chosen ones. The pinned candidates stay chosen.
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
    """(m,) squared distance of the forces that the guess and another solution expect, N²."""
    difference = predict(other, R_candidates) - predict(guess.parameters, R_candidates)
    return np.asarray((difference[:, :3] ** 2).sum(axis=1))


def _gains(rows: Array, C: Array, M: Array) -> Array:
    """(m,) decrease of trace(M C) by the rows (m, r, p) of each candidate."""
    JC = rows @ C
    solved = np.linalg.solve(JC @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1]), JC)
    return np.asarray(np.einsum("mrp,mrp->m", solved, JC @ M))


def _covariance_from(information: Array) -> Array:
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


# Selection of poses that verify a calibration: far from those of the fit, and able to name what has changed.

FEWEST_TO_VERIFY = 2
# Share of the candidates, the farthest from the fit, among which the poses are chosen.
FARTHER_SHARE = 0.5
# The choice hardly depends on the tool.
TOOL = Guess(mass_kg=1.0, sigma_force_N=0.02, sigma_torque_Nm=0.001)
# (15,) of mounting, gravity force, force bias, centre of mass and torque bias.
USUAL_CHANGE = np.repeat([np.deg2rad(1.0), TOOL.weight_N * np.deg2rad(0.5), 0.5, 3e-3, 0.02], 3)

# Error coordinates of mounting, gravity force (base or payload), centre of mass, and bias.
CAUSES = (range(3), range(3, 6), range(9, 12), BIASES)


def choose_verification_poses(
    candidates: Array, fitted: Array, n: int, *, gravity_direction_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Indices:
    """Choose poses for a verification: greedily, then exchanging one at a time as long as it helps.

    They are chosen among the half of the candidates in which gravity pulls on the tool from directions farthest from
    those of the fit. They maximise the determinants of the information about each pair of causes of a change, with a
    prior of the usual size of a change. Two poses then differ in tilt, and no two causes look alike.

    Parameters
    ----------
    candidates : array, shape (m, 3, 3)
        Orientations R_base_flange that the arm can reach.
    fitted : array, shape (k, 3, 3)
        R_base_flange of the calibration.
    n : int
        2 or more.
    gravity_direction_base : array_like, shape (3,)
        For a robot on a table -z.

    Returns
    -------
    int array, shape (n,)
        Indices of candidates, all different.
    """
    candidates, fitted = np.asarray(candidates, dtype=np.float64), np.asarray(fitted, dtype=np.float64)
    if not FEWEST_TO_VERIFY <= n <= len(candidates):
        raise ValueError(
            f"cannot choose {n} poses of {len(candidates)}: {FEWEST_TO_VERIFY} or more, of at least as many"
        )
    down = np.asarray(gravity_direction_base, dtype=np.float64)
    nearest = np.max((down @ candidates) @ (down @ fitted).T, axis=1, initial=-np.inf)  # cosine, in flange axes
    count = max(n, round(FARTHER_SHARE * len(candidates)))
    far = np.sort(np.argsort(nearest, kind="stable")[:count])
    rows = whitened_jacobian(candidates[far], TOOL) / TOOL.scale * USUAL_CHANGE
    pairs = [rows[..., [*a, *b]] for a, b in combinations(CAUSES, 2)]

    def gains(chosen: list[int]) -> Array:
        """Increase of log det(1 + sum of J'J), summed over the pairs of causes."""
        total = np.zeros(len(far))
        for J in pairs:
            done = J[chosen].reshape(-1, J.shape[2])
            covariance = np.linalg.inv(np.eye(J.shape[2]) + done.T @ done)
            total += np.linalg.slogdet(np.eye(6) + J @ covariance @ np.swapaxes(J, 1, 2))[1]
        return total

    return np.asarray(far[greedy_and_exchange(gains, n)])


# The sets of orientations A to H of Yu, Shi, Lou 2021 (Fig. 6), by which the cases of Table III are named.
#
# The figure gives kinds and counts, no numbers. A is the paper's own; the others are drawn here, always alike. The
# limited workspace of E is that of a tool that points forwards and down: its axis (flange z) within 60° of the
# direction halfway between straight down and forwards. F is on the opposite side, backwards and down.

# Orientations of each set. H is the first half of E.
COUNTS: Mapping[str, int] = {"A": 24, "B": 12, "C": 12, "D": 150, "E": 24, "F": 24, "G": 48, "H": 12}
# What Table III needs.
EVERY_SET = "A+B+C+D+E+F+G"
_HALF_ANGLE_RAD = np.pi / 3
_SIDES = {"E": 1.0, "F": -1.0, "G": 1.0, "H": 1.0}


def paper_set(name: str, *, spare: int = 0, down_base: ArrayLike = (0.0, 0.0, -1.0)) -> Array:
    """Return the orientations of one set.

    Parameters
    ----------
    name : str
        A to H.
    spare : int
        More orientations of the same kind, for an arm that cannot reach each of them; A has none.
    down_base : array_like, shape (3,)
        Direction of gravity in base, a unit vector: forwards is base x, or base z where gravity is along x.

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
    drawn = Rotation.random(8 * count + 100, rng=rng).as_matrix()  # a quarter of all directions is inside
    inside = drawn[:, :, 2] @ axis / np.linalg.norm(axis) >= np.cos(_HALF_ANGLE_RAD)
    return np.asarray(drawn[inside][:count])


def set_names(sets: str) -> Sequence[str]:
    """Split the names in "A+E". Raises `ValueError` for an unknown set, a repeated one, or E and its half H."""
    names = sets.split("+")
    if unknown := [name for name in names if name not in COUNTS]:
        raise ValueError(f"there is no set '{unknown[0]}': choose {', '.join(COUNTS)}, or several as A+E")
    if len(set(names)) < len(names) or {"E", "H"} <= set(names):
        raise ValueError(f"{sets} contains a set twice (H is the half of E): leave one of them out")
    return names


def set_numbers(name: str) -> NDArray[np.intp]:
    """Return the numbers of the poses of one set: those of the paper for A, 1001 to 1012 for B, from 2001 on for C."""
    return np.arange(1, COUNTS[name] + 1) + 1000 * "ABCDEFG".index("E" if name == "H" else name)
