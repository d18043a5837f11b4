"""The section about motion: inertia, delay, what was used and what was contact, from the facts."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ftcalib.rounding import with_sigma
from ftdrive.report.document import Figure, Section, Table
from ftdrive.report.words import rounded

Facts = Mapping[str, Any]


def motion(facts: Facts) -> Section:
    """Show what only motion gives, and the planned sweep."""
    found = facts["motion"]
    sigma = found["sigma"]
    moments, of_moments = (np.array(values) for values in (found["inertia_kg_m2"], sigma["inertia_kg_m2"]))
    principal = np.linalg.eigvalsh(moments)
    text = [
        f"{100 * found['used_share']:.0f} % of the recording was used. Not used: contact, gaps, both ends, which the "
        "filter needs, and what is too fast where the position is unknown.",
        f"The wrench follows the pose by {with_sigma(1e3 * found['delay_s'], 1e3 * sigma['delay_s'])} ms.",
        f"The origin of the sensor is {with_sigma(1e3 * found['height_m'], 1e3 * sigma['height_m'])} mm above the "
        "flange face, as the acceleration shows it.",
        f"Principal moments of inertia about the centre of mass: {', '.join(rounded(1e3 * one) for one in principal)} "
        "g·m². Good: all positive, and each at most the sum of the others.",
    ]
    rows = [
        (f"{'xyz'[i]}{'xyz'[j]}", f"{1e3 * moments[i, j]:.3f}", f"{1e3 * of_moments[i, j]:.3f}")
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ]
    tables = [Table("Inertia about the centre of mass, sensor axes, g·m²", ("axes", "estimate", "± 1 sigma"), rows)]
    touches = [
        (
            f"{one['t_s']:.1f}",
            *(rounded(one[key], 2) for key in ("duration_s", "force_N", "torque_Nm")),
        )
        for one in found["contacts"]
    ]
    if touches:
        columns = ("at, s", "for, s", "force, N", "torque, N·m")
        tables.append(Table("Contact, which was left out", columns, touches))
    else:
        text.append("No contact was found.")
    figures = []
    if found["sweep"] is not None:
        figures.append(
            Figure(
                "sweep",
                f"Angles of the three wrist joints against time in the planned sweep of "
                f"{found['sweep']['duration_s']:.0f} s.",
                "The planned sweep: wrist joints against time at the planned speed. It begins and ends at rest.",
            )
        )
    return Section("motion", "Motion", text, figures, tables)
