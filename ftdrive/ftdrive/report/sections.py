"""The sections of a report, in the order in which a reader needs them."""

from collections.abc import Mapping
from typing import Any

from ftdrive.report.document import Section
from ftdrive.report.fit_sections import coverage, cross_validation, drift, error, estimates, noise, residuals
from ftdrive.report.motion_section import motion
from ftdrive.report.origin_sections import comparison, provenance, tour


def sections_of(facts: Mapping[str, Any]) -> list[Section]:
    """Write the sections in the order in which a reader needs them; one without data says why it is empty."""
    return [
        estimates(facts),
        error(facts),
        *([motion(facts)] if facts["motion"] is not None else []),
        cross_validation(facts),
        residuals(facts),
        drift(facts),
        noise(facts),
        coverage(facts),
        tour(facts),
        comparison(facts),
        provenance(facts),
    ]
