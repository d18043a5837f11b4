"""Sections about where a result comes from: tour and settings, the previous result, provenance, from the facts."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ftdrive.report.document import Figure, Section, Table
from ftdrive.report.words import flattened, in_words, label_of, rounded

Facts = Mapping[str, Any]

LIMIT_SIGMAS = 3
"""One difference in 370 is larger by chance."""
CHANGED_P = 1e-3
"""Two results of one tool differ more than this by chance in one case of 1000."""


def tour(facts: Facts) -> Section:
    """Show run, plan, devices and settings."""
    run, title = facts["tour"], "Tour and settings"
    if run is None:
        return Section("tour", title, ["The source is not a run folder: it holds no plan, devices or settings."])
    started = f"{str(run['created_utc'])[:19]} UTC"
    text = [f"Run {run['run']}, started {started}, mode {run['mode']}, {run['stops']} stops."]
    tables = [
        Table("Devices", ("device", "model", "serial", "firmware"), _devices(run["devices"])),
        Table("Settings", ("setting", "value"), list(flattened(run["config"])), folded=True),
    ]
    plan = run["plan"]
    if plan is None:
        text.append(run["plan_error"] or "The poses were chosen by hand: there is no plan.")
        return Section("tour", title, text, (), tables)
    text += plan["why"]
    if "sweep" in plan:
        text.append(f"Proven clear along the whole curve, nearest {plan['min_clearance_mm']:.0f} mm.")
        return Section("tour", title, text, (), tables)
    text.append(
        f"{plan['poses']} poses, {plan['motion_time_s']:.0f} s of motion, no move above {plan['max_move_deg']:.0f}°, "
        f"{'all' if plan['certified'] else 'NOT all'} proven clear, nearest {plan['min_clearance_mm']:.0f} mm."
    )
    rows = [
        (name, rounded(scale * _largest(plan["predicted_sigma"].get(key)), 2), rounded(scale * got, 2))
        for name, scale, key, got in _predicted(facts)
    ]
    caption = "One sigma as the plan predicted it, and as obtained. Good: obtained at most as predicted"
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


def _devices(devices: Facts) -> list[Sequence[str]]:
    keys = ("model", "serial", "firmware")
    return [(name, *(str(one.get(key, "-")) for key in keys)) for name, one in devices.items()]


def comparison(facts: Facts) -> Section:
    """Show the differences from the previous result."""
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
        changed = [one["name"] for one in found["groups"][:-1] if one["p_value"] < CHANGED_P]
        text.append(
            f"Changed by more than chance explains: {', '.join(changed)}."
            if changed
            else "Nothing changed by more than chance explains."
        )
        text.append("A bias may change from day to day; a change of anything else means another tool or mounting.")
    groups = [(one["name"], f"{one['chi2']:.4g}", str(one["dof"]), in_words(one["p_value"])) for one in found["groups"]]
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
        Table("Joint test of each group", ("group", "chi2", "dof", "p"), groups),
        Table("Differences (rad, N, m, N·m)", ("parameter", "difference", "in sigma"), rows, folded=True),
    ]
    return Section("comparison", title, text, [figure], tables)


def provenance(facts: Facts) -> Section:
    """Show where the result comes from and how to get it again."""
    text = [f"Report of {facts['source']}, written {facts['created_utc']}. Calibration id {facts['id']}."]
    if facts["reproduce"]:
        text.append(f"Reproduce the result: `{facts['reproduce']}`. The id must be {facts['id']}.")
    else:
        text.append("The file holds no data: solve the dataset with the hash below to reproduce the result.")
    text += _last_verification(facts["trust"] or {})
    rows, columns = list(flattened(facts["result"]["provenance"])), ("field", "value")
    long = [row for row in rows if row[0].startswith(("devices.", "station."))]
    tables = [Table("", columns, [row for row in rows if row not in long])]
    tables += [Table("Devices", columns, long, folded=True)] if long else []
    return Section("provenance", "Provenance and how to reproduce the result", text, (), tables)


def _last_verification(trust: Facts) -> Iterator[str]:
    if last := trust.get("last_verification"):
        outcome = "passed" if last["passed"] else "FAILED"
        yield f"Last verification {last['created_utc'][:16]} UTC, {outcome}: {last['reason']}. File {last['path']}."
    if trust.get("store_error"):
        yield f"A later verification may be missing, because {trust['store_error']}."
