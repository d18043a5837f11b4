"""The stream of a cell: what it opens and refuses, gaps and silence, recovery, and what it reports."""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult
from ftcalib.after.series import BiasTemperature
from ftcalib.display import MOST_LINES
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig
from ftdrive.errors import ConfigError
from ftdrive.library import open_stream
from ftdrive.runs.calibration import FOREIGN, read_calibration
from ftdrive.store import tools as named_tools
from ftdrive.store.tools import Tool
from ftdrive.stream import sources as module
from ftdrive.stream.contact import Contact
from ftdrive.stream.samples import Stages, WrenchFrame
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Stream
from ftdrivers.errors import DeviceError, DeviceTimeout
from ftdrivers.follow import Follow
from ftdrivers.interfaces import ArmStates, DeviceInfo, FtSamples, Health
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import STATUS
from tests.unit.ftdrive.stream.simulated import DEVICE, NOISE, Motion, calibrated

RATE_HZ, ARM_HZ = 1000.0, 500.0


class Link:
    """A device that measures at a fixed rate and delivers what was measured until now, each time it is read."""

    def __init__(self, clock: FakeClock, rate_Hz: float) -> None:
        self.clock, self.rate_Hz = clock, rate_Hz
        self.begin_ns = clock.now_ns()
        self.sent = 0
        self.silent = False
        self.failure: DeviceError | None = None
        self.opened = 0
        self.info = DEVICE
        self.motion = Motion(turn_rad_s=0.0, acceleration_m_s2=0.0)

    def open(self, **_: Any) -> None:
        self.opened += 1
        if self.silent:
            raise DeviceTimeout("no sample for 1 s", "check cable and power")
        self.failure = None

    def close(self) -> None: ...

    def check(self) -> None: ...

    def __enter__(self) -> "Link":
        self.open()
        return self

    def __exit__(self, *_: object) -> None: ...

    def identify(self) -> DeviceInfo:
        return self.info

    def health(self) -> Health:
        return Health(self.sent, 3, 0, self.rate_Hz, 0.001, nominal_rate_Hz=float("nan"))

    def status(self) -> Any:
        return STATUS

    def follow(self) -> AbstractContextManager[Follow[Any]]:
        self.sent = self._due()
        return nullcontext(Follow(self._read))

    def _due(self) -> int:
        return max(0, int((self.clock.now_ns() - self.begin_ns) * 1e-9 * self.rate_Hz))

    def _read(self, timeout_s: float) -> Any:
        if self.failure is not None:
            raise self.failure
        for left_s in self.clock.looks(timeout_s):
            if self._due() > self.sent and not self.silent:
                break
            self.clock.advance(min(left_s, 0.02))
        if self.silent and timeout_s:
            self.clock.advance(0.3)
        if self.silent:
            self.failure = DeviceTimeout("no sample for 0.3 s", "check cable and power")
            raise self.failure
        numbers = np.arange(self.sent, max(self.sent, self._due()))
        self.sent += len(numbers)
        return self.rows(numbers, self.begin_ns + np.rint(numbers * 1e9 / self.rate_Hz).astype(np.int64))

    def rows(self, numbers: Any, t_ns: Any) -> Any:
        raise NotImplementedError


class Sensor(Link):
    push = np.zeros(6)
    now_C: float | None = None

    def temperature_C(self) -> float | None:
        return self.now_C

    def rows(self, numbers: Any, t_ns: Any) -> FtSamples:
        rng = np.random.default_rng(int(numbers[0]) if len(numbers) else 0)
        noise = rng.normal(size=(len(numbers), 6)) * NOISE
        return FtSamples.of(t_ns, numbers, self.motion.wrench(numbers / self.rate_Hz) + noise + self.push)


class Arm(Link):
    def rows(self, numbers: Any, t_ns: Any) -> ArmStates:
        nothing = np.zeros((len(numbers), 6))
        return ArmStates(t_ns, numbers / self.rate_Hz, nothing, nothing, *self.motion.pose(numbers / self.rate_Hz))


class Cell:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = FakeClock()
        self.sensor, self.arm = Sensor(self.clock, RATE_HZ), Arm(self.clock, ARM_HZ)
        monkeypatch.setattr(module, "build_sensor", lambda _: self.sensor)
        monkeypatch.setattr(module, "build_arm", lambda _: self.arm)
        self.config = CellConfig(
            RobotConfig("fake"), SensorConfig("fake://", height_mm=30.0), ToolConfig("gripper"), clock=self.clock
        )
        self.calibration: CalibrationResult = calibrated()

    def stream(self, **options: Any) -> Stream:
        given = {name: options.pop(name) for name in ("name", "force", "devices") if name in options}
        return Stream(CellSource(self.config, self.calibration, **given), **options)


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    return Cell(monkeypatch)


def until(stream: Stream, done: Callable[[], bool]) -> None:
    for _ in range(2000):
        stream.read()
        if done():
            return
    pytest.fail("it never happened")


@pytest.mark.parametrize("device", ["sensor", "arm"])
def test_a_silent_device_raises_and_recovers_with_events(cell: Cell, device: str) -> None:
    link: Link = getattr(cell, device)
    with cell.stream() as stream:
        before = [stream.read() for _ in range(20)][-1]
        link.silent = True
        with pytest.raises(DeviceTimeout, match="no sample"):
            until(stream, lambda: False)
        assert getattr(stream.status(), device).error.startswith("no sample")
        with pytest.raises(DeviceTimeout):  # still silent: no old value is delivered
            stream.read()
        link.silent = False
        after = stream.read()
        stale, recovered, gap = stream.take_events()
        status = stream.status()
    assert (stale.kind, stale.values["device"]) == ("stale", device)
    assert (gap.kind, recovered.kind) == ("gap", "recovered")
    assert after.t_host_ns[0] > before.t_host_ns[-1]
    assert (status.sensor.error, status.arm.error) == ("", "")


def test_another_device_after_an_interruption_is_refused(cell: Cell) -> None:
    with cell.stream() as stream:
        stream.read()
        cell.sensor.failure = DeviceTimeout("no sample for 0.3 s")
        with pytest.raises(DeviceTimeout):
            stream.read()
        cell.sensor.info = DeviceInfo("model", "other", "1")
        with pytest.raises(ConfigError, match="another device"):
            stream.read()


def test_a_calibration_of_another_sensor_or_mount_is_applied_if_forced(cell: Cell) -> None:
    made_with = {"devices": {"sensor": {"model": "model", "serial": "S2"}}, "setup": {"mount": "adapter-a"}}
    cell.calibration = replace(cell.calibration, provenance=made_with)
    with cell.stream(force=True) as stream:
        assert len(stream.read())
    assert "the sensor S2" in stream.warnings[0]
    assert FOREIGN in stream.info.marks
    assert stream.info.calibration_state.endswith(f", good, EMULATED, {FOREIGN}, not verified")
    assert "[sensor] mount = 'adapter-a', but no [sensor] mount is configured" in stream.warnings[1]
    cell.calibration = replace(cell.calibration, provenance={"setup": {"mount": "adapter-a"}})
    with pytest.raises(ConfigError, match=r"adapter-a.*--force"), cell.stream():
        pass
    cell.config = replace(cell.config, sensor=replace(cell.config.sensor, mount="adapter-a"))
    with cell.stream():
        pass


@pytest.fixture
def tools(cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    """A cell with the tool that hangs on it, and an empty flange with another bias."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    devices = {role: {"model": "model", "serial": "serial"} for role in ("arm", "sensor")}
    for day, (tool, bias_N) in enumerate({"gripper": 0.0, "drill": 7.0}.items()):
        parameters = cell.calibration.parameters.moved(np.eye(15)[6] * bias_N)
        provenance = {"devices": devices, "setup": {"tool": tool}, "created_utc": f"2026-01-0{day + 1}T00:00:00+00:00"}
        folder = tmp_path / "runs" / tool
        folder.mkdir(parents=True)
        (folder / "run.json").write_text("{}")
        replace(cell.calibration, parameters=parameters, provenance=provenance).save(folder / "calibration.json")
    return cell


@pytest.mark.slow
def test_the_tool_is_switched_while_the_devices_stay_open(tools: Cell) -> None:
    tools.sensor.motion = tools.arm.motion = Motion()
    with open_stream(tools.config, tool="drill", stages=Stages(lowpass_Hz=200.0)) as stream:
        stream.frame = WrenchFrame("base")
        until(stream, lambda: stream.status().delay_sigma_s < 0.02)
        before, sigma_s = stream.read(), stream.status().delay_sigma_s
        stream.mark("tool changed")
        event = stream.use_tool("gripper")
        after = stream.read()
        assert stream.status().delay_sigma_s == sigma_s
        assert [one.kind for one in stream.take_events() if one.kind != "contact"] == ["frame", "mark", "tool"]
        with pytest.raises(ConfigError, match="'welder'"):
            stream.use_tool("welder")
        assert stream.info.tool == "gripper"
        assert len(stream.read())
    assert event.values == {"tool": "gripper", "calibration": tools.calibration.id}
    assert after.seq[0] == before.seq[-1] + 1
    assert (after.frame, after.stages) == (before.frame, before.stages)
    change = after.wrench[0, :3] - before.wrench[-1, :3]  # the tool moves on, but not far
    assert np.linalg.norm(change) == pytest.approx(7.0, abs=0.5)
    assert (tools.sensor.opened, tools.arm.opened) == (1, 1)


def test_a_contact_is_called_back_once_when_it_begins_and_once_when_it_ends(cell: Cell) -> None:
    contacts: list[Contact] = []
    with open_stream(cell.config, cell.calibration, on_contact=contacts.append) as stream:
        until(stream, lambda: cell.clock.now_s() > 1001.7)  # the noise is known well enough
        cell.sensor.push = np.array([0, 0, -6.0, 0, 0, 0])
        until(stream, lambda: bool(contacts))
        assert [contact.over for contact in contacts] == [False]
        cell.sensor.push = np.zeros(6)
        until(stream, lambda: len(contacts) > 1)
    assert [contact.over for contact in contacts] == [False, True]
    assert contacts[1].t_s == contacts[0].t_s
    np.testing.assert_allclose(contacts[1].direction, [0, 0, -1], atol=0.03)


def test_a_stream_is_opened_from_paths(cell: Cell, tmp_path: Any) -> None:
    path = tmp_path / "calibration.json"
    cell.calibration.save(path)
    with open_stream(cell.config, path, frame=WrenchFrame("flange")) as stream:
        assert stream.info.calibration_name == str(path)
        assert stream.info.calibration.mass_kg == pytest.approx(cell.calibration.mass_kg)
        assert stream.info.tool == "gripper"
        np.testing.assert_allclose(stream.info.p_flange_sensor_m, [0, 0, 0.03])
    assert read_calibration(tmp_path).mass_kg == pytest.approx(cell.calibration.mass_kg)  # as a run folder
    with pytest.raises(ConfigError, match="no calibration"):
        open_stream(cell.config)


def test_a_stream_is_shown_before_it_is_open_read_and_closed(cell: Cell) -> None:
    stream = cell.stream()
    assert "not open" in repr(stream)
    stream.open()
    assert "no sample was read yet" in repr(stream)
    stream.read()
    assert re.search(r"force now x, y, z +-?0\.\d\d, -?0\.\d\d, -?0\.\d\d N in sensor axes", repr(stream))
    assert len(repr(stream).splitlines()) <= MOST_LINES
    assert "<table>" in stream._repr_html_()
    stream.close()
    stream.close()


def test_a_plot_has_the_samples_from_its_call_on(cell: Cell) -> None:
    pytest.importorskip("matplotlib")
    with cell.stream() as stream:
        stream.read()
        cell.clock.sleep(0.2)  # samples of a pause wait in the links
        figure = stream.plot(0.5)
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 2]
    assert len(lines) == 3
    for line in lines:
        t_s = line.get_xdata()
        assert t_s[0] == pytest.approx(0, abs=2e-3)
        assert t_s[-1] == pytest.approx(0.5, abs=0.02)
        assert np.std(line.get_ydata()) == pytest.approx(NOISE[0], rel=0.2)


def test_a_device_that_sends_nothing_is_named(cell: Cell) -> None:
    cell.arm.rate_Hz = 0.1
    with pytest.raises(DeviceTimeout, match="arm sent"), cell.stream():
        pass


def test_an_emulated_cell_excludes_a_real_one(cell: Cell) -> None:
    with pytest.raises(ConfigError, match="leave config, tool, sensor and arm out"):
        open_stream(cell.config, cell.calibration, simulate=True)
    with cell.stream() as stream, pytest.raises(ConfigError, match="only a stream with simulate=True"):
        _ = stream.station


@pytest.mark.slow
def test_the_bias_follows_the_temperature_of_the_sensor(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    slope, sigma = np.array([0.2, 0, 0, 0, 0, 0.01]), np.full(6, 1e-3)
    errors = np.full(2, 0.1), np.full(2, 0.5)
    warmth = BiasTemperature(slope, sigma, 12, 20.0, 40.0, *errors, np.zeros(2))
    made = replace(cell.calibration, provenance={**cell.calibration.provenance, "temperature_C": 25.0})
    monkeypatch.setattr(named_tools, "calibration_of_tool", lambda *_, **__: Tool(made, Path("c.json"), (), warmth))
    cell.sensor.now_C = 25.0

    def wait(seconds: float) -> None:
        end_s = cell.clock.now_s() + seconds
        until(stream, lambda: cell.clock.now_s() > end_s)

    with Stream(CellSource(cell.config, "gripper")) as stream:
        wait(1.2)
        cell.sensor.now_C = 31.0
        cell.sensor.push = 6 * slope
        wait(0.7)
        wrench = stream.read().wrench.mean(axis=0)
        assert np.abs(wrench / NOISE).max() < 3, "what the temperature does is no force"
        (event,) = [event for event in stream.take_events() if event.kind == "temperature"]
        assert event.values == {"temperature_C": 31.0, "change": pytest.approx((6 * slope).tolist())}
        assert stream.tare().kind == "tare"
        assert stream.status().tare == pytest.approx(6 * slope, abs=0.1)
        cell.sensor.now_C, cell.sensor.push = 33.0, 8 * slope
        wait(0.7)
        assert np.abs(stream.read().wrench.mean(axis=0) / NOISE).max() < 3, "from the tare on only what came after it"
        assert not stream.read().in_contact.any()
