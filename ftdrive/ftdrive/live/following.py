"""Bias and held part of a stream: from its samples to what is shown, written and, if wanted, applied."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.after.state import Update, with_bias_change
from ftcalib.after.weighing import LEAST_SIGMAS, Weight
from ftcalib.rounding import with_sigma
from ftdrive.live.noise import NoiseEstimator
from ftdrive.live.samples import Paired, StreamEvent, StreamInfo, Tracked
from ftdrive.live.tracking import NOTHING_KG, Tracker
from ftdrive.live.windows import Windows

_REPORT_S = 1.0
"""From one event with the tracked values to the next."""
_APPLIED = np.repeat([0.1, 0.003], 3)
"""A bias that is known less well is not applied, N and N·m, one sigma."""


class Following:
    """Follows bias and part of a stream.

    Parameters
    ----------
    info : StreamInfo
    """

    def __init__(self, info: StreamInfo) -> None:
        calibration = info.calibration
        self._windows = Windows(info)
        self._tracker = Tracker(calibration.mass_kg, calibration.parameters.p_sensor_com_m)
        self._reported_s = -np.inf
        self.tracked: Tracked | None = None
        """None before the first window."""

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._windows.restart()

    def add(
        self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator
    ) -> Iterator[tuple[Tracked, list[StreamEvent]]]:
        """Add samples with their states of motion; yield what is known after each window, and the events."""
        for window in self._windows.add(rows, states, noise):
            tracked = self.tracked = self._tracker.update(window)
            events = []
            for event in tracked.events:
                t_ns = round(event.t_s * 1e9)
                if event.kind == "load":
                    text = f"the load has changed by {with_sigma(event.size, event.sigma)} kg (1 sigma)"
                    values = {"mass_kg": event.size, "mass_sigma_kg": event.sigma}
                    events.append(StreamEvent(t_ns, "load-step", text, values))
                else:
                    values = {"peak_N": event.size, "duration_s": tracked.t_s - event.t_s}
                    text = f"contact {event.size:.1f} N while a part is held"
                    events.append(StreamEvent(t_ns, "contact", text, values))
            if tracked.t_s - self._reported_s >= _REPORT_S:
                self._reported_s = tracked.t_s
                events.append(StreamEvent(round(tracked.t_s * 1e9), "tracked", in_words(tracked), to_dict(tracked)))
            yield tracked, events


def to_dict(tracked: Tracked) -> dict[str, object]:
    """Return what is followed as JSON; the age of the last look is None before the first."""
    return {
        "bias": tracked.bias.tolist(),
        "sigma": tracked.sigma.tolist(),
        "part_kg": tracked.part_kg,
        "part_sigma_kg": tracked.part_sigma_kg,
        "part_known": tracked.part_known,
        "last_seen_s": tracked.last_seen_s if np.isfinite(tracked.last_seen_s) else None,
        "walk_N": tracked.walk_N,
    }


def in_words(tracked: Tracked) -> str:
    """Return size and sigma of the bias and the part, as one line."""
    force_N = float(np.linalg.norm(tracked.bias[:3]))
    sigma_N = float(np.linalg.norm(tracked.sigma[:3]) / np.sqrt(3))
    seen = f", seen {tracked.last_seen_s:.0f} s ago" if tracked.last_seen_s >= 1 else ""
    part = f"{with_sigma(tracked.part_kg, tracked.part_sigma_kg)} kg" if tracked.part_known else "not known yet"
    return f"bias {with_sigma(force_N, sigma_N)} N{seen}, part {part}"


def applied(calibration: CalibrationResult, tracked: Tracked) -> Update | None:
    """Return the calibration with the tracked bias; None while that is not known well."""
    if not (tracked.sigma < _APPLIED).all():
        return None
    return with_bias_change(calibration, tracked.bias, tracked.sigma, measured=True)


def part_of(tracked: Tracked) -> Weight | None:
    """Return the part as if it had been weighed; None for an empty gripper."""
    return None if tracked.part_kg < NOTHING_KG else weight_of(tracked)


def weight_of(tracked: Tracked) -> Weight:
    """Return what is held, nothing included, as if it had been weighed."""
    (x, covariance), mass_kg = tracked.moment, tracked.part_kg
    com_m = x[1:] / (mass_kg or 1.0)
    T = np.column_stack([-com_m, np.eye(3)]) / max(abs(mass_kg), 1e-9)
    return Weight(
        mass_kg=mass_kg,
        mass_sigma_kg=tracked.part_sigma_kg,
        least_kg=LEAST_SIGMAS * tracked.part_sigma_kg,
        p_sensor_com_m=com_m,
        com_covariance=T @ covariance @ T.T,
        line=None,
        fault=None,
        chi2=0.0,
        dof=0,
        poses=0,
        in_motion=True,
        moment=(x, covariance),
    )
