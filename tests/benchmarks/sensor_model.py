"""How well sensors of inexact calibration are predicted, and whether stated uncertainties hold on real data.

    FTDRIVE_REAL_DATA=… uv run python -m tests.benchmarks.sensor_model [--quick] [--only PART]

Prints one row per figure: name, figure, target, pass or FAIL; the exit code is the number of rows that failed.
"""

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftcalib import Parameters, read_csv
from ftcalib.known import Constraints, Known
from ftcalib.likelihood import fit as likelihood
from ftcalib.likelihood.explanation import Explanation, with_all_minima
from ftcalib.likelihood.response import COMMON_GAIN, CROSS_TALK_M, GAIN, Response, predicted_covariance
from ftcalib.likelihood.session import Session, inverses
from ftcalib.likelihood.session_noise import centred
from ftcalib.likelihood.variance_components import FORCE, RESPONSE, ROTATION, TORQUE, Kind, component
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array, predict
from ftcalib.published.yu import lrom
from ftcalib.result import LEAST_COMMON_GAIN
from tests.benchmarks import scenarios as sim
from tests.benchmarks.accuracy import Lab, Row, band, most, run

Rows = NDArray[np.intp]

DRIFT_N, ORIENTATION_RAD = 0.07, np.deg2rad(0.05)
NOISE = sim.sigma(400)


def response_of(parameters: Parameters, response: Response | None) -> tuple[Array, Array]:
    """Linear response (6, 9) to the orientation, and bias (6,)."""
    theta = np.stack([predict(parameters, E) for E in np.eye(9).reshape(9, 3, 3)], axis=1)
    bias = predict(parameters, np.zeros((3, 3)))
    if response is not None:
        theta = theta + np.stack([response.wrench(parameters, E) for E in np.eye(9).reshape(9, 3, 3)], axis=1)
    return theta - bias[:, None], bias


def predicted(fit: likelihood.Fit, R: Array) -> Array:
    """Wrench (n, 6) at orientations (n, 3, 3)."""
    theta, bias = response_of(fit.parameters, fit.response)
    return np.asarray(R.reshape(-1, 9) @ theta.T + bias)


# Recordings


def held_out(R: Array, wrench: Array, method: str) -> Array:
    """Measured minus predicted (n, 6), each pose left out once."""
    n, errors = len(R), np.empty((len(R), 6))
    for i in range(n):
        kept = np.flatnonzero(np.arange(n) != i)
        at = R[i : i + 1]
        if method == "LROM":
            errors[i] = wrench[i] - predict(lrom(R[kept], wrench[kept]), at)[0]
        elif method == "10-parameter LS":
            errors[i] = wrench[i] - predict(sim.ten_parameters(R[kept], wrench[kept]), at)[0]
        else:
            fit = likelihood.fit(R[kept], wrench[kept], t_s=kept.astype(np.float64))
            errors[i] = wrench[i] - predicted(fit, at)[0]
            if fit.drift is not None:
                errors[i] -= [np.interp(i, kept, channel) for channel in fit.drift.bias.T]
    return errors


def recordings(lab: Lab) -> Iterator[Row]:
    del lab
    if not (folder := os.environ.get("FTDRIVE_REAL_DATA")):
        return
    for name, limits in (("agimus_mini45_b", (0.145, 6.6)), ("foamcutting_2013_06_12", (np.inf, np.inf))):
        data = read_csv(Path(folder) / name / "poses.csv", orientation="R_flange_base")
        R, wrench = data.R_base_flange, data.wrench
        for method in ("10-parameter LS", "LROM", "ml"):
            e = held_out(R, wrench, method)
            force, torque = (float(np.sqrt((e[:, c] ** 2).sum(axis=1).mean())) for c in (slice(0, 3), slice(3, 6)))
            own = method == "ml"
            yield most(f"{name}, left out, {method}, force", force, limits[0] if own else np.inf, len(R), " N")
            yield most(
                f"{name}, left out, {method}, torque", 1e3 * torque, limits[1] if own else np.inf, len(R), " mN·m"
            )
        if name.startswith("agimus"):
            whole = likelihood.fit(R, wrench)
            for split, halves in splits(len(R)).items():
                one, two = (likelihood.fit(R[h], wrench[h], t_s=h.astype(float)) for h in halves)
                biases = np.r_[6:9, 12:15]
                every, mass_z = disagreement(one, two, np.zeros(6))
                moved, _ = disagreement(one, two, drifted(whole, halves))
                static, _ = disagreement(one, two, np.zeros(6), without=biases)
                yield most(f"{name}, {split}: chi2/dof of 15 parameters, biases that drift", moved, 1.5, 1)
                yield most("  without the biases", static, 1.5, 1)
                yield most("  biases taken as constant", every, np.inf, 1)
                yield most(f"{name}, {split}: z of the mass", abs(mass_z), 1.3 * 1.96, 1)


def splits(n: int) -> dict[str, tuple[Rows, Rows]]:
    rows = np.arange(n)
    return {"odd/even": (rows[::2], rows[1::2]), "first/second half": (rows[: n // 2], rows[n // 2 :])}


def drifted(whole: likelihood.Fit, halves: tuple[Rows, Rows]) -> Array:
    """Variance (6,) by which the mean biases of two halves differ, under the drift found in the whole run."""
    n = len(whole.weights)
    contrast = np.zeros(n)
    contrast[halves[0]], contrast[halves[1]] = 1 / len(halves[0]), -1 / len(halves[1])
    rows = np.arange(n, dtype=np.float64)
    size: dict[Kind, float] = {
        "walk": float(contrast @ np.minimum.outer(rows, rows) @ contrast),
        "slope": float(contrast @ centred(rows)) ** 2,
    }
    variance = np.zeros(6)
    for kind, unit in size.items():
        for channels in (FORCE, TORQUE, *([c] for c in range(6))):
            variance[list(channels)] += unit * whole.components.get(component(kind, channels).name, 0.0) ** 2
    return variance


def disagreement(
    one: likelihood.Fit, two: likelihood.Fit, bias_variance: Array, without: Rows | None = None
) -> tuple[float, float]:
    """Squared difference of the parameters in units of its covariance, over their number, and z of the weight.

    The bias of each fit is the mean over its poses: `bias_variance` is by how much these truly differ.
    """
    d, C = one.parameters.difference(two.parameters), one.covariance + two.covariance
    C[np.r_[6:9, 12:15], np.r_[6:9, 12:15]] += bias_variance
    keep = np.delete(np.arange(15), [] if without is None else without)
    b = one.parameters.gravity_force_base_N / np.linalg.norm(one.parameters.gravity_force_base_N)
    mass_z = float(b @ d[3:6] / np.sqrt(b @ C[3:6, 3:6] @ b))
    d, C = d[keep], C[np.ix_(keep, keep)]
    return float(d @ np.linalg.solve(C, d)) / len(keep), mass_z


# Simulated sensors


def sensor_run(
    seed: int, n: int, gain: float, cross_talk: float, drift_N: float, *, measured: bool = True, oracle: bool = True
) -> dict[str, object]:
    """Calibrate a sensor whose entries of gain and cross-talk are that uncertain."""
    rng = np.random.default_rng([seed, n])
    truth, R = sim.tool(rng), sim.poses(f"haar{n}", rng)
    K = np.tensordot(gain * rng.normal(size=5), GAIN, 1) + gain * rng.normal() / np.sqrt(3) * np.eye(3)
    S = np.tensordot(cross_talk * rng.normal(size=6), CROSS_TALK_M, 1)

    def read(R: Array) -> Array:
        u = sim.readings(truth, R)[:, :3] - truth.F0
        return np.asarray(sim.readings(truth, R) + np.concatenate([u @ K.T, u @ S.T], axis=1))

    path, mean = sim.walk(n, drift_N, rng)
    wrench = read(R) + path + mean + NOISE * rng.normal(size=(n, 6))
    reported = sim.with_inexact_orientations(R, ORIENTATION_RAD, rng)
    cov = np.diag(NOISE**2) if measured else None
    fit = likelihood.fit(reported, wrench, cov)
    elsewhere = sim.poses("haar40", rng)
    right = read(elsewhere) + mean
    e = predicted(fit, elsewhere) - right
    sigma = np.sqrt(np.diagonal(predicted_covariance(fit.parameters, fit.covariance, fit.response, elsewhere), 0, 1, 2))
    components = dict(fit.components)
    weight_N = float(np.linalg.norm(fit.parameters.gravity_force_base_N))
    along = fit.parameters.gravity_force_base_N / weight_N
    own = np.sqrt(along @ fit.covariance[3:6, 3:6] @ along)
    own = np.hypot(own, max(LEAST_COMMON_GAIN, COMMON_GAIN * fit.gain_sigma) * weight_N)
    record: dict[str, object] = {
        "square": [np.mean(e[:, :3] ** 2), np.mean(e[:, 3:] ** 2)],
        "covered": np.mean(np.abs(e) < 1.96 * sigma, axis=0),
        "gain": "gain" in components,
        "cross_talk": "cross_talk" in components,
        "mass": (weight_N - sim.WEIGHT_N) / own,
        "rejected": np.mean(fit.weights == 0),
    }
    for split, halves in splits(n).items():
        one, two = (likelihood.fit(reported[h], wrench[h], cov, t_s=h.astype(float)) for h in halves)
        record[split] = disagreement(one, two, drifted(fit, halves))[0]
    if oracle:
        fit = informed(reported, wrench, gain, cross_talk, drift_N)
        e = predicted(fit, elsewhere) - right
        record["oracle"] = [np.mean(e[:, :3] ** 2), np.mean(e[:, 3:] ** 2)]
    return record


def informed(R: Array, wrench: Array, gain: float, cross_talk: float, drift_N: float) -> likelihood.Fit:
    """Fit with the true variances."""
    session = Session(R, wrench, np.diag(NOISE**2), None, "auto", Constraints(Known(), STANDARD_GRAVITY_M_S2))
    found = [ROTATION, *RESPONSE, component("walk", FORCE), component("walk", TORQUE)]
    theta = np.array([ORIENTATION_RAD, gain, cross_talk, drift_N, sim.LEVER_M * drift_N]) ** 2
    minima = session.descent.minima(inverses(session.cov))
    used = [k for k in range(5) if theta[k] > 0]
    e = Explanation(minima[0].parameters, session.everything, tuple(found[k] for k in used), theta[used])
    return likelihood.fit_of(session, e, with_all_minima(session, e, minima), np.nan)


def false_choice(lab: Lab) -> Iterator[Row]:
    runs = lab.count(600, 60)
    for n in (24, 12, 8):
        for measured in (True, False):
            record = lab.simulate(partial(plain_run, n=n, measured=measured), runs)
            what = "measured" if measured else "unknown"
            share = 100 * float(record["chosen"].mean())
            yield most(f"no gain error, {n} poses, noise {what}: K or S chosen", share, 2, runs, " %")


def plain_run(seed: int, n: int, *, measured: bool) -> dict[str, object]:
    rng = np.random.default_rng([seed, n])
    truth, R, s = sim.tool(rng), sim.poses(f"haar{n}", rng), sim.sigma(100)
    wrench = sim.readings(truth, R) + s * rng.normal(size=(n, 6))
    return {"chosen": likelihood.fit(R, wrench, np.diag(s**2) if measured else None).response is not None}


def oracle(lab: Lab) -> Iterator[Row]:
    runs = lab.count(300, 30)
    for n in (24, 12):
        record = lab.simulate(partial(sensor_run, n=n, gain=0.01, cross_talk=0.01, drift_N=DRIFT_N), runs)
        ratio = np.sqrt(record["square"].mean(axis=0) / record["oracle"].mean(axis=0))
        for k, what in enumerate(("force", "torque")):
            yield most(f"gain and cross-talk 1 %, drift, {n} poses: {what} rms over an oracle's", ratio[k], 1.1, runs)
            covered = float(record["covered"][:, 3 * k : 3 * k + 3].mean())
            yield band(f"  95 % intervals of the predicted {what}", covered, 0.92, 0.97, runs)


def halves(lab: Lab) -> Iterator[Row]:
    runs = lab.count(200, 20)
    for gain in (0.003, 0.01, 0.02):
        for drift_N in (0.0, DRIFT_N):
            worker = partial(sensor_run, n=24, gain=gain, cross_talk=gain, drift_N=drift_N, oracle=False)
            record = lab.simulate(worker, runs)
            name = f"gain and cross-talk {100 * gain:g} %, drift {drift_N:g} N"
            for split in splits(2):
                value = float(record[split].mean())
                yield most(f"{name}: {split} disagree, chi2/dof", value, 1.5, runs)
            yield most(f"{name}: rms z of the mass", float(np.sqrt(np.mean(record["mass"] ** 2))), 1.3, runs)


PARTS: dict[str, Callable[[Lab], Iterator[Row]]] = {
    "recordings": recordings,
    "false": false_choice,
    "oracle": oracle,
    "halves": halves,
}


if __name__ == "__main__":
    sys.exit(run(PARTS, "Sensors of inexact calibration."))
