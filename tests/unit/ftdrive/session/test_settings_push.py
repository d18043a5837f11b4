"""A push to the controller of a fake cell: what is proposed, refused, sent, read back and kept for a restore."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult, Finding, Parameters
from ftcalib.errors import BadDataset
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.errors import ConfigError, Declined, NotAccepted, SupervisorGone
from ftdrive.session.settings_push import Push, Receipt, propose, restore, send
from ftdrive.words.session import proposal_in_lines, settings_in_words
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceFault, DeviceTimeout
from ftdrivers.interfaces import ControllerSettings, DeviceInfo, Guard
from tests.edited_files import edit
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import FakeArm, FakeSensor

SENSOR_KG, HEIGHT_MM = 0.3, 40.0
LEVEL = (0.0, 0.0, 9.82)
INERTIA = (0.01, 0.01, 0.002, 0.0, 0.0, 0.0)
OLD = ControllerSettings(0.6, (0.0, 0.0, 0.03), INERTIA, LEVEL)
NEW_KG = 1.5
NEW_M = (1.2 * 0.01 / 1.5, 0.0, (1.2 * 0.1 + 0.3 * 0.02) / 1.5)
"""By hand: 1.2 kg at (10, 0, 40 + 60) mm, 0.3 kg at (0, 0, 20) mm."""


class SettableArm(FakeArm):
    """Keeps what is set, and says how."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.settings = OLD
        self.sent: list[Any] = []
        self.failure: BaseException | None = None
        self.ignores = False
        self.moves_by_itself = False

    def controller_settings(self) -> ControllerSettings:
        return self.settings

    def set_payload(self, mass_kg: float, p_flange_com_m: Any, inertia_kg_m2: Any = (0.0,) * 6) -> None:
        self._set("payload", mass_kg=mass_kg, p_flange_com_m=tuple(p_flange_com_m), inertia_kg_m2=tuple(inertia_kg_m2))

    def set_gravity(self, up_base_m_s2: Any) -> None:
        self._set("gravity", up_base_m_s2=tuple(up_base_m_s2))

    def _set(self, name: str, **values: Any) -> None:
        assert self.control
        self.sent.append((name, *values.values()))
        if self.failure is not None:
            raise self.failure
        if not self.ignores:
            known = {key: value for key, value in values.items() if getattr(self.settings, key) is not None}
            self.settings = replace(self.settings, **known)

    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        super().wait_until_still(timeout_s=timeout_s, guard=guard)
        if self.moves_by_itself:
            raise DeviceTimeout("the arm has not come to rest within 5.0 s", "check whether something else moves it")


class Cell:
    """A fake cell, its calibration, and a run folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.arm = SettableArm(FakeClock())
        self.sensor = FakeSensor(self.arm)
        self.typed: list[str] = []
        self.at_question: Any = lambda: None
        self.config = CellConfig(
            RobotConfig("fake"),
            SensorConfig("fake://", mass_kg=SENSOR_KG, height_mm=HEIGHT_MM),
            ToolConfig(),
            WorkcellConfig(),
            clock=self.arm.clock,
        )
        self.arm.open()

    def result(self, lean_deg: float = 0.0, towards_y: float = 1.0, **other: Any) -> CalibrationResult:
        """The true calibration; or of a base that leans towards its +y or -y."""
        lean_rad = np.radians(lean_deg)
        down = np.array([0.0, towards_y * np.sin(lean_rad), -np.cos(lean_rad)])
        bias = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
        parameters = Parameters(np.eye(3), 1.2 * 9.81 * down, bias[:3], np.array([0.01, 0, 0.06]), bias[3:])
        found = {
            "findings": (),
            "provenance": {
                "devices": {"arm": {"model": "UR5e", "serial": "A1"}, "sensor": {"model": "fake", "serial": "S1"}},
                "setup": {"payload_kg": 0.9, "sensor_mass_kg": None, "mounting": "floor"},
            },
            **other,
        }
        return CalibrationResult(
            parameters, 1e-8 * np.eye(15), np.zeros((6, 6)), 1.0, 21, "measured", 9.81, "ml", **found
        )

    def propose(self, result: CalibrationResult | None = None, payload: bool = True, gravity: bool = False) -> Push:
        return propose(
            self.config, self.arm, self.sensor, result or self.result(), payload=payload, gravity=gravity, name="x.json"
        )

    def ask(self, name: str) -> None:
        self.typed.append(name)
        self.at_question()

    def send(self, push: Push) -> tuple[Path, ControllerSettings]:
        return send(self.arm, push, self.folder, self.ask)

    def receipts(self) -> list[dict[str, Any]]:
        return [json.loads(path.read_text()) for path in sorted(self.folder.iterdir())]


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    monkeypatch.setattr("os.fsync", lambda _: None)  # the disk may be slow
    return Cell(tmp_path)


# -------------------------------------------------------------------------------------------------------------- payload


def test_the_payload_is_sent_read_back_and_kept(cell: Cell) -> None:
    push = cell.propose()
    assert push.new.mass_kg == pytest.approx(NEW_KG)
    assert push.new.p_flange_com_m == pytest.approx(NEW_M)
    assert not cell.arm.sent
    path, read_back = cell.send(push)
    assert cell.typed == ["payload"]
    ((name, mass_kg, com_m, inertia),) = cell.arm.sent
    assert (name, mass_kg, com_m) == ("payload", pytest.approx(NEW_KG), pytest.approx(NEW_M))
    assert inertia == INERTIA  # gravity does not reveal it
    assert read_back == replace(push.new, up_base_m_s2=LEVEL)
    assert not cell.arm.control
    assert path == cell.folder / "push.json"
    (receipt,) = cell.receipts()
    assert (receipt["format"], receipt["error"]) == ("ftdrive.push/1", None)
    assert (receipt["old"]["mass_kg"], receipt["new"]["mass_kg"]) == (0.6, pytest.approx(NEW_KG))
    assert receipt["read_back"]["p_flange_com_m"] == pytest.approx(NEW_M)
    assert receipt["calibration"]["id"] == cell.result().id
    assert receipt["devices"]["arm"]["serial"] == "A1"
    assert receipt["payload_at_calibration_kg"] == 0.9


def test_a_receipt_restores_the_old_values_as_often_as_wanted(cell: Cell) -> None:
    cell.send(cell.propose())
    for count in (2, 3):
        push = restore(cell.config, cell.arm, Receipt.load(cell.folder))
        assert push.new == ControllerSettings(0.6, (0.0, 0.0, 0.03), INERTIA)
        path, _ = cell.send(push)
        assert cell.arm.settings == OLD
        assert path.name == f"push-{count}.json"
        assert json.loads(path.read_text())["restores"] == str(cell.folder / "push.json")
    (cell.folder / "push-notes.json").write_text("mine")
    for _ in range(7):
        cell.send(cell.propose())
    assert Receipt.load(cell.folder).path.name == "push-10.json"


def test_an_old_controller_is_set_blindly_and_cannot_be_restored(cell: Cell) -> None:
    cell.arm.settings = ControllerSettings()
    path, read_back = cell.send(cell.propose())
    assert read_back == ControllerSettings()
    assert "does not report" in settings_in_words(read_back)
    with pytest.raises(NotAccepted, match="no old payload"):
        restore(cell.config, cell.arm, Receipt.load(path))


@pytest.mark.parametrize(
    ("sensor", "says"),
    [({"mass_kg": None}, r"\[sensor\] mass_kg"), ({"height_mm": None}, r"\[sensor\] height_mm")],
)
def test_without_mass_or_height_of_the_sensor_nothing_is_proposed(cell: Cell, sensor: Any, says: str) -> None:
    cell.config = replace(cell.config, sensor=replace(cell.config.sensor, **sensor))
    with pytest.raises(ConfigError, match=says):
        cell.propose()


@pytest.mark.parametrize(
    ("devices", "says"),
    [
        ({"arm": {"model": "UR5e", "serial": "A2"}}, "the arm A2, but the arm A1 is connected"),
        ({"sensor": {"model": "fake", "serial": "S2"}}, "the sensor S2, but the sensor S1"),
    ],
)
def test_a_calibration_of_other_devices_is_refused(cell: Cell, devices: Any, says: str) -> None:
    with pytest.raises(NotAccepted, match=says):
        cell.propose(cell.result(provenance={"devices": devices}))


def test_a_rejected_calibration_is_refused(cell: Cell) -> None:
    rejected = Finding.of("second_solution", probability_percent=40.0)
    with pytest.raises(NotAccepted, match=r"rejected \(a very different mounting \(probability 40 %\) explains"):
        cell.propose(cell.result(findings=(rejected,)))


@pytest.mark.parametrize(
    ("arm", "says"),
    [
        ({"program": "playing"}, "another program is active on the controller"),
        ({"remote": False}, "local control"),
        ({"fault": DeviceFault("protective stop", "clear it")}, "clear it"),
        ({"identify": lambda: DeviceInfo("UR5e", "A7", "5.15")}, "A7"),
    ],
)
def test_an_arm_that_is_not_ready_is_refused(cell: Cell, arm: dict[str, Any], says: str) -> None:
    for name, value in arm.items():
        if name == "fault":
            cell.arm.set_status(fault=value)
        else:
            setattr(cell.arm, name, value)
    with pytest.raises(NotAccepted, match=says):
        cell.propose()
    assert not cell.arm.sent


def test_an_arm_or_a_reading_that_moves_is_refused(cell: Cell) -> None:
    rng = np.random.default_rng(2)
    cell.sensor.collecting = lambda: setattr(cell.sensor, "push", rng.normal(0, 5, 6))
    wrenches = cell.sensor._wrenches
    cell.sensor._wrenches = lambda n: wrenches(n) + np.linspace(0, 5, n)[:, None]  # type: ignore[method-assign]
    with pytest.raises(NotAccepted, match="not steady"):
        cell.propose()
    cell.arm.moves_by_itself = True
    with pytest.raises(DeviceTimeout, match="come to rest"):
        cell.propose()


def test_without_the_word_nothing_is_sent(cell: Cell) -> None:
    def no() -> None:
        raise Declined("the answer was no")

    cell.at_question = no
    with pytest.raises(Declined):
        cell.send(cell.propose())
    assert (cell.arm.sent, cell.receipts()) == ([], [])


@pytest.mark.parametrize("sent", [0, 1])
def test_nothing_more_is_sent_once_the_supervisor_is_gone(sent: int, cell: Cell) -> None:
    def guard() -> None:
        if len(cell.arm.sent) == sent:
            raise SupervisorGone("the terminal was closed")

    push = cell.propose(cell.result(lean_deg=2.0), payload=True, gravity=True)
    with pytest.raises(SupervisorGone):
        send(cell.arm, push, cell.folder, cell.ask, guard)
    assert len(cell.arm.sent) == sent
    assert ["the terminal was closed" in receipt["error"] for receipt in cell.receipts()] == [True] * sent


def test_values_that_change_during_the_question_are_not_overwritten(cell: Cell) -> None:
    cell.at_question = lambda: setattr(cell.arm, "settings", replace(OLD, mass_kg=0.7))
    with pytest.raises(NotAccepted, match="changed meanwhile"):
        cell.send(cell.propose())
    assert (cell.arm.sent, cell.receipts()) == ([], [])


def test_a_controller_that_keeps_other_values_is_an_error_with_a_receipt(cell: Cell) -> None:
    cell.arm.ignores = True
    with pytest.raises(NotAccepted, match="mass and centre of mass that was sent"):
        cell.send(cell.propose())
    (receipt,) = cell.receipts()
    assert receipt["read_back"]["mass_kg"] == 0.6


@pytest.mark.parametrize("failure", [DeviceFault("protective stop", "clear it"), KeyboardInterrupt()])
def test_what_fails_while_it_is_sent_leaves_a_receipt_to_restore(cell: Cell, failure: BaseException) -> None:
    cell.arm.failure = failure
    with pytest.raises(type(failure)):
        cell.send(cell.propose())
    (receipt,) = cell.receipts()
    assert receipt["error"]
    assert receipt["read_back"] is None
    cell.arm.failure = None
    cell.arm.close()
    cell.send(restore(cell.config, cell.arm, Receipt.load(cell.folder)))
    assert cell.arm.settings == OLD


def test_a_folder_that_cannot_be_written_is_refused_before_the_question(cell: Cell, monkeypatch: Any) -> None:
    def full(**_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("ftdrive.checks.computer.TemporaryFile", full)
    with pytest.raises(NotAccepted, match="no receipt can be written"):
        cell.send(cell.propose())
    assert (cell.typed, cell.arm.sent) == ([], [])


# -------------------------------------------------------------------------------------------------------------- gravity


def test_gravity_is_turned_as_measured_and_keeps_its_size(cell: Cell) -> None:
    push = cell.propose(cell.result(lean_deg=1.8), payload=False, gravity=True)
    assert push.settings == ["gravity"]
    # The base leans towards +y: gravity pulls towards +y, so away from the earth is towards -y.
    expected = 9.82 * np.array([0.0, -np.sin(np.radians(1.8)), np.cos(np.radians(1.8))])
    assert push.new.up_base_m_s2 == pytest.approx(expected)
    (line,) = [line for line in proposal_in_lines(push) if line.startswith("The base")]
    assert line.startswith("The base leans 1.80000° (sigma 0.00049°) towards its +y; the controller is set to level.")
    _, read_back = cell.send(push)
    assert cell.typed == ["gravity"]
    assert read_back.up_base_m_s2 == pytest.approx(expected)
    assert read_back.mass_kg == 0.6
    cell.send(restore(cell.config, cell.arm, Receipt.load(cell.folder)))
    assert cell.arm.settings == OLD
    assert [name for name, *_ in cell.arm.sent] == ["gravity", "gravity"]


def test_the_script_manual_turns_gravity_the_same_way(cell: Cell) -> None:
    # `set_gravity([0, 9.82*sin(theta), 9.82*cos(theta)])` is for a robot rotated by theta about the x axis of its base,
    # whose y axis has risen: the low side is -y.
    theta = np.radians(3)
    push = cell.propose(cell.result(lean_deg=3, towards_y=-1.0), payload=False, gravity=True)
    assert push.new.up_base_m_s2 == pytest.approx([0.0, 9.82 * np.sin(theta), 9.82 * np.cos(theta)])


def test_a_base_that_agrees_with_the_controller_needs_no_gravity(cell: Cell) -> None:
    assert cell.propose(cell.result(lean_deg=0.1), payload=False, gravity=True).settings == []
    cell.arm.settings = replace(OLD, up_base_m_s2=(0.0, -9.82 * np.sin(np.radians(2)), 9.82 * np.cos(np.radians(2))))
    assert cell.propose(cell.result(lean_deg=2.0), payload=False, gravity=True).settings == []


def test_gravity_that_is_not_reported_is_not_set(cell: Cell) -> None:
    cell.arm.settings = replace(OLD, up_base_m_s2=None)
    with pytest.raises(NotAccepted, match=r"leans 1.80000° .* set the mounting on the pendant"):
        cell.propose(cell.result(lean_deg=1.8), payload=False, gravity=True)
    push = cell.propose(cell.result(lean_deg=1.8))
    assert any("does not report its gravity" in line for line in proposal_in_lines(push))


def test_another_mounting_is_not_set(cell: Cell) -> None:
    with pytest.raises(NotAccepted, match="30° off"):
        cell.propose(cell.result(lean_deg=30.0), payload=False, gravity=True)


# ------------------------------------------------------------------------------------------------------------- receipts


def test_a_receipt_of_another_arm_is_refused(cell: Cell) -> None:
    path, _ = cell.send(cell.propose())
    edit(path, lambda other: other["devices"]["arm"].update(serial="A9"))
    with pytest.raises(NotAccepted, match="serial A9, but UR5e, serial A1"):
        restore(cell.config, cell.arm, Receipt.load(path))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"format": "ftdrive.push/2"}, "version '2' of ftdrive.push"),
        ({"old": {"mass_kg": 1.0}}, "damaged"),
        ({"devices": {}}, "damaged"),
    ],
)
def test_a_damaged_receipt_is_an_error_that_names_it(cell: Cell, change: dict[str, Any], says: str) -> None:
    path, _ = cell.send(cell.propose())
    edit(path, lambda receipt: receipt.update(change))
    with pytest.raises(BadDataset, match=says) as error:
        Receipt.load(path)
    assert "push.json" in str(error.value)


# ----------------------------------------------------------------------------------------------------------------- text
