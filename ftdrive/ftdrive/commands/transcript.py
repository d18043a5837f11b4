"""`ftdrive transcript`: record the bytes on a sensor's wire, and play them to the driver."""

from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from ftcalib.files import open_file
from ftdrive.cell.config import clock_in_force
from ftdrive.cell.emulated import EMULATED, sensor_name, sensor_reached
from ftdrive.cell.emulated_clock import LocalClock
from ftdrive.checks.computer import SensorAddress
from ftdrive.commands.options import EMULATED_SENSOR, FILE, JSON, NewFile, Number, check_simulate, simulate, write_json
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import versions
from ftdrive.terminal.console import answer, indented, messages, working
from ftdrive.terminal.text import Group
from ftdrivers.registry import sensor_from_url
from ftdrivers.transcript import Transcript, Writer


@click.group(cls=Group)
def transcript() -> None:
    """Record the bytes on a sensor's wire, or play them to the driver, to reproduce a bug report.

    For sensors on a serial port or a CAN bus. Capture others, such as a Net F/T, with Wireshark.
    """


@transcript.command("record")
@click.option("--sensor", metavar="URL", help="Address of the sensor, such as ati-serial:///dev/serial/by-id/NAME.")
@simulate("Use an emulated sensor: ATI RS-485, or --sensor emulated://NAME.")
@click.option("-o", "--output", "path", required=True, type=NewFile(), help="Save the transcript as this new file.")
@click.option(
    "--duration",
    "duration_s",
    type=Number(0.1, 600),
    default=5.0,
    show_default=True,
    help="Duration of the recording, s.",
)
@JSON
def transcript_record(sensor: str | None, simulate: bool, path: Path, duration_s: float, as_json: bool) -> None:
    """Record all bytes between the driver and its sensor, from opening to closing.

    Only the driver's own requests are sent. If the sensor fails, the transcript of the failure is kept.
    """
    if simulate:
        sensor = _emulated_address(sensor)
    if sensor is None:
        raise ConfigError("no sensor is given: add --sensor URL or --simulate")
    url, seen = _record_bytes(sensor, path, duration_s)
    if as_json:
        write_json({"schema_version": 1, "file": str(path), "url": url, "recorded": seen})
    else:
        answer.print(_describe_bytes(seen))


def _emulated_address(sensor: str | None) -> str:
    return EMULATED + sensor_name(sensor or f"{EMULATED}serial")


def _record_bytes(sensor: str, path: Path, duration_s: float, *, kept: bool = True) -> tuple[str, dict[str, Any]]:
    """Record a sensor's bytes; return its address and what the driver received. If `kept`, print the file's name."""
    # before an emulated sensor starts
    if sensor.startswith("ur-ft:") or sensor == f"{EMULATED}ur-ft":
        raise ConfigError(
            f"{sensor} is read over RTDE, which is not recorded: capture TCP port 30004 of the arm with Wireshark"
        )
    url, clock = sensor_reached(sensor, clock_in_force())
    address = SensorAddress.of(url)
    if address.serial_port is None and not address.scheme.endswith("-can"):
        raise ConfigError(
            f"{sensor} is neither on a serial port nor on a CAN bus: only these can be recorded; capture others with "
            "Wireshark"
        )
    device = sensor_from_url(url, clock=clock)
    header = {
        "url": url,
        "duration_s": duration_s,
        "utc": datetime.now(UTC).isoformat(),
        "t_ns": clock.now_ns(),  # the moment `utc` on the clock that gives the times of all lines
        "versions": versions(),
    }
    writer = Writer(path, header, clock)
    try:
        with working(f"Recording for {duration_s:g} s"):
            seen = writer.record(device, duration_s)
    finally:
        if kept and writer.is_saved:
            messages.print(f" Saved {path}")
    if not writer.has_port:
        raise ConfigError(f"the driver of {sensor} uses neither pyserial nor python-can: only these can be recorded")
    return url, seen


@transcript.command()
@click.argument("file", required=False, type=FILE)
@simulate("Record an emulated sensor for a second, and play the recording.")
@EMULATED_SENSOR
@JSON
def play(file: Path | None, simulate: bool, sensor: str | None, as_json: bool) -> None:
    """Play the transcript FILE to the unmodified driver, and print what the driver measures.

    An interrupted transcript is played up to its last complete line.
    """
    check_simulate(simulate, real={"FILE": file}, emulated={"--sensor": sensor})
    if simulate:
        with TemporaryDirectory(prefix="ftdrive-") as folder:
            path = Path(folder) / "sensor.jsonl"
            _record_bytes(_emulated_address(sensor), path, 1.0, kept=False)
            loaded = Transcript.load(path)
    elif file is not None:
        open_file(file).close()  # raises for a pipe or a device file
        loaded = Transcript.load(file)
    else:
        raise ConfigError("no transcript is given: add its FILE, or --simulate")
    # on a clock of its own, so that on a busy computer the playback slows down instead of missing its times
    played = loaded.play(LocalClock())
    recorded = {key: value for key, value in loaded.end.items() if key not in {"event", "t_ns"}}
    if as_json:
        write_json({"schema_version": 1, "url": loaded.header["url"], "recorded": recorded, "played": played})
    else:
        answer.print(indented(" recorded  ", _describe_bytes(recorded), answer))
        answer.print(indented(" played    ", _describe_bytes(played), answer))
    if (played_s := played["duration_s"]) < (whole_s := loaded.header["duration_s"]):
        messages.print(f" The recording was interrupted: {played_s:.3g} s of {whole_s:g} s were played.")


def _describe_bytes(seen: dict[str, Any]) -> str:
    if "identity" not in seen:
        return str(seen.get("error", "interrupted"))
    force, torque = (
        ", ".join(f"{value:.{digits}f}" for value in seen[key])
        for key, digits in (("mean_force_N", 3), ("mean_torque_Nm", 4))
    )
    who = seen["identity"]
    return f"{who['model']}, serial {who['serial']}: {seen['samples']} samples, mean ({force}) N, ({torque}) N·m"
