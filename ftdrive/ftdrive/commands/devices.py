"""`ftdrive devices`: the ports and buses of this computer, and with --probe the known sensors on them."""

from pathlib import Path
from typing import Any

import click
from rich.text import Text
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ftcalib.errors import UsageError
from ftdrive.cell.config import clock_in_force
from ftdrive.cell.emulated import Station
from ftdrive.checks.computer import can_details, can_interfaces, check_serial_port, name_by_id
from ftdrive.checks.discovery import probe_place
from ftdrive.commands.options import JSON, check_simulate, simulate, write_json
from ftdrive.terminal.console import answer, indented
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError

_PLACES = """\b
A PLACE is
  /dev/ttyUSB0                         a serial port
  can0                                 a CAN interface that is up, at its rate
  slcan:///dev/ttyACM0?bitrate=250000  a CAN adapter on a serial port"""


@click.command(epilog=_PLACES)
@click.option("--probe", "places", multiple=True, metavar="PLACE", help="Look for known sensors at PLACE. Repeatable.")
@simulate("Use the two ports of an emulated cell.")
@JSON
def devices_command(places: tuple[str, ...], simulate: bool, as_json: bool) -> None:
    """List serial ports by id and CAN interfaces; with --probe, the known sensors that answer there.

    Only a PLACE is opened: the command listens there, and then sends read requests in the protocols of the known
    sensors. Do not probe a serial port that another device uses.

    Only kernel CAN interfaces (can0) and slcan adapters can be probed. ATI sensors are expected at base identifier 0x20
    (else use socketcan://can0?base=0x7F), Robotous sensors at 1 Mbit/s. If another device uses the identifiers of a
    sensor, nothing is sent and the output reports it. A wrong bit rate disturbs a bus in use.
    """
    check_simulate(simulate, real={"--probe": places})
    failures: list[Exception] = []
    found = (
        _emulated_devices(failures)
        if simulate
        else {
            "serial": [_serial_port(port) for port in sorted(list_ports.comports())],
            "can": [{"interface": name, **can_details(name)} for name in can_interfaces()],
        }
    )
    if places:
        clock = clock_in_force()
        found["answers"] = [answer for place in places for answer in _probe_place(place, clock, failures)]
    if as_json:
        write_json({"schema_version": 1, **found})
    else:
        _print_devices(found)
    if failures:
        raise failures[0]


def _serial_port(port: ListPortInfo) -> dict[str, Any]:
    name = name_by_id(Path(port.device))
    checks = check_serial_port(name or Path(port.device))
    return {
        "port": port.device,
        "by_id": None if name is None else str(name),
        "description": None if port.description == "n/a" else port.description,
        "usb": None if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
        "serial_number": port.serial_number,
        "findings": [{"found": one.found, "fix": one.fix} for one in checks if one.state in {"warning", "failed"}],
    }


def _probe_place(place: str, clock: Clock, failures: list[Exception]) -> list[dict[str, Any]]:
    """Probe one port or bus for sensors. An error is added to `failures` and the result, so that others are probed."""
    nothing = {"port": place, "url": None, "what": "no known sensor answers", "error": None}
    try:
        answers = [nothing | {"url": answer.url, "what": answer.what} for answer in probe_place(place, clock)]
    except (UsageError, DeviceError, OSError) as error:
        failures.append(error)
        return [nothing | {"what": "could not be probed", "error": str(error)}]
    return answers or [nothing]


def _emulated_devices(failures: list[Exception]) -> dict[str, Any]:
    with Station("both") as station:
        serial, can = station.endpoints["sensors"]["serial"], station.endpoints["sensors"]["can"]
        places = (serial["port"], f"slcan://{can['channel']}?bitrate={can['bitrate']}")
        return {
            "serial": [_serial_port(ListPortInfo(path)) for path in (serial["port"], can["channel"])],
            "can": [],
            "answers": [answer for place in places for answer in _probe_place(place, station.clock, failures)],
        }


def _print_devices(found: dict[str, Any]) -> None:
    for port in found["serial"]:
        words = [port["by_id"] or port["port"], port["description"], port["usb"]]
        answer.print(indented(" serial  ", "   ".join(word for word in words if word), answer))
        for finding in port["findings"]:
            answer.print(indented(Text.assemble(" " * 9, ("!", "yellow"), " "), finding["found"], answer))
            answer.print(indented(f"{'':11}fix: ", finding["fix"] or "-", answer))
    for interface in found["can"]:
        words = [str(value) for value in interface.values()]
        answer.print(indented(" can     ", "   ".join(words), answer))
    for kind, name in (("serial", "serial ports"), ("can", "CAN interfaces of the kernel")):
        if not found[kind]:
            answer.print(f" no {name}")
    for reply in found.get("answers", ()):
        what = reply["what"] if reply["error"] is None else f"{reply['what']}: {reply['error']}"
        words = [reply["port"], what, reply["url"]]
        answer.print(indented(" probed  ", "   ".join(word for word in words if word), answer))
