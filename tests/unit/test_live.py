"""The live readout with sensors that are slow: noise is only told from enough samples."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.noise import LEAST_SAMPLES
from drivers.interfaces import Health
from ftdrive.commands import live


class Slow:
    """A sensor of 70 Hz and an arm at rest."""

    def __init__(self) -> None:
        self.sent = 0

    def open(self, **_: Any) -> None: ...

    def close(self) -> None: ...

    def __enter__(self) -> "Slow":
        return self

    def __exit__(self, *_: object) -> None: ...

    def identify(self) -> SimpleNamespace:
        return SimpleNamespace(serial="1", model="M")

    def state(self) -> SimpleNamespace:
        return SimpleNamespace(R_base_flange=np.eye(3))

    def health(self) -> Health:
        return Health(received=self.sent, lost=0, malformed=0, rate_Hz=70.0, age_s=0.0)

    def collect(self, duration_s: float) -> SimpleNamespace:
        n = round(70 * duration_s)
        first, self.sent = self.sent, self.sent + n
        return SimpleNamespace(wrench=np.add.outer(np.arange(first, self.sent, dtype=float), np.arange(6.0)))


def test_a_slow_sensor_is_averaged_over_the_newest_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Slow()
    monkeypatch.setattr(live, "build_sensor", lambda _: sensor)
    monkeypatch.setattr(live, "build_arm", lambda _: Slow())
    calibration: Any = SimpleNamespace(provenance={})
    with live._live_looks(SimpleNamespace(), calibration) as looks:  # type: ignore[arg-type]  # nothing is asked of it
        for _ in range(3):
            look = next(looks)
            newest = np.arange(sensor.sent - LEAST_SAMPLES, sensor.sent)
            np.testing.assert_allclose(look.mean.mean[0], newest.mean())


def test_a_slow_recording_is_shown_in_pieces_long_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda _: None)
    n = 95
    samples = SimpleNamespace(
        t_host_ns=np.arange(n) * 10_000_000, wrench=np.add.outer(np.arange(n) * 1.0, np.zeros(6)), seq=np.arange(n)
    )
    record = SimpleNamespace(samples=samples, before=SimpleNamespace(R_base_flange=np.eye(3)))
    run: Any = SimpleNamespace(records=lambda: [record])
    looks = list(live._recorded_looks(run))
    assert [look.mean.mean[0] for look in looks] == [9.5, 29.5, 49.5, 69.5]
    assert looks[0].rate_Hz == pytest.approx(100)
