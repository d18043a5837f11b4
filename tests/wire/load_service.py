"""`serve-load` as a process of its own, on a station that a test has started: it can be killed and suspended."""

import json
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.devices import program_registers
from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrive.servers.program import INTEGERS, ProgramService, doubles_of
from ftdrive.stream.samples import Block, StreamEvent, WrenchFrame
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Stream
from tests.unit.ftdrive.stream.simulated import calibrated_from


def opened(hello: dict[str, Any]) -> Stream:
    """Open the stream of a station by its first line."""
    url = next(iter(hello["sensors"].values()))["url"]
    height_mm = 1e3 * hello["truth"]["p_flange_sensor_m"][2]
    cell = CellConfig(
        RobotConfig(hello["arm"]["host"], hello["arm"]["model"]),
        SensorConfig(url, height_mm=height_mm),
        clock=EmulatedClock(hello["clock"]),
    )
    return Stream(CellSource(cell, calibrated_from(hello["truth"])), frame=WrenchFrame("base", "tcp"))


class Service(ProgramService):
    """Reports that the first wrench was written."""

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        super().add(block, events)
        if self._live == 1:
            sys.stdout.write("serving\n")
            sys.stdout.flush()


def service_on(stream: Stream, first: int = 24) -> ProgramService:
    """Return the service of an open stream."""
    connect = partial(program_registers, stream.cell, first, len(INTEGERS), len(doubles_of(stream.track)))
    return Service(stream, connect, sys.stderr.write)


if __name__ == "__main__":
    with opened(json.loads(sys.argv[1])) as stream:
        stream.track = "show"
        service_on(stream).run()
