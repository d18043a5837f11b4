"""The sections of a report in reading order: sentences, tables and figures from its facts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Any

import numpy as np

from ftcalib.motion.model import INERTIA_NAMES
from ftcalib.rounding import to_place_of, with_sigma
from ftcalib.shown import values_of
from ftdrive.report.facts import label_of
from ftdrive.report.subject import MAY_BE_MISSING
from ftdrive.words.result import SIGMA_OF_THE_TOOL, estimate_rows

Facts = Mapping[str, Any]

# A pose is suspicious if its rms residual over the six channels, in sigmas, is larger. So is 1 good pose in 1000.
SUSPICIOUS_SIGMAS = 1.9
_AXES = "xyz"
# A channel whose drift has a sigma below this, N or N·m, is regarded as free of drift.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class ReportTable:
    """A table of texts; the first cell of each row is its heading."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: bool = False
    """Whether a page hides the table until the reader opens it, because it is long."""

    @property
    def narrow(self) -> bool:
        """Whether the table has few enough columns to fit next to a figure."""
        return 2 < len(self.columns) <= 4


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a report: its name, text alternative, and caption, which explains what a good result looks like."""

    name: str
    alt: str
    caption: str


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report; `name` is its anchor in the page."""

    name: str
    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[ReportTable] = ()


def rounded(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits and without an exponent; None becomes "-"."""
    if value is None:
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(places, 9)}f}"


def capitalized(words: str) -> str:
    """Return a text with its first letter capitalized."""
    return words[:1].upper() + words[1:]


def shown_poses(poses: Sequence[Any], most: int = 200) -> list[Any]:
    """Return the poses to list and draw: all, or if there are more than `most`, the worst and evenly spaced others."""
    if len(poses) <= most:
        return list(poses)
    size = np.array([pose["sigmas"] or pose["force_N"] for pose in poses])
    worst = np.argsort(-size)[: most // 4]
    even = np.linspace(0, len(poses) - 1, most - len(worst)).astype(int)
    return [poses[row] for row in np.unique([*worst, *even])]


def estimates_section(facts: Facts) -> Section:
    """Return the section with the estimates, their correlations, and, if estimated, gain and cross-talk."""
    result, strong = facts["result"], facts["correlation"]["strong"]
    taken = "poses" if facts["motion"] is None else "parts of the motion"
    pairs = "; ".join(f"{label_of(one)} and {label_of(other)} {value:+.2f}" for one, other, value in strong[:5])
    text = [
        f"Method {result['method']}, {result['n_poses']} {taken}, gravity {result['g_m_s2']:g} m/s². Wrenches act on "
        "the sensor, in its axes, about its origin. Centre of mass and biases are in sensor axes.",
        f"Strongest correlations: {pairs}." if pairs else "No two parameters have a correlation above 0.7.",
    ]
    figure = Figure(
        "correlation",
        f"Matrix of the correlations of the 15 estimated parameters. {text[1]}",
        "Correlation of the estimates. Good: faint except on the diagonal. A strong colour elsewhere means that the "
        "poses hardly separate two parameters: add other orientations.",
    )
    rows = [(name, value, sigma) for _, _, name, _, value, sigma in estimate_rows(result)]
    tables = [ReportTable("", ("quantity", "estimate", "± 1 sigma"), rows)]
    if facts["mass"] is not None:
        text.append(f"Sigma: {SIGMA_OF_THE_TOOL}. Mass as read: {facts['mass']}.")
    if result["response"] is not None:
        columns = ("entry", "value", "± 1 sigma")
        rows = list(_response_rows(result["response"]))
        tables.append(ReportTable("Gain and cross-talk of the sensor", columns, rows, folded=True))
    return Section("estimates", "Estimates", text, [figure], tables)


def _response_rows(response: Facts) -> Iterator[tuple[str, str, str]]:
    kinds = (("force_gain", 100, "%", "force gain"), ("cross_talk_m", 1e3, "mN·m/N", "cross-talk"))
    for (key, scale, unit, label), (i, j) in product(kinds, combinations_with_replacement(range(3), 2)):
        value, sigma = (scale * one[key][i][j] for one in (response, response["sigma"]))
        yield f"{label} {_AXES[i]}{_AXES[j]}, {unit}", *_pair(value, sigma)


def _pair(value: float, sigma: float, sign: str = "") -> tuple[str, str]:
    return to_place_of(value, sigma, sign), to_place_of(sigma, sigma)


def error(facts: Facts) -> Section:
    """Return the section with the predicted compensation error over all orientations, and the worst orientation."""
    force, torque = facts["error_map"]["force_N"], facts["error_map"]["torque_Nm"]
    text = [
        f"Compensation error of a free tool at the next use: {facts['error']['words']}.",
        f"Its source: {facts['error']['source']}.",
        f"Worst direction of the tool axis for the force: {force['words']}, {rounded(force['largest'])} N.",
        f"Worst direction for the torque: {torque['words']}, {rounded(torque['largest'])} N·m.",
    ]
    trust = (
        "The map only shows the stated uncertainty: the error above also includes model errors."
        if facts["error"]["cross_validated"]
        else "The measured noise explains the residuals, so the map can be trusted."
    )
    figures = [
        Figure(
            f"{kind}_map",
            f"Map of the predicted {kind} error over the directions of the tool axis, "
            f"{rounded(float(np.min(one['map'])))} to {rounded(one['largest'])} {unit}, largest {one['words']}.",
            f"Predicted {kind} error (one sigma, worst turn of the tool about its axis) for each direction of the tool "
            "axis (flange z) in base. Dots: poses. Cross: worst direction. Good: one colour, and every value below "
            f"the contact {kind} that you need to measure. {trust}",
        )
        for kind, one, unit in (("force", force, "N"), ("torque", torque, "N·m"))
    ]
    rows = [
        (name, rounded(one["rms"]), rounded(one["largest"]), one["axes"])
        for name, one in (("force, N", force), ("torque, N·m", torque))
    ]
    caption = "Predicted error, one sigma: rms over all orientations, and largest"
    columns = ("error", "rms", "largest", "tool axis at the largest, in base")
    return Section(
        "error", "Compensation error over all orientations", text, figures, [ReportTable(caption, columns, rows)]
    )


def contact(facts: Facts) -> Section:
    """Return the section with the standard deviation of a contact force, which includes the sensor's errors."""
    found = facts["contact"]
    text = [
        "The compensation error above applies to a free tool. Under contact, the errors of the sensor are added; they "
        "increase with the force.",
        f"{found['words']}.",
    ]
    if found["source"] != "loads":
        text.append("To measure these errors, hang known weights: `ftdrive loads`.")
    if (tool := found["tool"]) is not None:
        com = ", ".join(f"{1e3 * value:.1f}" for value in tool["p_sensor_com_m"])
        text.append(
            f"Corrected for sensor errors, the tool weighs {tool['mass_kg']:.4f} kg, with its centre of mass at "
            f"({com}) mm in sensor axes."
        )
    near, far = found["sigma_N"][0], found["sigma_N"][-1]
    without = ""
    if found["without_loads_N"] is not None:
        without = f" Without known loads it would be {rounded(found['without_loads_N'][-1])} N."
    figure = Figure(
        "contact",
        f"Line of the sigma of a force at the tip: {rounded(near)} N without contact, {rounded(far)} N at "
        f"{found['force_N'][-1]:g} N.{without}",
        "Sigma of a force at the tip of the tool, as the norm of its error. Good: below the accuracy that your "
        f"contact task needs.{without}",
    )
    return Section("contact", "Error under contact", text, [figure])


def cross_validation(facts: Facts) -> Section:
    """Return the section with the leave-one-out error of each calibration method."""
    found = facts["cross_validation"]
    text = []
    if found["force_N"] is not None:
        text.append(
            f"Each pose predicted from all others: {rounded(found['force_N'])} N, {rounded(found['torque_Nm'])} N·m "
            "rms. Good: well below the contact that you need to measure."
        )
    if found["reason"]:
        text.append(f"The methods are not compared. {found['reason']}")
        return Section("cross-validation", "Cross-validation", text)
    solved = [one for one in found["methods"] if "reason" not in one]
    errors = {"residual": "residual", "cross_validated": "left out"}
    rows = [
        (
            one["method"],
            rounded(one["mass_kg"], 4),
            f"{math.degrees(one['rotation_difference_rad']):.2f}",
            *(rounded(one[kind][key]) for kind in errors for key in ("force_rms_N", "torque_rms_Nm")),
        )
        for one in solved
    ]
    of_errors = (f"{words}, {unit}" for words in errors.values() for unit in ("N", "N·m"))
    columns = ("method", "mass, kg", "mounting differs, °", *of_errors)
    tables = [ReportTable("Methods on the same poses", columns, rows)]
    if missing := [(one["method"], one["reason"]) for one in found["methods"] if "reason" in one]:
        tables.append(ReportTable("Methods without a result", ("method", "reason"), missing, folded=True))
    crossed = [one for one in solved if one["cross_validated"]["force_rms_N"]]
    best = min(crossed, key=lambda one: float(one["cross_validated"]["force_rms_N"]), default=None)
    figure = Figure(
        "methods",
        "Bars of the cross-validated force and torque error of each method"
        + (f"; {best['method']} has the smallest force error." if best else "."),
        "Error in predicting each pose from all others, by method, logarithmic. Good: the method of this result "
        "(orange) has one of the shortest bars. Methods with a known mounting fail for another mounting.",
    )
    return Section("cross-validation", "Cross-validation", text, [figure] if crossed else [], tables)


def residuals(facts: Facts) -> Section:
    """Return the section with the residuals per pose and over time; for a calibration in motion, per part of it."""
    result, poses, in_motion = facts["result"], facts["poses"], facts["motion"] is not None
    text = [
        f"Residuals: {facts['residuals']}.",
        f"They are {result['noise_factor']:.2f} times the measured noise (p = {_p_value_in_words(result['p_value'])})."
        if result["p_value"] is not None
        else "The noise was not measured but estimated from the residuals, so their size does not test the fit.",
    ]
    if result["rejected_poses"]:
        names = ", ".join(poses[row - 1]["name"] for row in result["rejected_poses"])
        text.append(f"Rejected, because they do not fit the others: pose {names}.")
    known = [] if in_motion else [pose for pose in poses if pose["sigmas"] is not None]
    figures = []
    if known:
        worst = max(known, key=lambda pose: float(pose["sigmas"]))
        figures.append(
            Figure(
                "pose_residuals",
                f"Bars of the cross-validated residual of each pose in sigma; the largest is {worst['sigmas']:.1f} at "
                f"pose {worst['name']}.",
                "Residual of each pose predicted from others, in sigma. Good: bars of about 1, none above the dashed "
                f"line at {SUSPICIOUS_SIGMAS:g}. Repeat a pose above it. Hatched: rejected.",
            )
        )
    timed = in_motion or all(pose["t_s"] is not None for pose in poses)
    order = "time" if timed else "the order of the poses"
    figures.append(
        Figure(
            "time_residuals",
            f"Force and torque residuals along x, y and z against {order}.",
            f"Measured minus predicted wrench, drift included, against {order}. "
            "Good: a scatter about zero. A slope or slow wave is drift; an outlier is contact or a cable.",
        )
    )
    rows = [
        (
            pose["name"],
            "-" if pose["t_s"] is None else f"{pose['t_s']:.0f}",
            *(f"{value:.3f}" for value in pose["residual"][:3]),
            *(f"{1e3 * value:.1f}" for value in pose["residual"][3:]),
            rounded(pose["sigmas"], 2),
            "yes" if pose["used"] else "no",
        )
        for pose in shown_poses(poses)
    ]
    columns = ("pose", "t, s", *(f"F{a}, N" for a in _AXES), *(f"T{a}, mN·m" for a in _AXES), "sigma", "used")
    few = "" if len(rows) == len(poses) else f" ({len(rows)} of {len(poses)} poses, including the worst)"
    tables = [] if in_motion else [ReportTable(f"Table of the residuals{few}", columns, rows, folded=True)]
    return Section("residuals", "Residuals", text, figures, tables)


def drift(facts: Facts) -> Section:
    """Return the section with the fitted drift of the bias, and the change of the first pose when repeated."""
    seen = facts["drift"]
    found, again = seen["in_fit"], seen["first_pose_again"]
    text = []
    if again is not None:
        text.append(f"{capitalized(again['words'])}.")
    if seen["lag1"] is not None:
        text.append(f"Correlation of successive residuals: {seen['lag1']:.2f}. Good: near 0. Drift increases it.")
    tables = tuple[ReportTable, ...]()
    if found is None:
        text.append("The fit found no drift of the bias.")
    else:
        model = "random walk" if any(name.startswith("walk") for name in seen["components"]) else "linear"
        text.append(f"The fit includes a drift of the bias ({model}), listed below. Good: within 3 sigma.")
        rows = []
        for k, (change, sigma) in enumerate(zip(found["change"], found["sigma"], strict=True)):
            unit, scale = (("N", 1.0), ("mN·m", 1e3))[k // 3]
            shown = ["-", "-", "-"]
            if sigma > _ROUNDING:
                shown = [*_pair(scale * change, scale * sigma, "+"), f"{change / sigma:+.1f}"]
            rows.append((f"{'FT'[k // 3]}{_AXES[k % 3]}, {unit}", *shown))
        columns = ("channel", "change of the bias", "± 1 sigma", "in sigma")
        tables = (ReportTable("Bias at the last pose minus bias at the first", columns, rows),)
    if seen["in_use"] is not None:
        text.append(f"{capitalized(seen['in_use'])}. Tare before use.")
    return Section("drift", "Drift", text, (), tables)


def noise(facts: Facts) -> Section:
    """Return the section with the standard error of the mean wrench at each pose."""
    measured = facts["noise"]
    if measured is None:
        why = "The source contains no noise of its poses: add columns sigma_fx to sigma_tz, or calibrate with ftdrive."
        return Section("noise", "Noise of each pose", [why])
    force, torque = np.array(measured["force_N"]), np.array(measured["torque_Nm"])
    text = [
        f"Standard error of the mean of one axis, median over the poses: {rounded(float(np.median(force)))} N, "
        f"{rounded(float(np.median(torque)))} N·m. Largest: {rounded(float(force.max()))} N, "
        f"{rounded(float(torque.max()))} N·m."
    ]
    if measured["unsteady"]:
        stops = ", ".join(map(str, measured["unsteady"]))
        text.append(f"Not steady while averaged: stop {stops}. Something swung there or was touched.")
    figure = Figure(
        "noise",
        f"Noise of the mean at each pose, {rounded(float(force.min()))} to {rounded(float(force.max()))} N.",
        "Noise of the mean wrench at each pose (one axis, one sigma). Good: bars of similar height. A pose far above "
        "the others swung, was touched, or was averaged over too few samples.",
    )
    return Section("noise", "Noise of each pose", text, [figure])


def coverage(facts: Facts) -> Section:
    """Return the section with the directions of gravity covered by the poses."""
    found, title = facts["coverage"], "Coverage of orientations"
    if found is None:
        return Section("coverage", title, ["The calibration file contains no orientations: report its run folder."])
    gap_deg = math.degrees(found["largest_gap_rad"])
    text = [
        capitalized(found["words"]),
        f"{found['orientations']} different orientations (24 or more count as 24) determine {found['rank']} of 15 "
        "parameters.",
        f"Largest gap: {gap_deg:.0f}° around the direction {found['gap_words']}.",
    ]
    figure = Figure(
        "coverage",
        f"Map of the directions of gravity in flange axes; the largest gap has a radius of {gap_deg:.0f}°.",
        "Direction of gravity in flange axes at each pose. Good: dots in all parts of the map. The circle is the "
        f"largest gap, {gap_deg:.0f}°; the 24 orientations of the paper have a gap of 55°.",
    )
    return Section("coverage", title, text, [figure])


# Differences above this number of sigmas are marked; by chance, 1 in 370 is larger.
LIMIT_SIGMAS = 3
# Quantities whose sigmas a plan predicts: name with unit, factor to this unit, and key in the plan and the result.
_PREDICTED = (
    ("mass, g", 1e3, "mass_kg"),
    ("centre of mass, mm", 1e3, "p_sensor_com_m"),
    ("force bias, N", 1.0, "force_bias_N"),
    ("torque bias, N·m", 1.0, "torque_bias_Nm"),
    ("force compensation, N", 1.0, "force_rms_N"),
    ("torque compensation, N·m", 1.0, "torque_rms_Nm"),
)
# The report names sigmas that exceed those predicted by the plan by more than this factor.
_AS_PREDICTED = 1.2
_AS_GOOD = "No sigma is more than 20 % larger than predicted."
_WHY_LARGER = "Noise or errors of this sensor are larger than the plan assumed."
# Two results of one tool are reported as different if the p-value of the joint test is below this.
CHANGED_P = 1e-3


def tour(facts: Facts) -> Section:
    """Return the section with the run, the plan, the devices and the settings."""
    run, title = facts["tour"], "Tour and settings"
    if run is None:
        return Section("tour", title, ["The source is not a run folder, so it contains no plan, devices or settings."])
    started = f"{str(run['created_utc'])[:19]} UTC"
    text = [f"Run {run['run']}, started {started}, mode {run['mode']}, {run['stops']} stops."]
    keys = ("model", "serial", "firmware")
    devices = [(name, *(str(one.get(key, "-")) for key in keys)) for name, one in run["devices"].items()]
    tables = [
        ReportTable("Devices", ("device", *keys), devices),
        ReportTable("Settings", ("setting", "value"), list(_flattened(run["config"])), folded=True),
    ]
    plan = run["plan"]
    if plan is None:
        text.append(run["plan_error"] or "The poses were chosen by hand, without a plan.")
        return Section("tour", title, text, (), tables)
    text += plan["why"]
    if "sweep" in plan:
        text.append(f"Proven clear along the whole curve, clearance at least {plan['min_clearance_mm']:.0f} mm.")
        return Section("tour", title, text, (), tables)
    proven = "all" if plan["certified"] else "NOT all"
    text.append(
        f"{plan['poses']} poses, {plan['motion_time_s']:.0f} s of motion, no move above {plan['max_move_deg']:.0f}°, "
        f"{proven} proven clear, clearance at least {plan['min_clearance_mm']:.0f} mm."
    )
    rows, larger = [], []
    obtained = facts["result"]["sigma"] | facts["result"]["predicted_error"]
    for name, scale, key in _PREDICTED:
        expected, got = _largest_size(plan["predicted_sigma"].get(key)), _largest_size(obtained[key])
        rows.append((name, rounded(scale * expected, 2), rounded(scale * got, 2)))
        if got > _AS_PREDICTED * expected:
            larger.append(f"{name.partition(',')[0]} ({got / expected:.2g} times)")
    text.append(f"Larger sigma than predicted: {', '.join(larger)}. {_WHY_LARGER}" if larger else _AS_GOOD)
    caption = "One sigma, predicted by the plan for a typical sensor, and obtained"
    return Section("tour", title, text, (), [ReportTable(caption, ("sigma", "predicted", "obtained"), rows), *tables])


def _largest_size(values: Any) -> float:
    return float(np.max(np.array(values, dtype=np.float64)))


def comparison(facts: Facts) -> Section:
    """Return the section with the differences from the parent, an earlier result."""
    found, title = facts["comparison"], "Comparison with the previous result"
    if found is None:
        why = facts["compared_with"] or "There is no result to compare with: give one with --parent."
        return Section("comparison", title, [why])
    text = [
        f"Compared with {facts['compared_with']}: id {found['id']}, {found['verdict']}, mass {found['mass_kg']:.4f} kg."
    ]
    before, now = found["sensors"]
    if before != now:
        text.append(
            f"Errors of the sensor under contact: {before} before, {now} now. The same contact now reads differently."
        )
    if found["same_data"]:
        text.append(
            "Both results use the same data, so the test below, which assumes independent noise, does not apply."
        )
    else:
        changed = [one["name"] for one in found["groups"][:-1] if one["p_value"] < CHANGED_P]
        text.append(f"Significant changes: {', '.join(changed)}." if changed else "No significant change.")
        text.append("A bias may change from day to day; any other change means another tool or mounting.")
    groups = [
        (one["name"], f"{one['chi2']:.4g}", str(one["dof"]), _p_value_in_words(one["p_value"]))
        for one in found["groups"]
    ]
    rows = [
        (label_of(one["name"]), f"{one['change']:+.2g}", "-" if one["sigmas"] is None else f"{one['sigmas']:+.1f}")
        for one in found["parameters"]
    ]
    figure = Figure(
        "comparison",
        "Bars of the difference of each parameter in sigma.",
        "This result minus the previous one, in sigma of the difference; beyond the dashed lines at "
        f"{LIMIT_SIGMAS} the scale is logarithmic. Good: bars within them, except for the biases.",
    )
    tables = [
        ReportTable("Joint test of each group", ("group", "chi2", "dof", "p"), groups),
        ReportTable("Differences (rad, N, m, N·m)", ("parameter", "difference", "in sigma"), rows, folded=True),
    ]
    return Section("comparison", title, text, [figure], tables)


def provenance(facts: Facts) -> Section:
    """Return the section with the origin of the result, and how to reproduce it."""
    text = [f"Report of {facts['source']}, written {facts['created_utc']}. Calibration id {facts['id']}."]
    if facts["reproduce"]:
        text.append(f"Reproduce the result: `{facts['reproduce']}`. The id must be {facts['id']}.")
    else:
        text.append("The file contains no data: solve the dataset with the hash below to reproduce the result.")
    text += _last_verification(facts["trust"] or {})
    rows, columns = list(_flattened(facts["result"]["provenance"])), ("field", "value")
    long = [row for row in rows if row[0].startswith(("devices.", "station."))]
    tables = [ReportTable("", columns, [row for row in rows if row not in long])]
    tables += [ReportTable("Devices", columns, long, folded=True)] if long else []
    return Section("provenance", "Provenance and how to reproduce the result", text, (), tables)


def _last_verification(trust: Facts) -> Iterator[str]:
    if last := trust.get("last_verification"):
        outcome = "passed" if last["passed"] else "FAILED"
        yield f"Last verification {last['created_utc'][:16]} UTC, {outcome}: {last['reason']}. File {last['path']}."
    if trust.get("store_error"):
        yield f"{capitalized(MAY_BE_MISSING.format(trust['store_error']))}."


def motion(facts: Facts) -> Section:
    """Return the section with what only a calibration in motion determines, such as inertia, and the planned sweep."""
    found = facts["motion"]
    sigma = found["sigma"]
    moments, of_moments = (np.array(values) for values in (found["inertia_kg_m2"], sigma["inertia_kg_m2"]))
    principal = np.linalg.eigvalsh(moments)
    text = [
        f"{100 * found['used_share']:.0f} % of the recording was used. Not used: contacts, gaps, both ends (needed by "
        "the filter), and fast motion with unknown position.",
        f"Delay of the wrench relative to the pose: {with_sigma(1e3 * found['delay_s'], 1e3 * sigma['delay_s'])} ms.",
        f"The origin of the sensor is {with_sigma(1e3 * found['height_m'], 1e3 * sigma['height_m'])} mm above the "
        "flange face, determined from the acceleration.",
        f"Principal moments of inertia about the centre of mass: {', '.join(rounded(1e3 * one) for one in principal)} "
        "g·m². Good: all positive, and each at most the sum of the others.",
    ]
    entries = (1e3 * values_of(one, "inertia_kg_m2") for one in (moments, of_moments))
    rows = [(axes, f"{value:.3f}", f"{sigma:.3f}") for axes, value, sigma in zip(INERTIA_NAMES, *entries, strict=True)]
    tables = [
        ReportTable("Inertia about the centre of mass, sensor axes, g·m²", ("axes", "estimate", "± 1 sigma"), rows)
    ]
    keys, columns = ("duration_s", "force_N", "torque_Nm"), ("at, s", "for, s", "force, N", "torque, N·m")
    touches = [(f"{one['t_s']:.1f}", *(rounded(one[key], 2) for key in keys)) for one in found["contacts"]]
    if touches:
        tables.append(ReportTable("Contacts, which were left out", columns, touches))
    else:
        text.append("No contact was detected.")
    if found["sweep"] is None:
        return Section("motion", "Motion", text, (), tables)
    figure = Figure(
        "sweep",
        f"Angles of the three wrist joints against time in the planned sweep of {found['sweep']['duration_s']:.0f} s.",
        "The planned sweep: wrist joints against time at the planned speed. It begins and ends at rest.",
    )
    return Section("motion", "Motion", text, [figure], tables)


def sections_of(facts: Mapping[str, Any]) -> list[Section]:
    """Return the sections of a report in reading order; a section without data says why.

    A calibration in motion has no poses, and therefore no sections about single poses.
    """
    in_motion = facts["motion"] is not None
    return [
        estimates_section(facts),
        error(facts),
        contact(facts),
        *([motion(facts)] if in_motion else [cross_validation(facts)]),
        residuals(facts),
        *([] if in_motion and facts["drift"]["in_fit"] is None else [drift(facts)]),
        *([] if in_motion else [noise(facts)]),
        coverage(facts),
        tour(facts),
        comparison(facts),
        provenance(facts),
    ]


def _p_value_in_words(p_value: float) -> str:
    return "< 0.0001" if p_value < 1e-4 else f"{p_value:.2g}"


def _flattened(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flattened(inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _value_text(inner)


def _value_text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(_value_text, value))
    return "-" if value is None else str(value)
