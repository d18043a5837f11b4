"""A force/torque sensor of any make whose wrench is published on a ROS 2 topic.

Ref: geometry_msgs/msg/WrenchStamped; REP 103 (SI units), REP 105 (frames), REP 107 (stamps).
Checked on hardware: no. Verified against: tests/ros2.

The wrench must be as measured, neither compensated for a payload nor filtered for contact; `doctor` and a calibration
detect a compensated wrench. A zero that does not change while ftdrive runs is part of the bias.
"""

from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Self

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Diagnosis, Fact, FtSamples
from ftdrivers.ros2.middleware import Node, OnePublisher, Received, clock_diagnosis, stamp_ns, subscribe
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor

if TYPE_CHECKING:
    from ftdrivers.registry import Options

_TYPE = "geometry_msgs/msg/WrenchStamped"
_WAIT_S = 0.05


class Ros2Sensor(StreamingSensor):
    """A sensor whose wrench is published as WrenchStamped.

    `t_device_s` is the stamp of the header. `seq` is the sequence number of the publisher's middleware, where lost
    messages are gaps. `counts` are empty and `status` is 0. There is no nominal rate.

    Parameters
    ----------
    topic : str
        Name of the topic, such as ``/ft_sensor/wrench``.
    reliable : bool
        Request reliable delivery, which the publisher must offer.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(self, topic: str, *, reliable: bool = False, sign: int = 1, clock: Clock = REAL) -> None:
        super().__init__(f"ROS 2 topic {topic}", sign=sign, clock=clock)
        self._topic, self._reliable = topic, reliable
        self._ros: Node | None = None
        self._queue: SimpleQueue[Received] = SimpleQueue()
        self._frame_id: str | None = None
        self._publisher: OnePublisher | None = None

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``ros2:/topic?reliable=0``."""
        topic = "/" + address.lstrip("/")
        return cls(topic, reliable=bool(options.integer("reliable", 0, 0, 1)), sign=sign, clock=clock)

    def _connect(self) -> DeviceInfo:
        self._queue, self._frame_id = SimpleQueue(), None
        self._ros = Node("ftdrive_sensor")
        self._ros.spin()
        publisher = subscribe(self._ros, self._topic, _TYPE, self._queue.put, self._clock, reliable=self._reliable)
        self._publisher = OnePublisher(self._ros, self._topic, self._clock)
        frame_id = self._first_frame()
        facts = {"publisher": Fact(publisher, "device"), "frame_id": Fact(frame_id, "device")}
        return DeviceInfo(f"{self.name}, frame {frame_id}", NOT_REPORTED, NOT_REPORTED, facts)

    def _first_frame(self) -> str:
        """Wait for the first message, drop it and return its frame."""
        try:
            first = self._queue.get(timeout=self._limits.first_sample_s)
        except Empty:
            raise ConnectError(f"no message of {self._topic} arrived", self._silence_fix()) from None
        self._check_frame({first.message.header.frame_id})
        return str(first.message.header.frame_id)

    def _read_block(self) -> FtSamples:
        if self._ros is not None:
            self._ros.check()
        try:
            received = [self._queue.get(timeout=_WAIT_S)]
        except Empty:
            return NOTHING
        while not self._queue.empty():
            received.append(self._queue.get_nowait())
        messages = [one.message for one in received]
        self._check_frame({message.header.frame_id for message in messages})
        numbers = np.array([one.number for one in received])
        newest = int(self._newest.seq[-1]) if len(self._newest) else int(numbers[0]) - 1
        self._lost += max(0, int(numbers[-1]) - newest - len(numbers))
        t_device_s = [1e-9 * stamp_ns(message.header, self._topic) for message in messages]
        if self._publisher is not None:
            steps_s = np.diff([*self._newest.t_device_s[-1:], *t_device_s])
            self._publisher.check(in_order=bool((steps_s >= 0).all()))
        return FtSamples.of(
            [one.t_host_ns for one in received],
            numbers,
            [
                [getattr(part, axis) for part in (one.wrench.force, one.wrench.torque) for axis in "xyz"]
                for one in messages
            ],
            t_device_s=t_device_s,
        )

    def _check_frame(self, frames: set[str]) -> None:
        """Raise `ProtocolError` for a message in another frame, whose wrench is in other axes."""
        self._frame_id = self._frame_id or min(frames)
        if frames != {self._frame_id}:
            other = ", ".join(sorted(frames - {self._frame_id}))
            raise ProtocolError(
                f"{self.name}: the frame changed from {self._frame_id!r} to {other!r}", "give each frame its own topic"
            )

    def _disconnect(self) -> None:
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close()

    def diagnose(self) -> list[Diagnosis]:
        """Report publishing node and frame, and the difference between the stamps and the clock of this computer."""
        facts = self.identify().facts
        found = f"published by {facts['publisher'].value}, frame {facts['frame_id'].value!r}"
        topic = Diagnosis("topic", bool(facts["frame_id"].value), found, "set header.frame_id in its driver")
        newest = self.latest(timeout_s=1.0)
        return [topic, *([clock_diagnosis(self._ros, float(newest.t_device_s[0]))] if self._ros else [])]

    def _silence_fix(self) -> str:
        return "check that its driver is running"
