"""Texts of `ftdrive loads`: the check of a sensor with a known load, and the estimate of its matrix from several."""

from collections.abc import Iterator
from math import degrees

import numpy as np

from ftcalib.loads.check import LoadCheck
from ftcalib.loads.model import KnownLoad
from ftcalib.loads.solve import AXES, LoadSolution
from ftcalib.model import Parameters
from ftcalib.rounding import with_sigma
from ftcalib.sensor_matrix import SensorMatrix


def check_lines(found: LoadCheck, load: KnownLoad) -> Iterator[str]:
    """Yield lines about a known load: its reading, and whether the error is within what is stated for the sensor."""
    off = with_sigma(100 * found.scale_error, 100 * found.scale_sigma, "+")
    yield f"reads {found.read_N:.3f} N, expected {found.expected_N:.3f} N: {off} %"
    line = ""
    if load.p_flange_m is not None:
        line = f"; line of action {with_sigma(1e3 * found.off_m, 1e3 * found.off_sigma_m)} mm from {load.name}"
    yield f"{degrees(found.off_vertical_rad):.1f}° off the vertical{line}"
    promised = f"{100 * found.promised_sigma:.1f} % (1 sigma) stated for the sensor"
    if not found.is_within:
        yield f"OUTSIDE the {promised}: check the mass, or calibrate with known loads."
    elif found.is_significant:
        yield f"Within the {promised}. Known loads can correct the error: ftdrive calibrate --load, ftdrive loads solve"
    else:
        yield f"No significant error, and within the {promised}."


def solution_lines(solution: LoadSolution, prior: SensorMatrix) -> Iterator[str]:
    """Yield lines about a sensor matrix estimated from known loads: loads, tool, matrix, findings."""
    yield f"{'load':14}{'mass, kg':>22}{'place from the flange, mm':>44}"
    for one in solution.loads:
        place = ", ".join(
            with_sigma(1e3 * p, 1e3 * s) for p, s in zip(one["p_flange_m"], one["p_sigma_m"], strict=True)
        )
        yield f"{one['name']:14}{with_sigma(one['mass_kg'], one['mass_sigma_kg']):>22}{place:>44}"
    yield f"{'tool':14}{with_sigma(solution.tool_mass_kg, solution.tool_mass_sigma_kg):>22}"
    tip_m = max((abs(one["p_flange_m"][2]) for one in solution.loads), default=0.2)
    before, _ = _contact_sigma(prior, tip_m)
    yield from matrix_lines(solution.sensor, tip_m, f" (before this solution: ± {before:.2g} N)")
    yield from (f"{finding.severity.upper()}  {finding.words}" for finding in solution.findings)


def matrix_lines(sensor: SensorMatrix, tip_m: float, beside: str) -> Iterator[str]:
    """Yield lines about a sensor matrix: its gain errors; the sigma of 100 N at the tool tip, and the text `beside`."""
    diagonal = zip(AXES, sensor.error.diagonal(), sensor.sigma.diagonal(), strict=True)
    yield "diagonal, %: " + ", ".join(f"{axis} {with_sigma(100 * e, 100 * s, '+')}" for axis, e, s in diagonal)
    force, torque = _contact_sigma(sensor, tip_m)
    yield f"100 N at {1e3 * tip_m:.0f} mm: ± {force:.2g} N, ± {torque:.2g} N·m{beside}"


def _contact_sigma(sensor: SensorMatrix, tip_m: float) -> tuple[float, float]:
    """Return the sigmas of force, N, and torque, N·m, for 100 N at the tip, as rms of the error over all directions."""
    nothing = Parameters(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    force, torque = sensor.contact_response(nothing).sigma_at(np.array([0, 0, tip_m]))
    return 100 * force, 100 * torque
