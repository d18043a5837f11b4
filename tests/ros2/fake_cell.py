"""A stream for the node that gives what a test says, and a process that plays it at 500 Hz."""

import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.servers.ros2 import Ros2Node
from ftdrive.stream.samples import Block, LinkStatus, StreamEvent, StreamStatus
from ftdrivers.errors import DeviceTimeout
from tests.unit.ftdrive.servers import fake_stream
from tests.unit.ftdrive.servers.fake_stream import FakeStream, block

_RATE_HZ = 500.0
_CALIBRATION = SimpleNamespace(**fake_stream.INFO.calibration.__dict__, id="abc")
_DEVICE = SimpleNamespace(model="Acme", serial="1")


class Stream(FakeStream):
    """Measures one sample each 2 ms of the computer's clock; silent on request."""

    def __init__(self) -> None:
        super().__init__()
        self.info = replace(
            fake_stream.INFO,
            result=cast(Any, _CALIBRATION),
            arm=cast(Any, _DEVICE),
            sensor=cast(Any, _DEVICE),
            sensor_rate_Hz=_RATE_HZ,
            utc_offset_ns=time.time_ns() - time.monotonic_ns(),
        )
        self.warnings: tuple[str, ...] = ()
        self.devices = self
        self.silent = self.has_ended = False
        self.blocks: list[Block] = []
        self.replaced: Block | None = None
        """Read next, once."""
        self._start_ns, self._read = time.monotonic_ns(), 0

    def read(self) -> Block:
        time.sleep(0.002)
        if self.silent:
            time.sleep(0.3)
            raise DeviceTimeout("the sensor sent nothing new for 0.3 s", "check cable and power")
        if (replaced := self.replaced) is not None:
            self.replaced = None
            return replaced
        due = int((time.monotonic_ns() - self._start_ns) * 1e-9 * _RATE_HZ)
        seq = np.arange(self._read, due)
        if not len(seq):
            return self.read()
        self._read = due
        made = block(len(seq), int(seq[0]), self.frame, self.stages)
        made = replace(made, t_host_ns=self._start_ns + (seq * 1e9 / _RATE_HZ).astype(np.int64))
        self.blocks.append(made)
        return made

    def status(self) -> StreamStatus:
        error = "the sensor sent nothing new for 0.3 s" if self.silent else ""
        link = LinkStatus(_RATE_HZ, _RATE_HZ, 0, 0.001)
        nan = float("nan")
        return StreamStatus(replace(link, error=error), link, 0.003, 0.0002, None, None, nan, 0.1, 22.5, 0.001)

    def take_events(self) -> list[StreamEvent]:
        return []

    def use_tool(self, name: str) -> StreamEvent:
        if name != "gripper":
            raise ConfigError(f"there is no accepted calibration of the tool {name!r}: calibrate it")
        return StreamEvent(7, "tool", f"tool {name}")


def main(*arguments: str) -> None:
    """Play a stream until a signal, as the command does."""

    @contextmanager
    def opened() -> Iterator[Any]:
        yield Stream()

    with suppress(KeyboardInterrupt), closing(Ros2Node(arguments)) as node:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        node.serve(opened)


if __name__ == "__main__":
    main(*sys.argv[1:])
