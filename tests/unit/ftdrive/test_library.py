"""What the functions of `import ftdrive` refuse, and with which words."""

from typing import Any

import numpy as np
import pytest

import ftdrive


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "ur6e"}, "ur6e"),
        ({"tool_mm": []}, "what is mounted"),
        ({"tool_mm": [(0, 200)]}, "tool_mm"),
        ({"poses": 7}, "choose 24, 12, 6"),
        ({"mounting": "shelf"}, "shelf"),
        ({"boxes_mm": [(0, 0, 0, 100, 100)]}, "boxes_mm"),
        ({"posture_deg": (0, -90)}, "posture_deg has 2 angles"),
        ({"mass_kg": -1.0}, "mass_kg"),
    ],
)
def test_an_impossible_cell_is_named_by_its_argument(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ftdrive.UsageError, match=words):
        ftdrive.plan_tour(**{"model": "ur5e", "tool_mm": [(0, 200, 100)], **arguments})


def test_a_plan_is_that_of_the_cell_and_of_no_file(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ftdrive.toml").write_text("[tool]\ncylinders_mm = [[0, 150, 60]]\n")
    monkeypatch.chdir(tmp_path)
    plan = ftdrive.plan_tour("UR10e", [(0, 200, 100)], 6, boxes_mm=[(600, -300, 0, 900, 300, 400)], mass_kg=2.0)
    assert plan.certified
    assert plan.measured
    np.testing.assert_allclose(np.linalg.det(plan.R_base_flange), np.ones(6))
    assert plan.to_dict()["description"]["tool"] != []
    plan.save(str(tmp_path / "plan.json"))
    assert type(plan).load(str(tmp_path / "plan.json")).sha256 == plan.sha256


def test_devices_that_cannot_be_named_or_reached() -> None:
    with pytest.raises(ftdrive.UsageError, match="unknown sensor 'scale'"):
        ftdrive.open_sensor("scale:///dev/ttyUSB0")
    with pytest.raises(ftdrive.UsageError, match="unknown arm 'kuka'"):
        ftdrive.open_arm("192.0.2.1", driver="kuka")
    with pytest.raises(ftdrive.DeviceError, match="no-such-port"):
        ftdrive.open_sensor("bota:///dev/no-such-port")


def test_a_stream_needs_one_calibration() -> None:
    with pytest.raises(ftdrive.UsageError, match="no calibration"):
        ftdrive.open_stream()
    with pytest.raises(FileNotFoundError):
        ftdrive.open_stream(calibration="runs/none/calibration.json")
