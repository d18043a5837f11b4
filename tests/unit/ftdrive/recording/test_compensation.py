"""A recording compensated at once."""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.errors import BadDataset
from ftcalib.model import predict
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.errors import ConfigError
from ftdrive.recording import Header, Recording, load_recording
from ftdrive.recording.compensation import compensate_recording, estimated_bias
from ftdrive.recording.foreign import TablePair, sample_numbers
from ftdrive.recording.recording import Measured, to_records, with_calibration
from ftdrive.stream.samples import Block, Stages, StreamEvent, WrenchFrame
from ftdrive.tables import text as text_tables
from ftdrive.tables.table import Table
from ftdrivers.interfaces import Array
from tests.unit.ftdrive.recorded import NOISE, TRUTH, calibration, info

RATE_HZ = 500.0
SHIFT = np.array([8.0, -5.0, 11.0, 0.2, 0.1, -0.3])
ZEROED = Parameters(
    TRUTH.R_flange_sensor,
    TRUTH.gravity_force_base_N,
    TRUTH.force_bias_N + SHIFT[:3],
    TRUTH.p_sensor_com_m,
    TRUTH.torque_bias_Nm + SHIFT[3:],
)


def turning(t_s: Array) -> Array:
    """Orientations (n, 3, 3) of a tool that turns about changing axes, about 1 rad/s."""
    angles = np.stack([np.sin(1.1 * t_s), 0.8 * np.sin(0.7 * t_s + 1), 0.5 * np.sin(1.3 * t_s + 2)], axis=1)
    return Rotation.from_rotvec(angles).as_matrix()


def recording(parameters: Parameters = TRUTH, seconds: float = 8.0) -> Recording:
    """A free tool, but for a push of 6 N along x of the sensor from 4 to 5 s."""
    rng, n = np.random.default_rng(0), round(seconds * RATE_HZ)
    t_s = np.arange(n) / RATE_HZ
    R = turning(t_s)
    push = np.where((t_s >= 4) & (t_s < 5), 6.0, 0.0)[:, None] * np.eye(6)[0]
    nothing, t_ns = np.zeros((n, 6)), np.rint(t_s * 1e9).astype(np.int64) + 10**12
    samples = Block(
        t_host_ns=t_ns,
        t_device_s=t_s,
        seq=np.arange(n),
        status=np.zeros(n, np.uint32),
        raw=predict(parameters, R) + rng.normal(0, NOISE, (n, 6)) + push,
        wrench=nothing,
        chi2=nothing[:, 0],
        in_contact=np.zeros(n, bool),
        q_rad=nothing,
        R_base_flange=R,
        p_base_flange_m=nothing[:, :3],
        sigma=NOISE,
        frame=WrenchFrame(),
        stages=Stages(),
    )
    header = Header(replace(info(), sensor_rate_Hz=RATE_HZ), WrenchFrame(), Stages())
    return Recording(
        header, to_records(samples), [StreamEvent(10**12, "mark", "begin"), StreamEvent(10**12, "contact", "old")]
    )


def test_the_push_is_found_and_the_weight_is_gone(tmp_path: Path) -> None:
    source, output = recording(), tmp_path / "a.csv"
    result, failure = compensate_recording(source, WrenchFrame("flange", "sensor"), output)
    assert failure is None
    assert (result["samples"], result["gaps"]) == (4000, 0)
    assert result["duration_s"] == pytest.approx(7.998)
    assert result["raw"]["force_rms_N"] == pytest.approx(np.sqrt((source.rows["raw"][:, :3] ** 2).sum() / 4000))
    assert result["compensated"]["force_max_N"] == pytest.approx(6, abs=6 * 0.05)
    assert result["compensated"]["torque_rms_Nm"] == pytest.approx(np.sqrt(3) * 0.002, rel=0.3)
    (contact,) = result["contacts"]
    assert contact["t_s"] == pytest.approx(4, abs=0.05)
    assert contact["duration_s"] == pytest.approx(1, abs=0.05)
    assert contact["peak_N"] == pytest.approx(6, abs=0.2)
    np.testing.assert_allclose(contact["direction"], TRUTH.R_flange_sensor[:, 0], atol=0.05)
    saved = load_recording(output)
    assert saved.header.frame == WrenchFrame("flange", "sensor")
    assert np.sqrt((saved.rows["wrench"][:, :3] ** 2).sum() / 4000) == pytest.approx(
        result["compensated"]["force_rms_N"]
    )
    np.testing.assert_array_equal(saved.rows["raw"], source.rows["raw"])
    assert [event.text for event in saved.events if event.kind != "contact"] == ["begin"]
    assert [event.values["peak_N"] for event in saved.events if event.kind == "contact"] == [contact["peak_N"]]


def test_a_contact_at_control_c_is_over() -> None:
    source, calls = recording(), count()
    (whole,) = source.blocks()

    def blocks() -> Iterator[Measured]:
        yield whole._replace(samples=whole.samples.rows(slice(2200)))
        if next(calls):  # the first pass is for the noise
            raise KeyboardInterrupt

    cut: Any = SimpleNamespace(header=source.header, cut="", blocks=blocks)
    result, failure = compensate_recording(cut, WrenchFrame())
    assert isinstance(failure, KeyboardInterrupt)
    assert [one["duration_s"] for one in result["contacts"]] == [pytest.approx(0.4, abs=0.05)]


def test_a_frame_that_is_not_configured_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="height_mm"):
        compensate_recording(recording(seconds=1.0), WrenchFrame("base", "flange"), tmp_path / "a.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("error", [0.0, 0.03])
def test_the_bias_of_a_zeroed_sensor_is_estimated_with_an_honest_sigma(error: float) -> None:
    sensor = replace(SensorMatrix.usual(), source="loads", error=error * np.eye(6))
    recorded, old = recording(ZEROED, seconds=10.0), replace(calibration(), sensor=sensor)
    source = replace(recorded, header=with_calibration(recorded.header, old, ""))
    header, change = estimated_bias(source)
    estimated, found = replace(source, header=header), header.info.calibration.parameters.bias
    np.testing.assert_allclose(found, old.parameters.bias + change["value"])
    assert (np.abs(found - ZEROED.bias) < 6 * np.array(change["sigma"])).all()
    assert (np.array(change["sigma"]) < 0.03 * NOISE).all(), "about that of the mean of 4,500 samples, 0.015"
    assert compensate_recording(estimated, WrenchFrame())[0]["compensated"]["force_max_N"] == pytest.approx(6, abs=0.3)
    assert compensate_recording(source, WrenchFrame())[0]["compensated"]["force_max_N"] > 13.5


def test_a_short_recording_shows_no_bias() -> None:
    with pytest.raises(BadDataset, match="too short"):
        estimated_bias(recording(seconds=1.0))


def write_pair(folder: Path, delay_s: float, orientation: str) -> tuple[Path, Path]:
    """The recording as two files: wrench at 500 Hz, late by the delay, orientation at 125 Hz."""
    source = recording(seconds=10.0)
    wrench, poses = folder / "wrench.csv", folder / "poses.csv"
    t_s = np.arange(len(source.rows)) / RATE_HZ + 100.0
    table = np.c_[t_s + delay_s, source.rows["raw"]]
    np.savetxt(wrench, table, "%.12g", ",", header="t, fx,fy,fz,tx,ty,tz", comments="")
    t_s = np.arange(-1.0, 11.0, 1 / 125)
    R = Rotation.from_matrix(turning(t_s))
    numbers = {
        "r11,r12,r13,r21,r22,r23,r31,r32,r33": R.as_matrix().reshape(-1, 9),
        "qx,qy,qz,qw": R.as_quat(),
        "rx,ry,rz": R.as_rotvec(),
    }[orientation]
    np.savetxt(poses, np.c_[numbers, t_s + 100.0], "%.12g", ",", header=f"{orientation},t", comments="")
    return wrench, poses


@pytest.mark.slow
def test_a_pair_of_files_is_paired_with_its_delay_despite_a_push(tmp_path: Path) -> None:
    files = write_pair(tmp_path, 0.012, "rx,ry,rz")
    found = TablePair(Table(files[0]), Table(files[1]), calibration(), "c", None)
    assert found.delay_s == pytest.approx(0.012, abs=1e-3)
    assert 0 < found.delay_sigma_s < 1e-3
    rms = compensate_recording(found, WrenchFrame())[0]["compensated"]["torque_rms_Nm"]
    fixed = TablePair(Table(files[0]), Table(files[1]), calibration(), "c", 0.0)
    assert (fixed.delay_s, fixed.delay_sigma_s) == (0.0, 0.0)
    assert rms < 1.2 * np.sqrt(3) * 0.002
    assert compensate_recording(fixed, WrenchFrame())[0]["compensated"]["torque_rms_Nm"] > 1.5 * rms


@pytest.mark.slow
@pytest.mark.parametrize("damaged", ["wrench.csv", "poses.csv"])
def test_what_is_before_a_damaged_line_of_a_pair_is_kept(
    damaged: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = write_pair(tmp_path, 0.012, "qx,qy,qz,qw")
    lines = (tmp_path / damaged).read_text().splitlines()
    lines[len(lines) * 2 // 3] = "?"
    (tmp_path / damaged).write_text("\n".join(lines))
    monkeypatch.setattr(text_tables, "_BLOCK", 1 << 15)
    found = TablePair(Table(files[0]), Table(files[1]), calibration(), "c", None)
    assert found.delay_s == pytest.approx(0.012, abs=2e-3)
    numbers, failure = compensate_recording(found, WrenchFrame(), tmp_path / "new.csv")
    assert isinstance(failure, BadDataset)
    assert re.match(rf"{damaged}: line \d+", numbers["cut"])
    assert 2600 < numbers["samples"] == len(load_recording(tmp_path / "new.csv").rows) <= 3400


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("wrench", "t,fx,fy,fz,tx,ty,tz\n0,1,2,3,4,5,6\n", "1 rows"),
        ("wrench", "t,fx,fy,fz,tx,ty,tz\n0,1,2,3,4,5,6\n1,1,2,x,4,5,6\n", "'x'"),
        ("wrench", "t,fx,fy,fz,tx,ty,tz\n0,1,2,3,4,5,6\n-1,1,2,3,4,5,6\n", "the time goes back to -1 s"),
        ("poses", "t,rx,ry,rz\n900,0,0,0\n901,0,0,0\n", "no time in common"),
    ],
)
def test_files_that_cannot_be_used_are_named_with_the_fault(
    name: str, content: str, words: str, tmp_path: Path
) -> None:
    good = {"wrench": "t,fx,fy,fz,tx,ty,tz\n0,1,2,3,4,5,6\n1,1,2,3,4,5,6\n", "poses": "t,rx,ry,rz\n0,0,0,0\n1,0,0,0\n"}
    for file, text in (good | {name: content}).items():
        (tmp_path / file).write_text(text)
    with pytest.raises(BadDataset, match=words):
        list(TablePair(Table(tmp_path / "wrench"), Table(tmp_path / "poses"), calibration(), "c", 0.0).blocks())


RNG = np.random.default_rng(8)
STEADY_S = np.arange(20_000) / 1000
JITTERS = {
    "regular": STEADY_S,
    "rounded": np.round(STEADY_S + 4e-4, 3),
    "jitter": STEADY_S + RNG.uniform(-4e-4, 4e-4, len(STEADY_S)),
    "noise": np.sort(STEADY_S + RNG.normal(0, 2.5e-4, len(STEADY_S))),
    "batches": np.repeat(STEADY_S[15::16], 16),
    "pauses": np.maximum(STEADY_S, np.floor(STEADY_S) + 0.06),  # what waited for 60 ms comes at once
}


@pytest.mark.parametrize("name", JITTERS)
def test_late_samples_of_another_program_are_no_gaps_and_missing_ones_are(name: str) -> None:
    t_s = JITTERS[name]
    assert np.count_nonzero(np.diff(sample_numbers(t_s)) != 1) == 0
    lost = [*range(3000, 3030), *range(9000, 9100), 15_000, 15_001]
    numbers = sample_numbers(np.delete(t_s, lost))
    assert np.count_nonzero(np.diff(numbers) != 1) in (3, 4)  # a gap amid batches may be found in two steps
    off = np.abs(numbers - np.delete(np.arange(len(t_s)), lost)).max()
    assert off <= {"batches": 2, "pauses": 1}.get(name, 0)  # there the place of a gap is not seen to the sample
    assert abs(numbers[-1] - (len(t_s) - 1)) <= 1
