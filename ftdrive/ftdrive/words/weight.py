"""Texts of the screen and page of a scale, in addition to the line of `ftdrive.stream.weighing.format_scale`."""

from datetime import timedelta
from math import isfinite

from ftcalib.after.weighing import Weight
from ftcalib.rounding import to_place_of
from ftdrive.runs.verification import age_in_words
from ftdrive.stream.weighing import Weighing

NO_MASS = "- - -"
# A larger smallest mass, kg, is caused by drift since the calibration, and a zero helps.
_UNZEROED_KG = 0.1


def worth_of(weight: Weight) -> str:
    """Return the sigma and the smallest mass of a weight as text."""
    sigma_g, least_g = (to_place_of(1e3 * kg, 1e3 * kg) for kg in (weight.mass_sigma_kg, weight.least_kg))
    return f"sigma {sigma_g} g, smallest mass {least_g} g"


def zero_in_words(weighing: Weighing) -> tuple[str, bool]:
    """Return the age of the zero, and whether another one would help; empty if the bias is tracked."""
    if weighing.moving:
        return "", False
    zeroed_s, weight = weighing.stream.processor.monitor.reference()[1], weighing.shown.measured
    helps, zeroed = weight is not None and weight.least_kg > _UNZEROED_KG, isfinite(zeroed_s)
    age = f"zeroed {age_in_words(timedelta(seconds=zeroed_s))} ago" if zeroed else "not zeroed"
    return age + (f": zero {'again' if zeroed else 'the empty gripper'}" if helps else ""), helps
