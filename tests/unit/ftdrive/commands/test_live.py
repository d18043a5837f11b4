"""The live readout: enough samples from slow sensors, and a screen that stands still and says when it ends."""

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from calib import CalibrationDataset, CalibrationResult, Known, Parameters, solve
from calib.data.dwell_mean import LEAST_SAMPLES, PoseMean
from calib.model import predict
from calib.published.yu import SPECIAL_R_flange_base
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


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """A recording of three looks with changing signs, and a calibration of nothing; the command's arguments."""
    calibration: Any = SimpleNamespace(
        provenance={},
        verdict="good",
        compensate=lambda raw, _: raw - 9.5,
        wrench_covariance=lambda _: np.zeros((6, 6)),
        predicted_error=lambda: (0.0, 0.0),
        quality={},
        R_flange_sensor=np.eye(3),
    )
    n = 60
    wrench = np.add.outer(np.repeat([9.4, -3.0, 12.0], 20), np.linspace(0.0, 1e-3, 6)) + np.arange(n)[:, None] % 2
    samples = SimpleNamespace(t_host_ns=np.arange(n) * 10_000_000, wrench=wrench, seq=np.arange(n))
    record = SimpleNamespace(samples=samples, before=SimpleNamespace(R_base_flange=np.eye(3)))
    monkeypatch.setattr(CalibrationResult, "load", lambda _: calibration)
    monkeypatch.setattr(live, "Run", lambda _: SimpleNamespace(records=lambda: [record]))
    monkeypatch.setattr("time.sleep", lambda _: None)
    file = tmp_path / "calibration.json"
    file.touch()
    return ["--calibration", str(file), "--replay", str(tmp_path)]


def test_the_end_of_a_recording_is_said(recorded: list[str]) -> None:
    shown = CliRunner().invoke(live.live, recorded, catch_exceptions=False).stderr
    assert shown.rstrip().endswith("The recording has ended.")
    assert "Ctrl-C" not in shown


def test_what_is_typed_does_not_break_the_screen(recorded: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    quiet: list[str] = []

    class Keyboard:
        def __init__(self, fd: int) -> None:
            assert fd == 0

        usable = staticmethod(lambda _: True)

        def __enter__(self) -> None:
            quiet.append("echo off")

        def __exit__(self, *_: object) -> None:
            quiet.append("as before")

    def screen(*_: object) -> str:
        quiet.append("shown")
        return "a screen"

    monkeypatch.setattr(live, "_screen", screen)
    monkeypatch.setattr(live, "Keyboard", Keyboard)
    CliRunner().invoke(live.live, recorded, catch_exceptions=False)
    assert quiet == ["echo off", "shown", "shown", "shown", "as before"]


def test_sigma_is_as_honest_as_the_headline_of_the_report() -> None:
    truth = Parameters(np.eye(3), np.array([0.1, -0.2, -5.0]), np.zeros(3), np.array([0.0, 0.0, 0.05]), np.zeros(3))
    R = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
    off = np.random.default_rng(1).normal(size=(24, 6)) * np.repeat([0.02, 0.001], 3)  # ten times the measured noise
    cov = np.tile(np.diag(np.repeat([2e-3, 1e-4], 3) ** 2), (24, 1, 1))
    known = Known(mass_kg=0.6)  # too much
    calibration = solve(
        CalibrationDataset(R, predict(truth, R) + off, cov, np.zeros(24, np.int64), np.full(24, np.nan)), known=known
    )
    headline = calibration.likely_error()
    assert (headline > 1.1 * np.array(calibration.predicted_error())).all()
    mean = PoseMean(np.zeros(6), np.zeros((6, 6)), 20)
    beyond = live._beyond_noise(calibration)
    shown = [live._reading(live.Look(mean, one, 1e3, 0), calibration, beyond, "base")["sigma"] for one in R]
    rms = [float(np.sqrt(np.mean([np.sum(np.square(one[key])) for one in shown]))) for key in ("force_N", "torque_Nm")]
    np.testing.assert_allclose(rms, headline)
    assert min(min(one["force_N"]) for one in shown) > 0.5 * headline[0] / np.sqrt(3)


@pytest.mark.parametrize("axes", ["sensor", "flange", "base"])
def test_what_stands_above_the_numbers_fits_into_80_columns(axes: str) -> None:
    three = {"force_N": [1.0] * 3, "torque_Nm": [0.1] * 3}
    reading = {"axes": axes, "about": "sensor origin", "verdict": "good", "rate_Hz": 1e3, "lost": 0}
    console = Console(width=80, file=io.StringIO(), color_system=None)
    console.print(live._screen(reading | {"raw": three, "compensated": three, "sigma": three}, "made for this"))
    assert isinstance(console.file, io.StringIO)
    assert "± 1 sigma" in console.file.getvalue().splitlines()[2]


def test_columns_stand_still_when_a_sign_changes() -> None:
    def ends(contact: float) -> list[int]:
        three = {"force_N": [contact] * 3, "torque_Nm": [contact / 10] * 3}
        reading = {"axes": "base", "about": "sensor origin", "verdict": "good", "rate_Hz": 1e3, "lost": 0}
        reading |= {"raw": three, "compensated": three, "sigma": {"force_N": [0.1] * 3, "torque_Nm": [0.1] * 3}}
        console = Console(width=80, file=io.StringIO(), color_system=None)
        console.print(live._screen(reading, "made for this"))
        assert isinstance(console.file, io.StringIO)
        (line,) = [line for line in console.file.getvalue().splitlines() if line.startswith(" Fx")]
        return [match.end() for match in re.finditer(r"\S+", line)]

    assert ends(1.5) == ends(-1.5) == ends(-150.0)
