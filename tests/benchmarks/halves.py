"""Whether sigmas hold on a real recording: two random halves of its poses, solved apart, differ by their covariance.

    FTDRIVE_REAL_DATA=FOLDER python -m tests.benchmarks.halves                   # 50 halves of agimus_mini45_b
    FTDRIVE_REAL_DATA=FOLDER python -m tests.benchmarks.halves --runs 200 --seed 7

Prints chi2 of the difference in all 15 parameters over 15, with the sum of both `tool_covariance`: mean and median.
Then for each parameter the root mean square of the difference over its sigma. The noise is not stated. The exit code is
1 if the mean is above 1.3. Nothing of the recording is copied.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, read_csv, solve

NAME = "agimus_mini45_b"
MOST = 1.3
BLOCKS = ("R", "F_b", "F0", "P", "T0")


def half(dataset: CalibrationDataset, rows: NDArray[np.intp]) -> CalibrationResult:
    """Solve a part of the poses, as if the noise were not stated."""
    no_covariance, samples = None, np.zeros(len(rows), np.int64)
    part = dataset.R_base_flange[rows], dataset.wrench[rows], no_covariance, samples, dataset.t_s[rows]
    return solve(CalibrationDataset(*part))


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    if not folder:
        sys.stderr.write("FTDRIVE_REAL_DATA is not set: let it name the folder of the recordings.\n")
        return 2
    dataset = read_csv(Path(folder) / NAME / "poses.csv", orientation="R_flange_base")
    rng, chi2, scaled, refused = np.random.default_rng(options.seed), [], [], 0
    for _ in range(options.runs):
        order = rng.permutation(len(dataset))
        middle = len(dataset) // 2
        try:
            one, other = (half(dataset, np.sort(part)) for part in (order[:middle], order[middle:]))
        except NotObservable:
            refused += 1
            continue
        apart = one.parameters.difference(other.parameters)
        cov = one.tool_covariance + other.tool_covariance
        chi2.append(float(apart @ np.linalg.solve(cov, apart)) / 15)
        scaled.append(apart / np.sqrt(np.diag(cov)))
    square = np.mean(np.square(scaled), axis=0).reshape(5, 3).mean(axis=1)
    each = ", ".join(f"{block} {np.sqrt(value):.2f}" for block, value in zip(BLOCKS, square, strict=True))
    mean = float(np.mean(chi2))
    sys.stdout.write(
        f"{NAME}, {len(chi2)} random halves, {refused} refused: chi2 / 15 mean {mean:.2f} (at most {MOST}), "
        f"median {np.median(chi2):.2f}, largest {max(chi2):.1f}\ndifference over sigma: {each}\n"
    )
    return int(mean > MOST)


if __name__ == "__main__":
    sys.exit(main())
