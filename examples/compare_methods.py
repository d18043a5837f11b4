"""Solve one dataset with all methods: ours, and those of the literature."""

from pathlib import Path

import numpy as np

import ftdrive

dataset = ftdrive.read_dataset(Path(__file__).with_name("poses.csv"))

print(f"{'method':20} {'mass':>9} {'mounting':>9} {'force':>8} {'torque':>9}")
print(f"{'':20} {'kg':>9} {'deg off':>9} {'N':>8} {'N·m':>9}")
for one in ftdrive.compare(dataset):
    if one.reason is not None:
        print(f"{one.method:20} {one.reason.partition(':')[0]}")
        continue
    # Errors in predicting each pose from all others; nan where the method needs every pose.
    errors = f"{one.cv_force_rms_N:8.3f} {one.cv_torque_rms_Nm:9.4f}"
    print(f"{one.method:20} {one.mass_kg:9.3f} {np.degrees(one.rotation_difference_rad):9.2f} {errors}")
