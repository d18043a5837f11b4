"""Three formats hold the same bits, and other programs read them."""

import gzip
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from pyarrow import parquet
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from ftcalib import files
from ftdrive.errors import BadRecording
from ftdrive.recording import Recorder, Recording, RecordingReader, load_recording, table_files, write_recording
from ftdrive.recording.recording import Header, next_header
from ftdrive.stream.samples import Stages, StreamEvent, WrenchFrame
from tests.unit.ftdrive.recorded import BASE_TCP, CONFIGURATION, UTC_OFFSET_NS, block, info

ENDINGS = (".mcap", ".csv", ".parquet")
PUSH = WrenchFrame("flange", (0.0, 0.01, 0.15))
GAP = StreamEvent(6_503_000_000, "gap", "3 samples lost", {"lost": 3})
MARK = StreamEvent(5_000_700_000, "mark", "Peg “in”", {"peak_N": [1.5, -2.0], "n": 3})


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """2.6 s with a gap, a mark and another frame, in all formats."""
    folder = tmp_path_factory.mktemp("recording")
    files = [folder / f"peg{ending}" for ending in ENDINGS]
    recorder = Recorder(files, info(), CONFIGURATION)
    for start in range(0, 1500, 100):
        recorder.add(block(100, start), [])
        if start == 700:
            recorder.add(None, [MARK])
    recorder.add(None, [GAP])
    for start in range(1503, 2603, 110):
        recorder.add(block(110, start, frame=PUSH, stages=Stages(lowpass_Hz=40.0)), [])
    assert not any(path.exists() for path in files)
    recorder.end()
    assert sorted(folder.iterdir()) == sorted(files)
    return files


def same(one: Recording, other: Recording) -> None:
    assert one.rows.tobytes() == other.rows.tobytes()
    assert list(one.events) == list(other.events)
    assert one.header.to_dict() == other.header.to_dict()
    assert (one.cut, other.cut) == ("", "")


def test_all_formats_hold_the_same_bits(paths: Sequence[Path]) -> None:
    first, *others = map(load_recording, paths)
    for other in others:
        same(first, other)


def test_a_recording_holds_what_was_measured(paths: Sequence[Path]) -> None:
    recording = load_recording(paths[0])
    frames = [(len(one.rows), one.header.frame, one.header.stages) for one in recording.pieces()]
    assert frames == [(1500, BASE_TCP, Stages()), (1100, PUSH, Stages(lowpass_Hz=40.0))]
    measured, found = block(100, 300), recording.paired().rows(slice(300, 400))
    for name in ("t_host_ns", "t_device_s", "seq", "status", "raw", "q_rad", "p_base_flange_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(measured, name))
    for name in ("wrench", "chi2", "in_contact"):
        np.testing.assert_array_equal(recording.rows[name][300:400], getattr(measured, name))
    np.testing.assert_allclose(found.R_base_flange, measured.R_base_flange, atol=1e-15)
    assert [event.kind for event in recording.events] == ["mark", "gap", "frame", "stages"]
    assert recording.events[0] == MARK
    assert recording.gaps == 1
    assert recording.duration_s == pytest.approx(2.602, abs=1e-5)
    assert recording.header.configuration == CONFIGURATION
    assert recording.header.info.sensor == info().sensor
    assert recording.header.info.calibration.to_dict() == info().calibration.to_dict()
    assert np.isnan(recording.header.info.p_flange_sensor_m[2])
    assert recording.header.info.verification == info().verification
    assert "VERIFICATION FAILED 2 h ago (bias)" in recording.header.words


def test_a_file_of_another_version_lacks_stages_that_were_off_and_may_have_one_that_was_off(
    small: Sequence[Path],
) -> None:
    header = replace(load_recording(small[0]).header, info=replace(info(), hour_change=np.arange(6.0)))
    document: Any = json.loads(json.dumps(header.to_dict()))
    np.testing.assert_array_equal(Header.from_dict(document).info.hour_change, np.arange(6.0))
    earlier = {name: value for name, value in document.items() if name not in ("foreign", "hour_change")}
    of_earlier = Header.from_dict(earlier | {"stages": {"gravity": True}})
    assert (of_earlier.stages, of_earlier.info.foreign) == (Stages(bias=False), False)
    for value in (0, False, None):
        assert (
            Header.from_dict(document | {"stages": document["stages"] | {"smoothing": value}}).stages == header.stages
        )
    newer = {"bias": True, "smoothing": 5}
    with pytest.raises(BadRecording, match=r"the stage smoothing is unknown to this version: use a newer ftdrive"):
        Header.from_dict(document | {"stages": newer})
    with pytest.raises(BadRecording, match="the stage smoothing is unknown to this version"):
        next_header(header, StreamEvent(0, "stages", "", newer))


@pytest.mark.slow
def test_conversion_is_lossless(paths: Sequence[Path], tmp_path: Path) -> None:
    first, path = load_recording(paths[0]), paths[0]
    for name in ("a.csv", "b.parquet", "c.mcap"):
        write_recording(tmp_path / name, RecordingReader(path))
        path = tmp_path / name
        same(first, load_recording(path))
    write_recording(tmp_path / "d.mcap", first)
    assert path.read_bytes() == (tmp_path / "d.mcap").read_bytes()  # messages name the frame of their samples too


@pytest.mark.slow
def test_rosbags_reads_the_messages(paths: Sequence[Path]) -> None:
    rows, frames = load_recording(paths[0]).rows, set()
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([paths[0]], default_typestore=store) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts == dict.fromkeys(
            ["/ft_raw", "/ft_compensated", "/flange_pose", "/joint_states", "/ft_sample"], 2600
        ) | {"/events": 4, "/ftdrive/load": 0, "/ftdrive/tracked": 0, "/tf": counts["/tf"]}
        seen: dict[str, list[Any]] = {topic: [] for topic in counts}
        for connection, t_ns, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            seen[connection.topic].append((t_ns, message))
    for i in (0, 1, 1499, 1500, 2599):
        row, t_utc_ns = rows[i], int(rows["t_host_ns"][i]) + UTC_OFFSET_NS
        for topic, column in (("/ft_raw", "raw"), ("/ft_compensated", "wrench")):
            t_ns, message = seen[topic][i]
            force, torque = message.wrench.force, message.wrench.torque
            assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == row[column].tolist()
            assert t_ns == t_utc_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            frames.add((topic, message.header.frame_id))
        pose = seen["/flange_pose"][i][1].pose
        assert [pose.position.x, pose.position.y, pose.position.z] == row["p_base_flange_m"].tolist()
        q = pose.orientation
        assert [q.x, q.y, q.z, q.w] == row["quaternion_base_flange"].tolist()
        assert seen["/joint_states"][i][1].position.tolist() == row["q_rad"].tolist()
        sample = seen["/ft_sample"][i][1]
        assert (sample.seq, sample.status, sample.in_contact) == (row["seq"], row["status"], row["in_contact"])
    assert frames == {
        ("/ft_raw", "sensor"),
        ("/ft_compensated", "base_at_tcp"),
        ("/ft_compensated", "flange_at_0_0.01_0.15_m"),
    }
    t_ns, log = seen["/events"][0]
    assert (log.name, log.msg, log.level) == ("mark", MARK.text, 20)
    assert t_ns == MARK.t_host_ns + UTC_OFFSET_NS
    assert 150 < len(seen["/tf"]) < 180
    for (_, message), named in ((seen["/tf"][0], "base_at_tcp"), (seen["/tf"][-1], "flange_at_0_0.01_0.15_m")):
        assert [one.child_frame_id for one in message.transforms] == ["flange", "sensor", "tcp", named]


def test_a_weighing_is_an_event_and_a_message(tmp_path: Path) -> None:
    values = {"mass_kg": 1.25, "mass_sigma_kg": 0.0005, "p_sensor_com_m": None, "p_sensor_com_sigma_m": None}
    recorder = Recorder([tmp_path / "a.mcap"], info(), CONFIGURATION)
    for start, com_m in ((0, None), (300, [0.01, 0.02, 0.15])):
        recorder.add(block(300, start), [])
        given = {**values, "p_sensor_com_m": com_m, "p_sensor_com_sigma_m": com_m}
        recorder.add(None, [StreamEvent(int(block(1, start).t_host_ns[0]), "load", "1.25 kg", given)])
    recorder.end()
    assert [event.kind for event in load_recording(tmp_path / "a.mcap").events] == ["load", "load"]
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        first, second = (decoded for *_, decoded in reader.iter_decoded_messages(["/ftdrive/load"]))
    assert (first.mass_kg, first.mass_sigma_kg) == (1.25, 0.0005)
    assert np.isnan(first.p_sensor_com_m).all()
    assert list(second.p_sensor_com_m) == [0.01, 0.02, 0.15]


def test_a_plain_reader_of_the_format_finds_no_fault(paths: Sequence[Path]) -> None:
    with paths[0].open("rb") as file:
        kinds = [type(record).__name__ for record in StreamReader(file, validate_crcs=True).records]
    with paths[0].open("rb") as file:
        frames = sum(1 for _ in make_reader(file).iter_messages("/tf"))
    assert kinds.count("Message") == 5 * 2600 + 4 + frames
    assert kinds[-1] == "Footer"


@pytest.mark.slow
def test_a_file_that_another_program_has_divided_otherwise_is_read(paths: Sequence[Path], tmp_path: Path) -> None:
    with paths[0].open("rb") as file, (tmp_path / "other.mcap").open("wb") as new:
        writer = Writer(new, chunk_size=20_000)
        writer.start("ros2", "another")
        for one in StreamReader(file).records:
            if isinstance(one, Attachment):
                writer.add_attachment(0, 0, one.name, one.media_type, one.data)
            elif isinstance(one, Schema):
                writer.register_schema(one.name, one.encoding, one.data)
            elif isinstance(one, Channel):
                writer.register_channel(one.topic, one.message_encoding, one.schema_id)
            elif isinstance(one, Message):
                writer.add_message(one.channel_id, one.log_time, one.data, one.publish_time, one.sequence)
            elif isinstance(one, DataEnd):
                break
        writer.finish()  # type: ignore[no-untyped-call]
    same(load_recording(paths[0]), load_recording(tmp_path / "other.mcap"))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Five seconds at 30 Hz."""
    files = [tmp_path_factory.mktemp("small") / f"small{ending}" for ending in ENDINGS]
    recorder = Recorder(files, info(), {})
    for start in range(0, 150, 10):
        recorder.add(block(10, start, step_ns=33_000_000), [])
    recorder.end()
    return files


@pytest.mark.parametrize(("ending", "cuts", "least"), [(".mcap", 16, 5), (".csv", 16, 10), (".parquet", 5, 1)])
def test_a_file_cut_anywhere_is_read_up_to_there_or_rejected(
    small: Sequence[Path], ending: str, cuts: int, least: int, tmp_path: Path
) -> None:
    whole, path = load_recording(small[0]).rows, small[ENDINGS.index(ending)]
    content = path.read_bytes()
    sizes = np.r_[0, 8, np.linspace(9, len(content) - 1, cuts)].astype(int)
    cut, lengths = tmp_path / f"cut{ending}", []
    for size in sizes.tolist():
        cut.write_bytes(content[:size])
        try:
            found = load_recording(cut)
        except BadRecording:
            lengths.append(0)
        else:
            assert found.rows.tobytes() == whole[: len(found.rows)].tobytes()
            assert found.cut or len(found.rows) == len(whole)
            lengths.append(len(found.rows))
    assert lengths == sorted(lengths)
    assert len(set(lengths)) >= least


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_flipped_bit_is_refused_or_changes_no_number(small: Sequence[Path], ending: str, tmp_path: Path) -> None:
    path = small[ENDINGS.index(ending)]
    whole, content = load_recording(path), path.read_bytes()
    rng = np.random.default_rng(3)
    damaged, rejected = tmp_path / f"damaged{ending}", 0
    for place in rng.integers(0, len(content), 40).tolist():
        flipped = bytes([content[place] ^ 1 << int(rng.integers(8))])
        damaged.write_bytes(content[:place] + flipped + content[place + 1 :])
        try:
            found = load_recording(damaged)
        except BadRecording:
            rejected += 1
        else:
            assert found.rows.tobytes() == whole.rows.tobytes()
            assert found.events == whole.events
            assert found.header.to_dict() == whole.header.to_dict()
    assert rejected > 13


def test_a_csv_file_without_an_end_of_a_line_or_a_checksum_is_refused(
    small: Sequence[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, path = small[ENDINGS.index(".csv")].read_bytes(), tmp_path / "a.csv"
    monkeypatch.setattr(files, "_LONGEST_LINE", 200_000)
    monkeypatch.setattr(table_files, "MOST_BYTES", 200_000)
    number = content.count(b"\n") + 1
    for damaged, why in (
        (content + bytes(300_000), f"line {number} is longer than .*: the file is damaged"),
        (content.partition(b"# crc32 ")[0] + b"1,2\n" * 100_000, "no checksum follows line 1: the file is damaged"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(BadRecording, match=why):
            load_recording(path)


@pytest.mark.parametrize("more", [bytes(9), b"\5" + (200_000_001).to_bytes(8, "little")])
def test_records_that_no_file_of_ours_has_are_refused_before_they_are_read(
    small: Sequence[Path], tmp_path: Path, more: bytes
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(small[0].read_bytes()[:8] + more + bytes(100))
    with pytest.raises(BadRecording, match="the file is damaged"):
        load_recording(path)


def test_parquet_of_the_writer_before_pyarrow_is_read_and_has_the_same_columns(
    small: Sequence[Path], tmp_path: Path
) -> None:
    path = tmp_path / "a.parquet"
    path.write_bytes(gzip.decompress(Path(__file__).with_name("numpy_writer.parquet.gz").read_bytes()))
    first, second = (recording := load_recording(path)).pieces()
    for piece, measured in ((first, block(4, 0, step_ns=6 * 10**9)), (second, block(4, 4, step_ns=6 * 10**9))):
        for name in ("t_host_ns", "t_device_s", "seq", "status", "in_contact"):
            np.testing.assert_array_equal(piece.rows[name], getattr(measured, name))
        for name in ("raw", "wrench", "p_base_flange_m"):  # sines, whose last digit is that of the processor
            np.testing.assert_allclose(piece.rows[name], getattr(measured, name), rtol=1e-15)
    assert [piece.header.frame for piece in (first, second)] == [BASE_TCP, PUSH]
    assert [event.kind for event in recording.events] == ["mark", "frame", "stages"]
    assert parquet.read_schema(path) == parquet.read_schema(small[2])
    assert {b"header", b"events"} < parquet.read_metadata(small[2]).metadata.keys()


@pytest.mark.slow
def test_parquet_that_pyarrow_has_copied_stays_a_recording_and_other_parquet_is_none(
    paths: Sequence[Path], tmp_path: Path
) -> None:
    table = parquet.read_table(paths[2])
    parquet.write_table(table, tmp_path / "a.parquet")
    same(load_recording(paths[2]), load_recording(tmp_path / "a.parquet"))
    parquet.write_table(table.replace_schema_metadata(None), tmp_path / "b.parquet")
    with pytest.raises(BadRecording, match="no header of ftdrive: another program wrote it"):
        load_recording(tmp_path / "b.parquet")
    parquet.write_table(table.drop_columns(["fz"]), tmp_path / "c.parquet")
    with pytest.raises(BadRecording, match="columns are not those of a recording"):
        load_recording(tmp_path / "c.parquet")
