"""Findings where a result contradicts the described cell: tool, payload, mounting. With one it is at best usable."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.assessment.contradictions import as_with, force_units
from ftcalib.assessment.faults import units
from ftcalib.assessment.verdict import REVERSED_TILT_DEG, reversed_signs
from ftcalib.model import Array
from ftcalib.poses.sphere import evenly_spread
from ftdrive.checks.controller_settings import OTHER_MOUNTING_DEG, lean_from, lean_in_words, payload_in_words
from ftdrive.planning.geometry.scene import down_of

COM_MARGIN_M = 0.01
"""Cables and screws may reach this far out of the described cylinders."""
SURELY_OUTSIDE_M = 0.1
"""A centre of mass farther outside than this is wrong; nearer, the description may be."""
FAR_COM_M = 0.1
"""Units are suspected where the centre of mass is outside and farther from the sensor than this."""
TOOL_KG, TOOL_SHARE = 0.1, 0.3
"""[tool] mass_kg is known to about the larger of this mass and this share."""
_SIGNIFICANT = 4.0


def judged(result: CalibrationResult) -> CalibrationResult:
    """Return the result with what contradicts the `setup` of its provenance as first reasons; as it is if nothing does.

    The setup is that of `ftdrive.runs.outcome`; a result from another source has none.
    """
    setup = result.provenance.get("setup")
    if setup is None or result.verdict == "rejected":
        return result
    up_in_base = -down_of(setup.get("mounting") or "floor")
    outside, surely = com_in_words(result, setup)
    mounting = _mounting(result, setup)
    found = [tool_mass_in_words(result, setup), _payload(result, setup), outside]
    if not any((mounting, *found)):
        return result
    causes = reversed_signs(result.parameters, result.covariance, up_in_base)
    causes = [words for words in causes if words in result.reasons]
    first = tuple(words for words in (mounting, *causes, *found) if words)
    reasons = (*first, *(words for words in result.reasons if words not in first))
    return replace(result, verdict="rejected" if surely else "usable", reasons=reasons)


def com_in_words(result: CalibrationResult, setup: Mapping[str, Any]) -> tuple[str, bool]:
    """Return how far the centre of mass lies outside the described tool, and whether that is surely wrong.

    A body's centre of mass lies in its convex hull. The distance from that of the cylinders is the largest over all
    directions of the point's reach beyond the hull's, less margin and sigma in that direction. Without the sensor's
    height its origin may be anywhere between flange face and tip.
    """
    cylinders = setup.get("cylinders_mm") or ()
    if not cylinders:
        return "", False
    hull_m = _reach_m(cylinders)
    height_m = setup.get("height_mm")
    lowest_m, highest_m = (0.0, max(row[1] for row in cylinders) / 1e3) if height_m is None else (height_m / 1e3,) * 2
    com_m = result.R_flange_sensor @ result.p_sensor_com_m
    covariance = result.R_flange_sensor @ result.covariance[9:12, 9:12] @ result.R_flange_sensor.T
    along_z = _DIRECTIONS[:, 2]
    reach_m = _DIRECTIONS @ com_m + np.minimum(along_z * lowest_m, along_z * highest_m)
    sigma_m = np.sqrt(np.einsum("ni,ij,nj->n", _DIRECTIONS, covariance, _DIRECTIONS))
    outside_m = float((reach_m - hull_m - _SIGNIFICANT * sigma_m).max())
    if outside_m <= COM_MARGIN_M:
        return "", False
    origin, from_origin_m = ("sensor", 0.0) if height_m is None else ("flange", lowest_m)
    x, y, z = 1e3 * np.add(com_m, (0.0, 0.0, from_origin_m))
    from_sensor_m = float(np.linalg.norm(com_m))
    like = ", or ".join(units(from_sensor_m)) if from_sensor_m > FAR_COM_M else ""
    return (
        f"the centre of mass, at ({x:.0f}, {y:.0f}, {z:.0f}) mm from the {origin} in flange axes, lies "
        f"{1e3 * outside_m:.0f} mm outside the tool of [tool] cylinders_mm{like and f', as with {like}'}: check signs "
        "and units of forces and torques, then the description of the tool",
        outside_m > SURELY_OUTSIDE_M,
    )


def tool_mass_in_words(result: CalibrationResult, setup: Mapping[str, Any]) -> str:
    """Return the difference between the weighed mass and [tool] mass_kg; empty if they agree or none is described."""
    tool_kg = setup.get("tool_mass_kg")
    if tool_kg is None or abs(result.mass_kg - tool_kg) <= max(
        TOOL_KG, TOOL_SHARE * tool_kg, _SIGNIFICANT * result.sigma["mass_kg"]
    ):
        return ""
    like = as_with(result.parameters, force_units(result.mass_kg, tool_kg))
    return (
        f"{result.mass_kg:.3g} kg hang on the sensor, but [tool] mass_kg is {tool_kg:.3g} kg{like}: check the sensor's "
        "units and what is mounted, or correct [tool] mass_kg"
    )


def _payload(result: CalibrationResult, setup: Mapping[str, Any]) -> str:
    """Words of a payload that no unit explains: `ftcalib.solve` names units."""
    payload_kg, sensor_kg = setup.get("payload_kg"), setup.get("sensor_mass_kg")
    if payload_kg is None or force_units(result.mass_kg, payload_kg - (sensor_kg or 0.0)):
        return ""
    return payload_in_words(payload_kg, result.mass_kg, sensor_kg)


def _mounting(result: CalibrationResult, setup: Mapping[str, Any]) -> str:
    """Words of gravity far from that of the mounting; `ftcalib.solve` names a sign that makes it point upwards."""
    mounting = setup.get("mounting")
    if mounting is None:
        return ""
    force_N, covariance = result.gravity_force_base_N, result.covariance[3:6, 3:6]
    if not OTHER_MOUNTING_DEG < lean_from(down_of(mounting), force_N, covariance).deg < REVERSED_TILT_DEG:
        return ""
    return lean_in_words(force_N, covariance, mounting)


_DIRECTIONS = np.vstack([evenly_spread(2000), np.eye(3), -np.eye(3)])
"""Neighbours are about 4° apart, so the distance is exact to 0.1 %."""


def _reach_m(cylinders_mm: Sequence[Sequence[float]]) -> Array:
    """Return how far the convex hull of cylinders along flange z reaches in each direction."""
    aside, along_z = np.linalg.norm(_DIRECTIONS[:, :2], axis=1), _DIRECTIONS[:, 2]
    reaches = [
        np.maximum(along_z * row[0], along_z * row[1]) + aside * row[2] / 2 + _DIRECTIONS[:, :2] @ (row[3:] or (0, 0))
        for row in cylinders_mm
    ]
    return np.asarray(np.max(reaches, axis=0) / 1e3)
