"""A stream without devices, in the states that the live screen must show."""

import math
from collections import deque
from collections.abc import Iterator
from functools import cache, cached_property
from itertools import islice
from typing import Any, Literal

import numpy as np

from ftcalib import CalibrationResult, Parameters
from ftcalib.model import predict
from ftdrive.runs.verification import VerificationRecord
from ftdrive.stream.feed import Feed
from ftdrive.stream.samples import (
    Block,
    EventKind,
    FrameTransform,
    LinkStatus,
    Stages,
    StreamEvent,
    StreamInfo,
    StreamStatus,
    WrenchFrame,
)
from ftdrivers.clock import REAL
from ftdrivers.errors import DeviceTimeout
from ftdrivers.interfaces import Array, DeviceInfo, Fact

Scenario = Literal["still", "contact", "stale", "tare-refused"]

SIGMA = np.repeat([0.1, 0.004], 3)
"""Of one sample."""
LIMIT = 22.46
START_NS = 1_000_000_000_000
UTC_OFFSET_NS = 1_794_841_200_000_000_000 - START_NS
R_FLANGE_SENSOR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""The sensor is turned by 90° about the tool axis."""
_TILT = math.radians(12)
R_BASE_FLANGE = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]) @ np.array(
    [[1.0, 0.0, 0.0], [0.0, math.cos(_TILT), -math.sin(_TILT)], [0.0, math.sin(_TILT), math.cos(_TILT)]]
)
"""The tool points down, 12° off."""
PARAMETERS = Parameters(
    R_flange_sensor=R_FLANGE_SENSOR,
    gravity_force_base_N=np.array([0.1, -0.2, -14.1]),
    force_bias_N=np.array([-3.2, 7.9, -35.0]),
    p_sensor_com_m=np.array([0.004, -0.002, 0.06]),
    torque_bias_Nm=np.array([0.1, -0.1, -1.0]),
)


FREE = predict(PARAMETERS, R_BASE_FLANGE[None])[0]
BIAS = np.concatenate([PARAMETERS.force_bias_N, PARAMETERS.torque_bias_Nm])
TARE = np.array([0.3, -0.2, 0.2, 0.0, 0.0, 0.0])


def calibration() -> CalibrationResult:
    return CalibrationResult(
        parameters=PARAMETERS,
        covariance=np.diag(np.repeat([1e-3, 0.005, 0.005, 1e-4, 2e-4], 3) ** 2),
        residuals=np.zeros((24, 6)),
        chi2=129.0,
        dof=129,
        noise_source="measured",
        g_m_s2=9.80665,
        method="ml",
        findings=(),
        provenance={
            "created_utc": "2026-11-14T08:00:00+00:00",
            "dataset_sha256": "7c1e9a" + "0" * 58,
            "devices": {
                "arm": {"model": "UR5e", "serial": "20225500001"},
                "sensor": {"model": "ATI Mini45", "serial": "FT12345"},
            },
        },
        measured_sigma=SIGMA / 30,
    )


INFO = StreamInfo(
    result=calibration(),
    calibration_name="runs/2026-11-14T080000Z-gripper_a/calibration.json",
    arm=DeviceInfo("UR5e", "20225500001", "5.12.0"),
    sensor=DeviceInfo(
        "ATI Mini45", "FT12345", "2.1", {"range": Fact((145.0, 145.0, 290.0, 5.0, 5.0, 5.0), "documented")}
    ),
    tool="gripper_a",
    utc_offset_ns=UTC_OFFSET_NS,
    sensor_rate_Hz=7000.0,
    arm_rate_Hz=500.0,
    p_flange_sensor_m=np.array([0.0, 0.0, 0.035]),
    R_flange_tcp=np.eye(3),
    p_flange_tcp_m=np.array([0.0, 0.0, 0.17]),
    versions={"ftdrive": "1.0"},
    verification=VerificationRecord(
        path="runs/2026-11-16T060000Z-verify/verification.json",
        calibration_id=calibration().id,
        created_utc="2026-11-16T06:00:00.000000+00:00",
        passed=True,
        change=None,
        reason="the calibration holds",
        force_max_N=0.08,
        torque_max_Nm=0.002,
    ),
)


PAST: tuple[tuple[float, EventKind, str], ...] = ((5.0, "mark", "peg in"), (6.1, "contact", "contact 8.0 N, 0.6 s"))


_AnyStream: Any = object


@cache
def transform_to(frame: WrenchFrame) -> FrameTransform:
    return FrameTransform(frame, INFO)


class FakeStream(_AnyStream):  # type: ignore[misc]  # of no class of the product, and accepted as any
    """Blocks of samples, as fast as they are read.

    Parameters
    ----------
    scenario : str
        "stale": the sensor is silent after `silent_after` blocks.
    rate_Hz, block_s : float
    """

    def __init__(
        self,
        scenario: Scenario = "still",
        rate_Hz: float = 1000.0,
        silent_after: int | None = None,
        block_s: float = 0.01,
    ) -> None:
        self.info = INFO
        self.processor = self.source = self
        self.clock = REAL
        self.frame = WrenchFrame("base", "tcp")
        self.stages = Stages(lowpass_Hz=40.0)
        self.scenario = scenario
        self.blocks = 0
        self.called: list[str] = []
        self._silent_after = silent_after
        self._block_ns = round(block_s * 1e9)
        self._per_block = round(rate_Hz * block_s)
        self._rng = np.random.default_rng(1)
        self._noise = self._rng.normal(size=(64, self._per_block, 6)) * SIGMA
        self._events: list[StreamEvent] = []

    @property
    def now_ns(self) -> int:
        return START_NS + self.blocks * self._block_ns

    @property
    def _is_silent(self) -> bool:
        return self._silent_after is not None and self.blocks >= self._silent_after

    def wake(self) -> None:
        self._silent_after = None

    def read(self) -> Block:
        if self._is_silent:
            raise DeviceTimeout("ATI Mini45 FT12345 sent no sample for 0.31 s", "check its cable and power supply")
        n = self._per_block
        t_ns = self.now_ns + (np.arange(n) + 1) * (self._block_ns // n)
        contact = self._contact(t_ns)
        noise = self._noise[self.blocks % len(self._noise)]
        self.blocks += 1
        rotations = np.broadcast_to(R_BASE_FLANGE, (n, 3, 3))
        wrench = noise + contact
        raw = wrench + FREE
        if not self.stages.bias:
            wrench = wrench + BIAS
        if not self.stages.gravity:
            wrench = wrench + FREE - BIAS
        in_contact = np.abs(contact).max(axis=1) > 0.2
        return Block(
            t_host_ns=t_ns,
            t_device_s=np.full(n, np.nan),
            seq=np.arange(n) + self.blocks * n,
            status=np.zeros(n, np.uint32),
            raw=raw + TARE,
            wrench=transform_to(self.frame)(wrench, rotations),
            chi2=np.where(in_contact, 812.0, 5.1),
            in_contact=in_contact,
            q_rad=np.zeros((n, 6)),
            R_base_flange=rotations,
            p_base_flange_m=np.tile([0.4, 0.1, 0.3], (n, 1)),
            sigma=SIGMA,
            frame=self.frame,
            stages=self.stages,
        )

    def _contact(self, t_ns: np.ndarray) -> np.ndarray:
        """A push of 0.6 s at 5.5 s, and in "contact" one of -5 N from 11.6 s on."""
        t_s = (t_ns - START_NS) * 1e-9
        push = 8.0 * np.clip(np.sin((t_s - 5.5) * np.pi / 0.6), 0, 1) * ((t_s > 5.5) & (t_s < 6.1))
        if self.scenario == "contact":
            push = push - 5.1 * np.clip((t_s - 11.6) / 0.1, 0, 1)
        return np.outer(push, [0.1, -0.05, -1.0, -0.01, 0.04, 0.0])

    def take_events(self) -> list[StreamEvent]:
        for t_s, kind, text in PAST:
            t_ns = START_NS + round(t_s * 1e9)
            if t_ns <= self.now_ns < t_ns + self._block_ns:
                self._events.append(StreamEvent(t_ns, kind, text))
        taken, self._events = self._events, []
        return taken

    def status(self) -> StreamStatus:
        silence = "no sample for 0.31 s" if self._is_silent else ""
        return StreamStatus(
            sensor=LinkStatus(6998.0, 7000.0, 0, 0.31 if silence else 0.001, silence),
            arm=LinkStatus(500.0, 500.0, 0, 0.002),
            delay_s=0.0031,
            delay_sigma_s=0.0002,
            tare=TARE,
            tare_t_host_ns=START_NS - 3_600_000_000_000,
            drift_N_h=0.1,
            drift_sigma_N_h=0.05,
            contact_limit=LIMIT,
            false_alarm_rate=0.001,
        )

    def sigma_of_mean(self, R_base_flange: Array, duration_s: float = 0.0, *, loaded: bool = True) -> Array:
        assert R_base_flange.shape == (3, 3)
        assert duration_s in ((0.0, 0.1) if not loaded else (0.1,))
        if not loaded:
            return SIGMA / 3 if duration_s else SIGMA
        # 2 % of a gain, on all axes alike
        force_N = float(np.linalg.norm(self._contact(np.array([self.now_ns]))[0, :3]))
        return np.asarray(np.hypot(SIGMA / 3, 0.02 * force_N * np.repeat([1.0, 0.067], 3)))

    def tare(self) -> StreamEvent:
        if self.scenario == "tare-refused":
            difference = "3.40 N and 0.120 N·m (6.8 sigma)"
            text = f"tare refused: {difference} from the free tool; take hand or contact away, then tare"
            return self._add("tare-refused", text)
        return self._add("tare", "tare: bias changed by 0.41 N and 0.002 N·m (0.8 sigma)")

    def undo_tare(self) -> StreamEvent:
        return self._add("tare-undone", "tare undone")

    def mark(self, text: str) -> StreamEvent:
        return self._add("mark", text)

    def _add(self, kind: Any, text: str) -> StreamEvent:
        self.called.append(kind)
        event = StreamEvent(self.now_ns, kind, text)
        self._events.append(event)
        return event


class SteppedFeed(Feed):
    @cached_property
    def _turns(self) -> Iterator[Block | None]:
        return self.turns(until=lambda: False)

    def step(self, turns: int = 1) -> None:
        deque(islice(self._turns, turns), 0)
