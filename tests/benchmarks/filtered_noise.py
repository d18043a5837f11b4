"""Whether calibrations from dwells of filtered noise are good, and their sigmas true: few independent samples a pose.

    python -m tests.benchmarks.filtered_noise                  # 200 sessions of each noise, about 2 minutes
    python -m tests.benchmarks.filtered_noise --sessions 50 --poses 12 --seed 7

24 poses of 2 s at 500 Hz, white noise behind a low-pass, 0.2 N and 8 mN·m: 1000 samples, but 9 to 31 independent ones.
The path is that of a tour: samples, `mean_and_covariance`, `CalibrationDataset`, `solve`. Dwells count as they come.

Columns: GOOD, USABLE and rejected results; chi2 per degree of freedom; root mean square of error / sigma for each
parameter; mean square error of predicted force and torque over all orientations, relative to a solution with the true
covariance; percent of the dwells that a tour would have taken again. Exit code 1 if a noise misses a target: GOOD in
95 %, error / sigma .9 to 1.1.
"""

import argparse
import os
import sys

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from ftcalib import CalibrationDataset, mean_and_covariance, solve
from ftcalib.data.dwell_mean import is_quiet, noise_level
from ftcalib.model import Parameters, predict
from tests.benchmarks.honest_sigmas import Session, orientations

Array = NDArray[np.float64]

RATE_HZ, DWELL_S, RECORD_S = 500, 2.0, 12.0
STD = np.repeat([0.2, 8e-3], 3)
NOISES = {"white": None, "5 Hz, 1st": (1, 5.0), "5 Hz, 2nd": (2, 5.0), "2 Hz, 1st": (1, 2.0), "2 Hz, 2nd": (2, 2.0)}
"""Order and corner of a Butterworth low-pass."""
BLOCKS = ("R", "F_b", "F0", "P", "T0")


def filtered(rng: np.random.Generator, low_pass: tuple[int, float] | None, dwells: int, seconds: float) -> Array:
    """Noise (dwells, N, 6) with the standard deviation `STD`."""
    n, settle = int(seconds * RATE_HZ), 2 * RATE_HZ
    white = rng.normal(size=(dwells, settle + n, 6))
    if low_pass is None:
        return np.asarray(white[:, settle:] * STD)
    b, a = butter(low_pass[0], low_pass[1], fs=RATE_HZ)
    impulse = lfilter(b, a, np.eye(1, 10 * RATE_HZ)[0])
    return np.asarray(lfilter(b, a, white, axis=1)[:, settle:] * STD / np.sqrt(np.sum(impulse**2)))


def variance_of_mean(low_pass: tuple[int, float] | None) -> float:
    """Of a dwell of noise with variance 1."""
    n = int(DWELL_S * RATE_HZ)
    if low_pass is None:
        return 1 / n
    impulse = lfilter(*butter(low_pass[0], low_pass[1], fs=RATE_HZ), np.eye(1, 10 * RATE_HZ)[0])
    return float(np.sum(np.convolve(impulse, np.ones(n)) ** 2) / np.sum(impulse**2) / n**2)


def row(name: str, poses: int, sessions: int, seed: int) -> tuple[str, bool]:
    """Run the sessions of a noise; return its row, and whether it meets the targets."""
    low_pass, verdicts, again, chi2 = NOISES[name], list[str](), list[bool](), list[float]()
    scaled, square = list[Array](), np.zeros((2, 2))
    for k in range(sessions):
        rng = np.random.default_rng([seed, k, poses, list(NOISES).index(name)])
        session = Session(rng, poses, "any", ())
        R, force_bias, torque_bias = session.R[:poses], session.bias[:3], session.bias[3:]
        truth = Parameters(session.R_flange_sensor, session.F_b, force_bias, session.P, torque_bias)
        dwells = predict(truth, R)[:, None] + filtered(rng, low_pass, poses, DWELL_S)
        level = noise_level(filtered(rng, low_pass, 1, RECORD_S)[0], dwells.shape[1])
        again += [not is_quiet(dwell, level) for dwell in dwells]
        means = [mean_and_covariance(dwell) for dwell in dwells]
        wrench, cov = np.array([m.mean for m in means]), np.array([m.covariance for m in means])
        result = solve(CalibrationDataset.of(R, wrench, wrench_cov=cov, n_samples=dwells.shape[1]))
        ideal = solve(CalibrationDataset.of(R, wrench, wrench_cov=np.diag(STD**2) * variance_of_mean(low_pass)))
        verdicts.append(result.verdict)
        chi2.append(result.chi2 / result.dof)
        scaled.append(result.parameters.difference(truth) / np.sqrt(np.diag(result.covariance)))
        anywhere = orientations(rng, 200, "any")
        for i, found in enumerate((result, ideal)):
            off = predict(found.parameters, anywhere) - predict(truth, anywhere)
            square[i] += np.sum(off**2, axis=0).reshape(2, 3).sum(axis=1)
    good, usable, rejected = (verdicts.count(one) for one in ("good", "usable", "rejected"))
    ratio = np.sqrt(np.mean(np.reshape(scaled, (sessions, 5, 3)) ** 2, axis=(0, 2)))
    force, torque = square[0] / square[1]
    met = bool(good >= 0.95 * sessions and ratio.min() > 0.9 and ratio.max() < 1.1)
    figures = " ".join(f"{value:5.2f}" for value in ratio)
    text = f"{name:10} {good:4} {usable:6} {rejected:8}  {np.mean(chi2):5.2f}  {figures}  {force:5.2f} {torque:6.2f}"
    return f"{text}  {100 * np.mean(again):5.1f}  {'pass' if met else 'FAIL'}", met


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=200, help="of each noise")
    parser.add_argument("--poses", type=int, default=24)
    parser.add_argument("--noises", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    heads = " ".join(f"{block:>5}" for block in BLOCKS)
    sys.stdout.write(f"{'noise':10} good usable rejected   chi2  {heads}  force torque  again\n")
    all_met = True
    for name in options.noises:
        text, met = row(name, options.poses, options.sessions, options.seed)
        all_met &= met
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    return 0 if all_met else 1


if __name__ == "__main__":
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, sys.orig_argv)
    sys.exit(main())
