"""What `/diagnostics` and `~/status` report: codes of a level with values, in the words of `live`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from ftdrive.live.processing import ProcessedStream, stages_in_words
from ftdrive.live.samples import LinkStatus, StreamStatus
from ftdrivers.ros2.middleware import ros2_module


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Report:
    """One part of the node: "stream", "sensor", "arm" or "calibration"."""

    part: str
    level: Level
    text: str
    values: Mapping[str, str] = field(default_factory=dict)
    hardware: str = ""

    def message(self, node: str) -> Any:
        """Return a DiagnosticStatus."""
        messages = ros2_module("diagnostic_msgs.msg")
        return messages.DiagnosticStatus(
            level=bytes([self.level]),
            name=f"{node}: {self.part}",
            message=self.text,
            hardware_id=self.hardware,
            values=[messages.KeyValue(key=key, value=value) for key, value in self.values.items()],
        )


def not_open(text: str, level: Level) -> list[Report]:
    """Report a stream that is not open."""
    return [Report("stream", level, text)]


def reports_of(stream: ProcessedStream, warnings: tuple[str, ...], lost_before: int, sent: int) -> list[Report]:
    """Report an open stream; `lost_before` is the number of lost samples at the report before."""
    status, info = stream.status(), stream.info
    sensor = _link("sensor", status.sensor, info.sensor, status.sensor.lost - lost_before)
    arm = _link("arm", status.arm, info.arm, 0)
    doubts = [*info.marks, *warnings]
    calibration = info.calibration
    usable = calibration.verdict != "rejected"
    level = Level.ERROR if not usable else Level.WARN if doubts else Level.OK
    text = "; ".join(doubts) or info.calibration_state
    state = Report("calibration", level, text, {"file": info.calibration_name, "verdict": calibration.verdict})
    failed = status.sensor.error or status.arm.error
    words = failed or f"{stream.frame}; {stages_in_words(stream.stages)}"
    whole = Report("stream", Level.ERROR if failed else Level.OK, words, _values(stream, status, sent))
    return [whole, sensor, arm, state]


def _link(part: str, link: LinkStatus, device: Any, lost: int) -> Report:
    values = {"rate_Hz": f"{link.rate_Hz:.1f}", "lost": str(link.lost), "age_s": f"{link.age_s:.3f}"}
    if link.error:
        level, text = Level.ERROR, link.error
    elif lost > 0:
        level, text = Level.WARN, f"{lost} samples lost since the report before"
    else:
        level, text = Level.OK, f"{link.rate_Hz:.0f} Hz"
    return Report(part, level, text, values, f"{device.model} {device.serial}")


def _values(stream: ProcessedStream, status: StreamStatus, sent: int) -> dict[str, str]:
    """Return the state of the stream as texts, as ROS has them."""
    info = stream.info
    tare = "none" if status.tare is None else " ".join(f"{value:.6g}" for value in status.tare)
    return {
        "axes": stream.frame.axes,
        "about": str(stream.frame.to_dict()["about"]),
        "stages": stages_in_words(stream.stages),
        "tool": info.tool,
        "calibration": str(info.calibration.id),
        "verdict": info.calibration.verdict,
        "tare": tare,
        "delay_s": f"{status.delay_s:.6g}",
        "delay_sigma_s": f"{status.delay_sigma_s:.6g}",
        "drift_N_h": f"{status.drift_N_h:.6g}",
        "messages_sent": str(sent),
    }
