"""An arm of any make that is read through ROS 2 topics and never moved.

Ref: REP 105 (frames), geometry_msgs/msg/PoseStamped, sensor_msgs/msg/JointState, tf2_msgs/msg/TFMessage.
Checked on hardware: no. Verified against: tests/ros2.
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import BadUrl, ConnectError, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.follow import Follow, Unread
from ftdrivers.interfaces import NOT_REPORTED, ArmState, ArmStates, DeviceInfo, Diagnosis, Fact, ReadOnlyArm
from ftdrivers.registry import Options, split_url
from ftdrivers.ros2.middleware import Node, OnePublisher, Received, clock_diagnosis, subscribe, subscribe_to_tf
from ftdrivers.ros2.poses import Chain, Joints, PoseReader, Poses, StampedPose, Transforms

SCHEME: Final = "ros2:"
# Time-out from the discovery of the publishing node to its first pose, s.
_FIRST_S: Final = 2.0
_STALE_S: Final = 0.3
# Interval over which the speed is averaged, s, because encoders have steps and time stamps have jitter.
_SPEED_NS: Final = 100_000_000
# Lever with which a translation of the flange is converted to an angle, m.
_LEVER_M: Final = 1.0
_MOST_UNREAD: Final = 1_000_000
# Stamps that go back by more than this, s, come from another clock.
_BACK_S: Final = 0.5


class Ros2Arm(ReadOnlyArm):
    """An arm whose flange pose is published on topics; `t_device_s` is the stamp of the header.

    Joint angles are NaN. All joint speeds are the speed of the flange, averaged over 0.1 s: the larger one of its
    angular velocity in rad/s and its velocity divided by 1 m.

    Parameters
    ----------
    host : str
        ``ros2:/pose_topic``, ``ros2:tf?base=base&flange=tool0`` or
        ``ros2:/joint_states?urdf=arm.urdf&flange=tool0&base=base``.
    model : str, optional
        Name of the arm, which is stored in calibrations.
    """

    def __init__(
        self,
        host: str,
        *,
        model: str | None = None,
        speed_rad_s: float = 0.0,  # noqa: ARG002 - the arm is never moved
        acceleration_rad_s2: float = 0.0,  # noqa: ARG002
        clock: Clock = REAL,
    ) -> None:
        self._host, self._model, self._clock = host, model, clock
        self._reader = pose_reader_of(host)  # rejects a wrong address early
        self._ros: Node | None = None
        self._publishers: dict[str, str] = {}
        self._single: list[OnePublisher] = []
        self._changed = threading.Condition()
        self._followers: list[Unread[ArmState]] = []
        self._recent: deque[StampedPose] = deque()
        self._newest: ArmState | None = None
        self._failure: ProtocolError | None = None

    def open(self, *, control: bool = False) -> None:
        """Subscribe and wait for the first pose. Raises `ConnectError` if none arrives, or if control is requested."""
        super().open(control=control)
        if self._ros is not None:
            if self._failure is None and self._age_s() < _STALE_S:
                return
            self.close()
        self._reader, self._failure, self._newest = pose_reader_of(self._host), None, None
        self._recent.clear()
        self._ros = Node("ftdrive_arm")
        self._ros.spin()
        try:
            self._subscribe(self._ros)
            self._await_first()
        except BaseException:
            self.close()
            raise

    def _subscribe(self, ros: Node) -> None:
        self._single = []
        for topic, kind in self._reader.topics.items():
            on_message = partial(self._receive, topic)
            if isinstance(self._reader, Transforms):
                subscribe_to_tf(ros, topic, on_message, self._clock)
                self._publishers[topic] = "tf"
            else:
                self._publishers[topic] = subscribe(ros, topic, kind, on_message, self._clock)
                self._single.append(OnePublisher(ros, topic, self._clock))

    def _await_first(self) -> None:
        with self._changed:
            for left_s in self._clock.looks(_FIRST_S):
                if self._newest is not None or self._failure is not None:
                    break
                self._clock.wait(self._changed, min(left_s, 0.05))
            if self._failure is not None:
                raise ConnectError(self._failure.found, self._failure.fix) from self._failure
            if self._newest is None:
                raise ConnectError(self._reader.missing(), "check topic and frames, and that the driver is running")

    def close(self) -> None:
        """Leave the ROS graph. Followers raise `StreamBroken`."""
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close()
        with self._changed:
            self._followers.clear()
            self._changed.notify_all()

    def identify(self) -> DeviceInfo:
        """Return the configured name of the arm and the publishing nodes."""
        if self._ros is None:
            raise ConnectError(f"{self._host}: not open", "open it first")
        facts = {"publisher": Fact(", ".join(sorted(set(self._publishers.values()))), "device")}
        return DeviceInfo(self._model or self._host, NOT_REPORTED, NOT_REPORTED, facts)

    def _receive(self, topic: str, received: Received) -> None:
        """Publish the poses of a message; called in the thread of the node."""
        try:
            poses = list(self._reader.read(topic, received.message))
        except ProtocolError as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()
            return
        with self._changed:
            for pose in poses:
                newest = self._newest
                t_s = 1e-9 * pose.t_ns
                if newest is not None and t_s <= newest.t_device_s:
                    if t_s < newest.t_device_s - _BACK_S:
                        self._failure = ProtocolError(
                            f"the stamps of {topic} went back by {newest.t_device_s - t_s:.1f} s",
                            "check that only one node publishes it, with one clock",
                        )
                    continue
                self._newest = state = self._state_of(pose, received.t_host_ns)
                for unread in self._followers:
                    unread.put(state)
            self._changed.notify_all()

    def _state_of(self, pose: StampedPose, t_host_ns: int) -> ArmState:
        self._recent.append(pose)
        while len(self._recent) > 2 and self._recent[1].t_ns <= pose.t_ns - _SPEED_NS:
            self._recent.popleft()
        speed = np.full(6, _speed(self._recent[0], pose))
        return ArmState(
            t_host_ns, 1e-9 * pose.t_ns, np.full(6, np.nan), speed, pose.R_base_flange, pose.p_base_flange_m
        )

    def state(self) -> ArmState:
        """Return a state that arrives after this call. Raises `DeviceTimeout` if no message arrives in time."""
        with self._changed:
            before = self._newest
            for left_s in self._clock.looks(_STALE_S):
                self._check()
                if self._newest is not None and self._newest is not before:
                    return self._newest
                self._clock.wait(self._changed, left_s)
        raise self._silence()

    @contextmanager
    def follow(self) -> Iterator[Follow[ArmStates]]:
        """Read every state from now on."""
        unread: Unread[ArmState] = Unread(self._host, _MOST_UNREAD)
        with self._changed:
            self._check()
            self._followers.append(unread)
        try:
            yield Follow(partial(self._read_on, unread))
        finally:
            with self._changed:
                self._followers = [one for one in self._followers if one is not unread]

    def _read_on(self, unread: Unread[ArmState], timeout_s: float) -> ArmStates:
        with self._changed:
            for left_s in self._clock.looks(timeout_s):
                if states := unread.take():
                    return ArmStates.of(states)
                self._check()
                if unread not in self._followers:
                    raise StreamBroken(f"{self._host}: the arm was closed", "follow it again")
                if self._age_s() > _STALE_S:
                    raise self._silence()
                self._clock.wait(self._changed, min(left_s, _STALE_S))
            states = unread.take()
            return ArmStates.of(states) if states else _no_states()

    def _age_s(self) -> float:
        return float("inf") if self._newest is None else (self._clock.now_ns() - self._newest.t_host_ns) * 1e-9

    def _check(self) -> None:
        if self._ros is None:
            raise ConnectError(f"{self._host}: not open", "open it first")
        self._ros.check()
        for publisher in self._single:
            publisher.check()
        if self._failure is not None:
            raise ProtocolError(self._failure.found, self._failure.fix) from self._failure

    def _silence(self) -> DeviceTimeout:
        return DeviceTimeout(
            f"{self._host}: no new pose for {self._age_s():.2f} s (allowed: {_STALE_S:g} s)",
            "check that the driver of the arm is running",
        )

    def diagnose(self) -> list[Diagnosis]:
        """Report the publishing nodes, and the difference between the stamps and the clock of this computer."""
        self._check()
        state, ros = self.state(), self._ros
        found = f"{self._host} is published by {', '.join(sorted(set(self._publishers.values())))}"
        return [Diagnosis("topic", True, found), *([clock_diagnosis(ros, state.t_device_s)] if ros else [])]


def _speed(before: StampedPose, after: StampedPose) -> float:
    """Return the speed of the flange between two poses, rad/s; 0 if they do not have ascending time stamps."""
    dt_s = 1e-9 * (after.t_ns - before.t_ns)
    if dt_s <= 0:
        return 0.0
    change = before.R_base_flange.T @ after.R_base_flange
    sine = np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]]) / 2
    angle_rad = float(np.arctan2(np.linalg.norm(sine), (np.trace(change) - 1) / 2))
    moved_m = float(np.linalg.norm(after.p_base_flange_m - before.p_base_flange_m))
    return max(angle_rad, moved_m / _LEVER_M) / dt_s


def _no_states() -> ArmStates:
    nothing = np.zeros((0, 6))
    return ArmStates(np.zeros(0, np.int64), np.zeros(0), nothing, nothing, np.zeros((0, 3, 3)), np.zeros((0, 3)))


def pose_reader_of(host: str) -> PoseReader:
    """Return the reader that converts messages to poses for an address. Raises `BadUrl` for an invalid address."""
    parts = split_url(host)
    options = Options(host, parts.query)
    address = parts.address.strip("/")
    if not address:
        raise BadUrl(f"{host} names no topic; write it like ros2:/pose_topic or ros2:tf?base=base&flange=tool0")
    base, flange = options.optional("base"), options.optional("flange")
    urdf = options.optional("urdf")
    options.reject_others()
    if address == "tf" and not parts.address.startswith("/"):
        if base is None or flange is None or urdf is not None:
            raise BadUrl(f"{host}: tf needs base and flange; write it like ros2:tf?base=base&flange=tool0")
        return Transforms(base, flange)
    if urdf is not None:
        if flange is None:
            raise BadUrl(f"{host}: option 'flange' is missing: the link of the flange in {urdf}")
        return Joints(f"/{address}", Chain(Path(urdf), base or "", flange))
    if base is not None or flange is not None:
        raise BadUrl(f"{host}: base and flange apply only to tf and urdf; a PoseStamped is already the flange pose")
    return Poses(f"/{address}")
