"""Observability of a set of poses: rank, inseparable parameters, second solution, and poses to add.

The Fisher information describes only the neighbourhood of one solution. Two further checks are therefore made: whether
a second, distant solution explains the data as well, and which motion removes the ambiguity.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.errors import NotObservable
from ftcalib.likelihood.rotation_minima import RotationMinimum, force_cost, minima
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array, Parameters, angle_between, gravity_wrench, jacobian

# Three different orientations have 4 or 8 exact solutions, although their Fisher information has full rank.
LEAST_POSES = 4
RECOMMENDED_POSES = 6
RANK_TOLERANCE = 1e-9
POOR_CONDITION = 1e4
# With this gap to the second solution, eight poses distinguish both, even if the weight is only ten times the noise.
WEAK_GAP = 0.02
AMBIGUOUS_GAP = 1e-6
# In 7361 simulated calibrations, a second solution with a chi2 larger by this difference was never the right one.
ACCEPTED_DELTA_CHI2 = 12.0
SAME_ORIENTATION_RAD = np.deg2rad(0.5)
# Usual ratio of torque noise to force noise.
LEVER_M = 0.025
MOST_ADVISED = 5

# Assumed tool without data: 1 kg at 80 mm from a sensor on an upright robot. Rank and gap hardly depend on the tool.
NOMINAL = Parameters(np.eye(3), -STANDARD_GRAVITY_M_S2 * UP_IN_BASE, np.zeros(3), np.array([0, 0, 0.08]), np.zeros(3))

_SAME_MINIMUM_RAD = np.deg2rad(1.0)
_ALIGNED = np.cos(np.deg2rad(5.0))
_NARROW_DEG = 30.0
# Spreads of unit vectors below about one degree are taken as zero.
_THIN = 0.02
_GROUPS = ("the mounting of the sensor", "gravity", "force bias", "centre of mass", "torque bias")


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Assessment of which parameters a set of poses determines."""

    orientations: int
    """Number of different orientations, counted up to 24."""
    rank: int
    """Number of determined combinations of the 15 parameters."""
    condition: float
    """Ratio of the extreme eigenvalues of the scaled Fisher information; infinite below rank 15."""
    ambiguities: tuple[str, ...]
    """Parts of a sentence: the reason, then the parameters that cannot be separated. Empty for a sound set."""
    advice: tuple[str, ...]
    """Phrases that describe the poses to add, relative to the last pose of the set."""
    advised_R_base_flange: Array
    """(k, 3, 3) orientations of the poses to add; the set is then sound, if five poses suffice."""
    second_gap: float
    """Mean squared force residual of the best other solution over the weight squared: at most 8/9, 0 if ambiguous."""

    @property
    def sound(self) -> bool:
        """Whether the set has four orientations, full rank, a fair condition, and a clearly worse second solution."""
        enough = self.orientations >= LEAST_POSES and self.rank == 15
        return enough and self.condition <= POOR_CONDITION and self.second_gap >= WEAK_GAP

    def sentence(self) -> str:
        """Return one sentence with the reason and the poses to add."""
        if not self.ambiguities:
            return f"the poses determine all parameters (condition {self.condition:.2g}, gap {self.second_gap:.2g})."
        text = self.ambiguities[0] + (": " + ", and ".join(self.ambiguities[1:]) if self.ambiguities[1:] else "")
        if len(self.advice) == 1:
            text += f"; add a pose: from the last one, {self.advice[0]}"
        elif self.advice:
            text += f"; add {len(self.advice)} poses, each from the last one: {'; '.join(self.advice)}"
        return text + "."


def assess(
    R_base_flange: Array, parameters: Parameters = NOMINAL, wrench_cov: Array | None = None, *, advise: bool = True
) -> Observability:
    """Return the observability of a set of poses.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    parameters : Parameters
        Estimated parameters or, without data, a guess.
    wrench_cov : array, shape (n, 6, 6), optional
        Noise of each pose; equal for all poses by default.
    advise : bool
        Whether to search for poses to add.
    """
    observability, information, weak = _nearby(R_base_flange, parameters, wrench_cov)
    observability = _with_second_gap(observability, R_base_flange, parameters)
    if observability.sound:
        return observability
    ambiguities = _ambiguities(R_base_flange, parameters, information, weak, observability)
    words, poses = _advice(R_base_flange, parameters) if advise else ((), observability.advised_R_base_flange)
    return replace(observability, ambiguities=ambiguities, advice=words, advised_R_base_flange=poses)


def require_orientations(R_base_flange: Array, least: int = LEAST_POSES) -> None:
    """Raise `NotObservable` for fewer than `least` different orientations.

    Raises
    ------
    NotObservable
        The message states the number of different orientations and the poses to add.
    """
    n, different = len(R_base_flange), different_orientations(R_base_flange)
    if n < least:
        raise NotObservable(
            f"{n} {'pose is' if n == 1 else 'poses are'} too few, at least {least} are needed: add {least - n}, or "
            f"better {max(RECOMMENDED_POSES, least) - n}."
        )
    if different == 1:
        raise NotObservable(f"all {n} poses have the same orientation: turn and tilt the tool between poses.")
    if different < least:
        raise NotObservable(
            f"the {n} poses have only {different} different orientations, at least {least} are needed: turn and tilt "
            "the tool between poses."
        )


def require_observable(R_base_flange: Array, parameters: Parameters, wrench_cov: Array | None = None) -> None:
    """Raise `NotObservable`, with the reason and the poses to add, if the poses do not determine the parameters.

    `parameters` are the estimates, because observability depends on the direction of gravity.
    """
    require_orientations(R_base_flange)
    observability = assess(R_base_flange, parameters, wrench_cov, advise=False)
    if observability.rank < 15 or observability.second_gap < AMBIGUOUS_GAP:
        raise NotObservable(replace(observability, advice=_advice(R_base_flange, parameters)[0]).sentence())


def _scaled_information(
    R_base_flange: Array, parameters: Parameters = NOMINAL, wrench_cov: Array | None = None
) -> Array:
    """Return the Fisher information (15, 15) in units of 1 rad, weight, weight, lever and weight times lever.

    The lever is the distance of the centre of mass, at least 25 mm. By default the noise of the forces equals the
    weight, and that of the torques 25 mm times the weight, so the entries are numbers of poses.
    """
    weight_N = parameters.weight_N or 1.0
    lever_m = max(float(np.linalg.norm(parameters.p_sensor_com_m)), LEVER_M)
    J = jacobian(parameters, R_base_flange) * np.repeat([1, weight_N, weight_N, lever_m, weight_N * lever_m], 3)
    if wrench_cov is None:
        J /= np.repeat([weight_N, LEVER_M * weight_N], 3)[:, None]
    else:
        J = np.linalg.solve(np.linalg.cholesky(wrench_cov), J)
    J = J.reshape(-1, 15)
    return np.asarray(J.T @ J)


def second_minimum(R_base_flange: Array, parameters: Parameters = NOMINAL) -> tuple[float, RotationMinimum | None]:
    """Return the gap to the best solution with another mounting, and that solution; infinity and None without one.

    The gap is the mean squared force residual over the squared weight, from forces without noise, because torques
    rarely decide. With force noise sigma, chi2 of the wrong solution for n poses is larger by n (weight / sigma)² gap.
    """
    force_N = gravity_wrench(parameters, R_base_flange)[:, :3]
    mountings = minima(force_cost(R_base_flange, force_N, np.ones(len(force_N))))
    others = (m for m in mountings if angle_between(m.R.T, parameters.R_flange_sensor) > _SAME_MINIMUM_RAD)
    if (other := next(others, None)) is None:
        return float("inf"), None
    weight_N2 = float(parameters.gravity_force_base_N @ parameters.gravity_force_base_N)
    return max(0.0, other.cost / (len(R_base_flange) * weight_N2)), other


def different_orientations(R_base_flange: Array) -> int:
    """Return the number of orientations that differ by more than half a degree, counted up to 24."""
    # Usually the first 24 poses of a tour all differ, and then one comparison of all pairs is enough.
    kept, rest = R_base_flange[:24], R_base_flange[24:]
    pairs = np.triu_indices(len(kept), 1)
    if np.any(angle_between(kept[pairs[0]], kept[pairs[1]]) <= SAME_ORIENTATION_RAD):
        kept, rest = np.empty((0, 3, 3)), R_base_flange
    elif len(kept) == 24:
        return 24
    for R in rest:
        if np.all(angle_between(kept, R) > SAME_ORIENTATION_RAD):
            kept = np.concatenate([kept, R[None]])
            if len(kept) == 24:
                break
    return len(kept)


def _nearby(
    R_base_flange: Array, parameters: Parameters, wrench_cov: Array | None = None
) -> tuple[Observability, Array, Array]:
    """Return the observability in the neighbourhood of one solution, without a second solution.

    Also returned are the information (15, 15) in units of its largest eigenvalue, and its weak directions (15, k).
    """
    information = _scaled_information(R_base_flange, parameters, wrench_cov)
    eigenvalues, V = np.linalg.eigh(information)
    free = eigenvalues < RANK_TOLERANCE * eigenvalues[-1]
    rank = 15 - int(free.sum())
    condition = float(eigenvalues[-1] / eigenvalues[0]) if rank == 15 else float("inf")
    different, none = different_orientations(R_base_flange), np.zeros((0, 3, 3))
    observability = Observability(different, rank, condition, (), (), none, float("inf"))
    return observability, information / eigenvalues[-1], V[:, free] if rank < 15 else V[:, :1]


def _is_sound(R_base_flange: Array, parameters: Parameters) -> bool:
    """Whether a set of poses is sound; the second solution, which takes longest, is sought only if necessary."""
    observability = _nearby(R_base_flange, parameters)[0]
    return observability.sound and _with_second_gap(observability, R_base_flange, parameters).sound


def _with_second_gap(observability: Observability, R_base_flange: Array, parameters: Parameters) -> Observability:
    return replace(observability, second_gap=second_minimum(R_base_flange, parameters)[0])


def _ambiguities(
    R_base_flange: Array, parameters: Parameters, information: Array, weak: Array, observability: Observability
) -> tuple[str, ...]:
    different = observability.orientations
    if different == 1:
        return (
            "there is only one orientation: weight, bias, centre of mass and mounting of the sensor cannot be "
            "separated",
        )
    if different < LEAST_POSES:
        return (
            f"there are only {different} different orientations: several solutions explain them exactly, and bias, "
            "weight and mounting of the sensor cannot be separated",
        )
    gravity_flange = parameters.gravity_force_base_N @ R_base_flange / parameters.weight_N  # unit vectors
    turns = Rotation.from_matrix(np.swapaxes(R_base_flange[:1], 1, 2) @ R_base_flange).as_rotvec()
    _, spread, axes = np.linalg.svd(turns, full_matrices=False)
    if spread[1] < _THIN * spread[0]:
        steady = float(np.ptp(gravity_flange, axis=0).max()) < _THIN
        return _one_axis(axes[0], R_base_flange[0], parameters, information, steady=steady)

    _, spread, normals = np.linalg.svd(gravity_flange - gravity_flange.mean(axis=0))
    thin = _THIN * np.sqrt(len(gravity_flange))
    if spread[1] < thin and spread[0] > 2 * thin:
        return (
            "gravity acts along one line of the tool only: bias, weight and mounting of the sensor cannot be separated",
        )
    if spread[2] < min(thin, 0.05 * spread[1]):
        normal = normals[2]
        angle = np.rad2deg(np.arccos(np.clip(abs(float(gravity_flange.mean(axis=0) @ normal)), 0, 1)))
        return (
            f"all poses keep {_axis_name(normal)} at one angle to gravity, {angle:.0f}° from the vertical",
            "reversed gravity with the sensor turned by 180° about that axis explains them as well",
        )
    mean = gravity_flange.mean(axis=0)
    length = float(np.linalg.norm(mean))  # zero if the gravity directions point equally to all sides
    widest = np.rad2deg(np.arccos(np.clip((gravity_flange @ mean).min() / max(length, _THIN), -1, 1)))
    if widest < _NARROW_DEG:
        return (
            f"gravity stays within {widest:.0f}° of one direction in the tool: mounting of the sensor, weight and bias "
            "are hard to separate",
        )
    if observability.rank == 15 and observability.condition <= POOR_CONDITION:
        return (
            "a very different mounting of the sensor explains these poses almost as well if the tool is light (gap "
            f"{observability.second_gap:.2g}, at least {WEAK_GAP:g} is sound)",
        )
    share = (weak**2).sum(axis=1).reshape(5, 3).sum(axis=1) / weak.shape[1]
    names = ", ".join(name for name, part in zip(_GROUPS, share, strict=True) if part > 0.05)
    hard = f"are hard to separate (condition {observability.condition:.1g})"
    how = "cannot be separated" if observability.rank < 15 else hard
    return (f"{names} {how}",)


def _one_axis(
    axis_flange: Array, R_base_flange: Array, parameters: Parameters, information: Array, *, steady: bool
) -> tuple[str, ...]:
    """Return the clauses for rotations about a single axis: the reason, and the parameters that cannot be separated."""
    R, P, b = parameters.R_flange_sensor.T, parameters.p_sensor_com_m, parameters.gravity_force_base_N
    axis_base, axis_sensor = R_base_flange @ axis_flange, R @ axis_flange
    weight_N, zero = parameters.weight_N, np.zeros(3)
    lever_m = max(float(np.linalg.norm(P)), LEVER_M)
    scale = np.repeat([1, weight_N, weight_N, lever_m, weight_N * lever_m], 3)

    def unseen(*change: Array) -> bool:
        x = np.concatenate(change) / scale
        return bool(x @ information @ x < x @ x / POOR_CONDITION)

    inseparable = []
    if steady:
        reason = "the tool was turned about the vertical only, so its weight always has the same direction"
        gravity_flange = b @ R_base_flange
        force_N = R @ gravity_flange
        delta = np.cross(gravity_flange, np.eye(3)[np.abs(gravity_flange).argmin()]) / weight_N
        dF0 = R @ np.cross(gravity_flange, delta)
        if unseen(delta, zero, dF0, zero, np.cross(P, dF0)):
            inseparable.append("the sensor mounting cannot be separated from the force bias")
        dP = lever_m * np.cross(force_N, np.eye(3)[np.abs(force_N).argmin()]) / weight_N
        if unseen(zero, zero, zero, dP, np.cross(force_N, dP)):
            inseparable.append("the centre of mass cannot be separated from the torque bias")
    else:
        last = abs(axis_flange[2]) > _ALIGNED
        reason = (
            "only the last joint was turned" if last else f"the tool was turned about {_axis_name(axis_flange)} only"
        )
        if unseen(-axis_flange, np.cross(axis_base, b), zero, zero, zero):
            inseparable.append(
                "the sensor angle about that axis cannot be separated from the direction of gravity about it"
            )
    if unseen(zero, axis_base, -axis_sensor, zero, -np.cross(P, axis_sensor)):
        inseparable.append("the weight along the axis cannot be separated from the force bias along it")
    return (reason, *inseparable)


def _axis_name(axis_flange: Array) -> str:
    k = int(np.abs(axis_flange).argmax())
    if abs(axis_flange[k]) > _ALIGNED:
        return ("the flange's x axis", "the flange's y axis", "the tool's own axis (flange z)")[k]
    return f"the axis ({', '.join(f'{x:.2f}' for x in axis_flange)}) of the flange"


def _suggested_motions() -> list[tuple[str, Array]]:
    """Return motions of the tool from the last pose as phrases and rotations, the simplest first."""

    def turn(axis: str, angle_deg: int) -> tuple[str, Array]:
        words = "turn the last joint by" if axis == "z" else "tilt the tool about the flange's"
        words += f" {angle_deg:+d}°" if axis == "z" else f" {axis} axis by {angle_deg:+d}°"
        return words, Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix()

    spins = [turn("z", angle_deg) for angle_deg in (90, -90)]
    tilts = [turn(axis, sign * angle_deg) for angle_deg in (45, 90) for axis in "xy" for sign in (1, -1)]
    both = [(f"{words}, then {then}", R @ spin) for words, R in tilts for then, spin in spins]
    return spins + tilts + both


def _advice(R_base_flange: Array, parameters: Parameters) -> tuple[tuple[str, ...], Array]:
    """Return phrases and orientations of a few simple motions from the last pose that make the set sound.

    Each step takes the first motion that makes the set sound, or else the most informative one.
    """
    poses, words, motions = R_base_flange, list[str](), _suggested_motions()
    while len(words) < MOST_ADVISED:
        trials = [np.concatenate([poses, [R_base_flange[-1] @ turn]]) for _, turn in motions]
        best = next((k for k, trial in enumerate(trials) if _is_sound(trial, parameters)), None)
        chosen = int(np.argmax([_worth(trial, parameters) for trial in trials])) if best is None else best
        poses = trials[chosen]
        words.append(motions[chosen][0])
        if best is not None:
            break
    return tuple(words), poses[len(R_base_flange) :]


def _worth(R_base_flange: Array, parameters: Parameters) -> float:
    """Return a score from the information volume and the spread of gravity directions out of a plane.

    Gravity directions in one plane have a second solution.
    """
    information = _scaled_information(R_base_flange, parameters)
    gravity_flange = parameters.gravity_force_base_N @ R_base_flange
    spread = np.linalg.svd(gravity_flange - gravity_flange.mean(axis=0), compute_uv=False)
    spread = spread / parameters.weight_N
    return float(np.log(np.maximum(np.linalg.eigvalsh(information), 0) + 1e-3).sum() + 4 * np.log(spread + 1e-3).sum())


# Number of points on the sphere; neighbours are about 3° apart.
_POINTS = 4000
# Number of directions compared with all points at once, limited to save memory.
_PART = 500
_ALONG = np.sin(np.radians(22.5))


def evenly_spread(n: int) -> Array:
    """Return n unit vectors (n, 3) spread evenly over the sphere on a Fibonacci spiral."""
    i = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * i / n, i * np.pi * (3 - np.sqrt(5))
    rho = np.sqrt(1 - z**2)
    return np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z])


def largest_gap(directions: Array) -> tuple[float, Array]:
    """Return the direction with the largest angle to the nearest of given unit vectors (n, 3).

    Returns
    -------
    angle_rad : float
        Angle between that direction and the nearest unit vector, accurate to about a degree.
    direction : array, shape (3,)
        Unit vector.
    """
    everywhere = evenly_spread(_POINTS)
    parts = np.array_split(directions, 1 + len(directions) // _PART)
    nearest = np.max([(everywhere @ part.T).max(axis=1) for part in parts], axis=0)
    worst = int(np.argmin(nearest))
    return float(np.arccos(np.clip(nearest[worst], -1, 1))), everywhere[worst]


def axes_along(direction: Array) -> list[str]:
    """Return the names of the axes along or between which a unit vector (3,) points, such as ["-x"]."""
    return [
        f"{'-' if part < 0 else '+'}{axis}"
        for axis, part in zip("xyz", direction.tolist(), strict=True)
        if abs(part) > _ALONG
    ]
