"""Changes during a session: of bias, load or mounting from a pose onwards, or alternating between two sensors.

The bias may also step several times, for example if a program zeroes the sensor at its start.

Each change competes with drift, orientation errors, gain and outliers. The solver fits the data corrected for the
change, and the change is reported if their restricted likelihood is larger by more than its `cost`.

`cable_of` estimates how far a cable may have shifted the estimates.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc as f_sf

from ftcalib.findings import CODES, Finding, Severity
from ftcalib.judge.faults import ROUNDING, rough_fit
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.fit import Fit
from ftcalib.likelihood.session_noise import summed_products
from ftcalib.likelihood.structure import MOST_POSES as STRUCTURED_POSES
from ftcalib.model import (
    BIASES,
    Array,
    Parameters,
    angle_between,
    gravity_wrench,
    jacobian,
    nearest_rotation,
    predict,
    rotation_of,
    skew,
)
from ftcalib.sensor_matrix import response_columns

# With fewer poses than this, a change cannot be separated from the 15 parameters.
FEWEST_POSES = 10
# Smallest number of poses before a change, and after it.
FEWEST_ON_A_SIDE = 3
# Largest number of poses that are searched for a change: normally, and in sessions of more than 1000 poses.
MOST_POSES, OF_MANY = 300, 150
# A change is fitted only if it reduces the mean square misfit below this share.
CLEARLY = 0.9
# If the residuals are below this share of the weight, the effect of a change is computed by linearisation.
SMALL = 0.01
# Required gain in twice the log-likelihood, in addition to log(6 n) for each parameter of the change.
MARGIN = 10.0
# Larger value of `MARGIN` for bias steps and alternating sensors, which resemble drift and hysteresis.
LARGER_MARGIN = 20.0
# Number of parameters of mounting and gravity, as matrix and vector without their common scale.
_SHAPE = 11
# Largest number of steps of the bias, and smallest number of poses between two steps.
MOST_STEPS, FEWEST_BETWEEN = 6, 2
# Number of sets of steps that are extended by another step (beam search).
BEAM = 4
Steps = tuple[int, ...]
Rows = NDArray[np.integer | np.bool_]

# Indices of the columns of the matrix that `_change_columns` returns.
TURN, BIAS, COM, LOAD, MOUNTING = range(3), range(3, 9), range(10, 13), range(9, 13), range(13, 16)
# Columns of the parameters that change, by code. A sensor usually turns together with its tool.
KINDS = {
    "bias_stepped": [*BIAS],
    "com_shifted": [*COM],
    "load_changed": [*LOAD],
    "sensor_turned": [*TURN],
    "sensor_changed": [*TURN, *BIAS],
    "sensor_and_tool_turned": [*MOUNTING],
}
CHANGES = frozenset(("sensors_alternate", *KINDS))
"""Codes of findings about changes; all other codes of causes are mistakes."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionChange:
    """Change during a session: some rows (poses) differ from the others."""

    code: str
    rows: Rows
    """(n,) in the order of time: whether a row has changed, or the number of bias steps before it."""
    values: Mapping[str, float]
    """Values of the finding about this change, by name."""
    corrected: Array
    """(n, 6) wrench with the change removed."""
    misfit: float
    """Mean square residual after the correction, relative to the noise."""
    criterion: float
    """BIC, by which different kinds of change are compared."""

    @property
    def takes_turns(self) -> bool:
        """Whether every other pose has changed, instead of all poses after a certain one."""
        step = np.diff(self.rows.astype(np.int64))
        return bool((step > 0).any() and (step < 0).any())

    @property
    def starts(self) -> NDArray[np.intp]:
        """Indices of the first row after each change."""
        return np.flatnonzero(np.diff(self.rows)) + 1

    @property
    def cost(self) -> float:
        """Required reduction of -2 log likelihood by the correction."""
        n, times = len(self.rows), 1 if self.takes_turns else len(self.starts)
        margin = LARGER_MARGIN if self.takes_turns or self.code == "bias_stepped" else MARGIN
        return float(times * (len(KINDS[self.code]) * np.log(6 * n) + 2 * np.log(n) + margin))

    def finding(self, rows: NDArray[np.intp], weights: Array) -> Finding:
        """Return the finding, given the examined rows (n,) of the session and the weights of all rows."""
        poses, code = (rows[self.starts] + 1).tolist(), self.code
        values = {"pose": poses if len(poses) > 1 else poses[0]} | dict(self.values)
        severity: Severity = "reject"
        if code == "sensor_and_tool_turned":
            code = "sensor_turned"
        if self.takes_turns:
            code = "sensors_alternate"
        elif code == "bias_stepped" or not (weights[rows[: self.starts[0]]] > 0.5).any():  # the current load was fitted
            severity = "limit"
        needed = CODES[code].values
        return Finding.of(code, severity, **{name: value for name, value in values.items() if name in needed})


def possible_changes(found: Fit, t_s: Array, *, steps: bool) -> tuple[NDArray[np.intp], list[SessionChange]]:
    """Return the likeliest lasting change or alternation of sensors, and the best steps of the bias.

    Parameters
    ----------
    found : Fit
        Fit without known values.
    t_s : array, shape (n,)
    steps : bool
        Whether to search for steps of the bias, which look like a drift.

    Returns
    -------
    rows : int array, shape (k,)
        Examined rows in the order of time; a subset for long sessions.
    changes : list of SessionChange
    """
    rows = np.argsort(t_s, kind="stable")
    # Negative floor division rounds the step up.
    rows = rows[:: -(-len(rows) // (MOST_POSES if len(rows) <= STRUCTURED_POSES else OF_MANY))]
    if len(rows) < FEWEST_POSES:
        return rows, []
    R, wrench = found.R_base_flange[rows], found.wrench[rows]
    used = found.residuals[rows][found.weights[rows] > 0.5]
    likeliest = _likeliest_change(found.on_average, R, wrench, np.repeat(_axis_rms(used), 3))
    stepped = bias_steps(R, wrench) if steps else None
    return rows, [change for change in (likeliest, stepped) if change is not None]


def _likeliest_change(parameters: Parameters, R: Array, wrench: Array, scale: Array) -> SessionChange | None:
    """Return the change with the smallest misfit; None if no change or a linear drift fits almost as well.

    The poses are in the order of time. `scale` (6,) is proportional to the residual of each channel without a change.
    """
    n = len(wrench)
    ramp = np.linspace(-1, 1, n)[:, None, None] * np.eye(6)
    J = np.concatenate([jacobian(parameters, R), response_columns(parameters, R)], axis=2)
    residuals = wrench - predict(parameters, R)
    # The misfit without a change is that with a linear drift, because a steady drift is not a change.
    without = min(_least(J, residuals, scale)[0], _least(np.concatenate([J, ramp], axis=2), residuals, scale)[0])
    small = bool((_axis_rms(residuals) < SMALL * _axis_rms(gravity_wrench(parameters, R))).all())
    changes = []
    for pure, groups in _groups(n):
        if pure is None:
            start, misfits = parameters, _linear_misfits(parameters, R, J, residuals, scale, groups)
        elif not small:
            start = rough_fit(R[pure], wrench[pure])
            misfits = _misfits(start, R, wrench, scale, groups)
        else:
            continue
        changes += [_refine(code, start, R, wrench, scale, groups[int(np.argmin(m))]) for code, m in misfits.items()]
    change = min(changes, key=lambda candidate: candidate.criterion)
    return change if change.misfit < CLEARLY * without else None


def _axis_rms(wrench: Array) -> Array:
    """Return the rms (2,) over all axes of force, and over all axes of torque."""
    return np.asarray(np.sqrt(np.mean(wrench.reshape(-1, 2, 3) ** 2, axis=(0, 2))))


def _linear_misfits(
    p: Parameters, R: Array, J: Array, residuals: Array, scale: Array, groups: NDArray[np.bool_]
) -> dict[str, Array]:
    """Return the squared misfit (k,) of each kind of change in each group (k, n), fitted together with columns J."""
    C, J, r = _change_columns(p, R) / scale[:, None], J / scale[:, None], residuals / scale
    J = J / column_scale(summed_products(J, J))
    inverse = np.linalg.pinv(summed_products(J, J), rcond=1e-12, hermitian=True)
    r = r - J @ (inverse @ np.tensordot(J, r, ([0, 1], [0, 1])))
    of_pose = np.einsum("nci,ncj->nij", C, np.concatenate([C, J, r[..., None]], axis=2))
    sums = np.tensordot(groups.astype(np.float64), of_pose, 1)
    k = C.shape[2]
    between, moment = sums[..., k:-1], sums[..., -1]
    gram = sums[..., :k] - between @ inverse @ between.swapaxes(1, 2)
    unit = np.sqrt(np.maximum(np.einsum("kii->ki", gram), 1e-300))
    gram, moment = gram / unit[:, :, None] / unit[:, None], moment / unit
    misfits = {}
    for code, own in KINDS.items():
        inverse, of_own = np.linalg.pinv(gram[:, own][:, :, own], rcond=1e-9, hermitian=True), moment[:, own]
        misfits[code] = np.sum(r**2) - np.einsum("ki,kij,kj->k", of_own, inverse, of_own)
    return misfits


def bias_steps(R: Array, wrench: Array) -> SessionChange | None:
    """Return the steps of the bias with the smallest force misfit; None for few poses, or if steps do not help.

    Each interval between steps has its own bias, so only differences within intervals are used. The misfit is that of
    an unconstrained matrix instead of a rotation, which needs no starting value. Steps are added by beam search.

    Parameters
    ----------
    R : array, shape (n, 3, 3)
        Orientations in the order of time.
    wrench : array, shape (n, 6)
    """
    n = len(wrench)
    force_N = wrench[:, :3] - wrench[:, :3].mean(axis=0)
    finest = (ROUNDING * float(np.abs(wrench[:, :3]).max())) ** 2
    # Residual in flange axes: M f - R.T b, linear in the mounting M (an arbitrary matrix) and in gravity b.
    rows = np.concatenate([np.einsum("nj,ik->nijk", force_N, np.eye(3)).reshape(n, 3, 9), -R.swapaxes(1, 2)], axis=2)
    total, sums = summed_products(rows, rows), np.concatenate([np.zeros((1, 3, 12)), np.cumsum(rows, axis=0)])

    def means(first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
        """Return the reduction (k, 12, 12) of the sums of squares by separate biases of intervals of poses."""
        own = sums[last] - sums[first]
        return np.asarray(np.einsum("kai,kaj->kij", own, own) / np.maximum(last - first, 1)[:, None, None])

    def square_left(gram: Array, steps: int) -> Array:
        """Return the mean square force residuals (k,) after fitting mounting and gravity, from sums (k, 12, 12)."""
        cross = gram[:, :9, 9:]
        left = gram[:, :9, :9] - cross @ np.linalg.pinv(gram[:, 9:, 9:], hermitian=True) @ cross.swapaxes(1, 2)
        return np.asarray(3 * np.maximum(np.linalg.eigvalsh(left)[:, 0], 0.0) / (3 * (n - steps - 1) - _SHAPE) + finest)

    def with_another(beam: Sequence[Steps]) -> dict[Steps, float]:
        """Return the mean square force residual for each set of bias steps, after each possible further step."""
        bounds, added = np.array([[0, *others, n] for others in beam]), dict[Steps, tuple[int, int]]()
        for i, own in enumerate(bounds.tolist()):
            for first, last in pairwise(own):
                for at in range(first + FEWEST_BETWEEN, last - FEWEST_BETWEEN + 1):
                    added[tuple(sorted([*beam[i], at]))] = i, at
        if not added:
            return {}
        i, at = np.array([*added.values()]).T
        k = np.sum(bounds[i] <= at[:, None], axis=1)
        before, after = bounds[i, k - 1], bounds[i, k]
        of_parts = means(bounds[:, :-1].ravel(), bounds[:, 1:].ravel()).reshape(len(beam), -1, 12, 12)
        gram = (total - of_parts.sum(axis=1))[i] + means(before, after)
        square = square_left(gram - (means(before, at) + means(at, after)), len(beam[0]) + 1)
        return dict(zip(added, square.tolist(), strict=True))

    everything = total - means(np.array([0]), np.array([n]))
    # One step of the bias must reduce the misfit, and each further step must reduce it clearly.
    least = 3 * n * float(np.log(square_left(everything, 0)[0])) + LARGER_MARGIN
    best, beam = Steps(), [Steps()]
    for count in range(1, min(MOST_STEPS, n - 2 - _SHAPE // 3) + 1):
        left_by = with_another(beam)
        beam = sorted(left_by, key=left_by.__getitem__)[: max(BEAM, 1000 // n)]
        if not beam:
            break
        criterion = 3 * n * np.log(left_by[beam[0]]) + count * len(BIAS) * np.log(6 * n)
        if criterion < least - LARGER_MARGIN:
            least, best = criterion, beam[0]
    if not best:
        return None
    p = rough_fit(_less_means(R, best), _less_means(wrench, best))
    rest = wrench - gravity_wrench(p, R)
    left, biases = _less_means(rest, best), rest - _less_means(rest, best)
    size = np.linalg.norm(np.diff(biases, axis=0).reshape(-1, 2, 3), axis=2).max(axis=0)
    values = {"force_N": float(size[0]), "torque_Nm": float(size[1])}
    stepped = np.searchsorted(best, np.arange(n), side="right")
    return SessionChange(
        "bias_stepped", stepped, values, left + wrench - rest + biases[0], float(np.mean(left**2)), least
    )


def _less_means(values: Array, steps: Sequence[int]) -> Array:
    """Return values (n, ...) minus their mean in each interval between steps."""
    return np.concatenate([part - part.mean(axis=0) for part in np.split(values, steps)])


def _groups(n: int) -> Iterator[tuple[slice | None, NDArray[np.bool_]]]:
    """Yield rows that may be unchanged (None: all), each time with groups of other rows that may have changed."""
    after = np.arange(n) >= np.arange(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1)[:, None]
    half, every_other = n // 2, np.arange(n)[None] % 2 == 1
    yield None, np.concatenate([after, every_other])
    yield slice(0, half), after[~after[:, :half].any(axis=1)]
    yield slice(half, n), ~after[after[:, half:].all(axis=1)]
    yield slice(0, n, 2), every_other


def _misfits(p: Parameters, R: Array, wrench: Array, scale: Array, groups: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the squared misfit (k,) of each kind of change in each group (k, n), at fixed parameters."""
    y, g, C = (wrench - p.bias) / scale, gravity_wrench(p, R) / scale, _change_columns(p, R) / scale[:, None]
    d, count = y - g, groups.sum(axis=1)[:, None, None]

    def sums(of_rows: Array) -> Array:
        return np.asarray(np.tensordot(groups.astype(np.float64), of_rows, 1))

    def explained(X: Array) -> Array:
        moment, gram = sums(np.einsum("ncj,nc->nj", X, d)), sums(np.einsum("ncj,nck->njk", X, X))
        return np.asarray(np.einsum("kj,kji,ki->k", moment, np.linalg.pinv(gram, hermitian=True), moment))

    def turned(cross: Array, square: Array) -> Array:
        """Return the squared misfit after the best rotation (Kabsch 1976)."""
        s = np.linalg.svd(cross, compute_uv=False)
        return np.asarray(square - 2 * (s[:, 0] + s[:, 1] + np.sign(np.linalg.det(cross)) * s[:, 2]))

    own = sums((d**2).sum(axis=1))
    others = (d**2).sum() - own
    parts = y.reshape(-1, 2, 3), g.reshape(-1, 2, 3)
    cross, square = sums(np.einsum("npi,npj->nij", *parts)), sums((y**2 + g**2).sum(axis=1))
    of_y, of_g = (np.tensordot(groups.astype(np.float64), part, 1) for part in parts)
    means = np.einsum("kpi,kpj->kij", of_y, of_g) / count, ((of_y**2 + of_g**2) / count).sum(axis=(1, 2))
    linear = {code: others + own - explained(C[..., own_]) for code, own_ in KINDS.items() if 0 not in own_}
    return {
        **linear,
        "sensor_turned": others + turned(cross, square),
        "sensor_changed": others + turned(cross - means[0], square - means[1]),
    }


def _refine(code: str, p: Parameters, R: Array, wrench: Array, scale: Array, rows: Rows) -> SessionChange:
    """Return the change of some rows, refined together with all parameters by linear least squares."""
    y, g, own = wrench - p.bias, gravity_wrench(p, R), KINDS[code]
    undone, turn, step = y.copy(), np.eye(3), np.zeros(6)
    if code in ("sensor_turned", "sensor_changed"):
        mean_y, mean_g = (x[rows].mean(axis=0) if code == "sensor_changed" else np.zeros(6) for x in (y, g))
        parts = (((x[rows] - mean) / scale).reshape(-1, 2, 3) for x, mean in ((y, mean_y), (g, mean_g)))
        turn = nearest_rotation(np.einsum("npi,npj->ij", *parts))
        step = mean_y - _turn_wrench(mean_g, turn)[0]
        undone[rows] = _turn_wrench(y[rows] - step, turn.T)
    if code == "sensor_and_tool_turned":
        turn = nearest_rotation(y[rows, :3].T @ g[rows, :3])
        undone[rows, :3] = y[rows, :3] @ turn
        undone[rows, 3:] += np.cross(p.p_sensor_com_m, undone[rows, :3] - y[rows, :3])
    C = _change_columns(p, R)[..., own] * rows[:, None, None]
    misfit, x = _least(np.concatenate([C, jacobian(p, R), response_columns(p, R)], axis=2), undone - g, scale)
    moved = np.zeros(16)
    moved[own] = x[: len(own)]
    if code == "sensor_and_tool_turned":
        turn = turn @ rotation_of(moved[MOUNTING])
    step += moved[BIAS]
    values = {
        "turn_deg": float(np.degrees(angle_between(turn, np.eye(3)))),
        "force_N": _norm(step[:3]),
        "torque_Nm": _norm(step[3:]),
        "change_N": float(moved[9] if rows[-1] else -moved[9]),
        "shift_mm": 1e3 * _norm(moved[COM]),
    }
    # BIC: a kind of change with more parameters must explain more.
    criterion = wrench.size * np.log(max(misfit, 1e-300)) + len(own) * np.log(wrench.size)
    return SessionChange(code, rows, values, undone - C @ x[: len(own)] + p.bias, misfit, float(criterion))


def _least(J: Array, residuals: Array, scale: Array) -> tuple[float, Array]:
    """Return the mean square residual per degree of freedom after fitting columns J (n, 6, m), and the coefficients."""
    J, r = J / scale[:, None], residuals / scale
    gram = summed_products(J, J)
    unit = column_scale(gram)
    moment = np.tensordot(r, J, ([0, 1], [0, 1])) / unit
    x = np.linalg.pinv(gram / np.outer(unit, unit), rcond=1e-12, hermitian=True) @ moment
    left = float(np.sum(r**2) - moment @ x)
    return max(left, 0.0) / max(r.size - len(x), 1), x / unit


def _change_columns(p: Parameters, R: Array) -> Array:
    """Return the derivative (n, 6, 16) of the wrench with respect to the parameters that may change.

    They are a rotation of the sensor, both biases, weight, centre of mass, and a rotation of sensor and tool together.
    """
    J, g = jacobian(p, R), gravity_wrench(p, R)
    turn = -np.concatenate([skew(g[:, :3]), skew(g[:, 3:])], axis=1)
    bias = np.broadcast_to(np.eye(6), (len(R), 6, 6))
    return np.concatenate([turn, bias, (J[..., 3:6] @ p.down)[..., None], J[..., 9:12], J[..., :3]], axis=2)


def _turn_wrench(wrench: Array, turn: Array) -> Array:
    return np.asarray((wrench.reshape(-1, 2, 3) @ turn.T).reshape(-1, 6))


def _norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))


# A cable that acts like a spring, and the shift of mounting, weight and centre of mass that its torque may cause.
#
#     torque_Nm = K v,    v = rotation vector of an orientation relative to the one in which the cable is slack
#
# Over orientations within a cone such a torque looks like a shift of the centre of mass, and the rest like white noise.
# If there is such noise, the stiffness K (3, 3) is estimated together with the parameters. The resulting shift of the
# parameters (omitted-variable bias) is added to their reported sigma. The compensation is not corrected, because the
# cable pulls at the next use too.

# False-alarm probability: with the slack orientation at the mean, and at the best of about 70 orientations.
FALSE = 1e-3, 1e-4
# False-alarm probability if the torques have more noise than measured, for which a cable is a common cause.
FALSE_IN_NOISE = 0.05
# Smallest and largest number of poses for the test of a cable; a tour rarely has more.
FEWEST, MOST = 8, 1000
# Number of parameters of a cable: stiffness, and orientation in which it is slack.
STIFFNESS, SLACK = 9, 3
STARTS = 24
STEPS_RAD = np.deg2rad([40.0, 20.0, 10.0])
_AROUND = np.array([v for v in product((-1.0, 0.0, 1.0), repeat=3) if np.abs(v).sum() in (1, 3)])
_AROUND /= np.linalg.norm(_AROUND, axis=1, keepdims=True)


def cable_of(fit: Fit) -> tuple[Finding, Array] | None:
    """Return the finding of a cable that acts like a spring, and the shift of the estimates; None if not significant.

    The finding has the rms torque over the poses and the possible shift of the centre of mass. The shift is (15,).
    """
    n = len(fit.order)
    dof = fit.dof - STIFFNESS - SLACK
    if not FEWEST <= n <= MOST or dof < 1:
        return None
    R = fit.R_base_flange[fit.order]
    J, r = jacobian(fit.parameters, R), fit.wrench[fit.order] - predict(fit.on_average, R)
    WX = fit.noise.solve(np.concatenate([J, r[..., None]], axis=2))
    WJ, C = WX[..., :15], fit.given_noise
    u = WX[..., 15] - WJ @ (C @ summed_products(J, WX[..., 15:])[:, 0])
    chi2 = float(np.vdot(r, u))

    def best_of(slack: Array) -> tuple[float, Array, Array, Array]:
        """Return the best of slack orientations (k, 3, 3): reduction of chi2, orientation, torques, parameter shift."""
        k = len(slack)
        v = Rotation.from_matrix((np.swapaxes(slack, 1, 2)[:, None] @ R).reshape(-1, 3, 3)).as_rotvec()
        each = np.zeros((n, 6, k, 3, 3))
        for axis in range(3):
            each[:, 3 + axis, :, axis] = v.reshape(k, n, 3).swapaxes(0, 1)
        X = each.reshape(n, 6, 9 * k)
        rows, g = X.reshape(6 * n, k, 9), summed_products(X, u[..., None])[:, 0].reshape(k, 9)
        H = np.einsum("rka,rkb->kab", rows, fit.noise.solve(X).reshape(rows.shape), optimize=True)
        between = summed_products(WJ, X).reshape(15, k, 9).swapaxes(0, 1)
        H -= np.swapaxes(between, 1, 2) @ C @ between
        scale = np.sqrt(np.maximum(np.einsum("kaa->ka", H), 1e-300))
        # Rotations about a single axis do not determine all of the stiffness.
        H = np.asarray(H / scale[:, :, None] / scale[:, None] + 1e-6 * np.eye(9))
        stiffness = np.linalg.solve(H, (g / scale)[..., None])[..., 0] / scale
        gain = np.sum(g * stiffness, axis=1)
        i = int(np.argmax(gain))
        return float(gain[i]), slack[i], rows[:, i] @ stiffness[i], C @ between[i] @ stiffness[i]

    def probability(gain: float, numbers: int) -> float:
        rest = fit.dof - numbers
        return float(f_sf(numbers, rest, gain / numbers / (max(chi2 - gain, 1e-12 * chi2) / rest)))

    best = best_of(nearest_rotation(R.sum(axis=0))[None])
    sure = probability(best[0], STIFFNESS) < FALSE[0]
    measured = bool(np.isfinite(fit.measured_chi2))
    noisy = measured and any(name.startswith("white_t") for name in fit.components)
    if not sure and (noisy or not measured):
        best = max(best, best_of(R[:: max(1, n // STARTS)]), key=lambda candidate: candidate[0])
        for angle_rad in STEPS_RAD:
            near = best[1] @ Rotation.from_rotvec(angle_rad * _AROUND).as_matrix()
            best = max(best, best_of(near), key=lambda candidate: candidate[0])
        sure = probability(best[0], STIFFNESS + SLACK) < (FALSE_IN_NOISE if noisy else FALSE[1])
    if not sure:
        return None
    shift = best[3].copy()
    shift[BIASES] = 0.0
    torque_Nm, shift_mm = float(np.sqrt(np.sum(best[2] ** 2) / n)), 1e3 * float(np.linalg.norm(shift[9:12]))
    return Finding.of("cable_spring", torque_Nm=torque_Nm, shift_mm=shift_mm), shift
