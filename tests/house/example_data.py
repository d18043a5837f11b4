"""The data that the examples read: `uv run python tests/house/example_data.py` writes them into examples/."""

from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.model import Parameters, predict

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

TRUTH = Parameters(
    R_flange_sensor=Rotation.from_euler("z", 30, degrees=True).as_matrix(),
    gravity_force_base_N=np.array([0.12, -0.08, -1.235 * 9.80665]),
    force_bias_N=np.array([4.2, -7.5, 11.0]),
    p_sensor_com_m=np.array([0.004, 0.002, 0.061]),
    torque_bias_Nm=np.array([0.12, -0.31, 0.05]),
)
SIGMA = np.repeat([0.01, 0.0005], 3)
"""Of the mean of a pose; of one sample it is five times that."""
PUSH_N = np.array([0.0, 0.0, -6.0])
"""From 3 s to 4 s of the recording, at the sensor's origin, in sensor axes."""


def poses() -> str:
    """Return poses.csv: 24 orientations, 4 s apart, and the mean wrench at each."""
    rotations = Rotation.create_group("O")
    wrench = predict(TRUTH, rotations) + np.random.default_rng(1).normal(0, SIGMA, (24, 6))
    sigmas = np.tile(SIGMA, (24, 1))
    names = "t,qx,qy,qz,qw,fx,fy,fz,tx,ty,tz,sigma_fx,sigma_fy,sigma_fz,sigma_tx,sigma_ty,sigma_tz"
    return _table(names, np.arange(24) * 4.0, rotations.as_quat(), wrench, sigmas)


def recording() -> str:
    """Return recording.csv: 6 s at 50 Hz of an arm that turns its tool, and a push."""
    t_s = np.arange(300) / 50
    rotations = Rotation.from_euler("xy", np.c_[180 - 15 * t_s, 40 * np.sin(t_s)], degrees=True)
    wrench = predict(TRUTH, rotations) + np.random.default_rng(2).normal(0, 5 * SIGMA, (300, 6))
    wrench[(t_s >= 3) & (t_s < 4), :3] += PUSH_N
    return _table("t,qx,qy,qz,qw,fx,fy,fz,tx,ty,tz", t_s, rotations.as_quat(), wrench)


def _table(names: str, *columns: ArrayLike) -> str:
    text = StringIO()
    np.savetxt(text, np.column_stack([np.asarray(one) for one in columns]), "%.5f", ",", header=names, comments="")
    return text.getvalue()


FILES = {"poses.csv": poses, "recording.csv": recording}

if __name__ == "__main__":
    for name, content in FILES.items():
        (EXAMPLES / name).write_text(content(), encoding="utf-8")
