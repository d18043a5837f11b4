"""Recordings as MCAP, for Foxglove, Lichtblick, PlotJuggler and ROS 2 bags. Needs the extra `record`.

The channels have CDR messages: those of `ftdrive.stream.ros2`, `/ft_sample` with the remaining columns, `/events`, and
`/tf` for viewers. All times are UTC. The attachments `calibration.json` and `recording.json` contain the header. Each
chunk, each attachment and the data section have a CRC-32.

Several thousand samples are packed as one array into one chunk, because the writer of the package `mcap` takes messages
one by one, which uses half a CPU core at 7 kHz. Format: https://mcap.dev/spec
"""

import io
import json
import struct
import zlib
from collections import defaultdict
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib.files import MOST_BYTES, open_file, parsed_json
from ftdrive import __version__
from ftdrive.errors import BadRecording
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import ROW, ZSTD_LEVEL, Header, Piece, Rows, next_header
from ftdrive.stream import ros2
from ftdrive.stream.samples import StreamEvent, matrices

if TYPE_CHECKING:
    from mcap.records import McapRecord

SAMPLE, EVENTS, LOAD, TRACKED = "/ft_sample", "/events", "/ftdrive/load", "/ftdrive/tracked"
_SCHEMAS: Final[Mapping[str, ros2.Schema]] = {
    **ros2.SCHEMAS,
    SAMPLE: ros2.Schema(
        "ftdrive_msgs/msg/Sample", "float64 t_device_s\nfloat64 chi2\nint64 seq\nuint32 status\nbool in_contact"
    ),
    EVENTS: ros2.Schema(
        "rcl_interfaces/msg/Log",
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line"
        f"\n{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
    ),
    ros2.TRANSFORMS: ros2.TRANSFORMS_SCHEMA,
    LOAD: ros2.Schema(
        "ftdrive_msgs/msg/Load",
        "float64 mass_kg\nfloat64 mass_sigma_kg\nfloat64[3] p_sensor_com_m\nfloat64[3] p_sensor_com_sigma_m",
    ),
    TRACKED: ros2.Schema(
        "ftdrive_msgs/msg/Tracked",
        "float64[6] bias\nfloat64[6] sigma\nfloat64 part_kg\nfloat64 part_sigma_kg\nfloat64 last_seen_s\n"
        "bool part_known",
    ),
}
_CHANNELS: Final = {topic: number for number, topic in enumerate(_SCHEMAS, 1)}
_SAMPLE: Final = [("t_device_s", "<f8"), ("chi2", "<f8"), ("seq", "<i8"), ("status", "<u4"), ("in_contact", "?")]
# For each channel, the columns of a sample in its messages, and the number of bytes after them in the message.
_COLUMNS: Final[Mapping[int, tuple[Any, int]]] = {
    _CHANNELS[ros2.RAW]: (np.dtype([("raw", "<f8", 6)]), 0),
    _CHANNELS[ros2.COMPENSATED]: (np.dtype([("wrench", "<f8", 6)]), 0),
    _CHANNELS[ros2.POSE]: (np.dtype([("p_base_flange_m", "<f8", 3), ("quaternion_base_flange", "<f8", 4)]), 0),
    _CHANNELS[ros2.JOINTS]: (np.dtype([("q_rad", "<f8", 6)]), 8),
    _CHANNELS[SAMPLE]: (np.dtype(_SAMPLE), 0),
}
# Shortest time between two messages on /tf, ns, because viewers redraw their screen at most 60 times per second.
_TRANSFORMS_STEP_NS: Final = 16_666_667

MAGIC: Final = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _ATTACHMENT, _DATA_END = 3, 4, 5, 6, 7, 9, 15
# Stands for the missing end of a truncated file in place of an opcode; MCAP itself does not use 0.
_CUT = 0
# Layout of the bytes before the body of an MCAP message; `log` and `publish` are its two times.
_HEAD: Final = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_NONE: Final = np.zeros(0, np.int64)


# Messages to write: times (n,), sequence numbers, and n messages per topic; those of one time follow each other.
_Group = tuple[NDArray[np.int64], ArrayLike, Mapping[str, ros2.Messages]]


class McapFile(GrowingFile):
    """A new recording in the MCAP format."""

    def __init__(self, path: Path, header: Header) -> None:
        from mcap.records import Attachment, AttachmentIndex, Channel, Schema
        from mcap.records import Header as Start

        super().__init__(path)
        self._header = header
        self.samples = 0
        self._crc = 0
        self._memory = np.empty(0, np.uint8)
        self._chunks: list[McapRecord] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._first_ns, self._last_ns = 1 << 63, 0
        self._channels: list[McapRecord] = []
        for topic, number in _CHANNELS.items():
            schema = _SCHEMAS[topic]
            self._channels.append(Schema(data=schema.text.encode(), encoding="ros2msg", id=number, name=schema.name))
            self._channels.append(Channel(number, topic, "cdr", {}, number))
        self._add(MAGIC + _bytes(Start("ros2", f"ftdrive {__version__}"), *self._channels))
        self._attachments: list[McapRecord] = []
        document = header.to_dict()
        for name, content in (("calibration.json", document.pop("calibration")), ("recording.json", document)):
            data = json.dumps(content, indent=1).encode()
            record = _bytes(Attachment(0, 0, name, "application/json", data))
            place = self._add(record)
            self._attachments.append(AttachmentIndex(place, len(record), 0, 0, len(data), name, "application/json"))

    def _add(self, content: bytes) -> int:
        place = self.add(content)
        self._crc = zlib.crc32(content, self._crc)
        return place

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples and events as one MCAP chunk. Raises `OSError` if the file cannot be written."""
        from mcap.records import Chunk, ChunkIndex
        from zstandard import compress

        for event in events:
            self._header = next_header(self._header, event)
        if not len(rows) and not events:
            return
        content, tables = self._messages([*self._groups(rows, events)])
        first_ns = min(int(table[:, 0].min()) for table in tables.values())
        last_ns = max(int(table[:, 0].max()) for table in tables.values())
        packed = compress(content, ZSTD_LEVEL)
        chunk = _bytes(Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(content), len(content)))
        indexes, places = b"", {}
        for number, table in tables.items():
            places[number] = self.size + len(chunk) + len(indexes)
            indexes += struct.pack("<BQHI", _INDEX, 6 + table.nbytes, number, table.nbytes) + table.tobytes()
            self._counts[number] += len(table)
        index = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self._add(chunk + indexes),
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=last_ns,
            message_index_length=len(indexes),
            message_index_offsets=places,
            message_start_time=first_ns,
            uncompressed_size=len(content),
        )
        self._chunks.append(index)
        self._first_ns, self._last_ns = min(first_ns, self._first_ns), max(last_ns, self._last_ns)
        self.samples += len(rows)

    def _groups(self, rows: Rows, events: Sequence[StreamEvent]) -> Iterator[_Group]:
        offset_ns = self._header.info.utc_offset_ns
        if len(rows):
            t_ns = rows["t_host_ns"] + offset_ns
            yield t_ns, rows["seq"], _pack_samples(rows, t_ns, self._header.frame.id)
            some = np.flatnonzero(np.diff(t_ns // _TRANSFORMS_STEP_NS, prepend=0))
            yield t_ns[some], 0, {ros2.TRANSFORMS: self._transforms(rows[some], t_ns[some])}
        log = partial(_pack_log, offset_ns=offset_ns)
        for topic, kind, pack in ((EVENTS, "", log), (LOAD, "load", _pack_load), (TRACKED, "tracked", _pack_tracked)):
            for event in events:
                if kind in ("", event.kind):
                    packed = ros2.ENCODING + pack(event)
                    yield np.array([event.t_host_ns + offset_ns]), 0, {topic: np.frombuffer(packed, f"V{len(packed)}")}

    def _messages(self, groups: Sequence[_Group]) -> tuple[memoryview, dict[int, NDArray[np.uint64]]]:
        """Return a chunk's messages, valid until the next call, and for each channel their times and offsets (n, 2)."""
        widths = [sum(_HEAD.itemsize + body.itemsize for body in bodies.values()) for *_, bodies in groups]
        messages = self._room(sum(len(t_ns) * width for (t_ns, *_), width in zip(groups, widths, strict=True)))
        tables, place = defaultdict(list), 0
        for (t_ns, sequence, bodies), width in zip(groups, widths, strict=True):
            n, start = len(t_ns), 0
            records = messages[place : place + n * width].reshape(n, width)
            for topic, body in bodies.items():
                end = start + _HEAD.itemsize + body.itemsize
                fields = records[:, start:end].view([*_HEAD.descr, ("body", body.dtype)])[:, 0]
                fields["opcode"], fields["length"] = _MESSAGE, _HEAD.itemsize - 9 + body.itemsize
                fields["channel"], fields["sequence"] = _CHANNELS[topic], np.bitwise_and(sequence, 0xFFFFFFFF)
                fields["log"] = fields["publish"] = t_ns
                fields["body"] = body
                tables[_CHANNELS[topic]].append(np.stack([t_ns, place + start + width * np.arange(n)], axis=1))
                start = end
            place += n * width
        return messages.data, {number: np.concatenate(parts).astype("<u8") for number, parts in tables.items()}

    def _room(self, size: int) -> NDArray[np.uint8]:
        """Return `size` bytes of a buffer, reused because a new one per chunk would take a third of the time."""
        if size > len(self._memory):
            self._memory = np.concatenate([self._memory, np.empty(2 * size - len(self._memory), np.uint8)])
        return self._memory[:size]

    def _transforms(self, rows: Rows, t_ns: NDArray[np.int64]) -> NDArray[np.void]:
        place = matrices(rows["quaternion_base_flange"]), rows["p_base_flange_m"]
        return ros2.pack_transforms(t_ns, ros2.transforms_of(self._header.frame, self._header.info, *place))

    def _write_end(self) -> None:
        from mcap.records import DataEnd, Footer, Statistics

        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(_CHANNELS),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns,
            metadata_count=0,
            schema_count=len(_SCHEMAS),
        )
        end = _bytes(DataEnd(self._crc))
        summary = _bytes(*self._channels, statistics, *self._attachments, *self._chunks)
        footer = _bytes(Footer(summary_start=self.size + len(end), summary_offset_start=0, summary_crc=0))
        self.add(end + summary + footer + MAGIC)


def _pack_samples(rows: Rows, t_ns: NDArray[np.int64], frame: str) -> dict[str, NDArray[np.void]]:
    sample = np.zeros(len(rows), [("encoding", "V4"), *_SAMPLE])
    sample["encoding"] = np.void(ros2.ENCODING)
    for name, _ in _SAMPLE:
        sample[name] = rows[name]
    return {
        ros2.RAW: ros2.pack_wrenches(t_ns, rows["raw"], "sensor"),
        ros2.COMPENSATED: ros2.pack_wrenches(t_ns, rows["wrench"], frame),
        ros2.POSE: ros2.pack_poses(t_ns, rows["p_base_flange_m"], rows["quaternion_base_flange"]),
        ros2.JOINTS: ros2.pack_joints(t_ns, rows["q_rad"]),
        SAMPLE: sample.view(f"V{sample.itemsize}"),
    }


def _pack_log(event: StreamEvent, offset_ns: int) -> bytes:
    """Pack an event as a ROS Log message: its kind in the field `name`, its values as JSON in `function`."""
    stamp = divmod(event.t_host_ns + offset_ns, 1_000_000_000)
    packed = struct.pack("<iIB3x", *stamp, 30 if event.kind in ros2.WARNINGS else 20)
    for text in (event.kind, event.text, "", json.dumps(dict(event.values))):
        data = text.encode() + b"\0"
        packed += struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)
    return packed + struct.pack("<I", 0)


def _pack_load(event: StreamEvent) -> bytes:
    """Pack mass and centre of mass of a weighing for plots of viewers; unknown values are NaN."""
    values, nowhere = event.values, [np.nan] * 3
    com_m, sigma_m = values["p_sensor_com_m"] or nowhere, values["p_sensor_com_sigma_m"] or nowhere
    return struct.pack("<8d", values["mass_kg"], values["mass_sigma_kg"], *com_m, *sigma_m)


def _pack_tracked(event: StreamEvent) -> bytes:
    """Pack the tracked bias and part; the age is infinite if the bias has not been seen yet."""
    values = event.values
    age_s = np.inf if values["last_seen_s"] is None else values["last_seen_s"]
    part = values["part_kg"], values["part_sigma_kg"], age_s, values["part_known"]
    return struct.pack("<15d?", *values["bias"], *values["sigma"], *part)


def _unpack_event(body: bytes, t_host_ns: int) -> StreamEvent:
    texts, place = [], 16
    for _ in range(4):
        (length,) = struct.unpack_from("<I", body, place)
        texts.append(body[place + 4 : place + 3 + length].decode())
        place += 4 + length + -length % 4
    kind, text, _, values = texts
    return StreamEvent(t_host_ns, kind, text, parsed_json(values))  # type: ignore[arg-type]  # newer kinds


def _bytes(*records: "McapRecord") -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap has no types here


def read_mcap(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read an MCAP recording in pieces; return why it ends early, or "". Damage raises `BadRecording`."""
    from zstandard import ZstdError

    documents: dict[str, Any] = {}
    content: _Content | None = None
    size = path.stat().st_size
    with open_file(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise BadRecording("the file does not begin as an MCAP file")
        try:
            for opcode, data in _data_section(file):
                if opcode == _ATTACHMENT:
                    _add_document(data, documents)
                if opcode not in (_CHUNK, _INDEX, _DATA_END, _CUT):
                    continue
                if content is None:
                    content = _Content(_mcap_header(documents), columns)
                    yield content.piece(0.0)
                if opcode == _INDEX:
                    content.indexes.append(data)
                elif opcode == _CUT:
                    # ignore errors, because the last chunk of an interrupted file may lack some indexes
                    with suppress(ValueError):
                        content.close_chunk()
                    yield content.piece(1.0)
                else:
                    if content.close_chunk():
                        yield content.piece(file.tell() / size)
                    if opcode == _DATA_END:
                        return ""
                    content.open_chunk(data)
        except (MemoryError, OverflowError, TypeError, ValueError, ZstdError, struct.error) as error:
            raise BadRecording(
                f"a record cannot be read ({error or type(error).__name__}): the file is damaged"
            ) from error
    return "its last record is incomplete"


def _add_document(data: bytes, documents: dict[str, Any]) -> None:
    from mcap.data_stream import ReadDataStream
    from mcap.records import Attachment

    _require_crc(zlib.crc32(data[:-4]), data[-4:])
    attachment = Attachment.read(ReadDataStream(io.BytesIO(data)))
    documents[attachment.name] = parsed_json(attachment.data)


def _mcap_header(documents: Mapping[str, Any]) -> Header:
    if not {"calibration.json", "recording.json"} <= documents.keys():
        raise BadRecording("the header is missing: the file was cut within it, or another program wrote it")
    return Header.from_dict(documents["recording.json"] | {"calibration": documents["calibration.json"]})


def _data_section(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and bytes of the complete records in an MCAP file's data section; at the end of a cut file, `_CUT`.

    Raises `ValueError` if the CRC does not match, or if the file has its last bytes but no end of the data section.
    """
    crc = zlib.crc32(MAGIC)
    while len(start := file.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", start)
        if not opcode or length > MOST_BYTES:
            raise ValueError(f"a record of kind {opcode} with {length} bytes")
        data = file.read(length)
        if len(data) < length:
            break
        if opcode == _DATA_END:
            _require_crc(crc, data)
            yield opcode, data
            return
        crc = zlib.crc32(data, zlib.crc32(start, crc))
        yield opcode, data
    file.seek(-len(MAGIC), io.SEEK_END)
    if file.read() == MAGIC:
        raise ValueError("the end of the data is missing")
    yield _CUT, b""


def _require_crc(crc: int, stored: bytes) -> None:
    """Raise `ValueError` unless a CRC-32 equals the stored one. A stored 0, as some programs write, means no CRC."""
    if struct.unpack("<I", stored) not in ((0,), (crc,)):
        raise ValueError("its bytes differ from their checksum")


class _Content:
    """Collects columns and events of MCAP chunks until `piece` returns them; its times are on the cell's clock."""

    def __init__(self, header: Header, columns: Collection[str]) -> None:
        self._header = header
        self._kind = np.dtype([(name, ROW[name]) for name in ROW.names or () if name in columns])
        self._columns: dict[str, list[NDArray[Any]]] = {name: [] for name in ("t_host_ns", *(self._kind.names or ()))}
        self._events: list[StreamEvent] = []
        self._messages = b""
        self.indexes: list[bytes] = []
        """Message indexes of the channels in the open chunk."""

    def open_chunk(self, data: bytes) -> None:
        """Unpack the messages of an MCAP chunk, and check their CRC; `close_chunk` then reads them."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk
        from mcap.stream_reader import get_chunk_data_stream

        stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(io.BytesIO(data))), validate_crc=True)
        self._messages = stream.read(size)

    def close_chunk(self) -> bool:
        """Decode the messages of the open chunk; return whether there were any.

        Raises `ValueError` unless its indexes name all messages; the CRC of the chunk does not cover the indexes.
        """
        messages, indexes, self._messages, self.indexes = self._messages, self.indexes, b"", []
        found = [_read_index(messages, index) for index in indexes]
        _require_complete(
            messages,
            np.concatenate([_NONE, *(places for _, _, places, _ in found)]),
            np.concatenate([_NONE, *(ends for *_, ends in found)]),
        )
        offset_ns = self._header.info.utc_offset_ns
        for channel, t_ns, places, ends in found:
            if channel == _CHANNELS[EVENTS]:
                for t, place, end in zip((t_ns - offset_ns).tolist(), places.tolist(), ends.tolist(), strict=True):
                    self._events.append(_unpack_event(messages[place + _HEAD.itemsize : end], t))
            elif channel in _COLUMNS:
                kind, behind = _COLUMNS[channel]
                values = _gather(messages, ends - behind - kind.itemsize, kind)
                for name in self._columns.keys() & set(kind.names):
                    self._columns[name].append(values[name])
                if channel == _CHANNELS[SAMPLE]:
                    self._columns["t_host_ns"].append(t_ns - offset_ns)
        return bool(messages)

    def piece(self, share: float) -> Piece:
        """Return the complete samples and the events read so far; samples with missing columns wait for more chunks."""
        columns = {name: np.concatenate([np.empty(0, ROW[name]), *parts]) for name, parts in self._columns.items()}
        rows = np.empty(min(map(len, columns.values())), self._kind)
        for name, column in columns.items():
            if name in (self._kind.names or ()):
                rows[name] = column[: len(rows)]
            self._columns[name] = [column[len(rows) :]] if len(column) > len(rows) else []
        events, self._events = self._events, []
        return Piece(self._header, rows, events, share)


def _read_index(messages: bytes, index: bytes) -> tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the channel, times, starts and ends (n,) of an index's messages. Raises `ValueError` if they differ."""
    channel, size = struct.unpack_from("<HI", index)
    t_ns, places = np.frombuffer(index, "<i8", size // 8, 6).reshape(-1, 2).T
    heads = _gather(messages, places, _HEAD)
    if (heads["opcode"] != _MESSAGE).any() or (heads["channel"] != channel).any() or (heads["log"] != t_ns).any():
        raise ValueError("an index differs from its chunk")
    return channel, t_ns, places, places + 9 + heads["length"].astype(np.int64)


def _require_complete(messages: bytes, places: NDArray[np.int64], ends: NDArray[np.int64]) -> None:
    """Raise `ValueError` if a chunk has anything but schema and channel records between its indexed messages."""
    # sort, because only the offsets within each channel are in order
    order = np.argsort(places, kind="stable")
    begins, stops = np.append(places[order], len(messages)), np.insert(ends[order], 0, 0)
    for stop, begin in zip(stops[stops != begins].tolist(), begins[stops != begins].tolist(), strict=True):
        place = stop
        while place < begin:
            opcode, length = struct.unpack_from("<BQ", messages, place)
            if opcode not in (_SCHEMA, _CHANNEL):
                break
            place += 9 + length
        if place != begin:
            raise ValueError("a chunk has a message without an index entry")


def _gather(data: bytes, places: NDArray[np.int64], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the values of type `kind` at these offsets of `data`, without a copy if the offsets are equidistant."""
    if len(places) and (places.min() < 0 or places.max() + kind.itemsize > len(data)):
        raise ValueError("an index points outside its chunk")
    steps = np.diff(places)
    if len(steps) and (steps == steps[0]).all():
        return np.ndarray(len(places), kind, data, int(places[0]), (int(steps[0]),))
    return np.array([np.frombuffer(data, kind, 1, place)[0] for place in places.tolist()], kind)
