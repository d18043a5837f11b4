"""What the node of ROS 2 reports about itself, and which transforms it publishes, without ROS 2."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ftdrive.servers import ros2
from ftdrive.servers.parameters import Fixed
from ftdrive.servers.ros2 import Level, PartState, TransformPublisher, reports_of
from ftdrive.stream.samples import LinkStatus, Stages, StreamStatus, WrenchFrame
from ftdrivers.errors import NoRos2
from tests.unit.ftdrive.terminal.fake_stream import INFO, R_BASE_FLANGE, FakeStream

LINK = LinkStatus(998.4, 1000.0, 7, 0.0012)


def reports(
    *, warnings: tuple[str, ...] = (), lost_before: int = 7, verdict: str = "good", **status: Any
) -> list[PartState]:
    stream = FakeStream()
    calibration = SimpleNamespace(verdict=verdict, id="29ce87")
    stream.info = cast("Any", SimpleNamespace(
        arm=INFO.arm, sensor=INFO.sensor, tool="gripper", marks=("EMULATED",) if "mark" in status else (),
        calibration=calibration, calibration_name="c.json", calibration_state="3 d old",
    ))  # fmt: skip
    status.pop("mark", None)
    links = {"sensor": LINK, "arm": replace(LINK, rate_Hz=500.0, lost=2)} | status
    rest = (0.00312, 0.0002, None, None, 0.12, 0.05, 22.5, 0.001)
    stream.status = lambda: StreamStatus(links["sensor"], links["arm"], *rest)  # type: ignore[method-assign]
    stream.warnings = warnings
    return reports_of(cast("Any", stream), lost_before, 42)


def test_what_is_wrong_has_its_level() -> None:
    assert reports(lost_before=4)[1].text == "3 samples lost since the last report"
    assert reports(lost_before=6)[1].level is Level.WARN
    assert [one.level for one in reports(lost_before=4)] == [Level.OK, Level.WARN, Level.OK, Level.OK]
    silent = reports(arm=replace(LINK, error="no state for 0.3 s"))
    assert [one.level for one in silent] == [Level.ERROR, Level.OK, Level.ERROR, Level.OK]
    assert silent[0].text == silent[2].text == "no state for 0.3 s"
    doubtful = reports(warnings=("another tool",), mark=True)[3]
    assert (doubtful.level, doubtful.text) == (Level.WARN, "EMULATED; another tool")
    assert reports(verdict="rejected")[3].level is Level.ERROR


def test_a_report_becomes_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(DiagnosticStatus=SimpleNamespace, KeyValue=SimpleNamespace)
    monkeypatch.setattr(ros2, "ros2_module", lambda _: fake)
    message = reports(lost_before=0)[1].message("ftdrive")
    assert (message.level, message.name, message.hardware_id) == (b"\x01", "ftdrive: sensor", "ATI Mini45 FT12345")
    assert {one.key: one.value for one in message.values}["lost"] == "7"


class FakeNode:
    """A node that keeps what it publishes, by topic."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Any]] = []
        self.logged: list[str] = []

    def create_publisher(self, _: object, topic: str, __: object) -> Any:
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.logged.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=77))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> FakeNode:
    def kept(t_ns: Any, found: Sequence[tuple[str, str, Any, Any]]) -> Any:
        made = t_ns[0], {(parent, child): (R, p) for parent, child, p, R in found}
        return SimpleNamespace(tobytes=lambda: made)

    policy = SimpleNamespace(TRANSIENT_LOCAL=1)
    fake = SimpleNamespace(TFMessage=object, DurabilityPolicy=policy, QoSProfile=SimpleNamespace)
    monkeypatch.setattr(ros2, "ros2_module", lambda _: fake)
    monkeypatch.setattr(ros2, "pack_transforms", kept)
    return FakeNode()


FIXED = Fixed(base_frame="ur_base", flange_frame="ur_tool0", sensor_frame="wrist_ft")


def test_sensor_and_tcp_are_published_once_where_the_height_is_known(node: FakeNode) -> None:
    TransformPublisher(node, FIXED).use(INFO)
    ((topic, (t_ns, found)),) = node.published
    assert (topic, t_ns) == ("/tf_static", 77)
    assert found.keys() == {("ur_tool0", "wrist_ft"), ("ur_tool0", "tcp")}
    R, p_m = found["ur_tool0", "wrist_ft"]
    np.testing.assert_allclose(R, INFO.calibration.R_flange_sensor)
    np.testing.assert_allclose(p_m, [0, 0, 0.035])
    TransformPublisher(node, FIXED).use(replace(INFO, p_flange_sensor_m=np.array([0.0, 0.0, np.nan])))
    assert len(node.published) == 1


def test_a_frame_that_turns_and_on_request_the_flange_are_published_as_they_move(node: FakeNode) -> None:
    stream = FakeStream()
    block = stream.read()
    both = TransformPublisher(node, replace(FIXED, publish_base_tf=True))
    both.publish(block, INFO, 10**9)
    ((topic, (t_ns, found)),) = node.published
    assert (topic, t_ns) == ("/tf", 10**9)
    assert found.keys() == {("ur_tool0", "ur_base_at_tcp"), ("ur_base", "ur_tool0")}
    np.testing.assert_allclose(found["ur_tool0", "ur_base_at_tcp"][0], R_BASE_FLANGE.T)
    np.testing.assert_allclose(found["ur_tool0", "ur_base_at_tcp"][1], [0, 0, 0.17])
    np.testing.assert_allclose(found["ur_base", "ur_tool0"][0], R_BASE_FLANGE)
    np.testing.assert_allclose(found["ur_base", "ur_tool0"][1], [0.4, 0.1, 0.3])
    both.publish(block, INFO, 10**9 + 10**6)  # at most 50 a second
    assert len(node.published) == 1
    at_tcp = replace(block, frame=WrenchFrame("tcp", "tcp"), stages=Stages())
    TransformPublisher(node, FIXED).publish(at_tcp, INFO, 10**9)
    unknown = replace(at_tcp, p_base_flange_m=np.full((len(block), 3), np.nan))
    TransformPublisher(node, replace(FIXED, publish_base_tf=True)).publish(unknown, INFO, 10**9)
    assert len(node.published) == 1


def test_without_tf2_nothing_is_published(node: FakeNode, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise NoRos2(name)

    monkeypatch.setattr(ros2, "ros2_module", missing)
    found = TransformPublisher(node, FIXED)
    found.use(INFO)
    found.publish(FakeStream().read(), INFO, 10**9)
    assert not node.published
    assert "ur_tool0 to wrist_ft is not published" in node.logged[0]
