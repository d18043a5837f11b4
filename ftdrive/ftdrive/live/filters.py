"""Notch, low-pass and deadband of a stream."""

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.live.samples import Stages
from ftdrivers.interfaces import Array

LOWPASS_ORDER = 2
"""Butterworth."""
NOTCH_Q = 10.0
"""Frequency over width at -3 dB."""


class Filter:
    """Notch and low-pass as second-order sections, whose state lasts from block to block.

    It begins in the steady state of its first sample, so that there is no transient.

    Parameters
    ----------
    stages : Stages
    rate_Hz : float
        Of the sensor.

    Raises
    ------
    ConfigError
        A frequency is not between 0 and half the rate.
    """

    def __init__(self, stages: Stages, rate_Hz: float) -> None:
        self.power_gain = 1.0
        """Variance of filtered over unfiltered white noise."""
        self._state: Array | None = None
        self._sections = np.empty((0, 6))
        if stages.notch_Hz is None and stages.lowpass_Hz is None:
            return
        from scipy import signal

        sections = []
        for name, f_Hz in (("notch", stages.notch_Hz), ("low-pass", stages.lowpass_Hz)):
            if f_Hz is None:
                continue
            if not 0 < f_Hz < rate_Hz / 2:
                raise ConfigError(
                    f"a {name} of {f_Hz:g} Hz is not possible at {rate_Hz:g} Hz: choose more than 0 and less than "
                    f"{rate_Hz / 2:g} Hz"
                )
            if name == "notch":
                sections.append(signal.tf2sos(*signal.iirnotch(f_Hz, NOTCH_Q, rate_Hz)))
            else:
                sections.append(signal.butter(LOWPASS_ORDER, f_Hz, fs=rate_Hz, output="sos"))
        self._sections = np.concatenate(sections)
        self._steady = signal.sosfilt_zi(self._sections)
        self._run = signal.sosfilt
        # the area under |H|² is exact on this grid unless the cut-off is below a thousandth of the rate
        self.power_gain = float(np.mean(np.abs(signal.sosfreqz(self._sections, 1 << 14)[1]) ** 2))

    def __call__(self, wrench: Array) -> Array:
        """Filter the next samples (n, 6)."""
        if not len(self._sections) or not len(wrench):
            return wrench
        if self._state is None:
            self._state = self._steady[:, :, None] * wrench[0]
        filtered, self._state = self._run(self._sections, wrench, axis=0, zi=self._state)
        return np.asarray(filtered)


def deadband(wrench: Array, force_N: float, torque_Nm: float) -> Array:
    """Shorten force and torque vectors of wrenches (n, 6) by a deadband; shorter ones become zero.

    The length counts and not each axis, so that a deadband is the same in all axes.
    """
    if not force_N and not torque_Nm:
        return wrench
    vectors = wrench.reshape(-1, 2, 3)
    length = np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-300)
    left = np.maximum(1 - np.array([[force_N], [torque_Nm]]) / length, 0.0)
    return np.asarray((vectors * left).reshape(-1, 6))
