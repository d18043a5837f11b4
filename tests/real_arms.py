"""Factory kinematics of real arms, read from the file of published calibrations; no code of drivers or emulators.

``FTDRIVE_REAL_DATA`` names the folder of real recordings, with ``ur_calibrations/arms.csv``.
"""

import csv
import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


class RealArm(NamedTuple):
    """One arm: its number in the file, its model, and its links (6, 4, 4), each in the one before it."""

    number: str
    model: str
    links: Array

    def flange(self, q_rad: Array) -> Array:
        """Return the flange in base, (4, 4)."""
        X = np.eye(4)
        for link, q in zip(self.links, q_rad, strict=True):
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, q]).as_matrix()
            X = X @ link @ turn
        return X

    def dh(self) -> dict[str, list[float]]:
        """Return theta, a, d and alpha as the controller reports them: standard Denavit-Hartenberg, m and rad."""
        frames = np.array([np.eye(4), *np.array([self.flange_of(i + 1) for i in range(6)])])
        z, point = frames[1:, :3, 2], frames[1:, :3, 3]  # axes of joints 1 to 6
        x, origin, along = [frames[0, :3, 0]], [np.zeros(3)], [*z, z[5]]
        for i in range(5):
            normal = np.cross(z[i], z[i + 1])
            # p_i + s z_i and p_j + t z_j are nearest to one another; t gives the origin of the frame on axis j
            _s, t, _ = np.linalg.solve(np.column_stack((z[i], -z[i + 1], normal)), point[i + 1] - point[i])
            x.append(normal / np.linalg.norm(normal) * (1.0 if normal @ x[-1] > 0.0 else -1.0))
            origin.append(point[i + 1] + t * z[i + 1])
        x.append(frames[6, :3, 0])
        origin.append(point[5])

        def angle(u: Array, v: Array, about: Array) -> float:
            return float(np.arctan2(np.cross(u, v) @ about, u @ v))

        steps = np.diff(np.array(origin), axis=0)
        return {
            "theta": [angle(x[i], x[i + 1], along[i]) for i in range(6)],
            "a": [float(steps[i] @ x[i + 1]) for i in range(6)],
            "d": [float(steps[i] @ along[i]) for i in range(6)],
            "alpha": [angle(along[i], along[i + 1], x[i + 1]) for i in range(6)],
        }

    def flange_of(self, joints: int) -> Array:
        """Return the frame behind a number of joints at angles of zero, (4, 4)."""
        X = np.eye(4)
        for link in self.links[:joints]:
            X = X @ link
        return X

    def save(self, folder: Path) -> Path:
        """Write the file that ``--kinematics`` of an emulated cell takes."""
        path = folder / f"arm-{self.number}.json"
        path.write_text(json.dumps({"model": self.model, **self.dh()}), encoding="utf-8")
        return path


def real_arms() -> list[RealArm]:
    """Return the arms of the file; none without ``FTDRIVE_REAL_DATA``."""
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    path = Path(folder or ".") / "ur_calibrations" / "arms.csv"
    if folder is None or not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [RealArm(row["arm"], row["model"], _links(row)) for row in csv.DictReader(file)]


def _links(row: dict[str, str]) -> Array:
    links = np.tile(np.eye(4), (6, 1, 1))
    for X, link in zip(links, LINKS, strict=True):
        x, y, z, roll, pitch, yaw = (
            float(row.get(f"{link}_{name}", 0.0)) for name in ("x_m", "y_m", "z_m", "roll", "pitch", "yaw")
        )
        X[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        X[:3, 3] = x, y, z
    return links
