"""The sections of a report: every sentence, table and caption, from the facts alone."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ftdrive.report.document import Figure, Section, Table
from ftdrive.terminal.report import QUANTITIES, decimals, values_of

Facts = Mapping[str, Any]

SUSPICIOUS_SIGMAS = 1.9
"""One good pose in 1000 deviates more, in root mean square over the six channels."""
CHANGED_P = 1e-3
"""Two results of one tool differ more than this by chance in one case of 1000."""
_ROUNDED = 1e-9
_AXES = "xyz"
_LABELS = {
    "R_flange_sensor": "mounting",
    "gravity_force_base_N": "weight",
    "force_bias_N": "force bias",
    "p_sensor_com_m": "centre of mass",
    "torque_bias_Nm": "torque bias",
}


def sections_of(facts: Facts) -> list[Section]:
    """Write the sections in the order in which a reader needs them; one without data says why it is empty."""
    return [
        _estimates(facts),
        _error(facts),
        _cross_validation(facts),
        _residuals(facts),
        _drift(facts),
        _noise(facts),
        _coverage(facts),
        _tour(facts),
        _comparison(facts),
        _provenance(facts),
    ]


def label_of(parameter: str) -> str:
    """Name an error coordinate, such as "force bias x" for "force_bias_N.x"."""
    name, _, axis = parameter.partition(".")
    return f"{_LABELS[name]} {axis}"


def rounded(value: float | None, digits: int = 3) -> str:
    """Write a number with this many significant digits, without an exponent; "-" for None."""
    if value is None:
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(places, 9)}f}"


def in_words(p_value: float) -> str:
    """Write a probability."""
    return "< 0.0001" if p_value < 1e-4 else f"{p_value:.2g}"


def _estimates(facts: Facts) -> Section:
    result, strong = facts["result"], facts["correlation"]["strong"]
    pairs = "; ".join(f"{label_of(one)} and {label_of(other)} {value:+.2f}" for one, other, value in strong[:5])
    text = [
        f"Method {result['method']}, {result['n_poses']} poses, gravity {result['g_m_s2']:g} m/s². Wrenches are on the "
        "sensor, in its axes, about its origin. Centre of mass and biases are in sensor axes.",
        f"Strongest correlations: {pairs}." if pairs else "No two parameters are correlated by more than 0.7.",
    ]
    figure = Figure(
        "correlation",
        f"Matrix of the correlations of the 15 estimated parameters. {text[1]}",
        "Correlation of the estimates. Good: pale everywhere beside the diagonal. A dark field means that the poses "
        "hardly separate two parameters: add other orientations.",
    )
    tables = [Table("Estimates", ("quantity", "estimate", "± 1 sigma"), list(_estimate_rows(result)))]
    if result["response"] is not None:
        tables.append(Table("Gain and cross-talk of the sensor", ("entry", "value", "± 1 sigma"), _response(result)))
    return Section("estimates", "Estimates", text, [figure], tables)


def _estimate_rows(result: Facts) -> Iterator[tuple[str, str, str]]:
    fixed_below = _ROUNDED * float(np.sqrt(np.diag(result["covariance"]).max()))
    for label, scale, unit, key in QUANTITIES:
        values, sigmas = (values_of(source[key], key) * scale for source in (result, result["sigma"]))
        fixed = sigmas <= fixed_below * scale
        digits = 4 if fixed.all() else decimals(float(sigmas[~fixed].min()))
        for axis, value, sigma, known in zip(_AXES, values, sigmas, fixed, strict=False):
            name = f"{label} {axis}, {unit}" if len(values) > 1 else f"{label}, {unit}"
            yield name, f"{value:.{digits}f}", "fixed" if known else f"{sigma:.{digits}f}"


def _response(result: Facts) -> list[tuple[str, str, str]]:
    kinds = (("force_gain", 100, "%", "force gain"), ("cross_talk_m", 1e3, "mN·m/N", "cross-talk"))
    return [
        (
            f"{label} {_AXES[i]}{_AXES[j]}, {unit}",
            f"{scale * result['response'][key][i][j]:.2f}",
            f"{scale * result['response']['sigma'][key][i][j]:.2f}",
        )
        for key, scale, unit, label in kinds
        for i in range(3)
        for j in range(i, 3)
    ]


def _error(facts: Facts) -> Section:
    force, torque = facts["error_map"]["force_N"], facts["error_map"]["torque_Nm"]
    text = [
        f"Compensation error of a free tool: {facts['error']['words']}.",
        f"Worst direction of the tool axis for the force: {force['words']}, {rounded(force['largest'])} N.",
        f"Worst direction for the torque: {torque['words']}, {rounded(torque['largest'])} N·m.",
    ]
    trust = (
        "The map shows the stated uncertainty only: the cross-validated error above is larger."
        if "cross-validated" in facts["error"]["words"]
        else "The measured noise explains the residuals, so the map can be trusted."
    )
    figures = [
        Figure(
            f"{kind}_map",
            f"Map of the predicted {kind} error over the directions of the tool axis, "
            f"{rounded(float(np.min(one['map'])))} to {rounded(one['largest'])} {unit}, largest {one['words']}.",
            f"Predicted {kind} error (one sigma, worst turn of the tool about its axis) for each direction of the tool "
            "axis (flange z) in base. Dots: poses. Cross: worst direction. Good: one colour, and every value below "
            f"the contact {kind} that matters to you. {trust}",
        )
        for kind, one, unit in (("force", force, "N"), ("torque", torque, "N·m"))
    ]
    rows = [
        (name, rounded(one["rms"]), rounded(one["largest"]), one["words"])
        for name, one in (("force, N", force), ("torque, N·m", torque))
    ]
    columns = ("predicted error, 1 sigma", "rms over all orientations", "largest", "tool axis there")
    return Section("error", "Compensation error over all orientations", text, figures, [Table("", columns, rows)])


def _cross_validation(facts: Facts) -> Section:
    found = facts["cross_validation"]
    text = []
    if found["force_N"] is not None:
        text.append(
            f"Each pose predicted from all others: {rounded(found['force_N'])} N, {rounded(found['torque_Nm'])} N·m "
            "rms. Good: well below the contact that matters to you."
        )
    if found["reason"]:
        text.append(f"Methods are not compared. {found['reason']}")
        return Section("cross-validation", "Cross-validation", text)
    solved = [one for one in found["methods"] if "reason" not in one]
    rows = [
        (
            one["method"],
            rounded(one["mass_kg"], 4),
            f"{math.degrees(one['rotation_difference_rad']):.2f}",
            rounded(one["residual"]["force_rms_N"]),
            rounded(one["residual"]["torque_rms_Nm"]),
            rounded(one["cross_validated"]["force_rms_N"]),
            rounded(one["cross_validated"]["torque_rms_Nm"]),
        )
        for one in solved
    ]
    columns = (
        "method",
        "mass, kg",
        "mounting differs, °",
        "residual, N",
        "residual, N·m",
        "left out, N",
        "left out, N·m",
    )
    tables = [Table("Methods on the same poses", columns, rows)]
    if missing := [(one["method"], one["reason"]) for one in found["methods"] if "reason" in one]:
        tables.append(Table("Methods without a result", ("method", "reason"), missing, folded=True))
    crossed = [one for one in solved if one["cross_validated"]["force_rms_N"]]
    best = min(crossed, key=lambda one: float(one["cross_validated"]["force_rms_N"]), default=None)
    figure = Figure(
        "methods",
        "Bars of the cross-validated force and torque error of each method"
        + (f"; {best['method']} has the smallest force error." if best else "."),
        "Error in predicting each pose from all others, by method, logarithmic. Good: the method of this result "
        "(orange) has one of the shortest bars. Methods with a known mounting fail if the sensor is mounted otherwise.",
    )
    return Section("cross-validation", "Cross-validation", text, [figure] if crossed else [], tables)


def _residuals(facts: Facts) -> Section:
    result, poses = facts["result"], facts["poses"]
    sums = result["residual"]
    text = [
        f"Residuals: force {rounded(sums['force_rms_N'])} N rms, {rounded(sums['force_max_N'])} N at most; torque "
        f"{rounded(sums['torque_rms_Nm'])} N·m rms, {rounded(sums['torque_max_Nm'])} N·m at most.",
        f"They are {result['noise_factor']:.2f} times the measured noise (p = {in_words(result['p_value'])})."
        if result["p_value"] is not None
        else "The noise was not measured but estimated from the residuals, so their size does not test the fit.",
    ]
    if result["rejected_poses"]:
        names = ", ".join(poses[row - 1]["name"] for row in result["rejected_poses"])
        text.append(f"Rejected, because they do not fit the others: pose {names}.")
    known = [pose for pose in poses if pose["sigmas"] is not None]
    figures = []
    if known:
        worst = max(known, key=lambda pose: float(pose["sigmas"]))
        figures.append(
            Figure(
                "pose_residuals",
                f"Bars of the cross-validated residual of each pose in sigma; the largest is {worst['sigmas']:.1f} at "
                f"pose {worst['name']}.",
                "Residual of each pose if all others predict it, in sigma. Good: bars about 1, none above the dashed "
                f"line at {SUSPICIOUS_SIGMAS:g}. Repeat a pose above it. Hatched: rejected.",
            )
        )
    timed = all(pose["t_s"] is not None for pose in poses)
    figures.append(
        Figure(
            "time_residuals",
            f"Force and torque residuals along x, y and z against {'time' if timed else 'the order of the poses'}.",
            f"Measured minus predicted wrench, drift included, in the order of {'time' if timed else 'the rows'}. "
            "Good: a scatter about zero. A slope or slow wave is drift; one point far away is contact or a cable.",
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
    few = "" if len(rows) == len(poses) else f" ({len(rows)} of {len(poses)} poses, the worst among them)"
    return Section("residuals", "Residuals", text, figures, [Table(f"Residuals{few}", columns, rows, folded=True)])


def shown_poses(poses: Sequence[Any], most: int = 200) -> list[Any]:
    """Choose the poses to list and draw, in their order: all, or the worst quarter and evenly spread others."""
    if len(poses) <= most:
        return list(poses)
    size = np.array([pose["sigmas"] or pose["force_N"] for pose in poses])
    worst = np.argsort(-size)[: most // 4]
    even = np.linspace(0, len(poses) - 1, most - len(worst)).astype(int)
    return [poses[row] for row in np.unique([*worst, *even])]


def _drift(facts: Facts) -> Section:
    drift = facts["drift"]
    found, again = drift["in_fit"], drift["first_pose_again"]
    text = []
    if again is not None:
        text.append(f"{again['words'][0].upper()}{again['words'][1:]}.")
    if found is None:
        text.append("The fit found no drift of the bias.")
    else:
        model = "random walk" if any(name.startswith("walk") for name in drift["components"]) else "linear"
        text.append(f"The fit includes a drift of the bias ({model}), from the first pose to the last:")
    if drift["lag1"] is not None:
        text.append(
            f"Residuals of successive poses are correlated by {drift['lag1']:.2f}. Good: near 0. Drift makes it larger."
        )
    rows = [
        (f"{name}, {unit}", f"{scale * change:+.{digits}f}", f"{scale * sigma:.{digits}f}", f"{change / sigma:+.1f}")
        if sigma > 0
        else (f"{name}, {unit}", f"{scale * change:+.{digits}f}", "-", "-")
        for name, unit, scale, digits, change, sigma in (
            ()
            if found is None
            else (
                (f"{'FT'[k // 3]}{_AXES[k % 3]}", *(("N", 1.0, 3), ("mN·m", 1e3, 2))[k // 3], *pair)
                for k, pair in enumerate(zip(found["change"], found["sigma"], strict=True))
            )
        )
    ]
    columns = ("channel", "change of the bias", "± 1 sigma", "in sigma")
    return Section("drift", "Drift", text, (), [Table("Drift in the fit", columns, rows)] if rows else ())


def _noise(facts: Facts) -> Section:
    noise = facts["noise"]
    if noise is None:
        why = "The source states no noise of its poses: add columns sigma_fx to sigma_tz, or calibrate with ftdrive."
        return Section("noise", "Noise of each pose", [why])
    force, torque = np.array(noise["force_N"]), np.array(noise["torque_Nm"])
    text = [
        f"Standard error of the mean of one axis, median over the poses: {rounded(float(np.median(force)))} N, "
        f"{rounded(float(np.median(torque)))} N·m. Largest: {rounded(float(force.max()))} N, "
        f"{rounded(float(torque.max()))} N·m."
    ]
    if noise["unsteady"]:
        stops = ", ".join(map(str, noise["unsteady"]))
        text.append(f"Not steady while averaged: stop {stops}. Something swung or was touched there.")
    figure = Figure(
        "noise",
        f"Noise of the mean at each pose, {rounded(float(force.min()))} to {rounded(float(force.max()))} N.",
        "Noise of the mean wrench at each pose (one axis, one sigma). Good: bars of similar height. A pose far above "
        "the others swung, was touched, or was averaged over too few samples.",
    )
    return Section("noise", "Noise of each pose", text, [figure])


def _coverage(facts: Facts) -> Section:
    found, title = facts["coverage"], "Coverage of orientations"
    if found is None:
        return Section("coverage", title, ["The calibration file holds no orientations: report its run folder."])
    gap_deg = math.degrees(found["largest_gap_rad"])
    text = [
        f"{found['words'][0].upper()}{found['words'][1:]}",
        f"{found['orientations']} different orientations (24 or more count as 24) determine {found['rank']} of 15 "
        "parameters.",
        f"Largest gap: no direction of gravity within {gap_deg:.0f}° of {found['gap_words'].removeprefix('along ')}.",
    ]
    figure = Figure(
        "coverage",
        f"Map of the directions of gravity in flange axes; the largest gap has a radius of {gap_deg:.0f}°.",
        "Direction of gravity in flange axes at each pose. Good: dots in all parts of the map. The circle is the "
        f"largest gap, {gap_deg:.0f}°; the 24 orientations of the paper leave 55°.",
    )
    return Section("coverage", title, text, [figure])


def _tour(facts: Facts) -> Section:
    tour, title = facts["tour"], "Tour and settings"
    if tour is None:
        return Section("tour", title, ["The source is not a run folder: it holds no plan, devices or settings."])
    text = [f"Run {tour['run']}, started {tour['created_utc']}, mode {tour['mode']}, {tour['stops']} stops."]
    if tour["emulated"]:
        text.append("The cell was EMULATED: these are not the values of a real tool.")
    tables = [
        Table("Devices", ("device", "model", "serial", "version"), _devices(tour["devices"])),
        Table("Settings", ("setting", "value"), list(flattened(tour["config"])), folded=True),
    ]
    plan = tour["plan"]
    if plan is None:
        text.append(tour["plan_error"] or "The poses were chosen by hand: there is no plan.")
        return Section("tour", title, text, (), tables)
    text += plan["why"]
    text.append(
        f"{plan['poses']} poses, {plan['motion_time_s']:.0f} s of motion, no move above {plan['max_move_deg']:.0f}°, "
        f"{'all' if plan['certified'] else 'NOT all'} proven clear, nearest {plan['min_clearance_mm']:.0f} mm."
    )
    rows = [
        (name, rounded(scale * _largest(plan["predicted_sigma"].get(key)), 2), rounded(scale * got, 2))
        for name, scale, key, got in _predicted(facts)
    ]
    caption = (
        "Sigma as the plan predicted it, and as obtained: similar values mean that noise and tool were as expected"
    )
    return Section("tour", title, text, (), [Table(caption, ("sigma", "predicted", "obtained"), rows), *tables])


def _predicted(facts: Facts) -> Iterator[tuple[str, float, str, float]]:
    sigma, predicted = facts["result"]["sigma"], facts["result"]["predicted_error"]
    for name, scale, key in (
        ("mass, g", 1e3, "mass_kg"),
        ("centre of mass, mm", 1e3, "p_sensor_com_m"),
        ("force bias, N", 1.0, "force_bias_N"),
        ("torque bias, N·m", 1.0, "torque_bias_Nm"),
    ):
        yield name, scale, key, _largest(sigma[key])
    yield "compensation, N", 1.0, "force_rms_N", predicted["force_rms_N"]
    yield "compensation, N·m", 1.0, "torque_rms_Nm", predicted["torque_rms_Nm"]


def _largest(values: Any) -> float:
    return float(np.max(np.array(values, dtype=np.float64)))


def _devices(devices: Facts) -> list[tuple[str, str, str, str]]:
    return [
        (name, *(str(one.get(key, "-")) for key in ("model", "serial", "version"))) for name, one in devices.items()
    ]


def flattened(value: Facts, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the values of nested objects with their full names, as text."""
    for name, inner in value.items():
        if isinstance(inner, Mapping):
            yield from flattened(inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _text(inner)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(_text, value))
    return "-" if value is None else str(value)


def _comparison(facts: Facts) -> Section:
    found, title = facts["comparison"], "Comparison with the previous result"
    if found is None:
        why = facts["compared_with"] or "There is no result to compare with: name one with --parent."
        return Section("comparison", title, [why])
    text = [
        f"Compared with {facts['compared_with']}: id {found['id']}, {found['verdict']}, mass {found['mass_kg']:.4f} kg."
    ]
    if found["same_data"]:
        text.append("Both rest on the same data: the test below does not apply, because it assumes independent noise.")
    else:
        changed = [one["name"] for one in found["groups"][:-2] if one["p_value"] < CHANGED_P]
        text.append(
            f"Changed by more than chance explains: {', '.join(changed)}."
            if changed
            else "Nothing changed by more than chance explains."
        )
        text.append("A bias may change from day to day; a change of anything else means another tool or mounting.")
    groups = [(one["name"], f"{one['chi2']:.1f}", str(one["dof"]), in_words(one["p_value"])) for one in found["groups"]]
    rows = [
        (label_of(one["name"]), f"{one['change']:+.2g}", "-" if one["sigmas"] is None else f"{one['sigmas']:+.1f}")
        for one in found["parameters"]
    ]
    figure = Figure(
        "comparison",
        "Bars of the difference of each parameter in sigma.",
        "This result minus the previous one, in sigma of the difference. Good: bars within the dashed lines at 3, "
        "except for the biases.",
    )
    tables = [
        Table("Joint test of each group", ("group", "chi2", "degrees of freedom", "p"), groups),
        Table("Differences (rad, N, m, N·m)", ("parameter", "difference", "in sigma"), rows, folded=True),
    ]
    return Section("comparison", title, text, [figure], tables)


def _provenance(facts: Facts) -> Section:
    text = [f"Report of {facts['source']}, written {facts['created_utc']}. Calibration id {facts['id']}."]
    if facts["reproduce"]:
        text.append(f"Reproduce the result: `{facts['reproduce']}`. The id must be {facts['id']}.")
    else:
        text.append("The file holds no data: solve the dataset with the hash below to reproduce the result.")
    table = Table("Provenance", ("field", "value"), list(flattened(facts["result"]["provenance"])))
    return Section("provenance", "Provenance", text, (), [table])
