"""The methods of both papers by another hand: numpy only, imports nothing of ours, so that an error must occur twice.

Letters of the papers: `A` (n, 3, 3) = e_bR, base to flange; `F`, `T` (n, 3) measured, N and N m. Every method returns
`(R, F_b, F0, P, T0)`: R = s_eR (3, 3) flange to sensor, the weight F_b in the base, N, the biases F0, N, and T0, N m,
and the centre of mass P in the sensor frame, m. `d` (3,) is the known unit direction of gravity in the base.

Sources: Yu, Shi, Lou 2021 ("Yu"), Carlson 2019 ("Carlson"), with their errata corrected.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Estimate = tuple[Array, Array, Array, Array, Array]

I3 = np.eye(3)

# ---------------------------------------------------------------------------------------------------------------- Yu

SPECIAL_ROWS = (
    "+x+y+z +x-y-z +x-z+y +x+z-y -x+y-z -x-y+z -x+z+y -x-z-y +y+x-z -y+x+z +z+x+y -z+x-y "
    "+y-x+z -y-x-z -z-x+y +z-x-y +y+z+x -y-z+x -z+y+x +z-y+x +y-z-x -y+z-x +z+y-x -z-y-x"
)


def special() -> Array:
    """Return the 24 matrices e_bR_1 to e_bR_24 (Yu, Fig. 3)."""
    unit = {s + c: (1.0 if s == "+" else -1.0) * I3[k] for s in "+-" for k, c in enumerate("xyz")}
    return np.array([[unit[rows[k : k + 2]] for k in (0, 2, 4)] for rows in SPECIAL_ROWS.split()])


SUMS = {  # (Yu, eqs 17-19, 22-23): the forces added and those subtracted
    (1, 1): ((1, 2, 3, 4), (5, 6, 7, 8)),
    (1, 2): ((9, 10, 11, 12), (13, 14, 15, 16)),
    (1, 3): ((17, 18, 19, 20), (21, 22, 23, 24)),
    (2, 1): ((9, 13, 17, 21), (10, 14, 18, 22)),
    (2, 2): ((1, 5, 19, 23), (2, 6, 20, 24)),
    (2, 3): ((3, 7, 11, 15), (4, 8, 12, 16)),
    (3, 1): ((11, 16, 20, 23), (12, 15, 19, 24)),
    (3, 2): ((4, 7, 17, 22), (3, 8, 18, 21)),
    (3, 3): ((1, 6, 10, 13), (2, 5, 9, 14)),
}


def srom_weight(F: Array) -> Array:
    """Return F_b from the forces at the 24 special orientations in the paper's order (Yu, eqs 17-23)."""
    F_b = []
    for k in (1, 2, 3):
        p = [sum(F[i - 1] for i in SUMS[k, j][0]) - sum(F[i - 1] for i in SUMS[k, j][1]) for j in (1, 2, 3)]
        F_b.append(np.cbrt(np.linalg.det(np.column_stack(p) / 8)))
    return np.array(F_b)


def in_order(A: Array, F: Array, within_rad: float = 0.0175) -> Array:
    """Return the mean force at each special orientation: poses within an angle, which no paper names, of the 24."""
    traces = np.einsum("nij,sij->ns", A, special())
    nearest = traces.argmax(axis=1)
    near = traces.max(axis=1) >= 1 + 2 * np.cos(within_rad)
    means = []
    for s in range(24):
        own = near & (nearest == s)
        if not own.any():
            raise ValueError(f"no pose at special orientation {s + 1}")
        means.append(F[own].mean(axis=0))
    return np.array(means)


def lrom_weight(A: Array, F: Array) -> Array:
    """Return F_b by least squares over R^T by rows of fixed norm, F_b and R^T F0 (Yu, eqs 24-33); sign by det > 0."""
    A9 = np.vstack([np.kron(I3, f) for f in F])
    A6 = np.vstack([np.hstack([-a, -I3]) for a in A])
    H = A9 - A6 @ np.linalg.lstsq(A6, A9, rcond=None)[0]
    x9 = np.sqrt(3) * np.linalg.svd(H)[2][-1]
    if np.linalg.det(x9.reshape(3, 3)) < 0:
        x9 = -x9
    x6 = np.linalg.lstsq(A6, -A9 @ x9, rcond=None)[0]
    return np.asarray(x6[:3])


def wahba(A: Array, F: Array, F_b: Array) -> tuple[Array, Array]:
    """Return R and F0 of known F_b (Yu, eqs 36-42)."""
    g = A @ F_b
    D = (F - F.mean(axis=0)).T @ (g - g.mean(axis=0))
    U, _, Vt = np.linalg.svd(D)
    R = U @ np.diag([1, 1, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    return R, F.mean(axis=0) - R @ g.mean(axis=0)


def cross_matrix(v: Array) -> Array:
    """Return v^, which maps w to v x w (Yu, eq 5; Carlson's <v>)."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def torque_step(F: Array, T: Array, F0: Array) -> tuple[Array, Array]:
    """Return P and T0, with the measured force as the regressor (Yu, eqs 43-45)."""
    C = np.vstack([np.hstack([-cross_matrix(f - F0), I3]) for f in F])
    y = np.linalg.lstsq(C, T.ravel(), rcond=None)[0]
    return y[:3], y[3:]


def weight_and_tilt(F_b: Array) -> tuple[float, float, float]:
    """Return the weight, N, and alpha, beta, rad, of R_Y(beta) R_X(alpha) (Yu, eqs 46-48, norm and signs corrected)."""
    x, y, z = F_b
    return float(np.linalg.norm(F_b)), np.arctan2(y, np.hypot(x, z)), np.arctan2(-x, -z)


def _yu(A: Array, F: Array, T: Array, F_b: Array) -> Estimate:
    R, F0 = wahba(A, F, F_b)
    return R, F_b, F0, *torque_step(F, T, F0)


def srom(A: Array, F: Array, T: Array) -> Estimate:
    """F_b from the special orientations among the poses, all else from all (Yu, III-A.1; Table III, cases 1 and 8)."""
    return _yu(A, F, T, srom_weight(in_order(A, F)))


def lrom(A: Array, F: Array, T: Array) -> Estimate:
    """Limited orientations (Yu, III-A.2)."""
    return _yu(A, F, T, lrom_weight(A, F))


# ----------------------------------------------------------------------------------------------------------- Carlson


def to_rotation(M: Array, flip: bool) -> Array:
    """Return the nearest rotation (Carlson, eqs 28-29); `flip` takes -M of a negative determinant, a sign left open."""
    if flip and np.linalg.det(M) < 0:
        M = -M
    U, _, Vt = np.linalg.svd(M)
    R: Array = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return R


def centred(A: Array, F: Array, bias: bool) -> tuple[Array, Array]:
    """Subtract the means, which eliminates a constant force, if there is a bias."""
    return (A - A.mean(axis=0), F - F.mean(axis=0)) if bias else (A, F)


def D_and_F(A: Array, F: Array, bias: bool) -> tuple[Array, Array]:
    """Return the stacked D (3n, 3) and F (3n, 9) for vec by columns (Carlson, eq 17)."""
    A, F = centred(A, F, bias)
    return A.reshape(-1, 3), np.vstack([np.kron(f, I3) for f in F])


def _mat(r: Array) -> Array:
    return r.reshape(3, 3).T  # vec is by columns


def _vec(M: Array) -> Array:
    return M.T.ravel()


def _carlson(A: Array, F: Array, T: Array, R: Array, F_b: Array, bias: bool) -> Estimate:
    """Complete R and F_b: biases and Yu's torque step, or neither bias and the lever of eqs 4-5, sign corrected."""
    if bias:
        F0 = F.mean(axis=0) - R @ A.mean(axis=0) @ F_b
        return R, F_b, F0, *torque_step(F, T, F0)
    lever = np.linalg.lstsq(np.vstack([-cross_matrix(g) for g in A @ F_b]), (T @ R).ravel(), rcond=None)[0]
    return R, F_b, np.zeros(3), R @ lever, np.zeros(3)


def _with_weight(A: Array, F: Array, T: Array, R: Array, bias: bool) -> Estimate:
    """Complete R with F_b by least squares (Carlson, eq 20)."""
    D, F9 = D_and_F(A, F, bias)
    return _carlson(A, F, T, R, np.linalg.lstsq(D, F9 @ _vec(R.T), rcond=None)[0], bias)


def relaxation(A: Array, F: Array, T: Array, d: Array, bias: bool) -> Estimate:
    """Known direction: F vec(R^T / mg) = D d, then project; the weight by least squares given R (Carlson, eq 3)."""
    D, F9 = D_and_F(A, F, bias)
    R = to_rotation(_mat(np.linalg.lstsq(F9, D @ d, rcond=None)[0]), flip=False).T
    g = D @ d
    weight = g @ (F9 @ _vec(R.T)) / (g @ g)
    return _carlson(A, F, T, R, weight * d, bias)


def _cayley_rotation(A: Array, F: Array, F_b: Array) -> Array:
    """Total least squares of <f + A F_b> s = f - A F_b, then R = (I + <s>)^-1 (I - <s>) (Carlson, eqs 6-11)."""
    c, e = F + A @ F_b, F - A @ F_b
    v = np.linalg.svd(np.column_stack([np.vstack([cross_matrix(x) for x in c]), e.ravel()]))[2][-1]
    S = cross_matrix(-v[:3] / v[3])
    return np.linalg.solve(I3 + S, I3 - S)


def cayley(A: Array, F: Array, T: Array, F_b: Array, bias: bool, half_turns: bool) -> Estimate:
    """Known F_b. `half_turns` tries the flange turned by 180 deg about its axes too and keeps the least residual."""
    A0, f0 = centred(A, F, bias)
    turns = [np.diag(h) for h in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))][: 4 if half_turns else 1]
    rotations = [_cayley_rotation(H @ A0, f0, F_b) @ H for H in turns]
    R = min(rotations, key=lambda R: np.sum((f0 - A0 @ F_b @ R.T) ** 2))
    return _carlson(A, F, T, R, F_b, bias)


def eigen(A: Array, F: Array, T: Array, bias: bool) -> Estimate:
    """Dominant eigenvector of K = F^+ D D^+ F (Carlson, theorem 1)."""
    D, F9 = D_and_F(A, F, bias)
    K = np.linalg.lstsq(F9, D, rcond=None)[0] @ np.linalg.lstsq(D, F9, rcond=None)[0]
    values, vectors = np.linalg.eig(K)
    return _with_weight(A, F, T, to_rotation(_mat(vectors[:, values.real.argmax()].real), flip=True).T, bias)


def nullspace(A: Array, F: Array, T: Array, bias: bool) -> Estimate:
    """All pairs i < k of A_k A_i^T (R^T f_i - h) - (R^T f_k - h) = 0, h = R^T F0 eliminated (Carlson, eqs 22-26)."""
    F9 = [np.kron(f, I3) for f in F]
    pairs = [(i, k) for i in range(len(A)) for k in range(i + 1, len(A))]
    M = np.vstack([A[k] @ A[i].T @ F9[i] - F9[k] for i, k in pairs])
    if bias:
        N = np.vstack([A[k] @ A[i].T - I3 for i, k in pairs])
        M = M - N @ np.linalg.lstsq(N, M, rcond=None)[0]
    r = np.linalg.svd(M, full_matrices=False)[2][-1]
    return _with_weight(A, F, T, to_rotation(_mat(r), flip=True).T, bias)


def iterative(A: Array, F: Array, T: Array, bias: bool, tol: float = 1e-14, iterations: int = 2000) -> Estimate:
    """Alternating least squares from R = I, converged; the sign of the matrix is corrected (Carlson, algorithm 1)."""
    D, F9 = D_and_F(A, F, bias)
    K = np.linalg.lstsq(F9, D, rcond=None)[0] @ np.linalg.lstsq(D, F9, rcond=None)[0]
    R = I3
    for _ in range(iterations):
        before, R = R, to_rotation(_mat(K @ _vec(R)), flip=True)
        if np.abs(R - before).max() < tol:
            break
    else:
        raise ValueError("algorithm 1 does not converge")
    return _with_weight(A, F, T, R.T, bias)


def polynomial(A: Array, F: Array, T: Array, bias: bool) -> Estimate:
    """Global minimum of the sum of |R^T f - A F_b|^2 over SO(3), from 24 starts (Carlson, eq 27)."""
    D, F9 = D_and_F(A, F, bias)
    H = F9 - D @ np.linalg.lstsq(D, F9, rcond=None)[0]
    Q = H.T @ H / np.trace(H.T @ H)
    minima = [_descend(Q, R) for R in special()]
    return _with_weight(A, F, T, min(minima, key=lambda R: _vec(R) @ Q @ _vec(R)).T, bias)


def _exp(x: Array) -> Array:
    angle, S = np.linalg.norm(x), cross_matrix(x)
    R: Array = I3 + np.sinc(angle / np.pi) * S + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * S @ S
    return R


def _descend(Q: Array, R: Array) -> Array:
    """Minimise r^T Q r, r = vec(R), by Newton steps R exp(<x>) with positive curvature and a line search."""
    E = [cross_matrix(e) for e in I3]
    EE = [[(a @ b + b @ a) / 2 for a in E] for b in E]
    for _ in range(100):
        r = _vec(R)
        J = np.column_stack([_vec(R @ e) for e in E])
        bend = np.einsum("ij,klij->kl", R.T @ _mat(Q @ r), EE)
        curvature, V = np.linalg.eigh(J.T @ Q @ J + bend)
        step = -V @ ((V.T @ J.T @ Q @ r) / np.maximum(np.abs(curvature), 1e-12))
        step /= max(1.0, np.linalg.norm(step))
        if np.abs(step).max() < 1e-15:
            break
        tries = [R @ _exp(step * 0.5**k) for k in range(4)]
        R = min(tries, key=lambda R: _vec(R) @ Q @ _vec(R))
    return R


# --------------------------------------------------------------------------------------- what Yu compares with


def vougioukas(A: Array, F: Array, T: Array, d: Array, R: Array) -> Estimate:
    """Known mounting and direction: one least squares of 6n equations in weight, weight P, F0, T0 (Yu's [15])."""
    rows, y = [], []
    for a, f, t in zip(A, F, T, strict=True):
        u = R @ a @ d
        rows += [np.column_stack([u, np.zeros((3, 3)), I3, np.zeros((3, 3))])]
        rows += [np.column_stack([np.zeros(3), -cross_matrix(u), np.zeros((3, 3)), I3])]
        y += [f, t]
    x = np.linalg.lstsq(np.vstack(rows), np.concatenate(y), rcond=None)[0]
    return R, x[0] * d, x[4:7], x[1:4] / x[0], x[7:]


def wang(A: Array, F: Array, T: Array, R: Array) -> Estimate:
    """Known mounting: linear least squares in F_b and F0, then the torque step (Yu's [16])."""
    x = np.linalg.lstsq(np.vstack([np.hstack([R @ a, I3]) for a in A]), F.ravel(), rcond=None)[0]
    return R, x[:3], x[3:], *torque_step(F, T, x[3:])


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def yang(A: Array, F: Array, T: Array) -> Estimate:
    """Unknown yaw R = R_Z(yaw), F_b and F0: least residual over a grid, refined by Newton's steps (Yu's [17])."""
    D, F9 = D_and_F(A, F, bias=True)
    H = F9 - D @ np.linalg.lstsq(D, F9, rcond=None)[0]
    Q = H.T @ H

    def r(angle: float) -> Array:
        return _vec(_yaw(angle).T)

    angle = min(np.linspace(0, 2 * np.pi, 721), key=lambda a: r(a) @ Q @ r(a))
    for _ in range(20):
        d1 = _vec(_yaw(angle + np.pi / 2).T * np.array([1, 1, 0]))  # the z axis does not turn
        d2 = -_vec(_yaw(angle).T * np.array([1, 1, 0]))
        step = (d1 @ Q @ r(angle)) / (d1 @ Q @ d1 + d2 @ Q @ r(angle))
        angle -= step
        if abs(step) < 1e-12:
            break
    return wang(A, F, T, _yaw(angle))
