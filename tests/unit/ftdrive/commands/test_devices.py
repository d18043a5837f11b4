"""What `ftdrive devices` finds and prints."""

import json
from types import SimpleNamespace
from typing import Any

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ftdrive import cli
from ftdrive.commands import devices
from ftdrivers.errors import DeviceTimeout


def port(path: str, **more: Any) -> ListPortInfo:
    found = ListPortInfo(path)
    for name, value in more.items():
        setattr(found, name, value)
    return found


@pytest.fixture(autouse=True)
def _computer(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [
        port("/dev/ttyUSB1"),
        port("/dev/ttyUSB0", description="FT232R", vid=0x403, pid=0x6001, serial_number="A9"),
    ]
    check = [
        SimpleNamespace(state="failed", found="you may not open it", fix="join dialout"),
        SimpleNamespace(state="ok", found="its timer is fast", fix=""),
        SimpleNamespace(state="warning", found="its timer is slow", fix=""),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    monkeypatch.setattr(devices, "name_by_id", lambda path: f"/by-id{path}" if path.name == "ttyUSB0" else None)
    monkeypatch.setattr(devices, "check_serial_port", lambda path: check if str(path).startswith("/by-id") else [])
    monkeypatch.setattr(devices, "can_interfaces", lambda: ["can0"])
    monkeypatch.setattr(devices, "can_details", lambda _: {"state": "up", "bitrate": 250000})


def ask(place: str, _: object) -> list[Any]:
    match place:
        case "can0":
            return [SimpleNamespace(url="ati-can://can0", what="ATI FT9")]
        case "silent":
            return []
    raise DeviceTimeout("it is open elsewhere", "close the other program")


def test_places_are_probed_and_an_error_is_an_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(devices, "probe_place", ask)
    places = ["--probe", "can0", "--probe", "silent", "--probe", "busy"]
    assert cli.run(["devices", *places]) == 4
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(" probed")]
    assert lines[:2] == [" probed  can0   ATI FT9   ati-can://can0", " probed  silent   no known sensor answers"]
    assert lines[2].startswith(" probed  busy   could not be probed: it is open elsewhere")
    assert cli.run(["devices", *places[:2], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["answers"] == [{"port": "can0", "url": "ati-can://can0", "what": "ATI FT9", "error": None}]
    assert found["can"] == [{"interface": "can0", "state": "up", "bitrate": 250000}]
    (usb, bare) = found["serial"]
    assert (usb["usb"], usb["serial_number"], usb["description"]) == ("0403:6001", "A9", "FT232R")
    assert [one["found"] for one in usb["findings"]] == ["you may not open it", "its timer is slow"]
    assert (bare["by_id"], bare["description"], bare["usb"], bare["findings"]) == (None, None, None, [])
