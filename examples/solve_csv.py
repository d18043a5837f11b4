"""Calibrate from a CSV file: one row per pose, with the orientation of the flange and the mean wrench."""

from pathlib import Path
from tempfile import TemporaryDirectory

import ftdrive

dataset = ftdrive.read_dataset(Path(__file__).with_name("poses.csv"))
result = ftdrive.solve(dataset)

sigma = result.sigma
print(f"{result.verdict}: {len(dataset)} poses")
print(f"mass            {result.mass_kg:.4f} kg, sigma {sigma['mass_kg']:.4f} kg")
print(f"centre of mass  {1e3 * result.p_sensor_com_m.round(5)} mm in sensor axes")
print(f"force bias      {result.force_bias_N.round(2)} N")
print(f"torque bias     {result.torque_bias_Nm.round(3)} N·m")
for finding in result.findings:
    print(f"{finding.severity} {finding.code}: {finding.words}")

with TemporaryDirectory() as folder:  # in your program: a permanent folder
    path = Path(folder, "calibration.json")
    result.save(path)
    print("read again:", ftdrive.read_calibration(path).id == result.id)
