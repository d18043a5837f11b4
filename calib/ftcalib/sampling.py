"""Settings for sampling a pose. The module does not import numpy, so that reading a configuration is fast."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sampling:
    """Averaging time, time-out and number of attempts at each pose."""

    average_s: float = 2.0
    still_timeout_s: float = 10.0
    """Time-out for the arm to come to rest, s."""
    attempts: int = 2
    """Largest number of dwells at a pose. A dwell with motion or drift is repeated; the last one is kept anyway."""
    noise_record_s: float = 12.0
    """Duration, s, of the noise record before a tour, from which the averaging time follows; 0: use `average_s`."""
