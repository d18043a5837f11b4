"""The demo on both wires with five seeds: every parameter against its sigma, compensation against its prediction.

uv run python tests/benchmarks/demo_matrix.py
"""

import json
import subprocess
import sys
import tempfile
import time

import numpy as np


def main() -> int:
    failed = 0
    sys.stdout.write("sensor  seed  worst error / sigma  force error / predicted  torque  wall s\n")
    for sensor in ("can", "serial"):
        for seed in range(5):
            start = time.perf_counter()
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, "-m", "ftdrive", "demo", "--json", "--sensor", sensor, "--seed", str(seed)]
                answer = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, check=True).stdout
            demo = json.loads(answer)
            worst = max(np.abs(errors).max() for errors in demo["error_in_sigma"].values())
            force, torque = (
                demo["compensation_error"][key] / demo["result"]["predicted_error"][key]
                for key in ("force_rms_N", "torque_rms_Nm")
            )
            passed = worst < 4 and force < 3 and torque < 3
            failed += not passed
            sys.stdout.write(
                f"{sensor:7} {seed:4}  {worst:19.2f}  {force:23.2f}  {torque:6.2f}  {time.perf_counter() - start:6.1f}"
                f"  {'pass' if passed else 'FAIL'}\n"
            )
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
