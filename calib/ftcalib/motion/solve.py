"""Calibration from a recording of a moving arm."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ftcalib.after.new_tool import CellPrior
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.findings import Finding, Severity, ordered, verdict_of
from ftcalib.judge.observability import assess
from ftcalib.judge.verdict import REJECTED_SHARE, SIGNIFICANT_SIGMAS, USABLE_SHARE, Case, judge_motion
from ftcalib.known import NOTHING, Known, Setup
from ftcalib.likelihood.fit import Estimate
from ftcalib.likelihood.structure import hidden_in_any_poses, yielding_columns
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array, jacobian, nearest_rotation, predict
from ftcalib.motion.estimate import MotionFit, fit_freely, fit_motion, rough_delay
from ftcalib.motion.mistakes import (
    COMPENSATED,
    JUDGED_ROWS,
    OF_AXES,
    Correction,
    Stream,
    are_bias_steps,
    find_impossible_body,
    find_motion_mistakes,
    find_zeroings,
    fit_bias_steps,
    static_wrench,
    unchanged,
    without_steps,
)
from ftcalib.motion.model import HEIGHT, INERTIA, NAMES
from ftcalib.motion.samples import (
    NARROW_S,
    WIDE_S,
    Means,
    MotionRows,
    interpolation_error_rad,
    motion_rows,
    require_seconds,
)
from ftcalib.result import CalibrationResult, MotionResult
from ftcalib.sensor_matrix import Calibrated, Response

# Shortest usable motion without a gap.
LEAST_S = 5.0
# Largest delay between wrench and poses that is tried, s.
FARTHEST_S = 1.5
# A delay of the wrench longer than this, s, is reported as a clock error.
OFFSET_S = 0.1
# Up to this remaining delay, s, scale and signs of the motion are reliable.
ALIGNED_S = 0.02
# Up to this remaining delay, s, the model is linear in the delay.
LINEAR_S = 2e-3
# Without positions the acceleration is unknown, and only rows slower than this are used.
SLOW_RAD_S = 0.15
# Residual, as a share of the change of the wrench, below which the clocks agree; and the share of the residual that
# must remain for another clock rate to be accepted.
_FOLLOWS, _OTHER_RATE = 0.03, 0.5
# Smallest relative difference of clock rates that is corrected, and trial ratios relative to that of the durations.
_SAME_RATE, _RATIOS = 3e-3, 1 + np.linspace(-0.06, 0.06, 49)
# Interpolation error above which poses are too coarse for their motion; then only rows slower than this are used.
_COARSE_RAD, _REST_RAD_S = 8e-3, 0.02
# Assumed radius of the flange's motion, m. It bounds the unknown acceleration if positions are missing.
REACH_M = 1.0
NARROW_DEG = 45.0
# A parameter counts as determined by the motion if its sigma is below this share of its prior sigma.
MEASURED = 0.3
WRONG_HEIGHT_M = 3e-3
# A larger share of rows in contact limits the result.
MOSTLY = 0.5
# Residual, as a share of the change of the force, above which wrench and poses do not belong together.
_UNEXPLAINED = 0.3
# Prefixes of the names of components that are smooth functions of the pose.
_SMOOTH = ("load", "cable", "rotation", "yielding")


def solve_motion(  # noqa: PLR0913 - one for each thing that may be known
    wrench: Means,
    poses: Means,
    *,
    known: Known | None = None,
    earlier: CalibrationResult | None = None,
    point_mass: bool = False,
    guarded: bool = False,
    height_m: float | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup = NOTHING,
    provenance: Mapping[str, Any] | None = None,
) -> CalibrationResult:
    """Calibrate from a recording of a free tool in motion.

    Parameters
    ----------
    wrench : Means
        Means of fx, fy, fz, tx, ty, tz in N and N·m, as measured, in the sensor frame.
    poses : Means
        Means of R_base_flange row by row, followed by the position of the flange in base, m, if it is known: 12 or 9
        columns. Wrench and poses share one clock, s, but may have different rates.
    known : Known, optional
        Known mounting, direction of gravity and mass.
    earlier : CalibrationResult, optional
        Accepted result of the same sensor, mounting and base, with any tool. Its mounting, direction of gravity, gain
        and cross-talk are a prior with their covariance. The result's `provenance` names it as `parent`.
    point_mass : bool
        Whether the inertia of the load about its centre of mass is known to be 0.
    guarded : bool
        Whether a contact guard watched the motion, see `ftcalib.motion.estimate.fit_motion`.
    height_m : float, optional
        Configured height of the sensor origin above the flange face, which is compared with the estimate.
    setup : Setup
        Description of the cell, for the verdict.
    provenance : mapping, optional
        Stored with the result. Must be valid JSON.

    Raises
    ------
    BadDataset
        The recording is too short, or wrench and poses do not overlap in time.
    NotObservable
        The motion does not determine the parameters, or contradicts the earlier result. The message says why.
    """
    prior = None if earlier is None else CellPrior(earlier)
    data = wrench.result(), poses.result()
    for (t_s, _), name in zip(data, ("wrench", "poses"), strict=True):
        require_seconds(t_s, f"the times of the {name}")
    coarse_rad = interpolation_error_rad(data[1])
    is_coarse = coarse_rad > _COARSE_RAD
    # Poses too coarse for motion leave only rows at rest, which contain no information about positions.
    positions = data[1][1].shape[1] == 12 and not is_coarse
    limit_rad_s = _REST_RAD_S if is_coarse else np.inf if positions else SLOW_RAD_S
    data, zeroed_s = _without_zeroing(*data)
    data, ratio, delay_s = _on_one_clock(*data)
    rows = motion_rows(*data, delay_s, NARROW_S if guarded else WIDE_S)
    mistakes, undo = _find_mistakes(data, rows, known, g_m_s2) if positions else ([], unchanged)

    def rows_at(delay_s: float) -> tuple[MotionRows, MotionRows]:
        """Return rows of wrench and motion for a delay, with mistakes undone, and those slow enough to be used."""
        others = undo(motion_rows(*data, float(np.clip(delay_s, -FARTHEST_S, FARTHEST_S)), rows.row_s))
        return others, _select_rows(others, limit_rad_s)

    delay_s += rough_delay(_select_rows(undo(rows), limit_rad_s), known, g_m_s2)
    fit_rows = partial(fit_motion, known=known, g_m_s2=g_m_s2, prior=prior, guarded=guarded, zeroed_s=zeroed_s)
    rows, used, best = _fit_at_delay(rows_at, delay_s, partial(fit_rows, point_mass=point_mass or not positions))
    _require_enough_motion(used, best, known)
    start_s, delay_s = data[0][0][0], rows.delay_s + best.load.delay_s
    motion = MotionResult(
        best.load.inertia_kg_m2,
        delay_s,
        best.load.height_m,
        best.covariance[:23, :23],
        min(best.kept.sum() * rows.row_s / float(np.ptp(data[0][0])), 1.0),
        _contacts(used, best, start_s) if positions else (),
    )
    causes = _causes(mistakes, ratio, zeroed_s - start_s, coarse_rad, len(used) / len(rows))
    places = np.flatnonzero(best.kept)
    places = places[:: max(1, len(places) // JUDGED_ROWS)]
    quality = judge_motion(Case(_static_estimate(used, best, places), setup=setup, known=known, g_m_s2=g_m_s2))
    findings = list(causes)
    if verdict_of(causes) != "rejected":  # else the cause explains all others
        # Torques about a TCP put the load behind the sensor, as reversed torques do.
        elsewhere = any(cause.code in ("torques_about_tcp", "poses_of_tcp") for cause in causes)
        findings += [each for each in quality.findings if not (elsewhere and each.code == "torques_reversed")]
        aligned = used if abs(best.load.delay_s) <= LINEAR_S else rows_at(delay_s)[1]
        findings += _other_wrench(used, aligned, best, quality.findings)
        findings += _narrow_findings(used, best, explained=verdict_of(findings) == "rejected")
        findings += _motion_findings(rows, used, best, motion, height_m, positions=positions, is_coarse=is_coarse)
        findings += find_impossible_body(best) if positions and verdict_of(findings) != "rejected" else []
    findings += [] if earlier is None else [Finding.of("earlier_cell", parent=earlier.id)]
    responding = best.components.keys() & {"gain", "cross_talk"} or (prior is not None and prior.has_response)
    joint = np.r_[0:15, 23:34]
    response = Response(best.load.response, best.covariance[np.ix_(joint, joint)]) if responding else None
    return CalibrationResult(
        parameters=best.load.static,
        mean_bias=best.mean_bias,
        covariance=best.covariance[:15, :15],
        hidden_covariance=_unseen_covariance(used, best, setup.orientation_rad),
        residuals=best.residuals[places],
        chi2=best.chi2,
        dof=max(6 * int(best.kept.sum()) - 23, 1),
        noise_source="residuals",
        g_m_s2=g_m_s2,
        method="motion",
        findings=ordered(findings),
        provenance={**(provenance or {}), **({} if earlier is None else {"parent": {"id": earlier.id}})},
        components=best.components,
        drift=None if best.drift is None else replace(best.drift, course=None),
        response=response,
        gain_sigma=best.components.get("gain", 0.0 if earlier is None else earlier.gain_sigma),
        second_basin_chi2=best.second_basin_chi2,
        quality={
            "next_use_force_rms_N": float(best.next_use[0]),
            "next_use_torque_rms_Nm": float(best.next_use[1]),
            **quality.to_dict(),
        },
        motion=motion,
    )


def _fit_at_delay(
    rows_at: Callable[[float], tuple[MotionRows, MotionRows]],
    delay_s: float,
    fit_rows: Callable[[MotionRows], MotionFit],
) -> tuple[MotionRows, MotionRows, MotionFit]:
    """Fit rows at a delay, and again at the fitted delay, because the model is linear only in a small change of it."""
    for _ in range(3):
        rows, used = rows_at(delay_s)
        best = fit_rows(used)
        delay_s = rows.delay_s + best.load.delay_s
        if abs(best.load.delay_s) < LINEAR_S:
            break
    if best.contradiction:
        raise NotObservable(best.contradiction)
    return rows, used, best


def _causes(
    mistakes: list[Finding], ratio: float, zeroed_at_s: Array, coarse_rad: float, share: float
) -> list[Finding]:
    """Return findings about what was corrected (mistakes, clocks, zeroings) or left out before the fit."""
    if ratio != 1:  # explains a wrong scale of the acceleration too
        mistakes = [each for each in mistakes if each.code not in ("clock_rate", "wrench_compensated")]
        mistakes.append(Finding.of("clocks_differ", ratio=ratio))
    zeroed = [Finding.of("zeroed", at_s=zeroed_at_s)] if len(zeroed_at_s) else []
    coarse = {"off_deg": np.degrees(coarse_rad), "share_percent": 100 * share}
    return [*mistakes, *zeroed, *([Finding.of("motion_coarse", **coarse)] if coarse_rad > _COARSE_RAD else [])]


def _on_one_clock(wrench: Stream, poses: Stream) -> tuple[tuple[Stream, Stream], float, float]:
    """Return both streams at one clock rate, the ratio of the original rates, and the delay of the wrench, s.

    Files of one recording begin and end within seconds of each other, so different rates show in their durations.
    """
    t_w, t_p = wrench[0], poses[0]
    delay_s, left = _coarse_delay(motion_rows(wrench, poses))
    best, limit = ((wrench, poses), 1.0, delay_s), _OTHER_RATE * left
    if left < _FOLLOWS:
        return best
    for ratio in float(np.ptp(t_w) / np.ptp(t_p)) * _RATIOS:
        alike = wrench, (t_w[0] + ratio * (t_p - t_p[0]), poses[1])
        with suppress(BadDataset):  # too short
            delay_s, left = _coarse_delay(motion_rows(*alike))
            if abs(ratio - 1) > _SAME_RATE and left < limit:
                best, limit = (alike, float(ratio), delay_s), left
    return best


def _coarse_delay(rows: MotionRows) -> tuple[float, float]:
    """Return the delay, s, at which a linear function of the motion explains the wrench best, and the median residual.

    Delays of whole numbers of rows are tried. The residual is relative to the standard deviation of each channel.
    """
    if len(rows) * rows.row_s < LEAST_S:
        raise BadDataset(f"only {len(rows) * rows.row_s:.1f} s of motion are free of gaps: record 20 s or more")
    index = np.round((rows.t_s - rows.t_s[0]) / rows.row_s).astype(np.int64)
    place = np.full(index[-1] + 1, -1)
    place[index] = np.arange(len(rows))
    features = np.column_stack([np.ones(len(rows)), rows.motion.columns()])
    y = rows.wrench / np.maximum(rows.wrench.std(axis=0), 1e-12)
    farthest = min(round(FARTHEST_S / rows.row_s), len(place) // 4)
    left = {}
    for shift in range(-farthest, farthest + 1):
        at = np.arange(max(shift, 0), min(len(place) + shift, len(place)))
        both = (place[at] >= 0) & (place[at - shift] >= 0)
        X, target = features[place[at - shift][both]], y[place[at][both]]
        if len(X) > 2 * features.shape[1]:
            residual = target - X @ np.linalg.lstsq(X, target, rcond=1e-9)[0]
            left[shift] = float(np.median(np.abs(residual)))
    best = min(left, key=lambda shift: left[shift], default=0)
    if not left or left[best] >= 0.8 * left[0]:
        return rows.delay_s, left.get(0, np.inf)
    return rows.delay_s + best * rows.row_s, left[best]


def _select_rows(rows: MotionRows, limit_rad_s: float) -> MotionRows:
    """Return the rows slower than a limit; raise `NotObservable` or `BadDataset` if they last less than 5 s."""
    if np.isinf(limit_rad_s):
        return rows
    slow = rows[rows.speed_rad_s < limit_rad_s]
    if len(slow) * rows.row_s < LEAST_S and limit_rad_s < SLOW_RAD_S:
        raise NotObservable(
            "the pose rate is too low for the motion, or the times do not belong to the poses, and the arm is at rest "
            f"for only {len(slow) * rows.row_s:.1f} s: record at 50 Hz or more, or rest for a second in each of six "
            "orientations"
        )
    if len(slow) * rows.row_s < LEAST_S:
        raise BadDataset(
            f"positions are missing, so only slow motion is usable, and it lasts {len(slow) * rows.row_s:.1f} s: give "
            "the position of the flange (x, y, z), or record a slower motion"
        )
    return slow


def _require_enough_motion(rows: MotionRows, best: MotionFit, known: Known | None) -> None:
    """Raise `NotObservable` if the mounting or the gravity force is so uncertain that a prediction would be useless."""
    mounting_rad = float(np.sqrt(np.diag(best.covariance)[:3].max()))
    weight_N = best.load.static.weight_N
    sigma_N = float(np.sqrt(np.diag(best.covariance)[3:6].max()))
    if mounting_rad < 0.3 and sigma_N < 0.5 * weight_N:
        return
    if known is not None:
        return  # with known values, only the verdict reports it
    observability = assess(_orientations(rows), best.load.static)
    if observability.ambiguities:
        reason = ": ".join(observability.ambiguities[:2])
        raise NotObservable(f"{reason}; turn wrist 1 and wrist 2 by 60° or more, wrist 3 too, and record again.")


def _unseen_covariance(rows: MotionRows, best: MotionFit, orientation_rad: float) -> Array:
    """Return the covariance (15, 15) due to errors that the motion does not show: of arm, mounts and a compliant tool.

    Smooth errors of the arm are part of the fit instead.
    """
    static, R = best.load.static, _orientations(rows)
    if orientation_rad == 0:
        return np.zeros((15, 15))
    sigma = best.sigma.mean(axis=0)[:, None]
    J, columns = ((each / sigma).reshape(6 * len(R), -1) for each in (jacobian(static, R), yielding_columns(static, R)))
    scale = np.linalg.norm(J, axis=0)
    moved = np.linalg.lstsq(J / scale, columns, rcond=1e-9)[0] / scale[:, None]
    return np.asarray(hidden_in_any_poses(static, orientation_rad) + moved @ moved.T)


def _orientations(rows: MotionRows) -> Array:
    return nearest_rotation(rows.motion.R_base_flange[:: max(1, len(rows) // JUDGED_ROWS)])


def _static_wrench(rows: MotionRows, best: MotionFit, weight_N: float) -> Array:
    """Return the wrench (n, 6), N and N·m, that the sensor would read at rest in the orientation of each row.

    If the fit is poor, the inertial wrench is that of the best linear function, whatever the axes and signs.
    """
    static = predict(best.load.static, nearest_rotation(rows.motion.R_base_flange)) + best.residuals
    kept = best.residuals[best.kept, :3]
    if float(np.sqrt(np.mean(np.sum(kept**2, axis=1)))) < 2 * USABLE_SHARE * weight_N:
        return np.asarray(static)
    return static_wrench(rows)[0]


def _static_estimate(rows: MotionRows, best: MotionFit, places: NDArray[np.intp]) -> Estimate:
    """Return the fit as an estimate from static poses: the rows at the indices `places`.

    The residual of each row is averaged over one second, because faster changes are vibration.
    """
    # An odd number of rows, so that the average is centred on the row.
    second = round(1 / rows.row_s / 2) * 2 + 1
    best = replace(best, residuals=_residual_means(best, second), sigma=best.sigma / np.sqrt(second))
    return Estimate.independent(
        best.load.static,
        best.covariance[:15, :15],
        nearest_rotation(rows.motion.R_base_flange[places]),
        _static_wrench(rows, best, best.load.static.weight_N)[places],
        best.sigma[places, :, None] ** 2 * np.eye(6),
        np.ones(len(places)),
        measured=False,
        second_basin_chi2=best.second_basin_chi2,
        components={name: size for name, size in best.components.items() if name.startswith(_SMOOTH)},
    )


def _residual_means(best: MotionFit, rows: int) -> Array:
    """Return residuals (n, 6), each averaged over the kept rows among the `rows` rows around it."""
    window, weight = np.ones(rows), best.kept.astype(np.float64)
    count = np.maximum(np.convolve(weight, window, "same"), 1.0)
    return np.stack([np.convolve(column * weight, window, "same") / count for column in best.residuals.T], axis=1)


def _motion_findings(
    rows: MotionRows,
    used: MotionRows,
    best: MotionFit,
    motion: MotionResult,
    height_m: float | None,
    *,
    positions: bool,
    is_coarse: bool = False,
) -> list[Finding]:
    """Return findings about delay, missing positions, height and contacts, which only a recording in motion has."""
    sigma, findings = np.sqrt(np.diag(best.covariance)), list[Finding]()
    if abs(motion.delay_s) > OFFSET_S and not is_coarse:  # rows at rest do not show a delay
        findings.append(Finding.of("clock_offset", delay_s=motion.delay_s))
    if not (positions or is_coarse):
        turned = np.linalg.norm(used.motion.Omega_rad2_s2, ord=2, axis=(1, 2))
        bound_N = best.load.mass_kg * REACH_M * float(np.sqrt(np.mean(turned**2)))
        share = len(used) / max(len(rows), 1)
        findings.append(Finding.of("positions_missing", share_percent=100 * share, force_N=bound_N))
    elif (
        positions
        and height_m is not None
        and abs(best.load.height_m - height_m) > max(5 * sigma[HEIGHT], WRONG_HEIGHT_M)
    ):
        values = {"height_mm": 1e3 * best.load.height_m, "sigma_mm": 1e3 * sigma[HEIGHT]}
        findings.append(Finding.of("height_differs", **values, configured_mm=1e3 * height_m))
    if motion.contacts:
        share = sum(contact["duration_s"] for contact in motion.contacts) / max(len(used) * used.row_s, 1e-9)
        largest_N = max(contact["force_N"] for contact in motion.contacts)
        values = {"count": len(motion.contacts), "share_percent": 100 * share, "force_N": largest_N}
        findings.append(Finding.of("mostly_contact" if share > MOSTLY else "contacts_left_out", **values))
    weak = best.prior_share > MEASURED
    weak[:6] &= sigma[INERTIA] > 0
    if positions and weak.any():
        findings.append(Finding.of("motion_slow", names=_format_names([NAMES[k] for k in np.flatnonzero(weak)])))
    return findings


def _without_zeroing(wrench: Stream, poses: Stream) -> tuple[tuple[Stream, Stream], Array]:
    """Return both streams with the final bias throughout, and the times at which the sensor was zeroed."""
    at_s, seen = find_zeroings(wrench)
    if len(at_s):
        steps = fit_bias_steps(motion_rows(wrench, poses), at_s)
        staying = are_bias_steps(steps, seen)
        at_s, steps = at_s[staying], steps[staying]
    if len(at_s):
        wrench = without_steps(wrench, at_s, steps)
        rows = motion_rows(wrench, poses, _coarse_delay(motion_rows(wrench, poses))[0])
        wrench = without_steps(wrench, at_s, fit_bias_steps(rows, at_s))
    return (wrench, poses), at_s


def _find_mistakes(
    data: tuple[Stream, Stream], rows: MotionRows, known: Known | None, g_m_s2: float
) -> tuple[list[Finding], Correction]:
    """Find mistakes of signs, clock, axes and poses after aligning the delay; also return their correction."""
    free = fit_freely(rows, known, g_m_s2)
    for _ in range(2):
        if abs(free.load.delay_s) < ALIGNED_S:
            break
        delay_s = float(np.clip(rows.delay_s + free.load.delay_s, -FARTHEST_S, FARTHEST_S))
        rows = motion_rows(*data, delay_s, rows.row_s)
        free = fit_freely(rows, known, g_m_s2)
    spread_m = float(np.linalg.norm(np.ptp(data[1][1][:, 9:], axis=0)))
    return find_motion_mistakes(rows, free, spread_m) if abs(free.load.delay_s) < OFFSET_S else ([], unchanged)


def _other_wrench(used: MotionRows, aligned: MotionRows, best: MotionFit, named: Sequence[Finding]) -> list[Finding]:
    """Return a finding for a gravity-compensated wrench, or for one that does not follow the motion at all.

    `aligned` holds the rows at the fitted delay, because with wrong data that delay may be far from that of `used`.
    """
    X, y = np.column_stack([np.ones(len(aligned)), aligned.motion.columns()]), aligned.wrench[:, :3]
    linear, _, rank, _ = np.linalg.lstsq(X, y, rcond=1e-9)
    variance = np.mean((y - X @ linear) ** 2) * len(X) / max(len(X) - rank, 1)
    weight_N, mass_kg = (float(np.linalg.norm(linear[part]) / np.sqrt(3)) for part in (slice(1, 10), slice(10, 13)))
    sigma_kg = float(np.sqrt(max(np.trace(np.linalg.pinv(X.T @ X)[10:13, 10:13]) * variance, 0.0)))
    follows = variance < _UNEXPLAINED**2 * np.mean(y.var(axis=0))
    light = weight_N < COMPENSATED * mass_kg * best.load.g_m_s2
    if follows and light and mass_kg > SIGNIFICANT_SIGMAS * sigma_kg:
        return [Finding.of("wrench_compensated", "reject", weight_N=weight_N, mass_kg=mass_kg)]
    change = used.wrench[best.kept, :3].var(axis=0)
    left = float(np.sqrt(np.mean(best.residuals[best.kept, :3] ** 2) / np.mean(change)))
    if left > _UNEXPLAINED and not any(finding.code in OF_AXES for finding in named):
        return [Finding.of("other_recording", left_percent=100 * min(left, 1.0))]
    return []


def _narrow_findings(rows: MotionRows, best: MotionFit, *, explained: bool) -> list[Finding]:
    """Return a finding if the range of motion is too small, or if a large uncertainty has no other explanation."""
    sigma, range_deg = np.sqrt(np.diag(best.covariance)), _range_deg(rows)
    error = Calibrated(best.load.static, best.covariance[:15, :15]).predicted_error()[0]
    error /= max(best.load.static.weight_N, 1e-9)
    if range_deg >= NARROW_DEG and (explained or error < USABLE_SHARE):
        return []
    severity: Severity = "reject" if error > REJECTED_SHARE else "limit"
    mounting_deg = min(float(np.degrees(sigma[:3].max())), 180.0)
    values = {"range_deg": range_deg, "mounting_deg": mounting_deg, "weight_N": sigma[3:6].max()}
    return [Finding.of("motion_narrow", severity, **values)]


def _range_deg(rows: MotionRows) -> float:
    """Return twice the largest angle between the mean orientation and the others, deg; at most 360."""
    R = _orientations(rows)
    turned = np.einsum("ji,njk->nik", nearest_rotation(R.mean(axis=0)), R)
    cosine = np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return float(min(2 * np.degrees(np.arccos(cosine)).max(), 360.0))


def _contacts(rows: MotionRows, best: MotionFit, first_s: float) -> tuple[Mapping[str, float], ...]:
    """Return the contacts: runs of rows left out, without the rows that only filter or margin added."""
    force, torque = (np.where(best.kept, 0.0, np.linalg.norm(best.residuals[:, k : k + 3], axis=1)) for k in (0, 3))
    half = round(0.5 / rows.row_s)
    largest = (sliding_window_view(np.pad(each, half), 2 * half + 1).max(axis=1) for each in (force, torque))
    strong = [each > most / 2 for each, most in zip((force, torque), largest, strict=True)]
    touched = np.flatnonzero((strong[0] | strong[1]) & ~best.kept)
    contacts = []
    for within in np.split(touched, np.flatnonzero(np.diff(touched) > 1) + 1) if len(touched) else []:
        start_s, end_s = rows.t_s[within[0]] - rows.row_s / 2, rows.t_s[within[-1]] + rows.row_s / 2
        contacts.append(
            {
                "t_s": float(start_s - first_s),
                "duration_s": float(end_s - start_s),
                "force_N": float(force[within].max()),
                "torque_Nm": float(torque[within].max()),
            }
        )
    return tuple(contacts)


def _format_names(names: Sequence[str]) -> str:
    axes = [name.partition(".")[2] for name in names if name.startswith("inertia")]
    rest = [name.removesuffix("_m").removesuffix("_s") for name in names if not name.startswith("inertia")]
    return ", ".join(([f"the inertia ({', '.join(axes)})"] if axes else []) + [f"the {name}" for name in rest])
