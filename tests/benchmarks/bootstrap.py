"""Check by simulation whether the stated sigmas of a calibration hold: a parametric bootstrap of its run.

    uv run python -m tests.benchmarks.bootstrap RUN [--draws 1000] [--seed 0]

The result of the run is the truth. Each draw has the poses, times and measured covariances of the run, is solved as the
run was, and is compared with that truth. Draw i has random numbers of (seed, i), so the figures do not depend on the
number of processes. Exit code 1: a sigma does not hold.
"""

import argparse
import json
import os
import sys
from functools import cache, partial
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.data.dataset import pooled_covariance
from ftcalib.errors import NotObservable
from ftcalib.likelihood.response import response_columns
from ftcalib.likelihood.session import LEVER_M
from ftcalib.likelihood.session_noise import centred, pose_times, steps
from ftcalib.likelihood.variance_components import FORCE, TORQUE, component
from ftcalib.model import Array, predict
from ftdrive.fleet.resolve import solved, task_of
from ftdrive.runs.run import Run
from ftdrive.store.records import mass_sigma_kg

SIGNIFICANT, RELEVANT = 4.0, 0.1
"""A ratio differs from 1 by more than so many of its own sigmas, and by more than this."""
GROUPS = {
    "mounting rotation, °": (slice(0, 3), np.degrees(1)),
    "gravity force, N": (slice(3, 6), 1.0),
    "force bias, N": (slice(6, 9), 1.0),
    "centre of mass, mm": (slice(9, 12), 1e3),
    "torque bias, N·m": (slice(12, 15), 1.0),
    "mass, g": (slice(15, 16), 1e3),
}
"""Columns of an error, and the factor to the unit in the name."""
CHANNELS = {
    component(kind, channels).name: (kind, channels)
    for kind in ("white", "walk", "slope")
    for channels in (FORCE, TORQUE, *(range(k, k + 1) for k in range(6)))
}


def drawn(dataset: CalibrationDataset, result: CalibrationResult, rng: np.random.Generator) -> CalibrationDataset:
    """Draw the measured noise and every component that the result states, for the poses that were used."""
    n, found = len(dataset), result.components
    used = np.ones(n, bool) if result.weights is None else result.weights > 0
    variance = {kind: np.zeros(6) for kind in ("white", "walk", "slope")}
    for name in found.keys() & CHANNELS.keys():
        kind, channels = CHANNELS[name]
        variance[kind][channels] = found[name] ** 2
    if dataset.wrench_cov is not None:
        cov = pooled_covariance(dataset.wrench_cov, dataset.n_samples) + np.diag(variance["white"])
    else:
        if "white_torque_Nm" not in found:  # from few poses one sigma was estimated for both
            variance["white"][3:] = LEVER_M**2 * variance["white"][:3]
        cov = np.broadcast_to(np.diag(variance["white"]), (n, 6, 6))
    gain, cross_talk = (
        found.get(name, 0.0) * rng.standard_normal(size) for name, size in (("gain", 5), ("cross_talk", 6))
    )
    turn_rad = found.get("rotation_rad", 0.0) * rng.standard_normal((n, 3))
    white, walk = rng.standard_normal((n, 6, 1)), np.sqrt(variance["walk"]) * rng.standard_normal((n, 6))
    slope = np.sqrt(variance["slope"]) * rng.standard_normal(6)

    R, p = dataset.R_base_flange @ Rotation.from_rotvec(turn_rad).as_matrix(), result.parameters
    wrench = predict(p, R) + response_columns(p, R) @ np.append(gain, cross_talk)
    wrench += (np.linalg.cholesky(cov) @ white)[..., 0]
    time = pose_times(dataset.t_s)
    order = np.flatnonzero(used)[np.argsort(time[used], kind="stable")]
    bias = centred(time)[:, None] * slope
    bias[order] += np.cumsum(np.sqrt(steps(time[order]))[:, None] * walk[order], axis=0)
    wrench += bias - bias[used].mean(axis=0)  # the bias of a calibration is the mean over its poses
    return CalibrationDataset(
        dataset.R_base_flange[used],
        wrench[used],
        None if dataset.wrench_cov is None else dataset.wrench_cov[used],
        dataset.n_samples[used],
        dataset.t_s[used],
    )


def stated_sigma(result: CalibrationResult) -> Array:
    """Return the stated sigmas (16,); that of the mass without a gain common to all axes, which is not drawn."""
    mass_kg = mass_sigma_kg(result.parameters, result.covariance, result.g_m_s2)
    return np.asarray(np.sqrt(np.append(np.diag(result.covariance), mass_kg**2)))


@cache
def given(folder: Path) -> tuple[CalibrationDataset, CalibrationResult, bytes]:
    """Return dataset, calibration and circumstances of a run."""
    run = Run(folder)
    return CalibrationDataset.load(run.dataset_path), CalibrationResult.load(run.calibration_path), task_of(folder)[1]


def draw(folder: Path, seed: int, i: int) -> tuple[Array, Array, float] | None:
    """Return error (16,), stated sigma (16,) and normalised square of a draw; None: rejected or not observable."""
    dataset, result, task = given(folder)
    data = drawn(dataset, result, np.random.default_rng([seed, i]))
    try:
        found = CalibrationResult.from_dict(json.loads(solved(json.dumps(data.to_dict()).encode(), task)))
    except NotObservable:
        return None
    if found.verdict == "rejected":
        return None
    error = result.parameters.difference(found.parameters)
    sigma = stated_sigma(found)
    z = error / sigma[:15]
    chi2 = z @ np.linalg.solve(found.covariance / np.outer(sigma[:15], sigma[:15]), z)
    return np.append(error, found.weight_N / found.g_m_s2 - result.mass_kg), sigma, float(chi2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    _, result, _ = given(options.run)
    with Pool() as pool:
        one = partial(draw, options.run, options.seed)
        draws = [found for found in pool.imap(one, range(options.draws), 10) if found is not None]
    errors, sigmas, chi2 = (np.array(column) for column in zip(*draws, strict=True))
    sys.stdout.write(f"{len(draws)} of {options.draws} draws accepted; components {dict(result.components)}\n")
    sys.stdout.write(f"{'':22} stated sigma    scatter   ratio  its sigma  inside 95 %\n")
    failed = 0
    for name, (columns, unit) in GROUPS.items():
        square = (errors[:, columns] ** 2).mean(axis=1)
        stated, scatter = np.sqrt([np.mean(stated_sigma(result)[columns] ** 2), square.mean()])
        ratio, ratio_sigma = scatter / stated, np.std(square, ddof=1) / np.sqrt(len(draws)) / (2 * scatter * stated)
        inside = 100 * np.mean(np.abs(errors[:, columns]) < 1.959964 * sigmas[:, columns])
        holds = abs(ratio - 1) < max(SIGNIFICANT * ratio_sigma, RELEVANT)
        failed += not holds
        sys.stdout.write(
            f"{name:22} {unit * stated:12.3g} {unit * scatter:10.3g} {ratio:7.3f} {ratio_sigma:10.3f} {inside:10.1f} %"
            f"   {'holds' if holds else 'DOES NOT HOLD'}\n"
        )
    sys.stdout.write(f"chi2 / 15: {chi2.mean() / 15:.3f} (1 expected)\n")
    return int(failed > 0)


if __name__ == "__main__":
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before the processes start: more threads than cores are slow
    sys.exit(main())
