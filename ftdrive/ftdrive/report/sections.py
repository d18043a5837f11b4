"""The sections of a report, in the order in which a reader needs them."""

from collections.abc import Mapping
from typing import Any

from ftdrive.report.document import Section
from ftdrive.report.fit_sections import coverage, cross_validation, drift, error, estimates, noise, residuals
from ftdrive.report.motion_section import motion
from ftdrive.report.origin_sections import comparison, provenance, tour


def sections_of(facts: Mapping[str, Any]) -> list[Section]:
    """Write the sections in the order in which a reader needs them; one without data says why it is empty.

    A calibration in motion has no poses, and so none of the sections about single ones.
    """
    in_motion = facts["motion"] is not None
    return [
        estimates(facts),
        error(facts),
        *([motion(facts)] if in_motion else [cross_validation(facts)]),
        residuals(facts),
        *([] if in_motion and facts["drift"]["in_fit"] is None else [drift(facts)]),
        *([] if in_motion else [noise(facts)]),
        coverage(facts),
        tour(facts),
        comparison(facts),
        provenance(facts),
    ]
