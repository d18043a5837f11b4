"""Plausibility checks of a stream: frozen readings, the clock of the device, the sample rate."""

import logging
import math
from collections.abc import Callable

import numpy as np

from ftdrivers.errors import Frozen, ProtocolError, StreamBroken
from ftdrivers.interfaces import Array, FtSamples

log = logging.getLogger(__name__)

_FROZEN_S = 0.2
# With white noise of 0.4 quantization steps on every axis, 20 identical readings in a row have a probability of 1e-12,
# with 0.3 steps of 1e-5. A sensor is frozen if all samples of 0.2 s are identical, at least 20 and at most 50 of them.
# Reason: docs/decisions/sensors.md, 38.
_FROZEN_SAMPLES = (20, 50)
# Largest time, s, by which the device's clock may gain on ours between two blocks. A late block makes it lose time.
_CLOCK_JUMP_S = 0.5
# The device's clock may run slower than ours by this fraction. Samples of a slower clock are treated as late.
_CLOCK_DRIFT = 0.02
_RATE_TOLERANCE, _RATE_WINDOW_S = 0.1, 2.0


class Liveness:
    """Checks that readings are finite and that the sensor is not frozen."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.forget()

    def forget(self) -> None:
        """Forget earlier samples, for example after a reconnection."""
        self._last = np.zeros(0)
        self._same_rows, self._same_since_ns = 0, 0

    def judge(self, samples: FtSamples, nominal_Hz: float) -> None:
        """Raise `ProtocolError` if a wrench is not finite, and `Frozen` if it has not changed for too long."""
        # Not checked on hardware: a strong low-pass filter in the device could repeat readings of a healthy sensor.
        wrench, t_host_ns = samples.wrench, samples.t_host_ns
        if not np.isfinite(wrench).all():
            raise ProtocolError(f"{self._name}: the sensor sends a wrench that is not finite", "power it off and on")
        last = wrench[-1]
        other = np.flatnonzero((wrench != last).any(axis=1))
        if len(other) or not np.array_equal(last, self._last):
            first = int(other[-1]) + 1 if len(other) else 0
            self._same_rows, self._same_since_ns = len(wrench) - first, int(t_host_ns[first])
        else:
            self._same_rows += len(wrench)
        self._last = last
        same_s = (int(t_host_ns[-1]) - self._same_since_ns) / 1e9
        fewest, most = _FROZEN_SAMPLES
        enough = most if math.isnan(nominal_Hz) else min(most, max(fewest, _FROZEN_S * nominal_Hz))
        if self._same_rows >= enough and same_s >= _FROZEN_S:
            raise Frozen(
                f"{self._name}: frozen, {self._same_rows} identical samples in {same_s:.2f} s, although every "
                "measurement has noise",
                "power it off and on",
            )


class DeviceClock:
    """Compares durations on the device's clock with those on the host's clock."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._first: tuple[float, float] | None = None
        self._lead_s = 0.0

    def late_s(self, t_device_s: Array, heard_s: float) -> Array:
        """Return the delay (n,) of each sample relative to the fastest one so far, s; zeros if the device has no clock.

        Raises `StreamBroken` if the device's clock jumps back or ahead.
        """
        newest_s = float(t_device_s[-1])
        if math.isnan(newest_s):
            return np.zeros(len(t_device_s))
        if self._first is None:
            self._first = newest_s, heard_s
            self._newest = float(t_device_s[0]), heard_s
        before_s, heard_before_s = self._newest
        self._newest = newest_s, heard_s
        leads_s = (t_device_s - self._first[0]) - (heard_s - self._first[1])
        lead_s = float(leads_s[-1])
        step_s = lead_s - self._lead_s
        # samples of a clock that is slow, and has no other fault, lag ever more; they do not count as late
        self._lead_s = max(lead_s, self._lead_s - _CLOCK_DRIFT * (heard_s - heard_before_s))
        back_s = float((np.concatenate([[before_s], t_device_s[:-1]]) - t_device_s).max())
        if back_s > 0:
            raise StreamBroken(
                f"{self._name}: the device's clock jumped back by {back_s:.3f} s to {newest_s:.3f} s: it has restarted",
                "open it again",
            )
        if step_s > _CLOCK_JUMP_S:
            raise StreamBroken(
                f"{self._name}: the device's clock jumped ahead by {step_s:.3f} s to {newest_s:.3f} s", "open it again"
            )
        return self._lead_s - leads_s


class Rate:
    """Compares the sample rate with the nominal rate; `fix` returns what to do about a measured rate in Hz."""

    def __init__(self, name: str, fix: Callable[[float], str]) -> None:
        self._name = name
        self._fix = fix
        self._is_wrong = False
        self.forget()

    def forget(self) -> None:
        """Restart the count of samples, from which the rate follows, with the next samples."""
        self._since_ns, self._samples = 0, 0

    def judge(self, samples: int, t_host_ns: int, nominal_Hz: float) -> str | None:
        """Return a text for the log when the rate becomes wrong, and when it is right again; otherwise None."""
        if math.isnan(nominal_Hz):
            return None
        self._samples += samples
        if not self._since_ns:
            self._since_ns, self._samples = t_host_ns, 0
        elapsed_s = (t_host_ns - self._since_ns) / 1e9
        if elapsed_s < _RATE_WINDOW_S:
            return None
        rate_Hz = self._samples / elapsed_s
        self._since_ns, self._samples = t_host_ns, 0
        error = abs(rate_Hz / nominal_Hz - 1)
        if self._is_wrong and error < _RATE_TOLERANCE / 2:
            self._is_wrong = False
            return f"rate {rate_Hz:.1f} Hz, correct again"
        if not self._is_wrong and error > _RATE_TOLERANCE:
            self._is_wrong = True
            log.warning("%s: %.1f Hz instead of %g Hz; %s", self._name, rate_Hz, nominal_Hz, self._fix(rate_Hz))
            return f"rate {rate_Hz:.1f} Hz instead of {nominal_Hz:g} Hz"
        return None
