"""The settings of the station's sensors."""

from typing import Any

import pytest

from ftmocks.sensors.catalogue import parse_settings
from ftmocks.sensors.robotous import MODELS


@pytest.mark.parametrize(
    ("name", "settings", "options"),
    [
        ("can", [], {}),
        ("none", [], {}),
        (
            "robotous-can",
            ["model=RFT64-6A01", "ids=0xF0,0xF1,242"],
            {"model": MODELS["RFT64-6A01"], "ids": (0xF0, 0xF1, 0xF2)},
        ),
        ("bota", ["baud=230400", "boot-s=0.5"], {"baud_code": 3, "boot_s": 0.5}),
        (
            "netft",
            ["tool-transform=0,0,0,0,0,90", "bias=0,0,0,0,0,0"],
            {"tool_transform": [0, 0, 0, 0, 0, 90], "bias": [0] * 6},
        ),
    ],
)
def test_settings(name: str, settings: list[str], options: dict[str, Any]) -> None:
    assert parse_settings(name, settings) == options


@pytest.mark.parametrize(
    ("name", "setting", "says"),
    [
        ("can", "model=1", "leave --sensor-setting out"),
        ("both", "model=1", "leave --sensor-setting out"),
        ("netft", "bias", "give tool-transform=VALUE or bias=VALUE"),
        ("netft", "bias=1,2", "6 numbers"),
        ("netft", "tool-transform=0,0,inf,0,0,0", "6 numbers"),
        ("bota", "baud=1000", "unknown baud rate '1000'"),
        ("bota", "boot-s=-1", "a time in s"),
        ("robotous-can", "ids=1,1,2", "3 different"),
        ("robotous-serial", "model=RFT1", "unknown model 'RFT1'"),
    ],
)
def test_wrong_settings(name: str, setting: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse_settings(name, [setting])
