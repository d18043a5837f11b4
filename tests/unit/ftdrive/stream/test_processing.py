"""Stages, frames, noise, contact, tare and drift of the processing."""

import re
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
import pytest
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from ftcalib.after.series import BiasTemperature
from ftcalib.model import Array, predict
from ftcalib.sensor_matrix import SensorMatrix, ranges
from ftdrive.errors import ConfigError
from ftdrive.stream import processing
from ftdrive.stream.processing import Processor
from ftdrive.stream.samples import Block, FrameTransform, Links, LinkStatus, Paired, Stages, WrenchFrame
from ftdrive.stream.stages import stages_in_words
from tests.unit.ftdrive.stream.simulated import (
    NOISE,
    P_FLANGE_SENSOR_M,
    P_FLANGE_TCP_M,
    R_FLANGE_TCP,
    T0_NS,
    TRUTH,
    calibrated,
    dwells,
    info,
    moving,
    paired,
)

LINKS = Links(LinkStatus(1000.0, 1000.0, 0, 0.0), LinkStatus(500.0, 500.0, 0, 0.0), 0.0, 0.0)
UPSIDE_DOWN = Rotation.from_euler("xz", [170, 25], degrees=True).as_matrix()


def still(seconds: float, rate_Hz: float = 1000.0) -> Array:
    return np.tile(UPSIDE_DOWN, (round(seconds * rate_Hz), 1, 1))


def processed(rows: Paired, *, block: int = 50, rate_Hz: float = 1000.0, **options: Any) -> tuple[Processor, Block]:
    """Process in blocks; the block returned has all rows."""
    processor = Processor(info(calibrated(), rate_Hz), **options)
    return processor, run(processor, rows, block)


def run(processor: Processor, rows: Paired, block: int = 50) -> Block:
    blocks = [processor.process(rows.rows(slice(i, i + block))) for i in range(0, len(rows), block)]
    columns = ("t_host_ns", "wrench", "chi2", "in_contact", "seq")
    joined: dict[str, Any] = {name: np.concatenate([getattr(b, name) for b in blocks]) for name in columns}
    return replace(blocks[-1], **joined)


def kinds(processor: Processor) -> list[str]:
    return [event.kind for event in processor.take_events()]


# ------------------------------------------------------------------------------------------------------------- frames


def test_a_frame_needs_the_height_of_the_sensor() -> None:
    without = info(calibrated(), height=False)
    FrameTransform(WrenchFrame("base", "sensor"), without)
    for about in ("flange", "tcp", (0.0, 0.0, 0.1)):
        with pytest.raises(ConfigError, match=r"\[sensor\] height_mm"):
            FrameTransform(WrenchFrame("sensor", about), without)
    processor = Processor(without)
    with pytest.raises(ConfigError, match="height_mm"):
        processor.frame = WrenchFrame("base", "tcp")
    with pytest.raises(ConfigError, match="height_mm"):
        processor.settings = Stages(inertia=True)
    assert processor.frame == WrenchFrame()
    assert kinds(processor) == []


def test_a_frame_needs_the_tcp_of_the_controller() -> None:
    without = replace(info(calibrated()), p_flange_tcp_m=np.full(3, np.nan))
    with pytest.raises(ConfigError, match="TCP"):
        FrameTransform(WrenchFrame("tcp", "sensor"), without)


# ------------------------------------------------------------------------------------------------------------- stages


def test_each_stage_is_what_it_says() -> None:
    rows = paired(still(0.2), push=np.array([1.0, 2, 3, 0.1, 0.2, 0.3]), noise=0.0)
    weight = predict(TRUTH, UPSIDE_DOWN) - np.r_[TRUTH.force_bias_N, TRUTH.torque_bias_Nm]
    push = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
    for stages, expected in (
        (Stages(), push),
        (Stages(gravity=False), push + weight),
        (Stages(bias=False), push + np.r_[TRUTH.force_bias_N, TRUTH.torque_bias_Nm]),
        (Stages(bias=False, gravity=False), rows.raw[0]),
        (Stages(deadband_N=1.0, deadband_Nm=10.0), np.r_[push[:3] * (1 - 1 / np.sqrt(14)), 0, 0, 0]),
        (Stages(lowpass_Hz=10.0, notch_Hz=50.0), push),  # no transient at the beginning
    ):
        _, block = processed(rows, block=50, settings=stages)
        np.testing.assert_allclose(block.wrench, np.tile(expected, (200, 1)), atol=0.02)


def test_blocks_of_any_size_give_the_same() -> None:
    rows = moving(0.6)
    stages = Stages(lowpass_Hz=30.0, notch_Hz=100.0, inertia=True)
    _, small = processed(rows, block=7, settings=stages)
    processor = Processor(info(calibrated()), settings=stages)
    large = processor.process(rows, last=True)
    n = len(small.t_host_ns)
    assert n > 550  # the last rows wait for poses after them
    np.testing.assert_array_equal(small.seq, np.arange(n))
    np.testing.assert_allclose(small.wrench, large.wrench[:n], atol=1e-9)
    np.testing.assert_array_equal(large.seq, np.arange(600))


def test_a_lowpass_reduces_the_noise_as_its_sigma_says() -> None:
    rows = paired(still(8.0))
    processor, block = processed(rows, block=400, settings=Stages(lowpass_Hz=40.0))
    assert block.wrench[2000:].std(axis=0) == pytest.approx(block.sigma, rel=0.1)
    assert block.sigma[0] < 0.4 * NOISE[0]
    _, plain = processed(rows, block=400)
    assert plain.sigma == pytest.approx(NOISE, rel=0.05)
    assert stages_in_words(processor.settings) == "raw, bias, gravity, low-pass 40 Hz (Butterworth, order 2)"


def test_an_impossible_filter_is_rejected() -> None:
    with pytest.raises(ConfigError, match="less than 500 Hz"):
        Processor(info(calibrated()), settings=Stages(lowpass_Hz=600.0))


@pytest.mark.slow
def test_inertia_leaves_only_noise_of_a_moving_tool() -> None:
    rows = moving(3.0)
    _, static = processed(rows)
    _, dynamic = processed(rows, settings=Stages(inertia=True))
    assert (static.wrench.std(axis=0) > 4 * NOISE).all()
    assert dynamic.wrench.std(axis=0) == pytest.approx(NOISE, rel=0.1)
    assert len(static.seq) - len(dynamic.seq) <= 18  # milliseconds


# -------------------------------------------------------------------------------------------------- noise and contact


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processing, "FALSE_ALARM_RATE", 0.01)
    alarms = readings = 0
    for seed in range(4):
        R = np.concatenate([np.repeat(dwells(1, 1, seed), 20_000, axis=0), dwells(100, 740, seed + 1000)])
        processor = Processor(info(calibrated(6, seed)))
        chi2 = processor.process(paired(R, seed=seed)).chi2[20_000:].reshape(100, 740)[:, 559::20].ravel()  # at rest
        alarms, readings = alarms + int((chi2 > processor.status(LINKS).contact_limit).sum()), readings + len(chi2)
    assert readings == 4 * 1000
    assert 0.003 < alarms / readings < 0.012


def test_a_contact_is_one_event_with_its_line_of_force() -> None:
    R = still(3.0)
    force_base, at_tcp = np.array([4.0, 0, -3.0]), np.array([0.03, 0.0, 0.0])  # off the TCP by 30 mm, in tcp axes
    R_base_sensor = UPSIDE_DOWN @ TRUTH.R_flange_sensor
    force = R_base_sensor.T @ force_base
    point = TRUTH.R_flange_sensor.T @ (P_FLANGE_TCP_M + R_FLANGE_TCP @ at_tcp - P_FLANGE_SENSOR_M)
    push = np.zeros((3000, 6))
    push[1500:2100] = np.r_[force, np.cross(point, force)]
    processor, block = processed(paired(R, push=push), frame=WrenchFrame("base", "tcp"))
    (event,) = processor.take_events()
    assert event.kind == "contact"
    assert event.t_host_ns == pytest.approx(T0_NS + 1500e6, abs=20e6)
    values: Any = event.values
    assert values["duration_s"] == pytest.approx(0.62, abs=0.03)
    assert values["peak_N"] == pytest.approx(5.0, abs=0.05)
    np.testing.assert_allclose(values["direction"], force_base / 5, atol=0.02)
    assert (values["axes"], values["about"]) == ("base", "tcp")
    arm = UPSIDE_DOWN @ R_FLANGE_TCP @ at_tcp
    direction = force_base / 5
    np.testing.assert_allclose(values["line_point_m"], arm - (arm @ direction) * direction, atol=3e-3)
    assert block.in_contact[1560:2100].all()
    assert not block.in_contact[1000:1540].any()
    assert not block.in_contact[2190:].any()


@pytest.mark.slow
def test_neither_the_filter_of_a_sensor_nor_drift_make_contacts_and_a_push_of_1_N_is_found_in_100_ms() -> None:
    n, rate_Hz = 18_000, 500.0
    rng = np.random.default_rng(4)
    b, a = butter(2, 5.0, fs=rate_Hz)
    noise = lfilter(b, a, rng.normal(size=(n, 6)) * NOISE, axis=0) / 0.15
    drift = np.arange(n)[:, None] / 30_000 * np.repeat([0.3, 0.01], 3)
    push = np.zeros((n, 6))
    starts = np.arange(8000, n, 3000)
    for start in starts:
        push[start : start + 250, rng.integers(3)] = 1.0
    R = np.broadcast_to(UPSIDE_DOWN, (n, 3, 3))
    _, block = processed(paired(R, rate_Hz, push=noise + drift + push, noise=0.1), block=200, rate_Hz=rate_Hz)
    onsets = np.flatnonzero(np.diff(block.in_contact, prepend=False) & block.in_contact)
    assert len(onsets) == len(starts)
    assert ((onsets > starts) & (onsets <= starts + 50)).all()


# ------------------------------------------------------------------------------------------------------ tare and drift


def test_a_tare_takes_drift_of_the_bias_away_in_every_orientation() -> None:
    drift = np.array([0.4, -0.3, 0.5, 0.01, 0.0, -0.01])
    processor, _ = processed(paired(still(1.0), push=drift))
    event = processor.tare()
    assert event.kind == "tare"
    assert event.values["force_N"] == pytest.approx(np.linalg.norm(drift[:3]), abs=0.02)
    block = run(processor, paired(dwells(10, 100, seed=3), push=drift), 100)
    np.testing.assert_allclose(block.wrench.mean(axis=0), 0.0, atol=0.02)
    assert processor.tare_wrench == pytest.approx(drift, abs=0.02)
    assert processor.undo_tare().kind == "tare-undone"
    assert processor.tare_wrench is None
    block = run(processor, paired(still(1.0), push=drift))
    np.testing.assert_allclose(block.wrench.mean(axis=0), drift, atol=0.02)
    assert processor.undo_tare().kind == "tare-refused"
    assert kinds(processor)[:3] == ["tare", "tare-undone", "tare-refused"]


@pytest.mark.parametrize(
    ("push", "why"),
    [
        (np.array([0, 0, 3.4, 0, 0, 0]), r"3\.\d+ N .* sigma\) away from the free tool"),
        (np.array([0.8, 0, 0, 0, 0.15, 0]), "take hand or contact away"),
        (np.outer(np.linspace(0, 1, 1000), [0, 0, 2.0, 0, 0, 0]), "the reading changes"),
    ],
)
def test_a_tare_is_refused_with_a_hand_on_the_tool(push: Array, why: str) -> None:
    processor, _ = processed(paired(still(1.0), push=push))
    event = processor.tare()
    assert event.kind == "tare-refused"
    assert processor.tare_wrench is None
    assert re.search(why, event.text)


def test_a_tare_is_refused_while_the_arm_moves() -> None:
    processor, _ = processed(moving(1.0))
    assert "the arm moves" in processor.tare().text


def test_the_bias_follows_the_temperature_in_small_steps_and_events_in_large_ones() -> None:
    slope = np.array([0.3, 0.4, 0.0, 0.0, 0.0, 0.01])
    errors = np.full(2, 0.1), np.full(2, 0.5)
    warmth = BiasTemperature(slope, np.full(6, 1e-3), 12, 15.0, 40.0, *errors, np.zeros(2))
    made = calibrated()
    known = replace(made, provenance={**made.provenance, "temperature_C": 20.0})
    processor = Processor(info(known), temperature=warmth)
    for temperature_C, bias_C in ((20.04, 20.0), (20.06, 20.06), (20.95, 20.95)):
        processor.monitor.warm(temperature_C)
        change = processor.monitor.reference()[0].parameters.bias - made.parameters.bias
        np.testing.assert_allclose(change, slope * (bias_C - 20.0), atol=1e-12)
        assert not kinds(processor)
    processor.monitor.warm(21.04)
    (event,) = processor.take_events()
    assert (event.kind, event.text) == ("temperature", "sensor at 21.0 °C: bias corrected by 0.52 N")
    assert event.values["change"] == pytest.approx((slope * 1.04).tolist())
    processor.monitor.warm(22.0)  # less than 1 °C after the last event
    processor.monitor.warm(20.02)
    assert kinds(processor) == ["temperature"]
    for unknown in (Processor(info(made), temperature=warmth), Processor(info(known))):
        unknown.monitor.warm(35.0)
        assert unknown.monitor.reference()[0].parameters.bias.tolist() == made.parameters.bias.tolist()
        assert not kinds(unknown)


def test_sigma_grows_with_the_age_of_the_bias_until_a_tare() -> None:
    moves = np.repeat([0.3, 0.01], 3)
    made = {"created_utc": datetime.fromtimestamp(T0_NS * 1e-9 - 4 * 3600, UTC).isoformat()}
    calibration = replace(calibrated(), provenance=made)
    known, unknown = (Processor(replace(info(calibration), hour_change=change)) for change in (moves, None))

    def added() -> Array:
        """What the history adds to the variance."""
        fresh, aged = (one.sigma_of_mean(UPSIDE_DOWN) for one in (unknown, known))
        return np.asarray(aged**2 - fresh**2)

    for one in (known, unknown):
        run(one, paired(still(2.0)), 50)
    np.testing.assert_allclose(added(), 4 * moves**2, rtol=0.01)
    for one in (known, unknown):
        one.tare()
    assert (added() < 1e-3 * moves**2).all()


@pytest.mark.parametrize("source", ["assumed", "loads"])
def test_sigma_has_the_errors_of_the_sensor_under_the_present_contact(source: Literal["assumed", "loads"]) -> None:
    E = 0.03 * np.random.default_rng(4).normal(size=(6, 6)) * ranges(0.067)[:, None] / ranges(0.067)
    usual = SensorMatrix.usual()
    sensor = usual if source == "assumed" else replace(usual, source=source, error=E, covariance=usual.covariance / 100)
    calibration = replace(calibrated(), sensor=sensor)
    contact = np.array([30.0, -20.0, 40.0, 1.0, -2.0, 0.5])
    decoder = np.eye(6) if calibration.contact.decoder is None else calibration.contact.decoder
    push = np.zeros((3000, 6))
    push[1500:] = np.linalg.solve(decoder, contact)
    frame = WrenchFrame("base", "tcp")
    processor = Processor(info(calibration), frame)
    block = processor.process(paired(still(3.0), push=push))
    T = FrameTransform(frame, info(calibration)).matrix(UPSIDE_DOWN)
    np.testing.assert_allclose(block.wrench[2000:].mean(axis=0), T @ contact, atol=0.02)
    loaded, rest = (processor.sigma_of_mean(UPSIDE_DOWN, loaded=one) for one in (True, False))
    np.testing.assert_array_equal(block.sigma, loaded)
    expected = T @ calibration.contact.covariance(contact) @ T.T
    np.testing.assert_allclose(loaded**2 - rest**2, np.diag(expected), rtol=0.02)
    assert (loaded[:3] > (5 if source == "assumed" else 1) * rest[:3]).all()
