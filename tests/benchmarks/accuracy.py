"""The accuracy of the calibration, measured by simulation and on recordings against targets, beside other methods.

    uv run python -m tests.benchmarks.accuracy [--quick] [--only WORD]

Prints one row per figure: name, figure, target, pass or FAIL, number of runs; the exit code is the number of rows that
failed. Quick runs have few samples, so their targets are wider by the sampling error. The table of the README is that
of `side_by_side`. Terms: docs/contributing/figures/calibration.md.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, NotObservable, solve
from ftcalib.likelihood import fit as likelihood
from ftcalib.model import UP_IN_BASE, Array, SPECIAL_R_flange_base, predict
from ftcalib.published.methods import published
from ftcalib.published.yu import lrom, srom
from ftcalib.sensor_matrix import Calibrated
from ftdrive import read_dataset
from tests.benchmarks import scenarios as sim
from tests.benchmarks.common import Lab, Record, Row, all_within, band, most, run

GROSS_RAD = np.deg2rad(20.0)
RANDOM_STARTS = 12
SROM_POSES = np.swapaxes(SPECIAL_R_flange_base, 1, 2)


# Exactness


def exact_run(seed: int, name: str) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    truth, R = sim.tool(rng), SROM_POSES if name == "srom24" else sim.poses(name, rng)
    result = solve(plain(R, sim.readings(truth, R)))
    return {"error": np.abs(sim.error(truth, result.parameters)).max()}


def plain(R_base_flange: Array, wrench: Array) -> CalibrationDataset:
    n = len(wrench)
    return CalibrationDataset(R_base_flange, wrench, None, np.zeros(n, int), np.full(n, np.nan))


def exactness(lab: Lab) -> Iterator[Row]:
    for name, limit in (("srom24", 1e-11), ("haar7", 1e-10), ("haar4", 1e-7)):
        runs = lab.count(300, 30)
        worst = lab.simulate(partial(exact_run, name=name), runs)["error"].max()
        row = most(f"noise-free, {name}, largest error", worst, limit, runs, digits=2)
        # Of sets of four, one in some hundreds is so near a constant tilt that it is rightly refused.
        ok = row.passed and lab.refused <= (0.01 * runs if name == "haar4" else 0)
        figure = row.figure + (f", {lab.refused} refused" if lab.refused else "")
        yield Row(row.name, figure, row.target, ok, runs)


# Efficiency, basins and stated uncertainty, all from one simulation


def fit_run(seed: int, name: str, snr: float, starts: int = 0) -> dict[str, object]:
    """All figures of one calibration with known white noise."""
    rng = np.random.default_rng([seed, int(snr), sum(name.encode())])
    truth = sim.tool(rng)
    R = SROM_POSES if name == "srom24" else sim.poses(name, rng)
    s = sim.sigma(snr)
    y = sim.readings(truth, R) + s * rng.normal(size=(len(R), 6))
    fit = likelihood.fit(R, y, np.diag(s**2))
    e, C = sim.error(truth, fit.parameters), fit.covariance
    R_test = Rotation.random(25, rng=rng).as_matrix()
    free = sim.readings(truth, R_test) + s * rng.normal(size=(25, 6))
    total = np.diag(s**2) + Calibrated(fit.parameters, C).wrench_covariance(R_test)
    distance = (likelihood.standardize(free - predict(fit.parameters, R_test), total) ** 2).sum(axis=1)
    record: dict[str, object] = {
        "square": sim.blocks(e**2),
        "bound": sim.blocks(np.diag(sim.bound(truth, R, np.diag(s**2)))),
        "covered": np.abs(e) < 1.959964 * np.sqrt(np.diag(C)),
        "distance": float(e @ np.linalg.solve(C, e)),
        "p_value": float(stats.chi2.sf(fit.measured_chi2, fit.dof)),
        "alarms": float(np.mean(distance > stats.chi2.isf(0.01, 6))),
        "prediction": sim.prediction_square(truth, fit.parameters),
        "gross": float(np.linalg.norm(e[:3]) > GROSS_RAD),
        "rejected": float(np.mean(fit.weights == 0)),
    }
    if name == "srom24":
        record["srom"] = sim.prediction_square(truth, srom(R, y))
    if starts:
        own, _ = sim.lowest(R, y, s, [sim.as_truth(fit.parameters)], 0, rng)
        best, _ = sim.lowest(R, y, s, [truth], starts, rng)
        record["wrong"] = float(own > best + 1e-3)
    return record


def efficiency_of(record: Record) -> Array:
    """Mean square error over bound (5,), with equal weight for all runs."""
    return np.asarray(np.mean(record["square"] / record["bound"], axis=0))


def estimator(lab: Lab) -> Iterator[Row]:
    runs = lab.count(1200, 40)
    low, high = (0.5, 1.7) if lab.quick else (0.85, 1.15)
    at_100: dict[str, Record] = {}
    for name in (*sim.SETS, "haar24"):
        at_100[name] = lab.simulate(partial(fit_run, name=name, snr=100.0, starts=RANDOM_STARTS), runs)
        refused = f", {lab.refused} refused" if lab.refused else ""
        yield all_within(f"ML efficiency {name}, SNR 100{refused}", efficiency_of(at_100[name]), low, high, runs)

    runs_basin = lab.count(1000, 10)
    for name, snr in (*((name, 30.0) for name in sim.SETS), ("haar6", 10.0), ("ball40_24", 10.0)):
        record = lab.simulate(partial(fit_run, name=name, snr=snr, starts=RANDOM_STARTS), runs_basin)
        wrong = int(record["wrong"].sum()) + lab.refused
        yield most(f"wrong basin against multistart, {name}, SNR {snr:.0f}", wrong, 0, runs_basin)
    for name in sim.SETS:
        yield most(f"wrong basin against multistart, {name}, SNR 100", int(at_100[name]["wrong"].sum()), 0, runs)

    for method, key, (force_low, force_high), (torque_low, torque_high) in (
        ("ML", "prediction", (0, 55), (0, 2.0)),
        ("SROM", "srom", (70, 86), (4.0, 4.9)),
    ):
        force, torque = 1e3 * np.sqrt(at_100["srom24"][key].mean(axis=0) / 3)
        yield band(
            f"prediction rms a channel, {method}, srom24, SNR 100, force", force, force_low, force_high, runs, " mN"
        )
        yield band(
            f"prediction rms a channel, {method}, srom24, SNR 100, torque",
            torque,
            torque_low,
            torque_high,
            runs,
            " mN·m",
        )

    more = lab.count(2500, 300)
    haar24 = (
        at_100["haar24"] if lab.quick else lab.simulate(partial(fit_run, name="haar24", snr=100.0), more, seed=5000)
    )
    haar6 = at_100["haar6"] if lab.quick else lab.simulate(partial(fit_run, name="haar6", snr=100.0), more, seed=5000)
    slack = 2.5 if lab.quick else 1.0
    for name, record in (("haar24", haar24), ("haar6", haar6)):
        n = len(record["distance"])
        covered = float(record["covered"].mean())
        yield band(f"95 % intervals, {name}", covered, 0.95 - 0.02 * slack, 0.95 + 0.02 * slack, n)
        size = 100 * float((record["p_value"] < 0.01).mean())
        yield band(f"chi-square size at 1 %, {name}", size, 0.0 if lab.quick else 0.5, 1.7 * slack, n, " %")
        alarms = 100 * float(record["alarms"].mean())
        yield band(f"contact false alarms at 1 %, {name}", alarms, 0.7 / slack**2, 1.4 * slack, 25 * n, " %")
    for name in ("srom24", "haar12", "ball40_24"):
        distance = at_100[name]["distance"][:1000]
        p = float(stats.kstest(distance, "chi2", args=(15,)).pvalue)
        yield band(f"normalised error is chi-square(15), KS p, {name}", p, 1e-3, np.inf, len(distance))


# Noise that the estimator does not expect


def kinematics_run(seed: int, angle_deg: float) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    truth, R, s, a = sim.tool(rng), sim.poses("haar24", rng), sim.sigma(1000), np.deg2rad(angle_deg)
    y = sim.readings(truth, R) + s * rng.normal(size=(24, 6))
    fit = likelihood.fit(sim.with_inexact_orientations(R, a, rng), y, np.diag(s**2))
    turn = sim.derivative(truth, R)[:, :, :3]  # turning a pose is turning the sensor
    C = sim.bound(truth, R, np.diag(s**2) + a**2 * turn @ np.swapaxes(turn, 1, 2))
    return {
        "square": sim.blocks(sim.error(truth, fit.parameters) ** 2),
        "bound": sim.blocks(np.diag(C)),
        "found": fit.components.get("rotation_rad", 0.0) / a,
    }


def inexact_orientations(lab: Lab) -> Iterator[Row]:
    runs = lab.count(600, 40)
    record = lab.simulate(partial(kinematics_run, angle_deg=0.3), runs)
    ratio = efficiency_of(record)
    limit = 1.6 if lab.quick else 1.15
    yield all_within("orientation noise 0.3°, unknown, haar24: efficiency F0/P/T0", ratio[2:], 0, limit, runs)
    off = 100 * float(np.median(np.abs(record["found"] - 1)))
    yield most("orientation noise 0.3°: median error of the found sigma", off, 10, runs, " %")


def drift_run(seed: int, q_N: float) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    truth, R, s = sim.tool(rng), sim.poses("haar60", rng), sim.sigma(1000)
    path, mean = sim.walk(60, q_N, rng)
    truth = truth.moved(np.concatenate([np.zeros(6), mean[:3], np.zeros(3), mean[3:]]))
    y = sim.readings(truth, R) + path + s * rng.normal(size=(60, 6))
    record: dict[str, object] = {}
    for drift in ("auto", "none"):
        fit = likelihood.fit(R, y, np.diag(s**2), drift=drift)
        e = sim.error(truth, fit.parameters)
        record[drift] = sim.blocks(e**2)
        record[f"{drift} covered"] = np.abs(e) < 1.959964 * np.sqrt(np.diag(fit.covariance))
    return record


def drift(lab: Lab) -> Iterator[Row]:
    runs = lab.count(400, 12)
    walking, still = (lab.simulate(partial(drift_run, q_N=q), runs) for q in (0.07, 0.0))
    rms = {key: np.rad2deg(np.sqrt(walking[key][:, 0].mean())) for key in ("auto", "none")}
    yield most("drift 0.07 N a pose, 60 poses: rms error of R", rms["auto"], 0.03 if lab.quick else 0.022, runs, "°")
    yield band("  the same without drift in the model, for comparison", rms["none"], 0.06, 0.1, runs, "°")
    covered = float(walking["auto covered"].mean())
    yield band("drift: 95 % intervals", covered, 0.88 if lab.quick else 0.92, 0.97, runs)
    loss = 100 * (still["auto"].mean(axis=0) / still["none"].mean(axis=0) - 1)
    yield most("no drift there: loss of looking for it, worst block", float(loss.max()), 5, runs, " %")


def outlier_run(seed: int, name: str, bumped: int) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    truth, R, s = sim.tool(rng), sim.poses(name, rng), sim.sigma(100)
    y = sim.readings(truth, R) + s * rng.normal(size=(len(R), 6))
    bad = np.zeros(len(R), bool)
    bad[rng.choice(len(R), bumped, replace=False)] = True
    y[bad] += sim.bumps(bumped, rng)
    fit = likelihood.fit(R, y, np.diag(s**2))
    e = sim.error(truth, fit.parameters)
    return {
        "square": sim.blocks(e**2),
        "bound": sim.blocks(np.diag(sim.bound(truth, R[~bad], np.diag(s**2)))),
        "gross": np.rad2deg(np.linalg.norm(e[:3])) > 10 or np.linalg.norm(e[3:6]) > sim.WEIGHT_N / 5,
        "false": np.mean(fit.weights[~bad] == 0),
    }


def outliers(lab: Lab) -> Iterator[Row]:
    for name, bumped in (("haar24", 6), ("haar12", 3)):
        runs = lab.count(300, 24)
        record = lab.simulate(partial(outlier_run, name=name, bumped=bumped), runs)
        what = f"{bumped} bumped poses in {name}"
        yield most(f"{what}: gross errors", int(record["gross"].sum()) + lab.refused, 0, runs)
        ok = record["gross"] == 0
        ratio = np.mean(record["square"][ok] / record["bound"][ok], axis=0)
        yield all_within(f"{what}: efficiency", ratio, 0, 1.8 if lab.quick else 1.15, runs)
        yield most(f"{what}: good poses rejected", 100 * float(record["false"].mean()), 0.5, runs, " %")


# Side by side

PEERS = ("10-parameter LS", "relaxation", "LROM", "SROM", "ours")


def left_out(
    R: Array, y: Array, cov: Array | None, time_s: Array, folds: Sequence[NDArray[np.intp]], *, special: bool = False
) -> Array:
    """Measured minus predicted (5, m, 6) of the peers at poses left out of their fit; NaN for SROM without its 24."""
    return np.array(
        [
            np.concatenate([_left_out(name, R, y, cov, time_s, fold) for fold in folds])
            if special or name != "SROM"
            else np.full((sum(map(len, folds)), 6), np.nan)
            for name in PEERS
        ]
    )


def rms(residuals: Array) -> Array:
    """Force and torque rms (..., 2) of residuals (..., m, 6): N and N·m, norm over the axes."""
    return np.asarray(np.sqrt((residuals**2).mean(axis=-2).reshape(*residuals.shape[:-2], 2, 3).sum(axis=-1)))


def _left_out(name: str, R: Array, y: Array, cov: Array | None, time_s: Array, fold: NDArray[np.intp]) -> Array:
    kept = np.setdiff1d(np.arange(len(R)), fold)
    training = R[kept], y[kept]
    bias = np.zeros((len(fold), 6))
    if name == "10-parameter LS":
        estimate = sim.ten_parameters(*training)
    elif name == "relaxation":
        try:
            estimate = published("carlson-relaxation", R[kept], gravity_direction_base=-UP_IN_BASE)(y[kept])
        except (NotObservable, ValueError):
            return np.full((len(fold), 6), np.inf)
    elif name == "LROM":
        estimate = lrom(*training)
    elif name == "SROM":
        estimate = srom(*training)
    else:
        fit = likelihood.fit(*training, cov, t_s=time_s[kept])
        estimate, bias = fit.on_average, drifted(fit, time_s[kept], time_s[fold])
    return y[fold] - sim.readings(sim.as_truth(estimate), R[fold]) - bias


@dataclass(frozen=True)
class Session:
    """Conditions of a simulated session."""

    name: str
    poses: str = "haar24"
    aligned: bool = False
    """Sensor axes equal those of the flange and the base is level, as the ROS packages assume."""
    mount_deg: float | None = None
    """Angle between the axes of sensor and flange; None: any mounting."""
    walk_N: float = 0.0
    orientation_deg: float = 0.0
    bumped: int = 0


SESSIONS = (
    Session("as the ROS packages assume", "srom24", aligned=True),
    Session("sensor 2° off, base 2° off", "srom24", mount_deg=2.0),
    Session("any mounting", "srom24"),
    Session("any mounting, 12 poses", "haar12"),
    Session("tool within 40° of down", "cone40_24"),
    Session("wrist within 40°", "ball40_24"),
    Session("drift 0.07 N a pose", "srom24", walk_N=0.07),
    Session("orientations off by 0.3°", "srom24", orientation_deg=0.3),
    Session("3 poses bumped", "srom24", bumped=3),
)


def session_run(seed: int, session: Session) -> dict[str, object]:
    """Calibrate on every other pose of a session, validate on the rest."""
    rng = np.random.default_rng(seed)
    if session.aligned:
        truth = sim.tool(rng, R=np.eye(3), tilt_deg=0.0)
    elif session.mount_deg is not None:
        truth = sim.tool(rng, R=Rotation.from_rotvec(np.deg2rad(session.mount_deg) * sim.direction(rng)).as_matrix())
    else:
        truth = sim.tool(rng)
    special = session.poses == "srom24"
    training = rng.permutation(SROM_POSES) if special else sim.poses(session.poses, rng)
    n = len(training)
    R = np.empty((2 * n, 3, 3))
    R[0::2], R[1::2] = training, sim.poses(f"haar{n}" if special else session.poses, rng)
    s = sim.sigma(400)
    actual = sim.with_inexact_orientations(R, np.deg2rad(session.orientation_deg), rng)
    path, _ = sim.walk(2 * n, session.walk_N / np.sqrt(2), rng)
    y = sim.readings(truth, actual) + path + s * rng.normal(size=(2 * n, 6))
    y[2 * rng.choice(n, session.bumped, replace=False)] += sim.bumps(session.bumped, rng)
    fold = np.arange(1, 2 * n, 2)
    return {"rms": rms(left_out(R, y, np.diag(s**2), np.arange(2.0 * n), [fold], special=special))}


def side_by_side(lab: Lab) -> Iterator[Row]:
    runs = lab.count(60, 6)
    lines = [f"| session | {' | '.join(PEERS)} |", "|---|" + "---|" * len(PEERS)]
    for session in SESSIONS:
        errors = lab.simulate(partial(session_run, session=session), runs)["rms"]
        force, torque = np.moveaxis(np.sqrt((errors**2).mean(axis=0)), 1, 0)
        cells = (
            f"{1e3 * f:.0f} / {1e3 * t:.1f}" if np.isfinite(f) else "–" for f, t in zip(force, torque, strict=True)
        )
        lines.append(f"| {session.name} | {' | '.join(cells)} |")
        yield _lowest_row(f"side by side, {session.name}", force, runs)
    MARKDOWN.extend(
        [*lines, "", "Force in mN / torque in mN·m, rms on poses not used; noise 50 mN / 1.25 mN·m a channel."]
    )


def _lowest_row(name: str, force: Array, runs: int) -> Row:
    others = float(np.nanmin(force[:-1]))
    best = PEERS[int(np.nanargmin(force[:-1]))]
    row = most(f"{name}: our rms over the best other's", float(force[-1]) / others, 1.02, runs)
    return Row(row.name, f"{row.figure} ({best})", row.target, row.passed, runs)


MARKDOWN: list[str] = []
"""The table of `side_by_side`, printed at the end."""


# Real data


def real_data(lab: Lab) -> Iterator[Row]:
    del lab
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    if not folder:
        return
    lines = [f"| recording | {' | '.join(PEERS)} |", "|---|" + "---|" * len(PEERS)]
    results = {}
    for name in ("agimus_mini45_b", "foamcutting_2013_06_12"):
        dataset = read_dataset(Path(folder) / name / "poses.csv", orientation="R_flange_base")
        n = len(dataset)
        folds = [np.array([i]) for i in range(n)]
        errors = left_out(dataset.R_base_flange, dataset.wrench, None, np.arange(float(n)), folds)
        cells = (f"{1e3 * f:.0f} / {1e3 * t:.1f}" if np.isfinite(f) else "–" for f, t in rms(errors))
        lines.append(f"| {name} | {' | '.join(cells)} |")
        results[name] = solve(dataset)
        row = _lowest_row(f"real data, {name}, leave-one-out", rms(errors)[:, 0], n)
        without_one = [rms(np.delete(errors, i, axis=1))[:, 0] for i in range(n)]
        ratio = np.array([force[-1] / np.nanmin(force[:-1]) for force in without_one])
        yield replace(row, figure=f"{row.figure} ± {np.sqrt((n - 1) * ratio.var()):.2f}")
        shown = [results[name].quality[f"loo_{unit}"] for unit in ("force_rms_N", "torque_rms_Nm")]
        for parts in (n, 3, 2):
            folds = [np.arange(i, n, parts) for i in range(parts)]
            force_N, torque_Nm = rms(np.concatenate([compensated_beside(dataset, fold) for fold in folds]))
            what = f"real data, {name}: " + ("refits without each pose" if parts == n else f"in {parts} parts")
            figure = f"{force_N:.3f} / {1e3 * torque_Nm:.2f}"
            target, passed = "", True
            if parts == n:
                figure += f", shown {shown[0]:.3f} / {1e3 * shown[1]:.2f}"
                if name == "agimus_mini45_b":
                    target, passed = "0.120 / 6.35", bool(force_N < 0.1205 and torque_Nm < 6.355e-3)
            yield Row(f"{what}, N / mN·m", figure, target, passed, n)
    agimus, foam = results.values()
    yield band("real data, agimus: mass", agimus.mass_kg, 0.7841, 0.7921, 17, " kg", 4)
    published_R = np.array(
        [[-0.260049, 0.965594, 0.001553], [0.965444, 0.259979, 0.018150], [0.017122, 0.006220, -0.999834]]
    )
    apart = np.rad2deg(Rotation.from_matrix(agimus.R_flange_sensor.T @ published_R.T).magnitude())
    yield most("real data, agimus: R against the authors'", float(apart), 0.7, 17, "°")
    off = abs(foam.mass_kg - 0.470) / float(np.asarray(foam.sigma["mass_kg"]))
    yield most("real data, foamcutting: mass off the authors' 0.470 kg, in sigma", off, 3, 24)
    yield Row("real data, foamcutting: verdict", foam.verdict, "not good", foam.verdict != "good", 24)
    MARKDOWN.extend(["", *lines, "", "Leave-one-out force in mN / torque in mN·m."])


def compensated_beside(dataset: CalibrationDataset, fold: NDArray[np.intp]) -> Array:
    """Compensate poses (m, 6) with a fit of all others, whose drift is followed at the times between."""
    kept, R, y = np.setdiff1d(np.arange(len(dataset)), fold), dataset.R_base_flange, dataset.wrench
    time_s = dataset.t_s if np.isfinite(dataset.t_s).all() else np.arange(float(len(dataset)))
    cov = None if dataset.wrench_cov is None else dataset.wrench_cov[kept]
    found = likelihood.fit(R[kept], y[kept], cov, t_s=time_s[kept])
    response = 0.0 if found.response is None else found.response.wrench(found.on_average, R[fold])
    return y[fold] - predict(found.on_average, R[fold]) - response - drifted(found, time_s[kept], time_s[fold])


def drifted(found: likelihood.Fit, time_s: Array, at_s: Array) -> Array:
    """Change of the bias (m, 6) from its mean at times between those of the fit."""
    if found.drift is None or found.drift.course is None:
        return np.zeros((len(at_s), 6))
    return np.stack([np.interp(at_s, time_s, column) for column in found.drift.course.T], axis=1)


SECTIONS: dict[str, Callable[[Lab], Iterator[Row]]] = {
    "exact": exactness,
    "estimator": estimator,
    "orientations": inexact_orientations,
    "drift": drift,
    "outliers": outliers,
    "side": side_by_side,
    "real": real_data,
}


if __name__ == "__main__":
    sys.exit(run(SECTIONS, "Accuracy of the calibration, measured against targets.", MARKDOWN))
