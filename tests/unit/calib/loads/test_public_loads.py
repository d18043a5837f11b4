"""A real sensor under known wrenches: FARE-KE, `calibrationReadings.csv` of github.com/telenaco/FARE-KE.

Six lines of ten loads, 0 to 21.7 N and 3.3 N·m: six calibrated readings, then the six applied values.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ftcalib.model import Array, Parameters
from ftcalib.sensor_matrix import SensorMatrix

LEVER_M = 0.15
NOISE = np.repeat([0.02, 0.003], 3)


def recorded() -> tuple[Array, Array]:
    """Return readings without the bias of their line, and applied wrenches (6, 10, 6)."""
    folder = Path(os.environ.get("FTDRIVE_REAL_DATA", "/nonexistent"))
    found = [path for path in (folder / "farke.csv", folder / "farke/calibrationReadings.csv") if path.is_file()]
    if not found:
        pytest.skip("FTDRIVE_REAL_DATA is not set, or has no farke.csv")
    read, applied = np.split(np.loadtxt(found[0], delimiter=",", skiprows=1).reshape(6, 10, 12), 2, axis=2)
    return read - read[:, :1], applied


def after_wrenches(read: Array, applied: Array) -> SensorMatrix:
    """Return the posterior of the usual errors after readings (n, 6) of known wrenches (n, 6)."""
    usual = SensorMatrix.usual(lever_m=LEVER_M)
    prior = usual.covariance[3:, 3:]
    H = np.concatenate([np.kron(np.eye(6), wrench) for wrench in applied])
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + np.diag(np.tile(NOISE**2, len(read))))
    error = (gain @ (read - applied).ravel()).reshape(6, 6)
    return SensorMatrix(error, block_diag(np.zeros((3, 3)), prior - gain @ H @ prior), "loads", LEVER_M)


@pytest.mark.parametrize("load", [6, 7, 8, 9], ids=["6.7 N", "11 N", "16 N", "22 N"])
def test_one_load_of_each_line_corrects_all_others(load: int) -> None:
    read, applied = recorded()
    sensor = after_wrenches(read[:, load], applied[:, load])
    # A tool at the origin: its mounting takes the antisymmetric part of the errors of the force.
    contact = sensor.contact_response(Parameters(np.eye(3), *np.zeros((4, 3))))
    others = np.delete(np.arange(10), [0, load])
    A = sensor.error[:3, :3]
    turn = Rotation.from_rotvec([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]] / np.array(2.0))
    force = applied[:, others, :3].reshape(-1, 3)
    before = read[:, others].reshape(-1, 6)
    scale = np.linalg.norm(force)
    assert np.linalg.norm(before[:, :3] - force) > 0.05 * scale
    assert np.linalg.norm(contact.decode(before)[:, :3] - turn.apply(force)) <= 0.013 * scale
