"""How `ftdrive doctor` examines an arm and a push, with devices that answer from a list."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ftdrive import cli
from ftdrive.checks import sensor as of_sensor
from ftdrive.checks.arm import check_clock, check_flange
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import PUSH_S, examine_push
from ftdrive.commands import doctor
from ftdrivers.errors import DeviceTimeout
from ftdrivers.interfaces import DeviceInfo, Fact
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import Lab

LOST = DeviceTimeout("no state for 0.3 s", "look at the cable")
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Arm:
    """Its clock is fast by `pace`; after `until` looks it is silent."""

    def __init__(self, clock: FakeClock, pace: float = 1.0, until: int = 10**6) -> None:
        self.clock, self.pace, self.until, self.looks = clock, pace, until, 0

    def status(self) -> Any:
        self.looks += 1
        if self.looks > self.until:
            raise LOST
        return SimpleNamespace(t_host_ns=self.clock.now_ns(), t_device_s=self.pace * self.clock.now_s())

    def state(self) -> Any:
        if not self.until:
            raise LOST
        return SimpleNamespace(p_base_flange_m=np.array([0.1, -0.2, 0.3456]), R_base_flange=TURN)


@pytest.mark.parametrize(
    ("pace", "until", "state"),
    [
        (1.0, 10**6, "ok"),
        (0.981, 10**6, "ok"),
        (0.979, 10**6, "warning"),
        (1.021, 10**6, "warning"),
        (1.0, 5, "failed"),
    ],
)
def test_the_clock_of_the_arm_is_compared_over_a_second(pace: float, until: int, state: str) -> None:
    clock = FakeClock()
    begin_s = clock.now_s()
    check = check_clock(cast("Any", Arm(clock, pace, until)), clock)
    assert (check.name, check.state) == ("clock.pace", state)
    if state == "failed":
        assert (check.found, check.fix) == ("no state for 0.3 s", "look at the cable")
    else:
        assert 1.0 <= clock.now_s() - begin_s < 1.1


class Sensor:
    """Reads a bias; then windows of 10, 25 and -30 N along y, and the bias again."""

    def __init__(self, *, silent: bool = False) -> None:
        self.forces_N, self.silent = [0.0, 10.0, 25.0, -30.0], silent
        self.collected_s: list[float] = []

    def collect(self, duration_s: float) -> Any:
        self.collected_s.append(duration_s)
        if self.silent:
            raise LOST
        push_N = self.forces_N.pop(0) if self.forces_N else 0.0
        return SimpleNamespace(wrench=np.tile([1.0, 2.0 + push_N, 3.0, 0.0, 0.0, 0.0], (5, 1)))


def examined(device: Any, monkeypatch: pytest.MonkeyPatch, *, pushes: bool = True, station: Any = None) -> Any:
    given: list[Any] = []

    def check_push(*arguments: Any) -> Any:
        given.extend(arguments)
        return Check("push.sign", "ok", "found"), {}

    monkeypatch.setattr(of_sensor, "check_push", check_push)
    arm, blame = cast("Any", Arm(FakeClock())), lambda name, error: Check(name, "failed", error.found)
    check, _ = examine_push(device, arm, np.eye(3), -1, station, lambda: pushes, blame)
    return check, given


def test_the_largest_change_during_the_push_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    check, (change_N, R_base_flange, R_flange_sensor, sign) = examined(sensor, monkeypatch)
    assert check.state == "ok"
    np.testing.assert_allclose(change_N, [0, -30, 0])
    np.testing.assert_array_equal(R_base_flange, TURN)
    np.testing.assert_array_equal(R_flange_sensor, np.eye(3))
    assert sign == -1
    assert sum(sensor.collected_s[1:]) == pytest.approx(PUSH_S)


def test_an_emulated_push_is_along_x_of_the_base_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    station = SimpleNamespace(control=lambda **named: asked.append(named["wrench"]))
    examined(Sensor(), monkeypatch, station=station)
    pushed, ended = np.array(asked)
    np.testing.assert_allclose(TURN @ pushed[:3], [15, 0, 0], atol=1e-12)
    assert not ended.any()


def test_a_sensor_alone_is_checked_without_a_robot(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = {"range": Fact((300.0,) * 3 + (30.0,) * 3, "documented")}
    monkeypatch.setattr(lab.sensor, "identify", lambda: DeviceInfo("fake", "S1", "1", facts))
    monkeypatch.setattr(doctor, "build_sensor", lambda _: lab.sensor)
    monkeypatch.chdir(tmp_path)
    states = []
    for force_N in (0.0, 290.0):
        lab.sensor.push = np.array([force_N, 0, 0, 0, 0, 0])
        code = cli.run(["doctor", "--sensor", "bota:///dev/x", "--json"])
        checks = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
        assert checks["robot.reachable"]["state"] == "skipped"
        assert "workcell.measured" not in checks
        states.append((code, checks["sensor.rest"]["state"]))
    assert states[0][1] == "ok"
    assert states[1] == (7, "failed")
    assert cli.run(["doctor"]) == 2  # without a sensor there is nothing to check
    assert "[robot] host is not set" in capsys.readouterr().err


def test_the_pose_is_read_in_millimetres() -> None:
    arm, silent = (cast("Any", Arm(FakeClock(), until=until)) for until in (10**6, 0))
    read, unknown = (cast("Any", SimpleNamespace(tcp_offset=one)) for one in (np.zeros(6), None))
    assert check_flange(arm, read).found == "TCP offset reported; flange at (100, -200, 346) mm in base"
    failed = check_flange(silent, read)
    assert (failed.state, failed.fix) == ("failed", "look at the cable")
    assert check_flange(arm, unknown).state == "skipped"


def test_without_a_reading_or_a_push_there_is_no_sign(monkeypatch: pytest.MonkeyPatch) -> None:
    assert examined(None, monkeypatch)[0].state == "skipped"
    assert examined(Sensor(), monkeypatch, pushes=False)[0].found == "no push: the standard input is closed"
    assert examined(Sensor(silent=True), monkeypatch)[0].state == "failed"
