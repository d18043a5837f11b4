"""How long a pose is sampled: settings, which a configuration reads without numpy."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sampling:
    """Time limits and repetitions at each pose."""

    average_s: float = 2.0
    still_timeout_s: float = 10.0
    attempts: int = 2
    """Dwells at a pose, at most: a dwell with motion or drift is repeated, and the last one is kept as noisy."""
    noise_record_s: float = 12.0
    """Length of the record before a tour from which the averaging time is chosen; 0 uses `average_s`."""
