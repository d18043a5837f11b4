"""The force-only problem: all minima over the rotations, and a certificate that the best one is global.

For a known mounting the force model is linear in gravity and bias. Eliminating them leaves `min r.T @ Q @ r` over the
rotations, where `r = R.ravel()` and `R = R_flange_sensor.T` maps flange to sensor coordinates (`s_eR` in Yu et al.).
In unit quaternions the cost is a quartic on the sphere. Newton descents from a fixed set of starts find all minima, and
a sum-of-squares relaxation proves which is lowest. `given_rotation` and `com_and_torque_bias` solve for the rest.
"""

from dataclasses import dataclass

import numpy as np

from ftcalib.model import Array, skew

# Rows per matrix product: 0.4 MB, so that a chunk stays in the cache.
_CHUNK = 4096
# In 16000 problems 24 starts missed a minimum in 93, 60 starts in 8, and 120 starts in 2. Neither of these two was the
# best minimum or from usable poses.
_STARTS = 120
# A curvature of the cost below this share of its variation counts as zero: the poses do not determine that direction.
_FLAT = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RotationMinimum:
    """Local minimum of the cost over the rotations."""

    R: Array
    """(3, 3) rotation that maps flange to sensor coordinates."""
    cost: float
    """`r.T @ Q @ r`."""


def force_cost(R_base_flange: Array, force_N: Array, weights: Array, *, with_bias: bool = True) -> Array:
    """Return the quadratic form of the force cost after elimination of gravity and bias.

    Parameters
    ----------
    R_base_flange : (n, 3, 3)
        Orientation of the flange at each pose.
    force_N : (n, 3)
        Measured force, sensor frame.
    weights : (n,) or (n, 3, 3)
        1 / variance of each pose's force, or its information matrix (inverse covariance). Of a matrix only the mean of
        its diagonal is used, because the cost must be quadratic. This is accurate enough for starting points.
    with_bias : bool
        Whether the sensor has an unknown force bias.

    Returns
    -------
    Q : (9, 9)
        Symmetric, positive semidefinite up to rounding. `r.T @ Q @ r` with `r = R_flange_sensor.T.ravel()` is
        `min sum(w * |force - R_flange_sensor.T @ R_base_flange.T @ gravity - bias|**2)`, exactly so for scalar weights.

    Notes
    -----
    Yu et al. eliminate the same unknowns in eq. (32), but minimise over the sphere of all r, which needs one pose more.
    """
    gram, _ = _centred_gram(R_base_flange, force_N, weights, with_bias=with_bias)
    return force_cost_from_gram(gram, with_bias=with_bias)


def force_cost_from_gram(gram: Array, *, with_bias: bool = True) -> Array:
    """Return the result of `force_cost`, computed from sums over the poses.

    `gram` (13, 13) is the sum of `w * row.T @ row` with row = (force, R_base_flange row by row, 1). A bias of k times
    the weight costs `2 * log10(k)` of the 16 digits; `force_cost` loses none, because it centres the data.
    """
    force_square, gravity_square, gravity_force = _blocks(gram, with_bias=with_bias)
    Q = (
        np.kron(force_square, np.eye(3))
        - gravity_force.T @ _pseudo_inverse(gravity_square, gram[12, 12]) @ gravity_force
    )
    return (Q + Q.T) / 2


def given_rotation(R_sensor_flange: Array, R_base_flange: Array, force_N: Array, weights: Array) -> tuple[Array, Array]:
    """Return the unknowns that `force_cost` eliminated, gravity force and force bias.

    Parameters
    ----------
    R_sensor_flange : (3, 3)
        Mounting as a rotation from flange to sensor, `R_flange_sensor.T`, as in `RotationMinimum`.
    R_base_flange, force_N, weights
        As in `force_cost`.

    Returns
    -------
    gravity_force_base_N : (3,)
        Weight of the load on the sensor in the base frame; the shortest solution if the poses do not determine it.
    force_bias_N : (3,)
        Sensor frame.
    """
    gram, offset = _centred_gram(R_base_flange, force_N, weights, with_bias=True)
    _, gravity_square, gravity_force = _blocks(gram, with_bias=True)
    gravity_N = _pseudo_inverse(gravity_square, gram[12, 12]) @ gravity_force @ R_sensor_flange.ravel()
    mean = gram[12, :12] / gram[12, 12] + offset[:12]
    return gravity_N, mean[:3] - R_sensor_flange @ mean[3:].reshape(3, 3).T @ gravity_N


def com_and_torque_bias(weight_N: Array, torque_Nm: Array) -> tuple[Array, Array]:
    """Return centre of mass (3,) and torque bias (3,) by linear least squares: Yu eqs 43-45.

    `weight_N` (n, 3) is the weight in the sensor frame. The paper uses the measured force minus the bias, whose noise
    shortens P by the share sigma^2 / (sigma^2 + mg^2 / 3).
    """
    P_x_F = -skew(weight_N)
    C = np.concatenate([P_x_F, np.broadcast_to(np.eye(3), P_x_F.shape)], axis=2)
    solution = np.asarray(np.linalg.lstsq(C.reshape(-1, 6), torque_Nm.ravel())[0], dtype=np.float64)
    return solution[:3], solution[3:]


def minima(Q: Array) -> list[RotationMinimum]:
    """Return all local minima of `r.T @ Q @ r` over the rotations.

    Parameters
    ----------
    Q : (9, 9)
        Symmetric matrix, from `force_cost`.

    Returns
    -------
    list of RotationMinimum
        By ascending cost, never empty. If the cost is constant along a curve (the poses leave a direction
        undetermined), the curve is represented by rotations at least 90 degrees apart.

    Notes
    -----
    Deterministic: Newton's method with limited steps and absolute curvatures, from evenly spread starts at once.
    """
    quartic, _ = _quartic(Q)
    q, cost, curvature = _descend(quartic, _super_fibonacci(_STARTS))
    kept: list[int] = []
    for i in np.argsort(cost, kind="stable"):
        turned = np.abs(q[kept] @ q[i])  # cosine of half the angle between the rotations
        same = turned > 1 - 1e-7
        if curvature[i] < _FLAT:
            same |= (turned > np.cos(np.pi / 4)) & (cost[i] - cost[kept] < _FLAT)
        if not same.any():
            kept.append(int(i))
    r = _squares(q[kept]) @ _R_OF_Q.T
    return sorted((RotationMinimum(R.reshape(3, 3), float(R @ Q @ R)) for R in r), key=lambda minimum: minimum.cost)


def certificate(Q: Array, R: Array) -> float:
    """Return a bound on the gap between the cost of a rotation and the global minimum of `r.T @ Q @ r`.

    Parameters
    ----------
    Q : (9, 9)
        From `force_cost`.
    R : (3, 3)
        The rotation to certify, as in `RotationMinimum`.

    Returns
    -------
    float
        Gap of at least 0: no rotation costs less than `cost(R) - gap * trace(Q) / 3`. The unit `trace(Q) / 3` is the
        mean cost of all rotations, so it is meaningful even if the lowest cost is 0. Below 1e-8 the minimum is global.

    Raises
    ------
    ValueError
        If R is not a rotation.

    Notes
    -----
    With phi the ten scaled quadratic monomials of the unit quaternion, the cost is `phi.T @ P @ phi`; if
    `P - gamma * I - sum(mu_k * N_k)` is positive semidefinite, where the N_k vanish on every phi, no cost is below
    gamma. The largest gamma is the solution of a semidefinite program of 21 variables, by a primal-dual interior-point
    method (the direction of Helmberg, Rendl, Vanderbei and Wolkowicz 1996). The bound is the smallest eigenvalue of
    that matrix minus a margin for rounding. It is valid even if the method stops early, so the gap can be too large,
    but never too small. The relaxation was exact in all of 8000 simulated calibrations, but not for 4 of 6000 random Q.
    """
    if R.shape != (3, 3) or np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise ValueError(f"the certificate needs a 3x3 rotation matrix, not {R.tolist()}")
    mean = np.trace(Q) / 3
    if mean == 0:
        return 0.0
    quartic, variation = _quartic(Q)
    excess = float(R.ravel() @ (Q @ R.ravel()) - mean)
    bound = _lower_bound(_PHI.T @ quartic @ _PHI, excess / variation, 1e-10 * mean / variation)
    return max(0.0, float((excess - bound * variation) / mean))


# The data


def _gram(R_base_flange: Array, force_N: Array, weights: Array, offset: Array) -> Array:
    """Return the weighted sum (13, 13) of `row.T @ row` over rows minus an offset."""
    gram = np.zeros((13, 13))
    for first in range(0, len(weights), _CHUNK):
        part = slice(first, first + _CHUNK)
        rows = np.column_stack((force_N[part], R_base_flange[part].reshape(-1, 9), np.ones(len(weights[part]))))
        rows -= offset
        gram += (rows * weights[part, None]).T @ rows
    return gram


def _centred_gram(R: Array, force_N: Array, weights: Array, *, with_bias: bool) -> tuple[Array, Array]:
    """Return the Gram matrix of the rows minus an offset, their mean over the first chunk, and the offset.

    The bias absorbs any constant, so the offset changes no result, but keeps all digits if the bias is large.
    """
    if weights.ndim == 3:
        weights = np.trace(weights, axis1=1, axis2=2) / 3
    offset = np.zeros(13)
    if with_bias:
        offset[:3], offset[3:12] = force_N[:_CHUNK].mean(0), R[:_CHUNK].mean(0).ravel()
    return _gram(R, force_N, weights, offset), offset


def _blocks(gram: Array, *, with_bias: bool) -> tuple[Array, Array, Array]:
    """Return least-squares blocks: force by force (3, 3), gravity by gravity (3, 3), gravity by R (3, 9).

    In the flange frame the residual is `R.T @ force - R_base_flange.T @ gravity`: linear in r and in gravity.
    """
    g = gram[:12, :12]
    if with_bias:
        g = g - np.outer(gram[:12, 12], gram[12, :12]) / gram[12, 12]
    gravity_square = np.einsum("ikjk->ij", g[3:, 3:].reshape(3, 3, 3, 3))
    gravity_force = g[:3, 3:].reshape(3, 3, 3).swapaxes(0, 1).reshape(3, 9)
    return g[:3, :3], gravity_square, gravity_force


def _pseudo_inverse(square: Array, total_weight: float) -> Array:
    """Return the pseudo-inverse; an eigenvalue per unit of weight is the squared spread of the poses in radians."""
    value, vector = np.linalg.eigh(square)
    keep = value > 1e-12 * total_weight
    inverse: Array = (vector[:, keep] / value[keep]) @ vector[:, keep].T
    return inverse


# The quartic on the unit quaternions q = (w, x, y, z)

# `(p * q)[c] = p @ _PRODUCT[c] @ q`.
_PRODUCT = np.array(
    [
        [[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, -1]],
        [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, 1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ]
)
# `(q @ _TANGENT).reshape(4, 3)` has the columns q*i, q*j, q*k: a basis of the directions q can move in.
_TANGENT = _PRODUCT.transpose(1, 0, 2)[:, :, 1:].reshape(4, 12)
_CONJUGATE = np.array([1.0, -1, -1, -1])
# `r = _R_OF_Q @ kron(q, q)`, from `R @ v = q * v * conjugate(q)`.
_R_OF_Q = np.einsum("idb,daj,b->ijab", _PRODUCT, _PRODUCT, _CONJUGATE)[1:, 1:].reshape(9, 16)


def _squares(q: Array) -> Array:
    """Return kron(q, q) (k, 16) of quaternions (k, 4)."""
    return (q[:, :, None] * q[:, None, :]).reshape(-1, 16)


def _quartic(Q: Array) -> tuple[Array, float]:
    """Return the cost minus its mean as a symmetric tensor, in units of its variation, and that unit.

    The tensor is a matrix T (16, 16), symmetric in its four indices, with the value `kron(q, q) @ T @ kron(q, q)`.
    """
    if Q.shape != (9, 9) or not np.isfinite(Q).all():
        raise ValueError(f"the cost matrix needs 9x9 finite numbers, not {Q.tolist()}")
    excess = Q - np.trace(Q) / 9 * np.eye(9)  # adds a constant, because r @ r = 3 for every rotation
    form = (_R_OF_Q.T @ excess @ _R_OF_Q).reshape(4, 4, 4, 4)
    form = (form + form.transpose(0, 1, 3, 2)) / 2
    form = (form + form.transpose(1, 0, 2, 3)) / 2
    tensor = (form + form.transpose(0, 2, 1, 3) + form.transpose(0, 3, 2, 1)) / 3
    variation = max(float(np.linalg.norm(tensor)), 1e-8 * abs(np.trace(Q))) or 1.0  # a floor for rounding
    return tensor.reshape(16, 16) / variation, variation


def _super_fibonacci(n: int) -> Array:
    """Return unit quaternions (n, 4) spread evenly over all rotations (Alexa, CVPR 2022, algorithm 1)."""
    s = np.arange(n) + 0.5
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    inner, outer = np.sqrt(s / n), np.sqrt(1 - s / n)
    return np.stack((inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)), axis=1)


def _local_quadratic(quartic: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return cost (k,), gradient (k, 3), Hessian (k, 3, 3) on the sphere, and their tangent basis (k, 4, 3)."""
    form = (_squares(q) @ quartic).reshape(-1, 4, 4)
    basis = (q @ _TANGENT).reshape(-1, 4, 3)
    half = form @ q[:, :, None]
    cost = (q[:, None] @ half)[:, 0, 0]
    hessian = 12 * basis.swapaxes(1, 2) @ form @ basis
    hessian[:, range(3), range(3)] -= 4 * cost[:, None]
    return cost, 4 * (basis.swapaxes(1, 2) @ half)[:, :, 0], hessian, basis


def _descend(quartic: Array, q: Array) -> tuple[Array, Array, Array]:
    """Return quaternions (k, 4), costs (k,) and smallest curvatures (k,) of the minima reached from the starts q."""
    longest, kick, floor, arrived = 0.35, 0.05, 1e-7, 1e-8  # lengths on the sphere: half the angles of rotation
    reach = np.full(len(q), longest)
    here: tuple[Array, ...] = (q, *_local_quadratic(quartic, q))
    ends: list[tuple[Array, ...]] = []
    for _ in range(100):
        q, cost, gradient, hessian, basis = here
        curvature, axes = np.linalg.eigh(hessian)
        step = -(gradient[:, None] @ axes)[:, 0] / np.maximum(np.abs(curvature), floor)
        length = np.linalg.norm(step, axis=1)
        saddle = (length < arrived) & (curvature[:, 0] < -_FLAT)
        step[saddle, 0] = length[saddle] = kick
        step *= np.minimum(1, reach / np.maximum(length, arrived))[:, None]
        ahead = q + (basis @ (axes @ step[:, :, None]))[:, :, 0]
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        there: tuple[Array, ...] = (ahead, *_local_quadratic(quartic, ahead))
        down = there[1] <= cost + 1e-14
        reach = np.where(down, np.minimum(2 * reach, longest), reach / 4)
        done = (length < arrived) | (reach < arrived)
        if not down.all():
            both = zip(here, there, strict=True)
            there = tuple(np.where(down.reshape(-1, *[1] * (y.ndim - 1)), y, x) for x, y in both)
        here = there
        near = np.abs(here[0] @ here[0].T) > 1 - 1e-6
        same = (near.argmax(axis=1) < np.arange(len(near))) & (
            curvature[:, 0] > 0
        )  # give up this start: another one converges to the same minimum
        if done.any():
            ends.append(tuple(x[done] for x in here[:4]))
        if (gone := done | same).any():
            here, reach = tuple(x[~gone] for x in here), reach[~gone]
        if not len(reach):
            break
    q, cost, gradient, hessian = (np.concatenate(parts) for parts in zip(*ends, here[:4], strict=True))
    curvature = np.linalg.eigvalsh(hessian)[:, 0]
    is_minimum = (curvature > -_FLAT) & (np.linalg.norm(gradient, axis=1) < 1e-9)
    is_minimum[np.argmin(cost)] = True
    return q[is_minimum], cost[is_minimum], curvature[is_minimum]


# The proof

_MONOMIALS = [(a, b) for a in range(4) for b in range(a, 4)]
# `phi = kron(q, q) @ _PHI`: the ten monomials, scaled so that |phi| = 1; and `kron(q, q) = _PHI @ phi`.
_PHI = np.zeros((16, 10))
for _column, (_a, _b) in enumerate(_MONOMIALS):
    _PHI[[4 * _a + _b, 4 * _b + _a], _column] = 1 if _a == _b else np.sqrt(0.5)


def _constraints() -> Array:
    """Return the identity and 20 forms that vanish on every phi because `(ab)(cd) = (ac)(bd)`, shape (21, 10, 10)."""
    ways: dict[tuple[int, ...], list[Array]] = {}
    for i, first in enumerate(_MONOMIALS):
        for j, second in enumerate(_MONOMIALS[: i + 1]):
            form = np.zeros((10, 10))
            form[i, j] = form[j, i] = 1 if i == j else 0.5
            scale = (1 if first[0] == first[1] else 2) * (1 if second[0] == second[1] else 2)
            ways.setdefault(tuple(sorted(first + second)), []).append(form / np.sqrt(scale))
    vanishing = [form - forms[0] for forms in ways.values() for form in forms[1:]]
    return np.array([np.eye(10), *vanishing])


_FORMS = _constraints()
_ROWS = _FORMS.reshape(21, 100)
_TRACE = _PHI.T @ np.eye(4).ravel()
# Mean of phi @ phi.T over all rotations: a strictly feasible start.
_MOMENTS = (np.outer(_TRACE, _TRACE) + 2 * np.eye(10)) / 24


def _lower_bound(form: Array, enough: float, tolerance: float) -> float:
    """Return the largest gamma found with `phi @ form @ phi >= gamma` for all phi; stop at `enough - tolerance`."""
    centring, margin = 0.1, 0.95
    primal, dual = _MOMENTS, np.zeros(21)
    dual[0] = np.linalg.eigvalsh(form)[0] - 0.3
    best = -np.inf
    for _ in range(60):
        slack = form - (dual @ _ROWS).reshape(10, 10)
        slack_values, slack_axes = np.linalg.eigh(slack)
        rounding = 1e-15 * (1 + np.abs(dual).sum())
        best = max(best, float(dual[0] + slack_values[0] - rounding))
        duality_gap = np.vdot(primal, slack)
        if best > enough - tolerance or duality_gap < tolerance / 10:
            break
        primal_values, primal_axes = np.linalg.eigh(primal)
        if min(slack_values[0], primal_values[0]) <= 0:
            break
        inverse = (slack_axes / slack_values) @ slack_axes.T
        schur = _ROWS @ (primal @ _FORMS @ inverse).reshape(21, 100).T
        target = centring * duality_gap / 10 * inverse - primal
        missing = np.eye(21)[0] - _ROWS @ (primal + target).ravel()
        try:
            d_dual = np.linalg.solve((schur + schur.T) / 2, missing)
        except np.linalg.LinAlgError:
            break
        d_slack = -(d_dual @ _ROWS).reshape(10, 10)
        change = primal @ d_slack @ inverse
        d_primal = target - (change + change.T) / 2
        primal = primal + _feasible_step(primal_values, primal_axes, d_primal, margin) * d_primal
        dual = dual + _feasible_step(slack_values, slack_axes, d_slack, margin) * d_dual
    return best


def _feasible_step(values: Array, axes: Array, direction: Array, margin: float) -> float:
    """Return the step length, at most 1, that keeps a positive definite matrix positive definite."""
    root = axes / np.sqrt(values)
    lowest = float(np.linalg.eigvalsh(root.T @ direction @ root)[0])
    return 1.0 if lowest > -margin else -margin / lowest
