"""All facts about a calibration for its report, as one JSON object from which every format is written."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.accuracy import error_map, force_sigma_at_tip, tip_of
from ftcalib.after.series import calibration_difference
from ftcalib.after.weighing import true_tool
from ftcalib.compare import compare
from ftcalib.errors import NotObservable
from ftcalib.judge.observability import assess, axes_along, largest_gap
from ftcalib.judge.verdict import strong_correlations
from ftcalib.model import PARAMETER_NAMES, Array
from ftcalib.result import MotionResult
from ftcalib.routine import drift_check
from ftdrive.errors import BadPlan, PlanRefused
from ftdrive.planning.plan import Plan
from ftdrive.report.subject import Subject
from ftdrive.runs.calibration import MARKS, marks_of
from ftdrive.runs.pose_hints import hints, pose_names
from ftdrive.runs.run import Run
from ftdrive.words.result import (
    contact_in_words,
    drift_in_use,
    drift_in_words,
    error_in_words,
    error_source,
    mass_in_words,
    residuals_in_words,
    sensor_in_words,
)

_LABELS = {
    "R_flange_sensor": "mounting",
    "gravity_force_base_N": "weight",
    "force_bias_N": "force bias",
    "p_sensor_com_m": "centre of mass",
    "torque_bias_Nm": "torque bias",
}


def label_of(parameter: str) -> str:
    """Return the label of a parameter, such as "force bias x" for "force_bias_N.x", or of a whole vector."""
    name, _, axis = parameter.partition(".")
    return f"{_LABELS[name]} {axis}".strip()


def comparison_facts(result: CalibrationResult, before: CalibrationResult) -> dict[str, Any]:
    """Return the comparison of a result with an earlier one, usually from other data.

    `sensors` are texts about the sensor errors, before and now. `parameters` have for each error coordinate its `name`,
    `change` (rad, N, m, N·m), and `sigmas`, null if exactly known in both. `groups` are tests for equality. `same_data`
    means that both use one dataset, so the tests do not apply.
    """
    found = calibration_difference(before, result)
    data = [one.provenance.get("dataset_sha256") for one in (result, before)]
    tests = {label_of(name): test for name, test in found.groups.items() if test.dof} | {"all": found.joint}
    return {
        "id": before.id,
        "verdict": before.verdict,
        "created_utc": before.provenance.get("created_utc"),
        "mass_kg": before.mass_kg,
        "same_data": data[0] is not None and data[0] == data[1],
        "sensors": [sensor_in_words(before), sensor_in_words(result)],
        "parameters": [
            {"name": name, "change": change, "sigmas": sigmas if sigma > 0 and np.isfinite(sigmas) else None}
            for name, change, sigma, sigmas in zip(
                PARAMETER_NAMES, found.change.tolist(), found.sigma.tolist(), found.in_sigmas.tolist(), strict=True
            )
        ],
        "groups": [{"name": name, **asdict(test)} for name, test in tests.items()],
    }


# Forces at the tool tip, N, for which the report draws the standard deviation.
FORCES_N = np.arange(0.0, 101.0, 5.0)


def contact_error(result: CalibrationResult) -> dict[str, Any]:
    """Return how uncertain a measured force at the tool tip is: `sigma_N`, the rms error over all directions.

    `tip_m` (3,) is relative to the sensor origin, sensor axes. If known loads were measured, `without_loads_N` (n,) is
    the sigma without them, and `tool` is corrected for the sensor errors that they show; otherwise both are null.
    """
    without, tool = None, None
    if result.known_contact is not None:
        without = force_sigma_at_tip(replace(result, sensor=None), FORCES_N).tolist()
        mass_kg, p_sensor_com_m = true_tool(result)
        tool = {"mass_kg": mass_kg, "p_sensor_com_m": p_sensor_com_m.tolist()}
    return {
        "source": "assumed" if result.sensor is None else result.sensor.source,
        "words": contact_in_words(result),
        "tip_m": tip_of(result).tolist(),
        "force_N": FORCES_N.tolist(),
        "sigma_N": force_sigma_at_tip(result, FORCES_N).tolist(),
        "without_loads_N": without,
        "tool": tool,
    }


def _error_map(result: CalibrationResult) -> dict[str, Any]:
    found = error_map(result)
    for one in (found["force_N"], found["torque_Nm"]):
        one["axes"] = _along_axes(direction := np.array(one["worst_direction"]))
        one["words"] = _direction_in_words(direction, "base")
    return found


def _along_axes(direction: Array) -> str:
    names = axes_along(direction)
    return f"along {names[0]}" if len(names) == 1 else f"between {' and '.join(names)}"


def _direction_in_words(direction: Array, frame: str) -> str:
    return f"{_along_axes(direction)} of the {frame}"


FORMAT = "ftdrive.report/1"
NEXT_STEP = {
    "good": "Use the calibration, and verify it on new poses with `ftdrive verify`, now and regularly.",
    "usable": (
        "Use the calibration if the error below is small enough. To improve it, work through the findings in "
        "order, then calibrate again."
    ),
    "rejected": (
        "Do not use the calibration. Fix the first finding, because it often causes the others; then calibrate again."
    ),
    "failed": (
        "The last verification failed. Run `ftdrive verify` again and accept the proposed update, or calibrate again."
    ),
}
NOTABLE_CORRELATION = 0.7
# Fields of a plan that the report leaves out, because they are long.
_LONG = ("steps", "made_for", "description")


def facts_of(subject: Subject, trust: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the facts of a report as JSON; a fact without data is null.

    The names contain the units: rad, m, N, N·m, s. The fact `result` is the content of the calibration file, and
    `trust` its age and last verification, from `ftdrive.report.subject.trust_facts`.
    """
    # The page and the JSON of a report are written from these facts, so that they agree.
    result, dataset = subject.result, subject.dataset
    sweep = _planned_sweep(subject.run)
    R_base_flange = dataset.R_base_flange if dataset is not None else None if sweep is None else sweep.R_base_flange
    force_N, torque_Nm = result.likely_error().tolist()
    last = (trust or {}).get("last_verification")
    failed = last is not None and not last["passed"] and result.verdict != "rejected"
    return {
        "format": FORMAT,
        "schema_version": 1,
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": str(subject.source),
        "id": result.id,
        "about": _about_of(result),
        "verdict": result.verdict,
        "marks": {mark: MARKS[mark] for mark in marks_of(result)},
        "findings": [one.to_dict() for one in result.findings],
        "hints": [one.to_dict() for one in hints(result, subject.records)],
        "trust": trust,
        "next_step": NEXT_STEP["failed" if failed else result.verdict],
        "error": {
            "words": error_in_words(result),
            "source": error_source(result),
            "force_N": force_N,
            "torque_Nm": torque_Nm,
            "cross_validated": not result.noise_explains,
        },
        "error_map": _error_map(result),
        "contact": contact_error(result),
        "correlation": _correlation_facts(result.covariance),
        "cross_validation": _cross_validation(subject),
        "poses": _pose_facts(subject),
        "residuals": residuals_in_words(result),
        "mass": mass_in_words(result),
        "drift": _drift_facts(subject),
        "noise": _noise_facts(subject),
        "coverage": None if R_base_flange is None else _coverage_facts(subject, R_base_flange),
        "motion": None if result.motion is None else _motion_facts(result.motion, sweep),
        "tour": None if subject.run is None else _tour(subject.run, len(subject.records)),
        "comparison": None if subject.parent is None else comparison_facts(result, subject.parent),
        "compared_with": subject.parent_name,
        "reproduce": subject.reproduce,
        "result": result.to_dict(),
    }


def _about_of(result: CalibrationResult) -> str:
    known = result.provenance
    setup, devices = known.get("setup") or {}, known.get("devices") or {}
    named = [
        " ".join(str(one[key]) for key in ("model", "serial") if one.get(key))
        for role in ("arm", "sensor")
        if (one := devices.get(role))
    ]
    tool = [f"tool {setup['tool']}"] if setup.get("tool") else []
    made = known.get("created_utc")
    return ", ".join([*named, *tool, *([made[:16].replace("T", " ") + " UTC"] if isinstance(made, str) else [])])


def _correlation_facts(covariance: Array) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(covariance))
    sigma[sigma == 0] = np.inf  # exactly known parameters have no correlations
    return {
        "names": list(PARAMETER_NAMES),
        "matrix": np.clip(covariance / np.outer(sigma, sigma), -1, 1).tolist(),
        "strong": [list(pair) for pair in strong_correlations(covariance, NOTABLE_CORRELATION)],
    }


def _cross_validation(subject: Subject) -> dict[str, Any]:
    quality = subject.result.quality
    methods: list[Any] = []
    reason = "The source contains no poses for a comparison of methods."
    if subject.dataset is not None:
        try:
            methods, reason = [one.to_dict() for one in compare(subject.dataset, **subject.solved_with)], ""
        except NotObservable as error:
            reason = str(error)
    return {
        "force_N": quality.get("loo_force_rms_N"),
        "torque_Nm": quality.get("loo_torque_rms_Nm"),
        "methods": methods,
        "reason": reason,
    }


def _pose_facts(subject: Subject) -> list[dict[str, Any]]:
    result, dataset = subject.result, subject.dataset
    names = pose_names(subject.records) or [str(row + 1) for row in range(result.n_poses)]
    spread = result.quality.get("residual_sigma") or [None] * result.n_poses
    t_s = [None] * result.n_poses if dataset is None else [None if np.isnan(t) else t for t in dataset.t_s.tolist()]
    return [
        {
            "row": row + 1,
            "name": names[row],
            "t_s": t_s[row],
            "residual": result.residuals[row].tolist(),
            "force_N": float(np.linalg.norm(result.residuals[row, :3])),
            "torque_Nm": float(np.linalg.norm(result.residuals[row, 3:])),
            "sigmas": spread[row],
            "used": row + 1 not in result.rejected_poses,
        }
        for row in range(result.n_poses)
    ]


def _drift_facts(subject: Subject) -> dict[str, Any]:
    result, again = subject.result, drift_check(subject.records)
    return {
        "in_fit": result.to_dict()["drift"],
        "components": {k: v for k, v in result.components.items() if k.startswith(("walk", "slope"))},
        "first_pose_again": None if again is None else {"words": drift_in_words(again)[0], **again.to_dict()},
        "lag1": result.quality.get("lag1"),
        "in_use": drift_in_use(result),
    }


def _noise_facts(subject: Subject) -> dict[str, Any] | None:
    """Return the standard errors of the mean wrench at each pose, averaged over the axes; None if not measured."""
    if subject.dataset is None or subject.dataset.wrench_cov is None:
        return None
    variance = np.einsum("nii->ni", subject.dataset.wrench_cov)
    return {
        "force_N": np.sqrt(variance[:, :3].mean(axis=1)).tolist(),
        "torque_Nm": np.sqrt(variance[:, 3:].mean(axis=1)).tolist(),
        "n_samples": subject.dataset.n_samples.tolist(),
        "unsteady": [record.stop for record in subject.records if not record.steady],
    }


def _coverage_facts(subject: Subject, R_base_flange: Array) -> dict[str, Any]:
    parameters = subject.result.parameters
    seen = assess(R_base_flange, parameters, advise=False)
    gravity, tool = parameters.down @ R_base_flange, R_base_flange[:, :, 2]
    gap_rad, towards = largest_gap(gravity)
    return {
        "orientations": seen.orientations,
        "rank": seen.rank,
        "condition": seen.condition if np.isfinite(seen.condition) else None,
        "second_gap": seen.second_gap if np.isfinite(seen.second_gap) else None,
        "words": seen.sentence() if seen.ambiguities else "the poses determine all parameters.",
        "gravity_in_flange": gravity.tolist(),
        "tool_in_base": tool.tolist(),
        "largest_gap_rad": gap_rad,
        "gap_towards": towards.tolist(),
        "gap_words": _direction_in_words(towards, "flange"),
    }


def _planned_sweep(run: Run | None) -> Plan | None:
    return Plan.load(run.plan_path) if run is not None and run.in_motion and run.plan_path.is_file() else None


def _motion_facts(motion: MotionResult, planned: Plan | None) -> dict[str, Any]:
    return {
        "inertia_kg_m2": motion.inertia_kg_m2.tolist(),
        "sigma": {name: np.asarray(value).tolist() for name, value in motion.sigma.items()},
        "delay_s": motion.delay_s,
        "height_m": motion.height_m,
        "used_share": motion.used_share,
        "contacts": [dict(one) for one in motion.contacts],
        "sweep": None if planned is None else planned.to_dict().get("sweep"),
    }


def _tour(run: Run, stops: int) -> dict[str, Any]:
    header = run.header()
    plan, why_not = None, ""
    if run.plan_path.is_file():
        try:
            plan = Plan.load(run.plan_path)
        except (BadPlan, PlanRefused) as error:
            why_not = str(error)
    return {
        "run": run.folder.name,
        "mode": header.get("mode", "auto"),
        "created_utc": header.get("created_utc"),
        "stops": stops,
        "emulated": header.get("station") is not None,
        "devices": header.get("devices", {}),
        "config": header.get("config", {}),
        "plan_error": why_not,
        "plan": None if plan is None else {name: value for name, value in plan.to_dict().items() if name not in _LONG},
    }
