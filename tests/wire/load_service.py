"""`serve-load` as a process of its own, on a station that a test has started: it can be killed and suspended."""

import json
import sys
from functools import partial
from typing import Any

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.devices import program_registers
from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrive.live.samples import WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.servers.program import INTEGERS, ProgramService, doubles_of
from tests.unit.ftdrive.live.simulated import calibrated_from


def opened(hello: dict[str, Any]) -> CompensatedStream:
    """Open the stream of a station by its first line."""
    url = next(iter(hello["sensors"].values()))["url"]
    height_mm = 1e3 * hello["truth"]["p_flange_sensor_m"][2]
    cell = CellConfig(
        RobotConfig(hello["arm"]["host"], hello["arm"]["model"]),
        SensorConfig(url, height_mm=height_mm),
        clock=EmulatedClock(hello["clock"]),
    )
    return CompensatedStream(cell, calibrated_from(hello["truth"]), frame=WrenchFrame("base", "tcp"))


def service_on(stream: CompensatedStream, first: int = 24) -> ProgramService:
    """Return the service of an open stream."""
    connect = partial(program_registers, stream.cell, first, len(INTEGERS), len(doubles_of(stream.track)))
    return ProgramService(stream, connect, sys.stderr.write)


def started(service: ProgramService, _block: object) -> None:
    """Report that the first wrench was written."""
    service.on_block = None
    sys.stdout.write("serving\n")
    sys.stdout.flush()


if __name__ == "__main__":
    with opened(json.loads(sys.argv[1])) as stream:
        stream.track = "show"
        service = service_on(stream)
        service.on_block = partial(started, service)
        service.run()
