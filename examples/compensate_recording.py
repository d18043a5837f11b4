"""Compensate a recording of another program: wrench and orientation in one table, such as a DataFrame."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import ftdrive

here = Path(__file__).parent
calibration = ftdrive.solve(ftdrive.read_dataset(here / "poses.csv"))

# With pandas: table = pandas.read_csv(here / "recording.csv"), then table[[...]].to_numpy() in both lines below.
table = np.genfromtxt(here / "recording.csv", delimiter=",", names=True)
orientation = Rotation.from_quat(np.stack([table[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
wrench = np.stack([table[name] for name in ("fx", "fy", "fz", "tx", "ty", "tz")], axis=1)

contact = calibration.compensate(wrench, orientation)  # (n, 6), N and N·m, sensor axes, about the sensor origin

# With pandas: contact = pandas.DataFrame(contact, columns=["fx", "fy", "fz", "tx", "ty", "tz"])
force_N = np.linalg.norm(contact[:, :3], axis=1)
pushed = force_N > 1.0
print(f"{len(table)} samples, raw force up to {np.linalg.norm(wrench[:, :3], axis=1).max():.1f} N")
print(f"free tool: {np.sqrt(np.mean(force_N[~pushed] ** 2)):.2f} N rms")
print(f"pushed from {table['t'][pushed][0]:.2f} s to {table['t'][pushed][-1]:.2f} s")
print(f"mean contact force {contact[pushed, :3].mean(axis=0).round(1) + 0.0} N")
