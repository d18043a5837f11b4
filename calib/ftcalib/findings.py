"""Findings about a calibration: code, severity and values as data, with their sentences, order and verdict.

`CODES` is the table of all codes, ordered by rank: causes come before their consequences. A template contains values in
braces. The name of a value ends with its unit, which is written after the value. ``{key:?yes|no}`` writes "yes" if the
value is present, else "no". ``{key:~sigma}`` rounds a value to the last decimal of the value named `sigma`.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from types import MappingProxyType
from typing import Any, Final, Literal, Self

from ftcalib.display import Displayed, Summary
from ftcalib.rounding import decimals, to_place_of

# Effect of a finding on the verdict: "reject" rejects the result, "limit" makes it at best usable, "note" has none.
Severity = Literal["reject", "limit", "note"]
Verdict = Literal["good", "usable", "rejected"]

# Verdict for each severity, the worst first.
_VERDICTS: Final[Mapping[Severity, Verdict]] = {"reject": "rejected", "limit": "usable", "note": "good"}
# Placeholder of a value in a template, with its format.
_PLACE: Final = re.compile(r"\{(\w+)(?::([^}]*))?\}")
_UNITS: Final = {
    "N": " N", "Nm": " N·m", "mNm": " mN·m", "kg": " kg", "m": " m", "s": " s", "mm": " mm", "deg": "°",
    "percent": " %",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Code:
    """Definition of a finding code: severities and sentence templates."""

    severities: Sequence[Severity]
    """Possible severities; with several, the size of the problem decides."""
    found: str
    """Template of the sentence part that describes the problem."""
    fix: str = ""
    """Template of the sentence part that gives the remedy."""

    @property
    def values(self) -> set[str]:
        """Names of the values that the templates require."""
        places = [place for place in _PLACE.finditer(self.found + self.fix) if place[2] not in _OPTIONAL]
        return {place[1] for place in places} | {place[2][1:] for place in places if (place[2] or "")[:1] == "~"}


@dataclass(frozen=True, slots=True, repr=False)
class Finding(Displayed):
    """Finding with code, severity and values. An unknown code, from a file of a later version, has no sentence.

    Raises
    ------
    ValueError
        The severity is unknown, or a value required by the sentence is missing.

    Examples
    --------
    >>> import ftcalib
    >>> finding = ftcalib.Finding.of("few_poses", n_poses=5, recommended=6)
    >>> finding.severity, finding.values["n_poses"]
    ('limit', 5)
    >>> finding.words
    'there are only 5 poses: take 6 or more'
    """

    code: str
    severity: Severity
    values: Mapping[str, Any] = field(default_factory=dict)
    """Numbers, strings, or lists of them, by names with units; None means unknown."""

    def __post_init__(self) -> None:
        if self.severity not in _VERDICTS:
            raise ValueError(f"the severity of a finding is {self.severity!r}, expected one of {', '.join(_VERDICTS)}")
        if self.code in CODES and (missing := CODES[self.code].values - self.values.keys()):
            raise ValueError(f"the finding {self.code} lacks {', '.join(sorted(missing))}")
        object.__setattr__(self, "values", MappingProxyType(_json_value(self.values)))

    @classmethod
    def of(cls, code: str, severity: Severity | None = None, /, **values: Any) -> Self:
        """Return a finding with a code of the table; `severity` is needed only for codes with several severities.

        Raises
        ------
        KeyError
            The table has no such code.
        """
        possible = CODES[code].severities
        if severity is None:
            (severity,) = possible
        return cls(code, severity, values)

    @property
    def found(self) -> str:
        """Description of the problem."""
        if self.code in CODES:
            return _write(CODES[self.code].found, self.values)
        return f"{self.code} ({json.dumps(dict(self.values), ensure_ascii=False)}), which this version does not know"

    @property
    def fix(self) -> str:
        """Description of the remedy; empty if there is none."""
        return _write(CODES[self.code].fix, self.values) if self.code in CODES else ""

    @property
    def words(self) -> str:
        """Sentence with the problem and its remedy."""
        return f"{self.found}: {self.fix}" if self.fix else self.found

    def _summary(self) -> Summary:
        return Summary(f"{self.code} ({self.severity}): {self.words}")

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the finding for files and `--json`."""
        return {"code": self.code, "severity": self.severity, "values": dict(self.values), "words": self.words}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Return the finding of a JSON object; raise `ValueError` if the object is damaged."""
        try:
            finding = cls(document["code"], document["severity"], document["values"])
            _ = finding.words  # raises if a value has a wrong type
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"finding {json.dumps(document)}: {error}") from error
        return finding


def ordered(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings sorted by rank, in the order in which to fix them; notes come last."""
    rank = {code: place for place, code in enumerate(CODES)}
    return tuple(sorted(findings, key=lambda each: (each.severity == "note", rank.get(each.code, len(rank)))))


def folded(findings: Iterable[Finding]) -> list[Finding]:
    """Return ordered findings without the consequences of a cause; the cause gets the worst severity among them."""
    findings, worse = list(findings), [*_VERDICTS].index
    for causes, consequences in _EXPLAINS:
        cause = next((each for each in findings if each.code in causes), None)
        if cause is None:
            continue
        severities = [each.severity for each in findings if each is cause or each.code in consequences]
        worst = min(severities, key=worse)
        if worst in CODES[cause.code].severities:
            findings[findings.index(cause)] = cause = replace(cause, severity=worst)
        findings = [
            each for each in findings if each.code not in consequences or worse(each.severity) < worse(cause.severity)
        ]
    return findings


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict of the worst finding; "good" without findings."""
    severities = {each.severity for each in findings}
    return next((verdict for severity, verdict in _VERDICTS.items() if severity in severities), "good")


# --------------------------------------------------------------------------------------------------------------- words


def _write(template: str, values: Mapping[str, Any]) -> str:
    def at(place: re.Match[str]) -> str:
        name, form = place[1], place[2] or ""
        if form[:1] == "~" and None not in (values[name], sigma := values[form[1:]]):
            form = f".{decimals(sigma)}f"
        return _format_value(name, values.get(name), form)

    return _PLACE.sub(at, template)


def _format_value(name: str, value: Any, form: str) -> str:
    if form[:1] == "?":
        present, _, absent = form[1:].partition("|")
        return absent if value is None or value in ("", [], {}) else present
    if form in _FORMS:
        return _FORMS[form](value)
    if value is None:
        return "unknown"
    unit = _UNITS.get(name.rpartition("_")[2], "")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format(each, form)}" for key, each in value.items())
    if isinstance(value, list):
        listed = ", ".join(format(each, form) for each in value)
        return f"({listed}){unit}" if form else listed
    return f"{format(value, form)}{unit}"


def _format_poses(value: Any) -> str:
    """Return row numbers as "pose 5" or "poses 5, 7"; names such as R05 are not changed."""
    rows = value if isinstance(value, list) else [value]
    listed = ", ".join(map(str, rows))
    return listed if isinstance(rows[0], str) else f"pose{'s' if len(rows) > 1 else ''} {listed}"


def _format_units(pairs: Sequence[Sequence[str]]) -> str:
    """Return a phrase with suspected units of force and torque, such as [["lbf", "N·m"]]."""
    each = (
        " and ".join([f"forces in {force}"] * (force != "N") + [f"torques in {torque}"] * (torque != "N·m"))
        for force, torque in pairs
    )
    return f" (perhaps {', or '.join(each)})" if pairs else ""


def _format_axes(corrections: Sequence[Sequence[Any]]) -> str:
    """Return a phrase with the channels from which axes should be taken, such as [["force", ["-x", "y", "z"]]]."""
    return ", or ".join(f"{group} {_format_channels(channels)}" for group, channels in corrections)


def _format_channels(channels: Sequence[str]) -> str:
    if [channel[-1] for channel in channels] == list("xyz"):
        return f"{' and '.join(channel[1:] for channel in channels if len(channel) > 1)} reversed"
    return f"x, y, z taken from ({', '.join(channels)})"


def _format_orders(orders: Sequence[str]) -> str:
    """Return a phrase with the orders of quaternions with which gravity would point down."""
    each = " or ".join(f"({order})" for order in orders)
    return f", such as quaternions {each} read inverted and in another order" if orders else ""


def _format_scale(unit_N: Sequence[float] | None) -> str:
    """Return a sentence with the size of the unit of force according to a known mass, and its sigma, both in N."""
    if not unit_N:
        return ""
    unit, sigma = (to_place_of(value, unit_N[1]) for value in unit_N)
    return f". According to the known mass, 1 unit = {unit} N (sigma {sigma} N)"


# Formats whose values may be missing, because earlier versions did not write them.
_OPTIONAL: Final = frozenset(("scale",))
_FORMS: Final[Mapping[str, Callable[[Any], str]]] = {
    "poses": _format_poses, "units": _format_units, "axes": _format_axes, "orders": _format_orders,
    "scale": _format_scale,
}  # fmt: skip


def _json_value(value: Any) -> Any:
    """Return a value as JSON; arrays and numpy numbers are converted, and numbers that are not finite become None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {name: _json_value(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


# --------------------------------------------------------------------------------------------------------------- codes

_REJECT: Final = ("reject",)
_LIMIT: Final = ("limit",)
_NOTE: Final = ("note",)
_REJECT_OR_LIMIT: Final = ("reject", "limit")
_LIMIT_OR_NOTE: Final = ("limit", "note")

# fmt: off
CODES: Final[Mapping[str, Code]] = {
    # Data that cannot be right
    "other_recording": Code(_REJECT, "{left_percent:.0f} of the variation of the wrench does not follow the poses",
        "keep the tool free of contact, check the format of the rotations, and check that wrench and poses come from "
        "one recording and one clock"),
    "stuck_channels": Code(_REJECT, "the reading of {channels} is the same in all poses",
        "check the sensor for a channel that is stuck"),
    "quantised": Code(_LIMIT, "the readings come in steps of {step_N:.2g} and {step_Nm:.2g}",
        "record the full resolution of the sensor, and the mean of many samples at each pose"),
    "saturated": Code(_REJECT, "{channel} reads exactly the same extreme value in {poses:poses}, as if it were "
        "saturated", "use a larger measuring range or a lighter tool, and repeat these poses"),
    "repeated_poses": Code(_REJECT, "{poses:poses} have identical wrenches and orientations", "keep one of the copies"),
    "repeated_wrenches": Code(_REJECT, "{poses:poses} have identical wrenches in different orientations",
        "repeat these poses"),
    "constant_force": Code(_REJECT, "the force is {force_N:.2g} in all poses, as if the wrench were given in base axes",
        "add --wrench-frame base, or record it in the axes of the sensor"),
    "wrench_in_base": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} with the wrench in base "
        "axes", "add --wrench-frame base, with --tcp if the torques are about the TCP, or record it in sensor axes"),
    "orientations_inverted": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} with the "
        "orientations inverted", "state that the orientations map base to flange (--orientation R_flange_base){also:?, "
        "or read them as |}{also}"),
    "quaternion_order": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} with quaternions "
        "({order}) instead of ({read_as})", 'exchange the quaternion columns (--columns "qx=NAME,..."){also:?, or read '
        "them as |}{also}"),
    "euler_angles": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} with Euler angles {order} "
        "instead of {read_as}", "add --euler {order} for a file of angles, or compute the rotations in this "
        "order{also:?, or read them as |}{also}"),
    "columns_swapped": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} with forces and torques "
        "exchanged", 'exchange the columns of force and torque (--columns "fx=NAME,...")'),
    "pairing_shifted": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} if each wrench is paired "
        "with the pose {neighbour} it", "pair each wrench with the pose at which it was measured"),
    "zeroed_each_pose": Code(_REJECT, "force residual {residual_N:.2g}, but {corrected_N:.2g} if the sensor was "
        "zeroed at each pose", "zero the sensor at most once, before the first pose, and record again"),
    "pairing_or_rotations": Code(_REJECT, "the norm of the forces fits a weight of {weight_N:.3g} within "
        "{radial_N:.2g}, but their direction only within {residual_N:.2g}", "check the pairing of wrenches and poses, "
        "the Euler angles (--euler), the unit of the angles, and the order of the rotations"),
    "orientations_off": Code(_REJECT_OR_LIMIT, "orientations are off by {turn_deg:.1f}: forces fit within "
        "{radial_N:.2g} in norm, {residual_N:.2g} in direction", "fasten base, sensor and tool, give the measured "
        "poses rather than the planned ones, and check the arm's model"),
    "torques_unrelated": Code(_REJECT_OR_LIMIT, "{left_percent:.0f} of the variation of the torques does not follow "
        "the weight, although the forces do", "check that forces and torques are from one sensor and one recording, "
        "then check for cables and contact"),
    "axes_disagree": Code(_REJECT, "torque residual {residual_Nm:.2g}, but {corrected_Nm:.2g} with other axes of force "
        "or torque", "try {corrections:axes} (--columns), or check the wiring of the axes and the sensor's matrix"),
    # Known values that the data contradict
    "known_mass": Code(_LIMIT_OR_NOTE, "the data give a mass of {mass_kg:~sigma_kg} (sigma {sigma_kg:~sigma_kg}), but "
        "the known mass is {known_kg:g}", 'scale the forces accordingly (--columns "fx=NAME [.82 N],..." for .82 N), '
        "or correct the known value (--mass-kg){units:units}{unit_N:scale}"),
    "known_gravity_direction": Code(_LIMIT_OR_NOTE, "gravity in the data is {off_deg:~sigma_deg} (sigma "
        "{sigma_deg:~sigma_deg}) off its known direction", "correct the data or the known value (--level-deg, --up)"),
    "known_mounting": Code(_LIMIT_OR_NOTE, "the mounting in the data is {off_deg:~sigma_deg} (sigma "
        "{sigma_deg:~sigma_deg}) off the known one", "correct the known value (--mounting-deg), or the "
        "data{corrections:?, such as |}{corrections:axes}"),
    # Units, drift and changes of one session
    "bias_implausible": Code(_REJECT_OR_LIMIT, "the bias is {force_N:.5g} and {torque_Nm:.5g} for a weight of "
        "{weight_N:.3g}, as with raw counts", "convert the counts to N and N·m with the sensor's factors. With a "
        "known mass, solve gives that of the force (--mass-kg){unit_N:scale}"),
    "payload_units": Code(_LIMIT, "the load on the sensor is {load_kg:.2f}, but the payload in the controller implies "
        "{expected_kg:.2f}", "check the units of the sensor{units:units} before you correct the payload"),
    "com_shifted": Code(_REJECT_OR_LIMIT, "from {pose:poses} on, the centre of mass is shifted by {shift_mm:.2g}, as "
        "if the load had slipped", "fasten the load and calibrate again"),
    "load_changed": Code(_REJECT_OR_LIMIT, "from {pose:poses} on, the weight has changed by {change_N:+.2g} and the "
        "centre of mass by {shift_mm:.2g}", "check whether something was lost, picked up or shifted, and calibrate "
        "again"),
    "bias_stepped": Code(_REJECT_OR_LIMIT, "the bias steps at {pose:poses}, by up to {force_N:.2g} and {torque_Nm:.2g}"
        ", as if the sensor was zeroed", "zero it at most once, before the first pose, and calibrate again. If no "
        "program zeroes it, look for a cable that pulls"),
    "sensor_turned": Code(_REJECT_OR_LIMIT, "from {pose:poses} on, the sensor is turned by {turn_deg:.2g}",
        "fasten its screws and calibrate again"),
    "sensor_changed": Code(_REJECT_OR_LIMIT, "from {pose:poses} on, another sensor seems to be in use: turned by "
        "{turn_deg:.2g}, bias changed by {force_N:.2g} and {torque_Nm:.2g}", "calibrate each sensor by itself"),
    "sensors_alternate": Code(_REJECT, "every other pose looks like another sensor: turned by {turn_deg:.2g}, bias "
        "changed by {force_N:.2g} and {torque_Nm:.2g}", "separate the readings of the sensors"),
    "drift": Code(_LIMIT_OR_NOTE, "the bias drifted by {force_N:.2g} and {torque_Nm:.2g} from the first pose to the "
        "last", "let the sensor warm up and calibrate again"),
    "weight_insignificant": Code(_REJECT, "the weight, {weight_N:.3g}, is less than {least_sigmas:g} times its "
        "uncertainty of {sigma_N:.2g}", "record the raw wrench if it was compensated, or zeroed at each pose. "
        "Otherwise keep the tool free of contact, or hang something heavier on the sensor"),
    "second_solution": Code(_REJECT, "a very different mounting (probability {probability_percent:.2g}) explains the "
        "data almost as well", "add poses with another angle between the tool and the vertical"),
    "torques_about_point": Code(_LIMIT, "the centre of mass is {inside_mm:.0f} behind the sensor, as if torques were "
        "about a point in front of it", "add --wrench-frame tcp --tcp X,Y,Z,RX,RY,RZ, or record the torques about the "
        "sensor"),
    "torques_reversed": Code(_LIMIT, "the centre of mass is {inside_mm:.0f} behind the sensor, as if torques were "
        "reversed or about the TCP", "push the tool tip sideways. If that gives almost no torque, add --wrench-frame "
        "tcp --tcp X,Y,Z,RX,RY,RZ. Otherwise reverse the torques, or give the orientations in right-handed axes, "
        "unless the tool reaches back that far"),
    "weight_compensated": Code(_LIMIT, "the weight is only {weight_N:.2g}, as if it were compensated, or zeroed at "
        "each pose", "record the raw wrench, without compensation, and zero at most once, before the first pose"),
    "weight_implausible": Code(_REJECT_OR_LIMIT, "the weight is {weight_N:.5g}",
        "check the units of force and torque{units:units}, and whether they are raw counts{unit_N:scale}"),
    "com_too_far": Code(_REJECT_OR_LIMIT, "the centre of mass is {distance_m:.2f} from the sensor, farther than "
        "{most_m:g}", "check the units of force and torque{units:units}, and their reference point (--wrench-frame, "
        "--tcp), or describe the tool if it reaches that far ([tool] cylinders_mm, [workcell] measured = true)"),
    "com_too_near": Code(_LIMIT, "the centre of mass is only {distance_mm:.2g} from the sensor, as with forces in mN "
        "or torques in kN·m", "check the units of force and torque"),
    # Directions and signs
    "gravity_off_mounting": Code(_LIMIT, "gravity is {off_deg:.0f} away from the direction of the declared mounting",
        "correct the mounting ([workcell] mounting, --up), here and in the controller, or check the order and the "
        "direction of the rotations{orders:orders}"),
    "mounting_undeclared": Code(_LIMIT, "gravity is tilted by {off_deg:.0f}, along {direction:.2f} in base axes, but "
        "no mounting is declared", "declare the mounting, such as a wall ([workcell] mounting, --up), or check the "
        "order and the direction of the rotations{orders:orders}"),
    "weight_upwards": Code(_LIMIT, "the weight pulls upwards ({off_deg:.0f} from straight down)",
        "add --sign -1 ([sensor] sign = -1) if the sensor reports the reaction, or correct axes that are reversed or "
        "swapped in forces and torques alike. If the robot is mounted that way, declare its mounting ([workcell] "
        "mounting, --up). Otherwise check the order and the direction of the rotations"),
    "forces_reversed": Code(_LIMIT, "the weight pulls upwards ({off_deg:.0f} from straight down), and the centre of "
        "mass is behind the sensor", "push the tool tip sideways. If that gives almost no torque, add --sign -1 "
        "--wrench-frame tcp --tcp X,Y,Z,RX,RY,RZ. Otherwise reverse the forces, or give the orientations in "
        "right-handed axes"),
    # The described cell
    "tool_mass_mismatch": Code(_LIMIT, "the load on the sensor is {load_kg:.3g}, but the described tool has a mass of "
        "{tool_kg:.3g}", "check the sensor's units{units:units}, the mounted tool, and whether the controller "
        "compensates part of the load, or correct [tool] mass_kg{unit_N:scale}"),
    "payload_mismatch": Code(_LIMIT, "the controller has a payload of {payload_kg:.2f}, but the load on the sensor is "
        "{load_kg:.2f}{sensor_kg:?|, and the mass of the sensor is not configured}",
        "set the payload in the controller to {set_kg:.2f}{sensor_kg:?, with sensor and adapter| plus the mass of "
        "sensor and adapter ([sensor] mass_kg)}"),
    "com_outside_tool": Code(_REJECT_OR_LIMIT, "the centre of mass, {com_mm:.0f} from the {origin} in flange axes, "
        "is {outside_mm:.0f} outside the tool", "check units{units:units}, signs and reference point of the "
        "wrench (--sign, --columns, --wrench-frame), then [tool] cylinders_mm"),
    # Recordings in motion
    "zeroed": Code(_LIMIT, "the sensor was zeroed during the recording, {at_s:.2f} after its start",
        "zero it only before the recording"),
    "positions_unit": Code(_REJECT, "the positions spread over {spread_m:.3g} and do not match the weight: they look "
        "like {unit}", "give them in m"),
    "wrench_compensated": Code(_REJECT_OR_LIMIT, "the load weighs {weight_N:.2g}, but has the inertia of "
        "{mass_kg:.2g}, as if its weight were partly compensated", "record the wrench as the sensor measures it, or "
        "set the controller's payload to 0 before recording"),
    "clocks_differ": Code(_REJECT, "the wrench follows the poses if its times are divided by {ratio:.4g}",
        "give the true rate of wrench and poses"),
    "clock_rate": Code(_REJECT_OR_LIMIT, "gravity and acceleration of the poses agree if the times are multiplied "
        "by {factor:~sigma} (sigma {sigma:~sigma})", "give the true rate, which is {rate:.4g} times the stated one, "
        "check the unit of the times, or record the wrench as the sensor measures it"),
    "reversed_in_motion": Code(_REJECT, "the {channels} look reversed: the signs of weight, acceleration and inertia "
        "disagree", "reverse the {channels}, or give wrench and orientations in right-handed axes"),
    "poses_of_tcp": Code(_REJECT_OR_LIMIT, "the sensor is at {point_mm:.0f} in the axes of the poses, off the z axis, "
        "as with poses of a TCP", "give the poses of the flange{units:?, or correct the units|}{units:units}"),
    "torques_about_tcp": Code(_REJECT_OR_LIMIT, "the torques are about {point_mm:.0f} in the axes of the poses, beyond "
        "the centre of mass", "give the torques about the sensor origin, and the poses of the flange"),
    "inertia_impossible": Code(_REJECT, "no body has the principal moments of inertia {principal_gm2:.2f} g·m² (sigma "
        "{sigma_gm2:.2g} g·m²)", "check that the poses are those of the flange, then the axes and units of wrench and "
        "poses, then the clock"),
    "height_impossible": Code(_REJECT, "the motion places the sensor {height_mm:~sigma_mm} above the flange (sigma "
        "{sigma_mm:~sigma_mm}), which is impossible", "check that the poses are those of the flange, then the axes and "
        "units of wrench and poses, then the clock"),
    "motion_coarse": Code(_LIMIT, "poses differ by {off_deg:.2g} from their interpolated neighbours, so only samples "
        "at rest are used ({share_percent:.0f})", "record poses and wrench at 50 Hz or more, with the time "
        "of each sample"),
    "motion_narrow": Code(_REJECT_OR_LIMIT, "the tool turned by only {range_deg:.0f}: sigma is {mounting_deg:.2g} for "
        "the mounting, {weight_N:.2g} for the weight", "turn wrist 2 and wrist 3 by 60° or more"),
    "clock_offset": Code(_LIMIT, "the wrench lags behind the poses by {delay_s:.3f}", "correct one of the clocks, or "
        "check that the times of both files have the same meaning"),
    "positions_missing": Code(_LIMIT, "positions are missing, so only slow motion is used ({share_percent:.0f}), with "
        "errors of up to {force_N:.2g}", "give the position of the flange too"),
    "height_differs": Code(_LIMIT, "the motion places the sensor {height_mm:~sigma_mm} above the flange (sigma "
        "{sigma_mm:~sigma_mm}), not {configured_mm:.3g}", "correct [sensor] height_mm, or check the positions"),
    "mostly_contact": Code(_LIMIT, "contact was left out: {count} times, {share_percent:.0f} of the time, up to "
        "{force_N:.2g}", "keep the tool free for most of the recording"),
    "contacts_left_out": Code(_NOTE, "contact was left out: {count} times, {share_percent:.0f} of the time, up to "
        "{force_N:.2g}"),
    "motion_slow": Code(_NOTE, "the motion does not determine {names}", "turn the three wrist joints together, at "
        "60 °/s or more"),
    # How well the data fit
    "gain_not_modelled": Code(_LIMIT, "the gain is off by {gain_percent:.1f}, which this method ignores (residual "
        "{residual_N:.2g}; {free_N:.2g} with the gain)", "solve with method ml"),
    "force_error": Code(_REJECT_OR_LIMIT, "the force error is {share_percent:.1f} of the weight ({error_N:.2g}, "
        "{source}), limit {limit_percent:g}", "check cables, contact and orientations, and take more poses"),
    "torque_error": Code(_REJECT_OR_LIMIT, "the torque error is {share_percent:.1f} of the weight times {lever_m:.2g} "
        "({error_Nm:.2g}, {source}), limit {limit_percent:g}", "check cables, contact and orientations, and take more "
        "poses"),
    "known_values_misfit_force": Code(_LIMIT, "method ml without known values fits the forces to within {free_N:.2g} "
        "instead of {residual_N:.2g}", "check the known values and what the method assumes, or take more poses"),
    "known_values_misfit_torque": Code(_LIMIT, "method ml without known values fits the torques to within "
        "{free_Nm:.2g} instead of {residual_Nm:.2g}", "check the known values and what the method assumes, or take "
        "more poses"),
    "response_not_linear": Code(_LIMIT_OR_NOTE, "the response of the sensor is nonlinear by {share_percent:.2g} of the "
        "weight, which is not compensated", "stay within the range of the sensor, or have it calibrated"),
    "cable_acts": Code(_LIMIT_OR_NOTE, "something, such as a cable, pulls with {force_N:.2g} and {torque_Nm:.2g} as "
        "the tool turns, which is not compensated", "give cables and hoses more slack"),
    "orientations_smoothly_off": Code(_LIMIT_OR_NOTE, "the orientations have smoothly varying errors of {turn_deg:.2g}",
        "fasten base, sensor and tool, use the factory calibration of the arm, or stiffen the mount"),
    "noise_exceeded": Code(_LIMIT_OR_NOTE, "the residuals are {factor:.1f} times the measured noise "
        "({components:?found: |not included in the sigmas}{components:.2g})",
        "look for drift, cables, contact and inexact orientations"),
    "poses_rejected": Code(_LIMIT_OR_NOTE, "{count} of {n_poses} poses were rejected because they do not fit the "
        "others", "repeat {poses:poses}"),
    "few_poses": Code(_LIMIT, "there are only {n_poses} poses", "take {recommended} or more"),
    "gain_unknown": Code(_LIMIT, "{n_poses} poses do not determine gain and cross-talk, so {gain_percent:.2g} is "
        "assumed in all sigmas", "take {recommended} poses or more, or declare accuracy_percent of the sensor"),
    "poses_unchecked": Code(_LIMIT, "{poses:poses} cannot be checked because the others do not determine all "
        "parameters", "add similar poses"),
    # Known loads
    "loads_swapped": Code(_REJECT, "the positions of the loads {first} and {second} are exchanged",
        "exchange their places in --at"),
    "load_absent": Code(_REJECT, "the readings show no weight at {name}", "hang the load there, and repeat that run"),
    "load_in_pounds": Code(_REJECT, "the load at {name} weighs {found_kg:.3f}, not {given_kg:.3f}: it was given in lb",
        "give its mass in kg"),
    "load_in_kilograms": Code(_REJECT, "the load at {name} weighs {found_kg:.3f}, not {given_kg:.3f}, as if kg were "
        "converted from lb", "give its mass in kg"),
    "load_mass": Code(_REJECT, "the load at {name} weighs {found_kg:~sigma_kg}, not {given_kg:.3f}", "weigh it again"),
    "load_tool_mass": Code(_REJECT, "the tool weighs {found_kg:~sigma_kg}, not {given_kg:.3f}", "weigh it again"),
    "load_place": Code(_REJECT, "the load at {name} hung at {found_mm:.0f}, not at {given_mm:.0f}, {off_mm:.0f} "
        "away", "check which hole was used, and measure again"),
    "load_moved": Code(_REJECT, "the load at {name} moved by {moved_mm:.1f} after pose {pose}",
        "secure the point from which it hangs, and repeat that run"),
    "load_pulled": Code(_REJECT, "something pulls the load at {name} sideways with {force_N:.2g}",
        "let it hang freely, and repeat that run"),
    "load_bias_stepped": Code(_REJECT, "the bias changes by {force_N:.2g} and {torque_Nm:.2g} after pose {pose} of "
        "{run}", "repeat that run without touching the arm"),
    "load_touched": Code(_REJECT, "something touched the load or the tool in {poses:poses} of {run}",
        "repeat that run"),
    "sensor_not_linear": Code(_REJECT, "the sensor is nonlinear: {remaining_percent:.1f} of the load remains in the "
        "residuals", "use a load within its range, or have the sensor calibrated by its maker"),
    "matrix_changed": Code(_REJECT, "the matrix of the sensor differs by {sigmas:.1f} sigma from the previous one, "
        "most in {entry}", "check masses and places, then accept it with --accept"),
    # Notes
    **{f"gain_{axis}": Code(_NOTE, f"the gain of the sensor along {axis} is {{gain_percent:+.1f}} off, corrected"
        ) for axis in "xyz"},
    "axes_mixed": Code(_NOTE, "the sensor mixes forces along {axes} by {share_percent:.1f}, corrected"),
    "cross_talk": Code(_NOTE, "the sensor reads up to {torque_mNm:.2g} of torque for 1 N of force, corrected"),
    "response_small": Code(_NOTE, "the sensor has a small error of gain or cross-talk, corrected"),
    "cable_spring": Code(_NOTE, "a torque of {torque_Nm:.2g}, such as from a cable, may shift the centre of mass by "
        "{shift_mm:.2g}", "give the cable more slack"),
    "residuals_alike": Code(_NOTE, "the residuals of successive poses correlate by {correlation:.2f}, most likely "
        "from drift", "let the sensor warm up and shuffle the order of the poses"),
    "pose_deviates": Code(_NOTE, "{pose:poses} deviates from the others by {sigmas:.1f} sigma",
        "consider repeating it"),
    "gravity_tilted": Code(_NOTE, "gravity is tilted by {off_deg:.0f}, along {direction:.2f} in base axes, as for a "
        "robot on a slope", "declare the mounting ([workcell] mounting, --up), or check the base frame and the "
        "orientations"),
    "base_leans": Code(_NOTE, "the base leans {lean_deg:~sigma_deg} (sigma {sigma_deg:~sigma_deg}) towards its {side} "
        "from the declared mounting", "level the base, or set its mounting in the controller"),
    "noise_unknown": Code(_NOTE, "chi2 does not test the fit, because the noise was estimated from the residuals",
        "state the noise of each pose to test it (columns sigma_fx to sigma_tz)"),
    "orientations_deviate": Code(_NOTE, "the poses deviate by up to {off_deg:.2f} from the 24 orientations: a force "
        "error of {force_N:.2g}", "use --method lrom or ml, which take the orientations as they are"),
    "earlier_cell": Code(_NOTE, "mounting, base and gain are taken from {parent}, with their sigmas"),
    "together": Code(_NOTE, "{n_runs} runs were combined, each with its own bias; the result has the bias of the last "
        "run"),
    "updated": Code(_NOTE, "{kind} updated from {n_poses} poses, with the verdict of {parent}"),
    # Notes about single poses, shown with the result
    "pose_turned": Code(_NOTE, "{pose:poses} turned by {turn_deg:.2f} while it was averaged", "repeat it"),
    "pose_unsteady": Code(_NOTE, "{pose:poses} was not steady while it was averaged",
        "look for something that swings or touches the tool, and repeat the pose"),
    "pose_off": Code(_NOTE, "{pose:poses} is off by {force_N:.2g} and {torque_Nm:.2g}"),
    "pose_touched": Code(_NOTE, "{pose:poses} is off by {force_N:.2g} and {torque_Nm:.2g}, as if touched, bumped or "
        "pulled by a cable", "repeat it"),
    "load_swings": Code(_NOTE, "{pose:poses} is off by {force_N:.2g} and {torque_Nm:.2g}: a torque without a force",
        "check whether the load tilts or swings"),
    "cable_pulls": Code(_NOTE, "something pulls on the tool in {poses:poses}",
        "give slack to a cable that is too short there, and repeat these poses"),
    "sensor_drifts": Code(_NOTE, "the reading of the first pose differs at the end, and the poses between drift too",
        "let the sensor warm up for 15 to 30 min, then calibrate again"),
    "return_differs": Code(_NOTE, "{pose:poses} differs at the end, but the poses between do not drift, as if the tool "
        "was touched", "repeat the last stop"),
}
# fmt: on

# Codes that may be mere consequences: of wrong units or another reference point of the torques, and of mistakes in the
# data or changes during the session, which spoil the fit.
_OF_UNITS: Final = frozenset((
    "weight_compensated", "weight_implausible", "com_too_far", "com_too_near", "com_outside_tool", "tool_mass_mismatch",
))  # fmt: skip
_OF_MISTAKES: Final = _OF_UNITS | {
    "drift", "weight_insignificant", "second_solution", "force_error", "torque_error", "known_values_misfit_force",
    "known_values_misfit_torque", "noise_exceeded", "poses_rejected", "poses_unchecked", "gain_x", "gain_y", "gain_z",
    "axes_mixed", "cross_talk", "response_small", "response_not_linear", "cable_acts", "orientations_smoothly_off",
    "cable_spring", "residuals_alike", "pose_deviates",
}  # fmt: skip
_EXPLAINS: Final[Sequence[tuple[frozenset[str], frozenset[str]]]] = (
    (frozenset(("bias_implausible", "torques_about_point", "torques_reversed", "forces_reversed")), _OF_UNITS),
    (
        frozenset((
            "other_recording", "constant_force", "wrench_in_base", "orientations_inverted", "quaternion_order",
            "euler_angles", "columns_swapped", "pairing_shifted", "zeroed_each_pose", "pairing_or_rotations",
            "orientations_off", "torques_unrelated", "axes_disagree", "com_shifted", "load_changed", "bias_stepped",
            "sensor_turned", "sensor_changed", "sensors_alternate",
        )),
        _OF_MISTAKES,
    ),
    (
        frozenset(("gain_not_modelled",)),
        frozenset(("force_error", "torque_error", "noise_exceeded", "residuals_alike")),
    ),
)  # fmt: skip
