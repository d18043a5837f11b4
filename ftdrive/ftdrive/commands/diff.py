"""`ftdrive diff`: the difference between two calibrations, in sigmas."""

from dataclasses import asdict
from math import degrees, isfinite
from pathlib import Path
from typing import Any, NamedTuple

import click

from ftcalib import CalibrationResult
from ftcalib.after.series import ChiSquare, Difference, EstimatedParameters, calibration_difference
from ftcalib.model import PARAMETER_NAMES
from ftcalib.rounding import to_place_of
from ftdrive.commands.options import JSON, write_json
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import EMULATED, marks_of, read_calibration
from ftdrive.store import open_store
from ftdrive.terminal.text import echo
from ftdrive.words.result import sensor_in_words

_SIGNIFICANT = 0.01
_ROWS = (
    ("R_flange_sensor", "mounting", "°", degrees(1.0)),
    ("gravity_force_base_N", "weight, base axes", "N", 1.0),
    ("force_bias_N", "force bias", "N", 1.0),
    ("p_sensor_com_m", "centre of mass", "mm", 1e3),
    ("torque_bias_Nm", "torque bias", "N·m", 1.0),
)


class _Side(NamedTuple):
    calibrated: EstimatedParameters
    id: str
    path: str
    created_utc: str | None
    mass_kg: float
    mass_sigma_kg: float
    # whether the calibration was made in an emulated cell
    emulated: bool


@click.command()
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@JSON
def diff(first: str, second: str, as_json: bool) -> None:
    """Compare two calibrations A and B: files, run folders, or ids of `ftdrive history` (the first digits suffice).

    The differences B minus A are given in combined sigmas, with a joint test that uses both covariances. The mounting
    is compared as one rotation about the flange axes. The exit code is 0 for any difference.
    """
    a, b = _side(first), _side(second)
    found, sensors = calibration_difference(a.calibrated, b.calibrated), _sensors(a, b)
    mass_change_kg, sigma_kg = b.mass_kg - a.mass_kg, (a.mass_sigma_kg**2 + b.mass_sigma_kg**2) ** 0.5
    if as_json:
        sides = {"a": a._asdict(), "b": b._asdict()}
        for one in sides.values():
            del one["calibrated"]
        values = zip(
            PARAMETER_NAMES, found.change.tolist(), found.sigma.tolist(), found.in_sigmas.tolist(), strict=True
        )
        write_json(
            {
                "schema_version": 1,
                **sides,
                "mass_kg": {"change": mass_change_kg, "sigma": sigma_kg},
                "parameters": [
                    {"name": name, "change": change, "sigma": sigma, "in_sigmas": ratio if isfinite(ratio) else None}
                    for name, change, sigma, ratio in values
                ],
                "groups": {name: _chi_square_json(test) for name, test in found.groups.items()},
                "joint": _chi_square_json(found.joint),
                "significant": found.joint.p_value < _SIGNIFICANT,
                "sensors": sensors,
            }
        )
        return
    for name, side in (("A", a), ("B", b)):
        made = (side.created_utc or "unknown time")[:16].replace("T", " ")
        echo("  ".join([name, side.id[:6], made, *(["EMULATED"] if side.emulated else []), side.path]))
    if sensors is not None:
        echo(f"Contacts are measured differently: the errors of the sensor are {sensors[0]} in A, {sensors[1]} in B.")
    echo(f"{'B minus A':22}{'change':>12}{'± 1 sigma':>12}{'in sigmas':>11}")
    echo(_change_line("mass, kg", mass_change_kg, sigma_kg))
    for i, (_, label, unit, scale) in enumerate(_ROWS):
        for k, axis in enumerate("xyz"):
            row = 3 * i + k
            echo(_change_line(f"{label} {axis}, {unit}", scale * found.change[row], scale * found.sigma[row]))
    if found.joint.dof:
        echo("Sigma from noise only: the effects of gain and cross-talk of one sensor are equal in A and B.")
    echo(_describe_difference(found, sensors))


def _side(text: str) -> _Side:
    if (path := Path(text)).exists():
        result = read_calibration(path)
        sigma_kg = result.parameters.weight_sigma_N(result.covariance) / result.g_m_s2
        created = result.provenance.get("created_utc")
        emulated = EMULATED in marks_of(result)
        made = created if isinstance(created, str) else None
        return _Side(result, result.id, text, made, result.mass_kg, sigma_kg, emulated)
    if len(text) < 4 or not set(text) <= set("0123456789abcdef"):
        raise ConfigError(f"'{text}' is neither a file nor an id: give a path, or at least 4 digits of an id")
    store = open_store()
    found = store.find(text)
    if not found:
        raise ConfigError(f"the store {store.name} has no result {text}…: `ftdrive history` lists them")
    if len(found) > 1:
        ids = ", ".join(one.id for one in found)
        raise ConfigError(f"{text} matches {ids}: give more digits")
    one = found[0]
    return _Side(one, one.id, one.path, one.created_utc, one.mass_kg, one.mass_sigma_kg, bool(one.emulated))


def _sensors(a: _Side, b: _Side) -> tuple[str, str] | None:
    """Return texts about the sensor errors under contact in A and in B; None if they are equal or unknown."""
    first, second = a.calibrated, b.calibrated
    # a result from the store has no sensor matrix, so its errors under contact are unknown
    if not (isinstance(first, CalibrationResult) and isinstance(second, CalibrationResult)):
        return None
    if first.contact.sensor.to_dict() == second.contact.sensor.to_dict():
        return None
    return sensor_in_words(first), sensor_in_words(second)


def _change_line(label: str, change: float, sigma: float) -> str:
    if change == 0:
        return f"{label:22}{'same':>12}"
    spread, ratio = (to_place_of(sigma, sigma), f"{change / sigma:+11.1f}") if sigma > 0 else ("known", "")
    return f"{label:22}{to_place_of(change, sigma, '+'):>12}{spread:>12}{ratio}"


def _describe_difference(found: Difference, sensors: tuple[str, str] | None) -> str:
    joint = found.joint
    if joint.dof == 0:
        but = "" if sensors is None else f", but the errors of the sensor are {sensors[0]} in A, {sensors[1]} in B"
        return f"The calibrations are the same{but}."
    test = f"chi2 {joint.chi2:.1f} for {joint.dof} degrees of freedom, p = {joint.p_value:.2g}"
    if joint.p_value >= _SIGNIFICANT:
        return f"They agree within their uncertainty ({test})."
    changed = [label for name, label, *_ in _ROWS if found.groups[name].p_value < _SIGNIFICANT / len(_ROWS)]
    return f"They differ significantly ({test}): {', '.join(changed) or 'several parameters together'}."


def _chi_square_json(test: ChiSquare) -> dict[str, Any]:
    return asdict(test) | ({} if isfinite(test.chi2) else {"chi2": None})
