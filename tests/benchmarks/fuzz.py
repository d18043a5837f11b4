"""Random bytes and damaged golden frames into all that decodes: only documented exceptions, no hang, no growing memory.

    python -m tests.benchmarks.fuzz [--inputs 1000000] [--only matrix]

Half of the inputs of each codec are random bytes, half are frames from the vendors' documents with some bytes changed,
added or missing. Prints for each codec how many inputs were refused, the longest time one took and how much memory
was kept, and pass or FAIL.
"""

import argparse
import gc
import io
import json
import random
import struct
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import cast

from ftdrive.checks.computer import SensorAddress
from ftdrivers.ati import codec as ati
from ftdrivers.ati import modbus
from ftdrivers.ati.netft import transformation_in
from ftdrivers.bota import codec as bota
from ftdrivers.errors import BadTranscript, BadUrl, ProtocolError
from ftdrivers.registry import sensor_from_url
from ftdrivers.robotiq import codec as robotiq
from ftdrivers.robotous import codec as robotous
from ftdrivers.robotous.can import Halves
from ftdrivers.sensors import SENSORS
from ftdrivers.transcript import FORMAT, Transcript
from ftdrivers.ur import rtde
from ftdrivers.wires.framing import crc16_modbus, crc16_x25
from tests.benchmarks.common import show

LONGEST = 400
SLOWEST_S = 0.5
"""Of one input: thousands of times what it takes, and still less than a pause of a busy computer."""
KEPT_BYTES = 100_000


@dataclass(frozen=True)
class Target:
    """One decoder, and a frame from its document that is intact."""

    name: str
    decode: Callable[[bytes], object]
    golden: bytes
    documented: type[Exception] = ProtocolError


def halves(*sizes: int) -> Callable[[bytes], list[bytes]]:
    """Cut bytes into pieces of these sizes; the last one gets the rest."""

    def cut(data: bytes) -> list[bytes]:
        pieces, at = [], 0
        for size in sizes[:-1]:
            pieces.append(data[at : at + size])
            at += size
        return [*pieces, data[at:]]

    return cut


def words(data: bytes, count: int) -> list[int]:
    """Cut bytes into numbers of two bytes; the last one gets the rest."""
    return [int.from_bytes(piece, "big") for piece in halves(*[2] * count)(data)]


def rtde_packages(data: bytes) -> None:
    buffer = bytearray(data)
    while rtde.take_package(buffer) is not None:
        pass


def rtde_data(data: bytes) -> object:
    """Decode a recipe, whose size comes first, and by it the data after it."""
    size = data[0] if data else 0
    recipe = rtde.Recipe.decode(data[1 : 1 + size])
    recipe.check(data[1 + size :])
    return recipe.columns([data[1 + size :]])


def robotous_halves() -> Callable[[bytes], None]:
    """Pair the halves of one sensor for ever: a byte that says which half it is and what came before, and the half."""
    pairs, times_ns = Halves(0.001), count(0, 400_000)

    def take(data: bytes) -> None:
        for at in range(0, len(data), 9):
            kind = data[at]
            pairs.take(next(times_ns), data[at + 1 : at + 9], second=bool(kind & 1))
            if kind & 2:
                next(times_ns)
                for field in pairs.silence():
                    robotous.decode_sample(field.data)

    return take


class FileOf:
    """A file with this in it, as far as it is read."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def open(self, _: str) -> io.BytesIO:
        return io.BytesIO(self._data)


def address(data: bytes) -> None:
    """Build a sensor from an address; what is no mistake in it must say where the device is."""
    scheme = sorted(SENSORS)[data[0] % len(SENSORS)] if data else ""
    url = f"{scheme}://{data[1:].decode(errors='surrogateescape')}"
    sensor_from_url(url)
    parts = SensorAddress.of(url)
    _ = parts.serial_port, parts.can_interface, parts.bitrate


TRANSCRIPT = "\n".join(
    json.dumps(line)
    for line in (
        {"format": FORMAT, "url": "bota:///dev/ttyUSB0?sinc=64", "duration_s": 1.5},
        {"t_ns": 1, "event": "open", "baudrate": 460800},
        {"t_ns": 9, "event": "page", "request": "474554202f", "reply": "4f4b", "took_s": 0.5},
        {"t_ns": 20, "dir": "tx", "hex": "430d"},
        {"t_ns": 31, "dir": "rx", "hex": "aa0042"},
        {"t_ns": 99, "event": "end", "error": None},
    )
).encode()


def targets() -> list[Target]:
    ati_row = halves(8, 8, 8)
    ati_pair = halves(8, 6)
    robotous_stream = robotous.deframer()
    robotiq_stream = robotiq.deframer()
    bota_stream = bota.deframer()
    sample = bytes([robotous.Command.START, *range(15)])
    record = bytes.fromhex("0064012C01F4FF38FE70FDA850")
    registers = modbus.read_registers(modbus.STATUS, 1)
    few = robotiq.read_registers(robotiq.SERIAL, 4)
    few_answer = bytes.fromhex("090308465453 0004D2 0000")
    netft_page = b"<cfgtfx>0;0;132.71;0;0;9</cfgtfx><scfgtdu>mm</scfgtdu><scfgtau>degrees</scfgtau>"
    calibration = bytes(2 * 117) + bytes.fromhex("000F4240000F4240") + bytes(338 - 2 * 117 - 8)
    bota_frame = bota.HEADER + with_crc(crc16_x25, bytes(34))
    frame = robotous.encode_frame(sample)
    recipe = b"\1DOUBLE,VECTOR6D"
    for kind in SENSORS.values():
        import_module(kind.driver.split(":")[0])  # a first use that takes half a second is no hang

    def keep(data: bytes) -> object:
        return modbus.keep_records(modbus.decode_records(data).intact)

    return [
        Target("ati.codec.decode_gauges", lambda d: ati.decode_gauges(*ati_pair(d)), bytes(14)),
        Target("ati.codec.decode_matrix_row", lambda d: ati.decode_matrix_row(*ati_row(d)), bytes(24)),
        Target("ati.codec.decode_serial", ati.decode_serial, b"FT12345\0"),
        Target("ati.codec.decode_slot", ati.decode_slot, b"\0"),
        Target("ati.codec.decode_counts_per_unit", ati.decode_counts_per_unit, bytes.fromhex("000F4240000F4240")),
        Target("ati.codec.decode_unit_codes", ati.decode_unit_codes, b"\x02\x03"),
        Target("ati.codec.decode_firmware", ati.decode_firmware, b"\x03\x08\x00\x01"),
        Target("ati.modbus.check_reply", lambda d: modbus.check_reply(registers, d), modbus.frame(0x03, b"\x02\0\0")),
        Target("ati.modbus.decode_calibration_block", modbus.decode_calibration_block, calibration),
        Target("ati.modbus.decode_records", keep, record * 8),
        Target("robotous.codec.decode_sample", robotous.decode_sample, sample),
        Target("robotous.codec.decode_text", robotous.decode_text, b"\x01RFT60-HA01".ljust(16, b"\0")),
        Target("robotous.codec.decode_rate", robotous.decode_rate, bytes([0x10, 5]).ljust(16, b"\0")),
        Target("robotous.codec.check_set", robotous.check_set, bytes([0x0F, 1]).ljust(16, b"\0")),
        Target("robotous.halves", robotous_halves(), b"\0" + sample[:8] + b"\3" + sample[8:]),
        Target("robotous frames", robotous_stream.feed, frame),
        Target("robotiq.codec.check_reply", lambda d: robotiq.check_reply(few, d), with_crc(crc16_modbus, few_answer)),
        Target("robotiq.codec.decode_frame", robotiq.decode_frame, with_crc(crc16_modbus, robotiq.HEADER + bytes(12))),
        Target("robotiq.codec.decode_serial", lambda d: robotiq.decode_serial(words(d, 4)), b"FTS\0\x04\xd2\0\0"),
        Target("robotiq frames", robotiq_stream.feed, with_crc(crc16_modbus, robotiq.HEADER + bytes(12))),
        Target("robotiq.codec.decode_firmware", lambda d: robotiq.decode_firmware(words(d, 3)), b"FTS\1\2\3"),
        Target("bota.codec.decode_frame", bota.decode_frame, bota_frame),
        Target("bota frames", bota_stream.feed, bota_frame),
        Target("netft.transformation_in", transformation_in, netft_page),
        Target("ur.rtde.take_package", rtde_packages, rtde.encode(rtde.DATA, bytes(57)) * 2),
        Target("ur.rtde.decode_version", rtde.decode_version, struct.pack(">4I", 5, 15, 0, 1)),
        Target("ur.rtde.Recipe.decode", rtde.Recipe.decode, recipe),
        Target("ur.rtde.Recipe.unpack", rtde_data, bytes([len(recipe)]) + recipe + b"\1" + bytes(56)),
        Target(
            "transcript.Transcript.load", lambda d: Transcript.load(cast(Path, FileOf(d))), TRANSCRIPT, BadTranscript
        ),
        Target("registry.sensor_from_url", address, b"\0can0?interface=slcan&bitrate=250000&base=0x20", BadUrl),
    ]


def with_crc(crc: Callable[[bytes], int], data: bytes) -> bytes:
    return data + crc(data).to_bytes(2, "little")


def inputs_for(golden: bytes, count: int, rng: random.Random) -> list[bytes]:
    """Make inputs: random ones, and the golden frame changed in a few places."""
    made = []
    for number in range(count):
        if number % 2:
            made.append(rng.randbytes(rng.choice([len(golden), rng.randrange(LONGEST)])))
            continue
        data = bytearray(golden)
        for _ in range(rng.randrange(4)):
            at = rng.randrange(len(data) + 1)
            match rng.randrange(3):
                case 0:
                    data[at : at + 1] = rng.randbytes(1)
                case 1:
                    data[at:at] = rng.randbytes(rng.randrange(1, 4))
                case _:
                    del data[at : at + rng.randrange(1, 4)]
        made.append(bytes(data))
    return made


@dataclass(frozen=True)
class Outcome:
    """What became of the inputs of one codec."""

    inputs: int
    refused: int
    slowest_s: float
    kept_bytes: int
    undocumented: str

    @property
    def passed(self) -> bool:
        """Whether the codec kept its word."""
        return not self.undocumented and self.slowest_s < SLOWEST_S and self.kept_bytes < KEPT_BYTES


def allocated_bytes() -> int:
    """Memory in use, without what only waits for the garbage collector, such as the cycles of numpy's formatting."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def fuzz(target: Target, inputs: int, *, seed: int = 1, batch: int = 10_000) -> Outcome:
    """Feed one codec; stops at the first exception that its document does not name."""
    rng = random.Random(seed)
    refused, slowest_s, undocumented, done = 0, 0.0, "", 0
    tracemalloc.start()
    before = None
    try:
        while done < inputs and not undocumented:
            for data in inputs_for(target.golden, min(batch, inputs - done), rng):
                begin = time.perf_counter()
                try:
                    target.decode(data)
                except target.documented:
                    refused += 1
                except Exception as exc:
                    undocumented = f"{exc!r} for {data.hex()}"
                    break
                slowest_s = max(slowest_s, time.perf_counter() - begin)
                done += 1
            data = b""
            if before is None:
                before = allocated_bytes()  # what a first use sets up is no growth
        kept = allocated_bytes() - (before or 0)
    finally:
        tracemalloc.stop()
    return Outcome(done, refused, slowest_s, kept, undocumented)


def main() -> int:
    """Fuzz all codecs; returns 1 when one fails."""
    parser = argparse.ArgumentParser(description="Fuzz every codec of the drivers.")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="for each codec")
    parser.add_argument("--only", default="", metavar="TEXT", help="codecs with this in their name")
    options = parser.parse_args()
    failed = False
    for target in [target for target in targets() if options.only in target.name]:
        outcome = fuzz(target, options.inputs)
        failed |= not outcome.passed
        show(
            f"{target.name:38} {outcome.inputs:8} inputs, {outcome.refused:8} refused, slowest "
            f"{outcome.slowest_s * 1e3:7.2f} ms, kept {outcome.kept_bytes:7} bytes   "
            f"{'pass' if outcome.passed else 'FAIL'} {outcome.undocumented}"
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
