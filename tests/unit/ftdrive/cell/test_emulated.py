"""An emulated cell that cannot be started."""

import json
from pathlib import Path
from typing import Any

import pytest

from ftdrive.cell.emulated import Station
from ftdrive.errors import ConfigError


def test_another_system_than_linux_has_no_emulated_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    with pytest.raises(ConfigError, match=r"needs Linux.* use recorded data"), Station():
        pass


@pytest.mark.parametrize(
    ("values", "sensor", "options"),
    [
        ({}, "netft", "--mount floor"),
        ({"tool.mass_kg": 1.2, "workcell.mounting": "wall"}, "netft", "--mass 1.2 --mount wall"),
        ({"sensor.height_mm": 33.0}, "netft", "--sensor-origin 0,0,0.033 --mount floor"),
        ({"sensor.mass_kg": 0.25}, "netft", "--sensor-mass-kg 0.25 --mount floor"),
        ({"sensor.mass_kg": 0.25}, "ur-ft", "--mount floor"),  # that sensor is part of the arm
        ({"workcell.mounting": 30.0}, "netft", "--mount floor --tilt-deg 0,30.0"),
    ],
)
def test_a_station_has_the_tool_and_the_mounting_of_the_configuration(
    values: dict[str, Any], sensor: str, options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [f"{key} = {json.dumps(value)}" for key, value in ({"robot.simulate": True} | values).items()]
    Path("ftdrive.toml").write_text("\n".join(['format = "ftdrive.config/1"', *lines]))
    assert " ".join(Station.of(None, f"emulated://{sensor}").options) == options


@pytest.mark.parametrize(
    ("truth", "options"),
    [
        ({"mass_kg": 1.0}, ("--gain", "0", "--cross-talk", "0", "--seed", "3")),  # made when sensors were perfect
        ({"sensor_error": [[0.0, 0.0], [0.0, 0.0]]}, ("--gain", "0", "--cross-talk", "0", "--seed", "3")),
        ({"sensor_error": [[0.0, 0.0], [0.0, 0.02]]}, ("--seed", "3")),
    ],
)
def test_the_station_of_a_run_has_its_sensor_again(truth: dict[str, Any], options: tuple[str, ...]) -> None:
    assert Station.of({"sensor": "can", "options": ["--seed", "3"], "truth": truth}).options == options
