"""What changed during a session: bias, load or mounting from a pose on, or between two sensors that take turns.

Each change competes with drift, inexact orientations, gain and bumped poses: the data without it are fitted again, and
it is named if their restricted likelihood is clearly larger.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftcalib.assessment.faults import CORRECTED, rough_fit
from ftcalib.findings import Finding, Severity
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.fit import Fit, fit
from ftcalib.likelihood.gain_and_cross_talk import response_columns
from ftcalib.likelihood.outliers import FARTHEST
from ftcalib.likelihood.session import LEVER_M
from ftcalib.likelihood.session_noise import summed_products
from ftcalib.likelihood.variance_components import GAIN, GAIN_OF_RESPONSE, squared_length
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, predict, skew

FEWEST_POSES = 10
"""Fewer do not show a change beside 15 parameters."""
FEWEST_ON_A_SIDE = 3
"""Poses before and after."""
MOST_POSES = 300
"""Of longer sessions every second, third, ... pose is looked at."""
CLEARLY = 0.5
"""A change must bring the mean square misfit below this share before the likelihood is asked."""
MARGIN = 20.0
"""By which twice the log-likelihood must rise, beside log(6 n) for each number of the change."""
Rows = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """A change of some rows, relative to the others."""

    what: str
    """bias, centre of mass, load, mounting or sensor."""
    rows: Rows
    """(n,) in the order of time."""
    values: dict[str, float]
    """Of its finding, as far as it has them."""
    corrected: Array
    """(n, 6) wrench without it."""
    misfit: float
    """Mean square of what it leaves, in noise."""
    criterion: float

    @property
    def takes_turns(self) -> bool:
        """Whether every other pose differs, not all from one on."""
        return np.count_nonzero(np.diff(self.rows)) > 1


_SIZE = {"bias": 6, "centre of mass": 3, "load": 4, "mounting": 3, "sensor": 9}
_CODES = {
    "bias": "bias_stepped",
    "centre of mass": "com_shifted",
    "load": "load_changed",
    "mounting": "sensor_turned",
    "sensor": "sensor_changed",
}


def session_change(found: Fit, order: NDArray[np.intp], t_s: Array | None, sigma: Array | None) -> list[Finding]:
    """Find a lasting change, or two sensors that take turns.

    Parameters
    ----------
    found : Fit
        Without known values.
    order : int array, shape (n,)
        Rows by time.
    t_s : array, shape (n,), optional
    sigma : array, shape (6,), optional
        Measured noise of a pose.
    """
    order = order[:: -(-len(order) // MOST_POSES)]
    n, R, wrench = len(order), found.R_base_flange[order], found.wrench[order]
    if n < FEWEST_POSES:
        return []
    change = likeliest_change(found.parameters, R, wrench, sigma)
    times = None if t_s is None else t_s[order]
    cov = None if sigma is None else np.diag(sigma**2)
    if change is None or not _is_likelier(change, R, wrench, cov, times):
        return []
    if change.takes_turns:
        return [Finding.of("sensors_alternate", **{"turn_deg": 0.0} | change.values)]
    first = int(np.flatnonzero(np.diff(change.rows))[0]) + 1
    as_it_is_now = not (found.weights[order[:first]] > 0.5).any()
    severity: Severity = "limit" if as_it_is_now or change.what == "bias" else "reject"
    return [Finding.of(_CODES[change.what], severity, pose=int(order[first]) + 1, **change.values)]


def _is_likelier(change: Change, R: Array, wrench: Array, cov: Array | None, t_s: Array | None) -> bool:
    as_read, without = (fit(R, y, cov, t_s=t_s) for y in (wrench, change.corrected))
    weight_N = _length(without.parameters.gravity_force_base_N)
    if np.sqrt(np.mean(np.sum(without.residuals[without.weights > 0.5, :3] ** 2, axis=1))) > CORRECTED * weight_N:
        return False
    costs = _SIZE[change.what] * np.log(wrench.size) + 2 * np.log(len(wrench)) + MARGIN
    return minus_two_log_likelihood(without) + costs < minus_two_log_likelihood(as_read)


def minus_two_log_likelihood(found: Fit) -> float:
    """Restricted, with what its components and its rejected poses cost."""
    information = found.free.T @ found.information @ found.free
    value = found.noise.logdet + float(np.linalg.slogdet(information)[1]) + found.chi2
    value += sum(2 * (GAIN_OF_RESPONSE if name in ("gain", "cross_talk") else GAIN) for name in found.components)
    rejected = found.weights < 0.5
    if rejected.any():
        S = found.left_out_cov[rejected]
        far = np.maximum(squared_length(found.left_out_residuals[rejected], S), FARTHEST)
        value += float(np.linalg.slogdet(S)[1].sum() + np.sum(FARTHEST + 6 * np.log(far / FARTHEST)))
    return value


def likeliest_change(parameters: Parameters, R: Array, wrench: Array, sigma: Array | None = None) -> Change | None:
    """Find the change that leaves the least; None if it does not leave much less than none, or a steady drift.

    Parameters
    ----------
    parameters : Parameters
        Estimated from all poses.
    R : array, shape (n, 3, 3)
        In the order of time, as the wrench.
    wrench : array, shape (n, 6)
    sigma : array, shape (6,), optional
        Measured noise of a pose.
    """
    n = len(wrench)
    scale = np.repeat([1.0, LEVER_M], 3) if sigma is None else sigma
    ramp = np.linspace(-1, 1, n)[:, None, None] * np.eye(6)
    J = np.concatenate([jacobian(parameters, R), response_columns(parameters, R)], axis=2)
    residuals = wrench - predict(parameters, R)
    without = min(_least(J, residuals, scale)[0], _least(np.concatenate([J, ramp], axis=2), residuals, scale)[0])

    best: dict[str, tuple[float, Parameters, Rows]] = {}
    for pure, groups in _groups(n):
        start = parameters if pure is None else rough_fit(R[pure], wrench[pure])
        for what, misfits in _misfits(start, R, wrench, scale, groups).items():
            k = int(np.argmin(misfits))
            if what not in best or misfits[k] < best[what][0]:
                best[what] = misfits[k], start, groups[k]
    changes = [_refined(what, start, R, wrench, scale, rows) for what, (_, start, rows) in best.items()]
    change = min(changes, key=lambda one: one.criterion)
    return change if change.misfit < CLEARLY * without else None


def _groups(n: int) -> Iterator[tuple[slice | None, NDArray[np.bool_]]]:
    """Yield rows that may be of one kind, all if None, and the groups of others that may differ from them."""
    after = np.arange(n) >= np.arange(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1)[:, None]
    half = n // 2
    yield None, after
    yield slice(0, half), after[~after[:, :half].any(axis=1)]
    yield slice(half, n), ~after[after[:, half:].all(axis=1)]
    yield slice(0, n, 2), np.arange(n)[None] % 2 == 1


def _misfits(p: Parameters, R: Array, wrench: Array, scale: Array, groups: NDArray[np.bool_]) -> dict[str, Array]:
    """Squared misfit (k,) for each kind of change of each group (k, n), in closed form; the parameters stay."""
    y, g = (wrench - _bias(p)) / scale, gravity_wrench(p, R) / scale
    d = y - g
    count = groups.sum(axis=1)

    def sums(of_rows: Array) -> Array:
        return np.tensordot(groups.astype(np.float64), of_rows, 1)

    def turned(cross: Array, square: Array) -> Array:
        s = np.linalg.svd(cross, compute_uv=False)
        return square - 2 * (s[:, 0] + s[:, 1] + np.sign(np.linalg.det(cross)) * s[:, 2])

    def explained(X: Array) -> Array:
        moment, gram = sums(np.einsum("ncj,nc->nj", X, d)), sums(np.einsum("ncj,nck->njk", X, X))
        return np.einsum("kj,kji,ki->k", moment, np.linalg.pinv(gram, hermitian=True), moment)

    others, own = (d**2).sum() - sums((d**2).sum(axis=1)), sums((d**2).sum(axis=1))
    by_part = y.reshape(-1, 2, 3), g.reshape(-1, 2, 3)
    cross, square = sums(np.einsum("npi,npj->nij", *by_part)), sums((y**2 + g**2).sum(axis=1))
    means = [sums(part.reshape(len(d), -1)).reshape(-1, 2, 3) for part in by_part]
    centred = cross - np.einsum("kpi,kpj->kij", *means) / count[:, None, None]
    centred_square = square - sum((mean**2).sum(axis=(1, 2)) for mean in means) / count
    load = _load_columns(p, R) / scale[:, None]
    return {
        "bias": others + own - (sums(d) ** 2).sum(axis=1) / count,
        "centre of mass": others + own - explained(load[..., 1:]),
        "load": others + own - explained(load),
        "mounting": others + turned(cross, square),
        "sensor": others + turned(centred, centred_square),
    }


def _refined(what: str, p: Parameters, R: Array, wrench: Array, scale: Array, rows: Rows) -> Change:
    """Undo the change of some rows, and improve it together with all parameters by linear least squares."""
    y, g = wrench - _bias(p), gravity_wrench(p, R)
    undone, turn, step = y.copy(), np.eye(3), np.zeros(6)
    if what in ("mounting", "sensor"):
        own_y, own_g = ((x[rows] / scale).reshape(-1, 2, 3) for x in (y, g))
        if what == "sensor":
            own_y, own_g = own_y - own_y.mean(axis=0), own_g - own_g.mean(axis=0)
        U, _, Vt = np.linalg.svd(np.einsum("npi,npj->ij", own_y, own_g))
        turn = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        step = (y[rows] - _turned(g[rows], turn)).mean(axis=0) if what == "sensor" else step
        undone[rows] = _turned(y[rows] - step, turn.T)
    columns = {
        "bias": lambda: np.broadcast_to(np.eye(6), (len(y), 6, 6)),
        "centre of mass": lambda: _load_columns(p, R)[..., 1:],
        "load": lambda: _load_columns(p, R),
        "mounting": lambda: _turn_columns(g),
        "sensor": lambda: np.concatenate([_turn_columns(g), np.broadcast_to(np.eye(6), (len(y), 6, 6))], axis=2),
    }[what]() * rows[:, None, None]
    J = np.concatenate([columns, jacobian(p, R), response_columns(p, R)], axis=2)
    misfit, x = _least(J, undone - g, scale)
    x = x[: columns.shape[2]]
    sign = 1.0 if rows[-1] else -1.0
    deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    moved = x if what == "bias" else step
    values = {
        "bias": lambda: {"force_N": _length(moved[:3]), "torque_Nm": _length(moved[3:])},
        "centre of mass": lambda: {"shift_mm": 1e3 * _length(x)},
        "load": lambda: {"change_N": sign * float(x[0]), "shift_mm": 1e3 * _length(x[1:])},
        "mounting": lambda: {"turn_deg": deg},
        "sensor": lambda: {"turn_deg": deg, "force_N": _length(moved[:3]), "torque_Nm": _length(moved[3:])},
    }[what]()
    size = wrench.size
    criterion = size * np.log(max(misfit, 1e-300)) + _SIZE[what] * np.log(size)
    return Change(what, rows, values, undone - columns @ x + _bias(p), misfit, float(criterion))


def _least(J: Array, residuals: Array, scale: Array) -> tuple[float, Array]:
    """Mean square of what the columns J (n, 6, m) leave, for each degree of freedom, and their coefficients."""
    J, r = J / scale[:, None], residuals / scale
    gram = summed_products(J, J)
    unit = column_scale(gram)
    moment = np.tensordot(r, J, ([0, 1], [0, 1])) / unit
    x = np.linalg.pinv(gram / np.outer(unit, unit), rcond=1e-12, hermitian=True) @ moment
    left = float(np.sum(r**2) - moment @ x)
    return max(left, 0.0) / max(r.size - len(x), 1), x / unit


def _load_columns(p: Parameters, R: Array) -> Array:
    """(n, 6, 4) derivative by the weight and by the centre of mass."""
    J = jacobian(p, R)
    down = p.gravity_force_base_N / (np.linalg.norm(p.gravity_force_base_N) or 1.0)
    return np.concatenate([J[..., 3:6] @ down[:, None], J[..., 9:12]], axis=2)


def _turn_columns(g: Array) -> Array:
    """(n, 6, 3) derivative of a wrench (n, 6) by a turn of its axes."""
    return -np.concatenate([skew(g[:, :3]), skew(g[:, 3:])], axis=1)


def _turned(wrench: Array, turn: Array) -> Array:
    return np.asarray((wrench.reshape(-1, 2, 3) @ turn.T).reshape(-1, 6))


def _bias(p: Parameters) -> Array:
    return np.concatenate([p.force_bias_N, p.torque_bias_Nm])


def _length(vector: Array) -> float:
    return float(np.linalg.norm(vector))
