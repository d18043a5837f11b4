"""Solutions beside which Carlson's methods are tested and measured: all pairs as published, and Umeyama's."""

import numpy as np

from ftcalib.model import Array, nearest_rotation
from ftcalib.published.carlson import ForceFit, _fit_vec, _least_singular_vector, _linear_equations, kron_identity
from ftcalib.published.carlson_known import _equations, _weight


def nullspace_all_pairs(R_base_flange: Array, force_N: Array, *, bias: bool) -> ForceFit:
    """Unknown gravity by the nullspace method as published, with all pairwise differences (eqs. 22-26, section 5).

    Needs O(n^2) memory and time: for comparison with `nullspace`, which is equal. A must be base to flange in eq. 22
    (the text says the opposite). With bias the constant h enters the differences as
    `(A_k A_i^T F_i - F_k) r = (A_k A_i^T - I) h` and is eliminated by least squares.

    Parameters
    ----------
    R_base_flange, force_N, bias
        As in `eigen`.

    Raises
    ------
    NotObservable
        As in `eigen`.
    """
    eq = _linear_equations(R_base_flange, force_N, bias=bias, method="the nullspace method")
    i, k = np.triu_indices(len(force_N), 1)
    A_k_i = R_base_flange[k].transpose(0, 2, 1) @ R_base_flange[i]
    F = kron_identity(force_N).reshape(-1, 3, 9)
    differences = (A_k_i @ F[i] - F[k]).reshape(-1, 9)
    h_columns = (A_k_i - np.eye(3)).reshape(-1, 3) if bias else np.empty((len(differences), 0))
    return _fit_vec(eq, _least_singular_vector(h_columns, differences))


def similarity(R_base_flange: Array, force_N: Array, gravity_direction_base: Array, *, bias: bool) -> ForceFit:
    """Weight and rotation, gravity known in direction, as the similarity between the directions `A_i d` and forces f_i.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE PAMI 13(4),
    1991, eqs. 39-42. Not in Carlson's paper and better: the exact least-squares solution for rotation, weight and bias.
    With the tool within 40 deg of straight down its mean square error of R is the smallest possible (0.95-1.02 times
    the bound), that of `relaxation` 4 to 6 times as large, and that of the total least squares with a bias column in
    Carlson's Robotlib 6 to 4000 times, depending on the configured mass and the size of the bias.

    Parameters
    ----------
    R_base_flange, force_N, gravity_direction_base, bias
        As in `relaxation`.

    Raises
    ------
    NotObservable
        Fewer than 2 poses (3 with bias), or gravity that changes along one flange axis only.
    BadDataset
        The forces point against the given gravity.
    """
    method = "the similarity solution"
    eq, down = _equations(R_base_flange, force_N, gravity_direction_base, 2, bias=bias, method=method)
    a = eq.A @ down
    R_sensor_flange = nearest_rotation(eq.f.T @ a)
    return eq.fit(R_sensor_flange.T, _weight(eq.f, a, R_sensor_flange) * down)
