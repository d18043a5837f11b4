"""The live readout: means of a stream with honest sigmas, one object a line, and a table that stands still."""

import io
import json
import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from ftdrive.commands import live
from ftdrive.stream.feed import Feed
from ftdrive.stream.samples import Links, WrenchFrame
from ftdrive.stream.sources import Read, RecordingSource
from ftdrive.stream.stream import Stream
from ftdrive.terminal import live_panels
from ftdrive.words.stream import StreamSummary, View
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.stream.simulated import NOISE, calibrated, dwells, info, paired

PUSH = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def pushed(seconds: float = 1.2, kind: type[RecordingSource] = RecordingSource, **options: Any) -> Stream:
    rows = paired(dwells(1, round(seconds * 1000), seed=1), push=PUSH)
    return Stream(kind(info(calibrated()), rows, clock=FakeClock(), speed=options.pop("speed", 1.0)), **options).open()


@pytest.fixture
def arguments(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The command with a recording in place of a run."""
    path = tmp_path / "calibration.json"
    calibrated().save(path)

    def stream(_path: Path, _calibration: Path, frame: WrenchFrame, *, speed: float, force: bool) -> Stream:
        assert not force
        return pushed(speed=speed, frame=frame)

    monkeypatch.setattr(live, "open_replay", stream)
    return ["--calibration", str(path), "--replay", str(tmp_path)]


def run(arguments: list[str], *more: str) -> Any:
    return CliRunner().invoke(live.live, [*arguments, *more], catch_exceptions=False)


def test_each_line_is_the_mean_of_a_tenth_of_a_second(arguments: list[str]) -> None:
    lines = [json.loads(line) for line in run(arguments, "--json").stdout.splitlines()]
    assert len(lines) == pytest.approx(11, abs=2)
    for line in lines:
        assert line["compensated"]["force_N"] == pytest.approx([1.0, 2.0, 3.0], abs=6 * NOISE[0] / 10)
        by_contact = np.diag(calibrated().contact.covariance(PUSH))
        assert line["sigma"]["force_N"] == pytest.approx(np.sqrt((NOISE / 10) ** 2 + by_contact)[:3], rel=0.1)
        assert line["sigma_at_rest"]["force_N"] == pytest.approx(NOISE[:3] / 10, rel=0.2)
        assert (line["axes"], line["about"], line["contact"], line["stale"]) == ("sensor", "sensor origin", True, None)
        assert line["delay_s"] == {"value": 0.0, "sigma": 0.0}
    assert np.diff([line["t_s"] for line in lines]) == pytest.approx(0.1, abs=0.02)


def test_axes_and_point_are_chosen_separately(arguments: list[str]) -> None:
    sensor = json.loads(run(arguments, "--json", "--once").stdout)
    base = json.loads(run(arguments, "--json", "--once", "--axes", "base").stdout)
    point = json.loads(run(arguments, "--json", "--once", "--about", "0,0,0.13").stdout)
    R = dwells(1, 1, seed=1)[0] @ calibrated().R_flange_sensor
    for key in ("raw", "compensated"):
        np.testing.assert_allclose(R @ sensor[key]["force_N"], base[key]["force_N"], atol=1e-9)
        lever = calibrated().R_flange_sensor.T @ [0, 0, -0.1]  # from the point to the sensor origin
        moved = np.array(sensor[key]["torque_Nm"]) + np.cross(lever, sensor[key]["force_N"])
        np.testing.assert_allclose(point[key]["torque_Nm"], moved, atol=1e-9)
    assert (base["axes"], base["about"], point["about"]) == ("base", "sensor origin", [0.0, 0.0, 0.13])
    as_measured = json.loads(run(arguments, "--json", "--once", "--stages", "bias=false,gravity=false").stdout)
    np.testing.assert_allclose(as_measured["compensated"]["force_N"], sensor["raw"]["force_N"], atol=1e-9)


def shown_table(monkeypatch: pytest.MonkeyPatch, views: Iterable[View]) -> str:
    console = Console(width=80, file=io.StringIO(), color_system=None, force_terminal=False)
    monkeypatch.setattr(live_panels, "answer", console)
    live_panels.show_table(views)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


class Interrupted(RecordingSource):
    reads, failures, error = 0, 2, ""

    def links(self) -> Links:
        links = super().links()
        return links._replace(sensor=replace(links.sensor, error=self.error))

    def read(self, timeout_s: float = 0.1) -> Read:
        self.reads, self.error = self.reads + 1, ""
        if 50 < self.reads <= 50 + self.failures:
            self.clock.sleep(3 * timeout_s)
            self.error = "no new sample for 0.300 s"
            raise DeviceTimeout(self.error, "check cable and power")
        return super().read(timeout_s)


def test_a_silent_device_is_shown_and_no_old_number(monkeypatch: pytest.MonkeyPatch) -> None:
    views = list(islice(StreamSummary(Feed(pushed(10.0, Interrupted))).views(), 12))
    first, second = (view for view in views if view.silent)
    for reading in (first.to_dict(), second.to_dict()):
        assert reading["stale"].endswith(": no new sample for 0.300 s")
        assert reading["compensated"] is reading["raw"] is reading["sigma"] is reading["contact"] is None
    assert not views[-1].silent
    assert first.in_line(timed=False).startswith("stale: ")
    shown = shown_table(monkeypatch, [first])
    assert "no new sample for 0.300 s" in shown
    assert "--.--" in shown
    assert not re.search(r" Fx +[+-]?\d", shown)


def test_a_failure_that_lasts_ends_the_command() -> None:
    for failures, raises in ((1000, False), (1, True)):
        stream = pushed(10.0, Interrupted)
        stream.source.failures = failures  # type: ignore[attr-defined]
        with pytest.raises(DeviceTimeout):
            list(StreamSummary(Feed(stream)).views(raises=raises))
