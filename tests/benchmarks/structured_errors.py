"""Whether sigmas, verdicts and shown errors hold under errors with a structure: of joints, load and time.

    uv run python -m tests.benchmarks.structured_errors [--quick] [--only PART] [--cells NAME ...] [--poses N ...]

The generator (tests/structured_cell.py) shares nothing with the estimator. Run k of a row has the seed k, and rows of
one seed differ in the disturbance alone. Prints one row a figure; the exit code is the number of failed rows.

Figures: root mean square of error / sigma of each parameter, and the share within 2 sigma, over what is GOOD or USABLE;
GOOD though wrong, if the sum of squares of error / sigma of R, F_b, F0, P or T0 exceeds the 99.73 % quantile of
chi-square; the error shown over the true one of the next use, median over the sessions, force and torque. The next use
is one minute later in the region of the poses and in the whole workspace, and an hour later in the region. "-": the
result states no such error, so that of one minute in the region is compared.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import stats

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, mean_and_covariance, solve
from ftcalib.after.new_tool import new_tool
from ftcalib.after.state import tare
from ftcalib.after.verification import verify
from ftcalib.after.weighing import drift_since, weigh
from ftcalib.errors import BadDataset
from ftcalib.motion.solve import solve_motion
from ftdrive.stream.noise import unexplained_variance
from tests.benchmarks.common import Array, Lab, Record, Row, all_within, most, run
from tests.moving_load import means_of
from tests.structured_cell import (
    CELLS,
    DEG,
    MOTIONS,
    NOISE,
    RATE_HZ,
    Cell,
    Load,
    Truth,
    dwell_times,
    flange,
    postures,
    tour,
    turned,
    unit,
    vector_of,
)

STATIC = ("R", "F_b", "tilt", "mass", "F0", "P", "T0")
MOVING = (*STATIC, "inertia", "height")
BLOCKS = ("R", "F_b", "F0", "P", "T0")
MOTION_CELLS = ("white", "kinematics", "compliance", "cable", "gain", "coloured", "all")
SCALED = ("F_b", "mass")
"""Their sigmas hold the scale that no orientation shows, at least 0.2 %: only the upper limit counts."""
PLACES = ("region", "workspace", "hour")
VERDICTS = ("good", "usable", "rejected", "refused")
NEXT = 12
"""Poses of the next use."""
NEXT_S, HOUR_S, MOTION_S = 60.0, 3600.0, 25.0
CHANGES = frozenset(
    ("sensor_turned", "sensor_changed", "com_shifted", "load_changed", "bias_stepped", "sensors_alternate")
)
NEAR_M = np.array([0.0, 0.0, 0.15])
"""Where the gripper holds parts."""
ALLOWED = 8.0
"""A change of so many sigmas in a reading must be found."""


class Options(NamedTuple):
    """What the command line chooses of each part."""

    cells: Sequence[str]
    poses: Sequence[int]
    where: Sequence[str]
    noise: Sequence[str]


# -- sessions at rest --------------------------------------------------------------------------------------------------


def dataset(q: Array, t_s: Array, samples: Array, *, given: bool) -> CalibrationDataset:
    """Means of the dwells, with the covariance that they show or none."""
    means = [mean_and_covariance(one) for one in samples]
    return CalibrationDataset.of(
        flange(q),
        [one.mean for one in means],
        wrench_cov=[one.covariance for one in means] if given else None,
        n_samples=samples.shape[1] if given else 0,
        t_s=t_s,
    )


class Session(NamedTuple):
    """A tour, what was made of it, and when it ended."""

    cell: Cell
    data: CalibrationDataset
    result: CalibrationResult
    truth: Truth
    end_s: float


def calibrated(seed: int, name: str, n: int, where: str, *, given: bool) -> Session:
    """Calibrate; raises `NotObservable`."""
    cell = Cell([seed], CELLS[name])
    q = tour(np.random.default_rng([seed, 1]), n, where)
    t, samples = cell.dwells(q, 0.0)
    data = dataset(q, t, samples, given=given)
    truth = cell.truth(postures(np.random.default_rng([seed, 2]), 200, where), dwell_times(n, 0.0).ravel())
    return Session(cell, data, solve(data), truth, float(t[-1]))


def in_sigmas(result: CalibrationResult, truth: Truth) -> dict[str, Array]:
    """Errors of the static parameters in sigmas."""
    sigma, F_b = result.sigma, truth.gravity_force_base_N
    x, y, z = -F_b / np.linalg.norm(F_b)
    tilt = np.array([np.arctan2(-y, np.hypot(x, z)), np.arctan2(x, z)])
    found = np.array([result.tilt_alpha_rad, result.tilt_beta_rad])
    turn = truth.R_flange_sensor @ vector_of(truth.R_flange_sensor.T @ result.R_flange_sensor)
    mass_N = result.weight_N - np.linalg.norm(F_b)
    return {
        "R": turn / sigma["R_flange_sensor"],
        "F_b": (result.gravity_force_base_N - F_b) / sigma["gravity_force_base_N"],
        "tilt": np.sin(found - tilt) / np.array([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]]),
        "mass": np.atleast_1d(mass_N / sigma["weight_N"]),
        "F0": (result.force_bias_N - truth.bias[:3]) / sigma["force_bias_N"],
        "P": (result.p_sensor_com_m - truth.p_sensor_com_m) / sigma["p_sensor_com_m"],
        "T0": (result.torque_bias_Nm - truth.bias[3:]) / sigma["torque_bias_Nm"],
    }


_LENGTH = {"tilt": 2, "mass": 1, "inertia": 6, "height": 1}


def _refused(names: Sequence[str]) -> dict[str, object]:
    nothing: dict[str, object] = {name: np.full(_LENGTH.get(name, 3), np.nan) for name in names}
    nothing |= {f"{what} {place}": np.full(2, np.nan) for what in ("shown", "true") for place in PLACES}
    return nothing | {"verdict": VERDICTS.index("refused"), "changed": False, "stated": np.zeros(3)}


def _judged(result: CalibrationResult, z: Mapping[str, Array]) -> dict[str, object]:
    first = next((one.code for one in result.findings if one.severity != "note"), "")
    return {**z, "verdict": VERDICTS.index(result.verdict), "changed": first in CHANGES}


def _rms(rest: Array) -> Array:
    return np.sqrt([np.mean(np.sum(rest[:, c] ** 2, axis=1)) for c in (slice(3), slice(3, 6))])


def _shown(result: CalibrationResult, noise: Array) -> dict[str, object]:
    """Errors that the result states by place, with the noise of a reading where it is not part of them."""
    record: dict[str, object] = {}
    stated = np.zeros(3)
    for k, (place, key) in enumerate(zip(PLACES, ("", "workspace", "hour"), strict=True)):
        names = [f"{key}_{unit}" for unit in ("force_rms_N", "torque_rms_Nm")]
        own = [result.quality.get(name) for name in names]
        stated[k] = not key or None not in own
        shown = np.array(own, dtype=np.float64) if key and stated[k] else result.likely_error()
        record[f"shown {place}"] = np.sqrt(shown**2 + (noise if result.noise_explains else 0.0))
    return {**record, "stated": stated}


def static_run(seed: int, name: str, n: int, where: str, given: bool) -> dict[str, object]:
    """All figures of one session."""
    try:
        cell, _, result, truth, end_s = calibrated(seed, name, n, where, given=given)
    except NotObservable:
        return _refused(STATIC)
    record = _judged(result, in_sigmas(result, truth))
    record |= _shown(result, np.sum((NOISE**2 / RATE_HZ).reshape(2, 3), axis=1))
    uses = ((where, NEXT_S), ("whole", NEXT_S), (where, HOUR_S))
    for kind, (place, (region, after_s)) in enumerate(zip(PLACES, uses, strict=True), 1):
        q = postures(np.random.default_rng([seed, 2 + kind]), NEXT, region)
        _, samples = cell.dwells(q, end_s + after_s, kind=kind)
        record[f"true {place}"] = _rms(result.compensate(samples.mean(axis=1), flange(q)))
    return record


def figures(title: str, record: Record, names: Sequence[str], places: Sequence[str], runs: int) -> Iterator[Row]:
    """Compare sigmas, verdicts and shown errors of one row of sessions."""
    kept, good = record["verdict"] < 2, record["verdict"] == 0
    counts = np.bincount(record["verdict"].astype(int), minlength=4)
    verdicts = ", ".join(f"{100 * c / runs:.0f} % {v}" for c, v in zip(counts, VERDICTS, strict=True) if c)
    yield Row(f"{title}: verdicts", verdicts, "", True, runs)
    changed = 100 * float(np.mean(record["changed"]))
    yield most(f"{title}: a change named first though nothing changed", changed, 1, runs, " %")
    if not kept.any():
        return
    ratio = np.array([np.sqrt(np.mean(record[name][kept] ** 2)) for name in names])
    fits = (ratio <= 1.4) & ((ratio >= 0.7) | np.array([name in SCALED for name in names]))
    figure = "/".join(f"{r:.2f}" for r in ratio)
    yield Row(f"{title}: error / sigma of {'/'.join(names)}", figure, "0.70 to 1.40", bool(fits.all()), int(kept.sum()))
    cover = np.array([100 * np.mean(np.abs(record[name][kept]) < 2) for name in names])
    figure = "/".join(f"{c:.0f}" for c in cover)
    yield Row(f"{title}: within 2 sigma, %", figure, ">= 90", bool((cover >= 90).all()), int(kept.sum()))
    if good.any():
        limit = {name: stats.chi2.ppf(0.9973, record[name].shape[1]) for name in BLOCKS}
        wrong = np.any([np.sum(record[name][good] ** 2, axis=1) > limit[name] for name in BLOCKS], axis=0)
        yield most(f"{title}: GOOD with an error above 3 sigma", 100 * float(wrong.mean()), 3, int(good.sum()), " %")
    for k, place in enumerate(places):
        shown = np.median(record[f"shown {place}"][kept] / record[f"true {place}"][kept], axis=0)
        row = all_within(f"{title}: shown / true next use, {place}", shown, 0.6, 1.4, int(kept.sum()))
        stated = bool(record["stated"][kept, k].all())
        yield row if stated else replace(row, figure=f"- ({row.figure})")


def static(lab: Lab, options: Options) -> Iterator[Row]:
    for name, n, where, noise in product(options.cells, options.poses, options.where, options.noise):
        runs = lab.count(200, 30)
        record = lab.simulate(partial(static_run, name=name, n=n, where=where, given=noise == "given"), runs)
        yield from figures(f"{name} {n} {where} {noise}", record, STATIC, PLACES, runs)


# -- motion ------------------------------------------------------------------------------------------------------------


def motion_run(seed: int, name: str, kind: str) -> dict[str, object]:
    """All figures of one recording."""
    cell = Cell([seed], CELLS[name])
    joints, later = (MOTIONS[kind](np.random.default_rng([seed, k]), MOTION_S) for k in (1, 2))
    t = np.linspace(0, MOTION_S, 200)
    try:
        result = solve_motion(*means_of(cell.record(joints, MOTION_S)))
    except (NotObservable, BadDataset):
        return _refused(MOVING)
    assert result.motion is not None
    z = in_sigmas(result, cell.truth(joints(t), t))
    upper, sigma = np.triu_indices(3), result.motion.sigma
    off = (result.motion.inertia_kg_m2 - cell.load.inertia_kg_m2) / sigma["inertia_kg_m2"]
    z |= {"inertia": off[upper], "height": np.atleast_1d((result.motion.height_m - cell.height_m) / sigma["height_m"])}
    record = _judged(result, z) | _shown(result, np.zeros(2))
    q = later(t[5:-5:8])
    rest = result.compensate(cell.readings(q) + cell.bias + cell.warmed(t[-1:]), flange(q))
    return record | {f"true {place}": _rms(rest) for place in PLACES}


def motion(lab: Lab, options: Options) -> Iterator[Row]:
    for name, kind in product([name for name in options.cells if name in MOTION_CELLS], MOTIONS):
        runs = lab.count(60, 12)
        record = lab.simulate(partial(motion_run, name=name, kind=kind), runs)
        yield from figures(f"{name} {kind}", record, MOVING, PLACES[:1], runs)


# -- verification ------------------------------------------------------------------------------------------------------


def verify_run(seed: int, name: str, where: str, there: str) -> dict[str, object]:
    """Verify an unchanged cell, and one with each change, in six other poses; NaN where it cannot be found."""
    nothing = {"alarm": np.nan, "20 g": np.nan, "3 mm": np.nan, ".5 N": np.nan}
    try:
        cell, data, result, _, end_s = calibrated(seed, name, 24, where, given=True)
    except NotObservable:
        return dict(nothing)
    if result.verdict == "rejected":
        return dict(nothing)
    rng = np.random.default_rng([seed, 11])
    q = postures(rng, 6, there)
    load, R = cell.load, flange(q)
    loads: Mapping[str, Load] = {
        "20 g": load.with_part(0.02, load.p_sensor_com_m),
        "3 mm": replace(load, p_sensor_com_m=load.p_sensor_com_m + 3e-3 * unit(rng)),
    }

    def means(part: Load | None) -> tuple[Array, Array]:
        at_rest = [mean_and_covariance(one) for one in cell.dwells(q, end_s + NEXT_S, load=part, kind=4)[1]]
        return np.array([one.mean for one in at_rest]), np.array([one.covariance for one in at_rest])

    y, cov = means(None)
    changed = {name: means(part)[0] for name, part in loads.items()} | {".5 N": y + np.r_[0.5 * unit(rng), 0, 0, 0]}
    unchanged = verify(result, R, y, cov, fitted=data)
    record: dict[str, object] = {**nothing, "alarm": not unchanged.passed}
    for kind, other in changed.items():
        if np.abs((other - y) / unchanged.predicted_sigma).max() >= ALLOWED:
            record[kind] = not verify(result, R, other, cov, fitted=data).passed
    return record


def verification(lab: Lab, options: Options) -> Iterator[Row]:
    for name, (where, there) in product(options.cells, (("whole", "whole"), ("wrist", "wrist"), ("wrist", "whole"))):
        runs = lab.count(200, 30)
        record = lab.simulate(partial(verify_run, name=name, where=where, there=there), runs)
        title = f"{name} {where}, verified in {there}"
        seen = int(np.isfinite(record["alarm"]).sum())
        if not seen:
            continue
        yield most(f"{title}: false alarms at 1 %", 100 * float(np.nanmean(record["alarm"])), 3, seen, " %")
        shares = {kind: record[kind][np.isfinite(record[kind])] for kind in ("20 g", "3 mm", ".5 N")}
        figure = "/".join(f"{100 * s.mean():.0f} of {len(s)}" if len(s) else "-" for s in shares.values())
        passed = all(s.mean() >= 0.9 for s in shares.values() if len(s))
        yield Row(f"{title}: 20 g/3 mm/.5 N found, %", figure, ">= 90 where seen", passed, runs)


# -- a tool that turns, another tool, a weighing -----------------------------------------------------------------------


def turned_run(seed: int, name: str, n: int, where: str, given: bool, turn_deg: float) -> dict[str, object]:
    """The sensor and its tool turn on the flange in mid-session."""
    cell, other = (Cell([seed], CELLS[name]) for _ in range(2))
    rng = np.random.default_rng([seed, 21])
    other.R_flange_sensor = cell.R_flange_sensor @ turned(turn_deg * DEG * unit(rng))
    q, k = tour(np.random.default_rng([seed, 1]), n, where), int(rng.integers(n // 3, 2 * n // 3 + 1))
    t, samples = cell.dwells(q, 0.0)
    samples[k:] = other.dwells(q, 0.0)[1][k:]
    result = solve(dataset(q, t, samples, given=given))
    first = next((one.code for one in result.findings if one.severity != "note"), "")
    return {"named": first in ("sensor_turned", "sensor_changed"), "verdict": VERDICTS.index(result.verdict)}


def turned_tool(lab: Lab, options: Options) -> Iterator[Row]:
    for name, noise, turn_deg in product(("white", "all"), options.noise, (0.5, 1.0, 2.0)):
        runs = lab.count(100, 20)
        worker = partial(turned_run, name=name, n=24, where="whole", given=noise == "given", turn_deg=turn_deg)
        record = lab.simulate(worker, runs)
        named, good = 100 * float(record["named"].mean()), 100 * float(np.mean(record["verdict"] == 0))
        title = f"{name} {noise}: turned by {turn_deg:g}° in mid-session, named first; GOOD"
        has_target = turn_deg >= 1
        yield Row(
            title, f"{named:.0f} %; {good:.0f} %", ">= 95 %" if has_target else "", named >= 95 or not has_target, runs
        )


def new_tool_run(seed: int, name: str, where: str) -> dict[str, object]:
    """Another tool in an unchanged cell, and in one whose sensor turned by 1°; NaN where there is no earlier result."""
    try:
        cell, _, earlier, _, end_s = calibrated(seed, name, 24, where, given=True)
    except NotObservable:
        return {"refused": np.nan, "named": np.nan}
    if earlier.verdict == "rejected":
        return {"refused": np.nan, "named": np.nan}
    rng = np.random.default_rng([seed, 31])
    tool, q = Load.drawn(rng), tour(rng, 4, where)
    words = []
    for turn_deg in (0.0, 1.0):
        cell.R_flange_sensor = cell.R_flange_sensor @ turned(turn_deg * DEG * unit(rng))
        data = dataset(q, *cell.dwells(q, end_s + NEXT_S, load=tool, kind=5), given=True)
        try:
            new_tool(earlier, data)
            words.append("")
        except NotObservable as error:
            words.append(str(error))
    return {"refused": bool(words[0]), "named": "mounted otherwise" in words[1]}


def another_tool(lab: Lab, options: Options) -> Iterator[Row]:
    for name, where in product(options.cells, options.where):
        runs = lab.count(60, 20)
        record = lab.simulate(partial(new_tool_run, name=name, where=where), runs)
        seen = int(np.isfinite(record["refused"]).sum())
        if not seen:
            continue
        refused, named = (100 * float(np.nanmean(record[key])) for key in ("refused", "named"))
        yield most(f"--from, {name} {where}: refused though unchanged", refused, 3, seen, " %")
        row = Row(f"--from, {name} {where}: sensor turned by 1°, named", f"{named:.0f} %", ">= 95 %", named >= 95, seen)
        yield row if name == "white" else replace(row, target="", passed=True)


def weigh_run(seed: int, name: str, where: str) -> dict[str, object]:
    """Weigh a part in the pose of the tare and in another one; NaN where nothing was weighed."""
    record: dict[str, object] = {f"{what} {pose}": np.nan for what in ("z", "fault") for pose in ("same", "moved")}
    try:
        cell, _, result, _, end_s = calibrated(seed, name, 24, where, given=True)
    except NotObservable:
        return record
    if result.verdict == "rejected":
        return record
    rng = np.random.default_rng([seed, 41])
    q, kg, at_s = postures(rng, 2, where), float(rng.uniform(0.1, 1.0)), end_s + NEXT_S
    held = cell.load.with_part(kg, NEAR_M + 0.015 * rng.standard_normal(3))
    R, noise = flange(q), np.diag(unexplained_variance(result))
    try:
        reference = tare(result, R[:1], list(cell.dwells(q[:1], at_s, kind=6)[1]))
    except BadDataset:
        return record
    for k, pose in enumerate(("same", "moved")):
        at_rest = mean_and_covariance(cell.dwells(q[k : k + 1], at_s + 10.0, load=held, kind=7 + k)[1][0])
        weight = weigh(
            reference,
            R[k : k + 1],
            at_rest.mean[None],
            at_rest.covariance[None] + noise,
            drift=drift_since(10.0),
            g_m_s2=result.g_m_s2,
            p_sensor_near_m=NEAR_M,
            orientation_sigma_rad=result.components.get("rotation_rad", 0.0),
        )
        record[f"fault {pose}"] = weight.fault is not None
        if weight.fault is None:
            record[f"z {pose}"] = (weight.mass_kg - kg) / np.hypot(
                weight.mass_sigma_kg, result.scale_sigma * weight.mass_kg
            )
    return record


def weighing(lab: Lab, options: Options) -> Iterator[Row]:
    for name, where in product(options.cells, options.where):
        runs = lab.count(100, 30)
        record = lab.simulate(partial(weigh_run, name=name, where=where), runs)
        for pose in ("same", "moved"):
            z, fault = (record[f"{what} {pose}"][np.isfinite(record[f"{what} {pose}"])] for what in ("z", "fault"))
            if not len(fault):
                continue
            title = f"weigh, {name} {where}, {'pose of the tare' if pose == 'same' else 'another pose'}"
            yield most(f"{title}: refused though clean", 100 * float(fault.mean()), 3, len(fault), " %")
            if not len(z):
                continue
            # The sigma holds scale and drift that not every cell has: only the upper limit counts.
            yield most(f"{title}: error / sigma", float(np.sqrt(np.mean(z**2))), 1.4, len(z))
            yield most(f"{title}: above 3 sigma", 100 * float(np.mean(np.abs(z) > 3)), 3, len(z), " %")


PARTS: Mapping[str, Callable[[Lab, Options], Iterator[Row]]] = {
    "static": static,
    "motion": motion,
    "verify": verification,
    "turned": turned_tool,
    "from": another_tool,
    "weigh": weighing,
}


def _with(part: Callable[[Lab, Options], Iterator[Row]], options: Options) -> Callable[[Lab], Iterator[Row]]:
    return lambda lab: part(lab, options)


def main() -> int:
    """Print the rows; the options beside these are those of every benchmark."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    parser.add_argument("--poses", nargs="+", type=int, default=[24, 12, 6])
    parser.add_argument("--range", nargs="+", choices=("whole", "wrist"), default=["whole", "wrist"], dest="where")
    parser.add_argument("--noise", nargs="+", choices=("given", "unknown"), default=["given", "unknown"])
    chosen, sys.argv[1:] = parser.parse_known_args()
    options = Options(**vars(chosen))
    description = "Errors with a structure. Also --cells, --poses, --range whole wrist, --noise given unknown."
    return run({name: _with(part, options) for name, part in PARTS.items()}, description)


if __name__ == "__main__":
    sys.exit(main())
