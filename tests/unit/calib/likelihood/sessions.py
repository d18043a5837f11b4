"""A tool at the 24 orientations, and its sessions before the fit."""

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.known import Constraints, Known
from ftcalib.likelihood.session import Drift, SessionData, white
from ftcalib.model import Array, SPECIAL_R_flange_base, predict

R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
TOOL = Parameters(
    Rotation.from_euler("ZYX", [50, 10, 175], degrees=True).as_matrix(),
    np.array([0.3, -0.2, -20.0]),
    np.array([3.0, -2, 8]),
    np.array([0.03, -0.02, 0.06]),
    np.array([0.1, 0.2, -0.3]),
)
SIGMA_N, SIGMA_NM = 0.05, 0.002
NOTHING_KNOWN = Constraints(Known(), 9.8)


def session(
    R: Array,
    *,
    measured: bool = True,
    drift: Drift = "auto",
    known: Constraints = NOTHING_KNOWN,
    residuals: Array | float = 0.0,
    t_s: Array | None = None,
) -> SessionData:
    cov = white(SIGMA_N, SIGMA_NM) if measured else None
    return SessionData(R, predict(TOOL, R) + residuals, cov, t_s, drift, known)
