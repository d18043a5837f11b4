"""An emulated ATI Net F/T box (or Ethernet Axia): samples over UDP (RDT), configuration over HTTP.

Ref: ATI 9620-05-Net FT, sections "UDP Interface Using RDT" and "XML"; 9610-05-Ethernet Axia, sections 9 and 10. Names
and form of the elements are those of a page of a Gamma SI-330-30 (box firmware 2.2.59), as quoted by a public client of
revision 22 of the manual. It has tool transformation and software bias, as the emulated box has.

* The software bias is six strain gauge counts (int16, sections 4.4 and 7.1), which the box subtracts from the gauges
  before its matrix. The RDT command "bias" makes the current gauge values the bias.
* The tool transformation follows: displacements in the axes of the transducer, then rotations about x, the new y and
  the new z. The force is ``R.T F``, the torque ``R.T (T - d x F)`` with ``R = Rx Ry Rz``. Order and signs are those of
  ATI's own library (TTM in ftconfig.c of the DAQ F/T C library, in lagadic/visp).
* A rate becomes the next higher whole fraction of 7000 Hz (section 4.7).

Does not model: the TCP interface, multi-unit mode, filters, monitor conditions, more than one configuration, the web
pages, DHCP, rounding to gauge counts, and that a real box answers only a few HTTP requests in a row.

Chosen here, because the sources leave it open: a new request for samples replaces the running one and its address.
"One-shot" sends its count of samples, one for count 0, at the set rate. A reading at its rating in the axes of the
transducer sets the summary and saturation bits. Other datagrams are ignored. A bias set over HTTP survives
a power failure, a bias set by RDT does not.
"""

import contextlib
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TypedDict
from urllib.parse import parse_qsl, urlsplit
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.sensors.ati_gauges import REFERENCE, Scale
from ftmocks.sensors.kind import Kind
from ftmocks.wires.device import Device

RDT_PORT = 49152
REQUEST = struct.Struct(">HHI")
RECORD = np.dtype([("rdt", ">u4"), ("ft", ">u4"), ("status", ">u4"), ("counts", ">i4", 6)])
REQUEST_HEADER = 0x1234
INTERNAL_HZ = 7000
MAX_BUFFER = 40
SUMMARY, LATCH, SATURATED = 0x8000_0000, 0x0001_0000, 0x8002_0000
FORCE_UNITS = {1: "lbf", 2: "N", 3: "klbf", 4: "kN", 5: "kgf", 6: "gf"}
TORQUE_UNITS = {1: "lbf-in", 2: "lbf-ft", 3: "Nm", 4: "Nmm", 5: "kgf-cm", 6: "kNm"}
DISTANCE_UNITS = {1: ("in", 0.0254), 2: ("ft", 0.3048), 3: ("mm", 0.001), 4: ("cm", 0.01), 5: ("m", 1.0)}
ANGLE_UNITS = {1: ("degrees", np.pi / 180), 2: ("radians", 1.0)}
TRANSFORM_KEYS, BIAS_KEYS = ([f"{name}{i}" for i in range(6)] for name in ("cfgtfx", "setbias"))


class Command(IntEnum):
    """Command codes of RDT requests."""

    STOP = 0x0000
    ONE_SHOT = 0x0001
    REAL_TIME = 0x0002
    BUFFERED = 0x0003
    RESET_LATCH = 0x0041
    BIAS = 0x0042


class Endpoint(TypedDict):
    """Addresses at which a client reaches the box."""

    host: str
    rdt_port: int
    http_port: int


@dataclass(frozen=True, eq=False)
class Calibration(Scale):
    """Data of the transducer that the box reports over HTTP.

    Parameters
    ----------
    serial, part_number
        Serial number and part number of the transducer.
    rating
        (6,) rated load, N and N·m, at which readings are clipped.
    """

    serial: str = "FT12345"
    part_number: str = "SI-130-10"
    rating: Sequence[float] = (130.0, 130.0, 400.0, 10.0, 10.0, 10.0)


def transform_matrix(displacement_m: Array, angles_rad: Array) -> Array:
    """Return the matrix (6, 6) that transforms wrenches from the transducer frame to a tool frame.

    Parameters
    ----------
    displacement_m
        (3,) origin of the tool frame in transducer coordinates.
    angles_rad
        (3,) rotations about x, the new y and the new z.
    """
    turned = np.eye(3)
    for axis, angle in enumerate(angles_rad):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[first, second], [first, second]] = np.cos(angle)
        turn[second, first] = np.sin(angle)
        turn[first, second] = -np.sin(angle)
        turned = turned @ turn
    x, y, z = displacement_m
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = turned.T
    matrix[3:, :3] = -turned.T @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return matrix


def rdt_records(first: int, ft: NDArray[np.int64], status: NDArray[np.int64], counts: Array) -> bytes:
    """Return consecutive 36-byte records, big-endian.

    Parameters
    ----------
    first
        RDT sequence number of the first record.
    ft, status, counts
        (n,) internal sequence numbers, (n,) status words, (n, 6) counts.
    """
    records = np.empty(len(counts), dtype=RECORD)
    records["rdt"] = (first + np.arange(len(counts))) & 0xFFFFFFFF
    records["ft"] = ft & 0xFFFFFFFF
    records["status"] = status
    records["counts"] = np.clip(np.rint(counts), -(2**31), 2**31 - 1)
    return records.tobytes()


@dataclass(eq=False, kw_only=True)
class NetFtBox(Device[bytes]):
    """The box, with one thread for RDT and one for HTTP. If `faults` stalls the wire, HTTP is not answered either.

    Parameters
    ----------
    host
        Address on which the box listens.
    rdt_port, http_port
        Ports; 0 selects a free one. The real ports are 49152 and 80, which needs privileges.
    calibration
        Scale and identity of the transducer.
    product
        Product name that the box reports.
    firmware
        Firmware version.
    tool_transform
        (6,) displacements dx dy dz and rotations rx ry rz in these units; zeros for none.
    distance_unit, angle_unit
        Codes of the units, keys of `DISTANCE_UNITS` and `ANGLE_UNITS`.
    bias
        (6,) software bias at power-up, gauge counts; zeros for none.
    gauge_offset
        (6,) or scalar readings of the gauges without load. None selects `bias`, which cancels them.
    rate_hz
        Sample rate, 1 to 7000 Hz.
    buffer_size
        Number of records per datagram in buffered mode, 1 to 40.
    rdt_enabled
        Whether the box answers at its UDP port.
    status
        Status bits that are sent with every sample.
    streaming_at_start
        Address and port of a client to which the box streams after power-up, as after a crash of that client.
    """

    host: str = "127.0.0.1"
    rdt_port: int = RDT_PORT
    http_port: int = 0
    calibration: Calibration = Calibration()
    product: str = "Net F/T"
    firmware: str = "2.2.59"
    tool_transform: Sequence[float] = (0.0, 0.0, 132.71, 0.0, 0.0, 0.0)
    distance_unit: int = 3
    angle_unit: int = 1
    bias: Sequence[int] = (745, 17, 447, 184, -596, -253)
    gauge_offset: float | Sequence[float] | None = None
    rate_hz: int = INTERNAL_HZ
    buffer_size: int = 5
    rdt_enabled: bool = True
    status: int = 0
    streaming_at_start: tuple[str, int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._client: tuple[str, int] | None = None
        self._left: int | None = None
        self._buffer = b""
        self._buffered = False
        self._stream_hz = float(self.rate_hz)
        self._gauge_offset = np.asarray(self.bias if self.gauge_offset is None else self.gauge_offset, dtype=float)
        self._bias = np.zeros(6)
        self._booted_s = 0.0
        self._ft_start = 0

    def start(self) -> Endpoint:
        """Power the box up.

        Raises
        ------
        RuntimeError
            The box is running already.
        OSError
            A port is not available.
        """
        self._require_stopped()
        with contextlib.ExitStack() as stack:
            self._socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._socket.bind((self.host, self.rdt_port))
            self._socket.setblocking(False)
            self._http = stack.enter_context(_HttpServer((self.host, self.http_port), self))
            stack.pop_all()
        self._file = self._socket.fileno()
        self._launch(lambda: self._http.serve_forever(poll_interval=0.1))
        return {"host": self.host, "rdt_port": self._socket.getsockname()[1], "http_port": self._http.server_port}

    def _close(self) -> None:
        self._http.shutdown()
        self._http.server_close()
        self._socket.close()

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._wire.clear()
        self._pacer.stop()
        self._bias = np.array(self.bias, dtype=float)
        self._booted_s = self.clock.now_s()
        if self.streaming_at_start:
            self.request(Command.REAL_TIME, 0, self.streaming_at_start)

    def _receive(self) -> None:
        with contextlib.suppress(OSError):  # a client that has ended causes a refused connection
            data, client = self._socket.recvfrom(256)
            if len(data) == REQUEST.size and self.rdt_enabled:
                header, command, count = REQUEST.unpack(data)
                if header == REQUEST_HEADER:
                    self.request(command, count, client)

    def request(self, command: int, count: int, client: tuple[str, int]) -> None:
        """Carry out a request that a client has sent."""
        match command:
            case Command.STOP:
                self._pacer.stop()
            case Command.ONE_SHOT | Command.REAL_TIME | Command.BUFFERED:
                self._client = client
                self._left = count or (1 if command == Command.ONE_SHOT else None)
                self._buffered, self._buffer = command == Command.BUFFERED, b""
                self._ft_start = int((self.clock.now_s() - self._booted_s) * INTERNAL_HZ)
                self._stream_hz = float(min(max(self.rate_hz, 1), INTERNAL_HZ))
                self._pacer.start(self._stream_hz)
            case Command.RESET_LATCH if self.status & LATCH:
                self.status &= ~LATCH
                self.status = 0 if self.status == SUMMARY else self.status
            case Command.BIAS:
                gauges_per_SI = REFERENCE.gauges_per_SI
                self._bias = gauges_per_SI @ self.measured(1)[0][0] + self._gauge_offset

    def _deliver(self, frames: list[bytes]) -> None:
        for datagram in frames:
            with contextlib.suppress(OSError):  # the buffer is full or no client listens: the datagram is lost
                if self._client is not None:
                    self._socket.sendto(datagram, self._client)

    def _sample(self, count: int) -> None:
        first = self._pacer.made - count  # number of the sample within this stream, from 0
        if self._left is not None:
            count = max(0, min(count, self._left - first))
            self._pacer.made = first + count
        if count:
            measured, saturated = self.measured(count)
            ft = self._ft_start + ((first + np.arange(count)) * (INTERNAL_HZ / self._stream_hz)).astype(np.int64)
            status = np.where(saturated, SATURATED, 0) | self.status
            records = rdt_records(first + 1, ft, status, self.counts(measured))
            self._send(records, last=self._left is not None and first + count >= self._left)
        if self._left is not None and first + count >= self._left:
            self._pacer.stop()

    def measured(self, count: int) -> tuple[Array, NDArray[np.bool_]]:
        """Return wrenches (count, 6) on the transducer, N and N·m, and whether each is at its rating (count,)."""
        return self._readings(count, np.asarray(self.calibration.rating))

    def counts(self, measured: Array) -> Array:
        """Return counts (n, 6) of wrenches on the transducer, after software bias and tool transformation."""
        bias = np.linalg.solve(REFERENCE.gauges_per_SI, self._bias - self._gauge_offset)
        metres, radians = DISTANCE_UNITS[self.distance_unit][1], ANGLE_UNITS[self.angle_unit][1]
        displacement, angles = np.reshape(self.tool_transform, (2, 3))
        matrix = transform_matrix(displacement * metres, angles * radians)
        return np.asarray((measured - bias) @ matrix.T * self.calibration.counts_per_SI)

    def _send(self, records: bytes, *, last: bool) -> None:
        data = self._buffer + records
        size = RECORD.itemsize * (min(max(self.buffer_size, 1), MAX_BUFFER) if self._buffered else 1)
        full = len(data) if last else len(data) - len(data) % size
        self._wire.put([data[i : min(i + size, full)] for i in range(0, full, size)], stream=not last)
        self._buffer = data[full:]

    def page(self, path: str) -> bytes | None:
        """Return the content of a page, or None if it does not exist. Pages for settings change the settings."""
        url = urlsplit(path)
        query = dict(parse_qsl(url.query))
        match url.path:
            case "/netftapi2.xml":
                return _xml("netft", self._configuration())
            case "/netftcalapi.xml":
                return _xml("netftCalibration", self._calibration())
            case "/comm.cgi" if query.keys() <= {"comrdte", "comrdtrate", "comrdtbsiz"}:
                return self._communication(query)
            case "/setting.cgi" if query.keys() <= set(BIAS_KEYS):
                return self._setting(query)
            case "/config.cgi" if query.pop("cfgid", "0") == "0":
                return self._configured(query)
        return None

    def _communication(self, query: dict[str, str]) -> bytes | None:
        if not all(value.isdecimal() for value in query.values()):
            return None
        self.rdt_enabled = query.get("comrdte", str(int(self.rdt_enabled))) != "0"
        rate_hz = min(max(int(query.get("comrdtrate", self.rate_hz)), 1), INTERNAL_HZ)
        self.rate_hz = INTERNAL_HZ // (INTERNAL_HZ // rate_hz)
        self.buffer_size = min(max(int(query.get("comrdtbsiz", self.buffer_size)), 1), MAX_BUFFER)
        return b"<html><body>Communications</body></html>"

    def _setting(self, query: dict[str, str]) -> bytes | None:
        with contextlib.suppress(ValueError):
            bias = [int(query.get(key, round(value))) for key, value in zip(BIAS_KEYS, self._bias, strict=True)]
            if all(-32768 <= value <= 32767 for value in bias):
                self.bias, self._bias = bias, np.array(bias, dtype=float)
                return b"<html><body>Settings</body></html>"
        return None

    def _configured(self, query: dict[str, str]) -> bytes | None:
        if not query.keys() <= {*TRANSFORM_KEYS, "cfgtdu", "cfgtau"}:
            return None
        with contextlib.suppress(ValueError):
            transform = [
                float(query.get(key, old)) for key, old in zip(TRANSFORM_KEYS, self.tool_transform, strict=True)
            ]
            distance = int(query.get("cfgtdu", self.distance_unit))
            angle = int(query.get("cfgtau", self.angle_unit))
            if np.isfinite(transform).all() and distance in DISTANCE_UNITS and angle in ANGLE_UNITS:
                self.tool_transform, self.distance_unit, self.angle_unit = transform, distance, angle
                return b"<html><body>Configurations</body></html>"
        return None

    def _configuration(self) -> dict[str, object]:
        calibration = self.calibration
        return {
            "runstat": f"0x{self.status:08X}",
            "cfgcalsel": 0,
            "cfgcalsn": calibration.serial,
            "cfgfu": calibration.force_unit,
            "scfgfu": FORCE_UNITS[calibration.force_unit],
            "cfgtu": calibration.torque_unit,
            "scfgtu": TORQUE_UNITS[calibration.torque_unit],
            "cfgcpf": calibration.counts_per_force,
            "cfgcpt": calibration.counts_per_torque,
            "cfgtdu": self.distance_unit,
            "scfgtdu": DISTANCE_UNITS[self.distance_unit][0],
            "cfgtau": self.angle_unit,
            "scfgtau": ANGLE_UNITS[self.angle_unit][0],
            "cfgtfx": ";".join(f"{value:.3f}" if value else "0" for value in self.tool_transform),
            "cfgmr": ";".join(f"{rating:g}" for rating in calibration.rating / calibration.units_SI),
            "setcfgsel": 0,
            "setbias": ";".join(f"{value:.0f}" for value in self._bias.round() + 0.0),
            "runrate": INTERNAL_HZ,
            "comrdte": "Enabled" if self.rdt_enabled else "Disabled",
            "comrdtrate": self.rate_hz,
            "comrdtbsiz": self.buffer_size,
            "setrate": INTERNAL_HZ,
            "mfgdigver": self.firmware,
            "prodname": self.product,
        }

    def _calibration(self) -> dict[str, object]:
        calibration = self.calibration
        return {
            "calsn": calibration.serial,
            "calpn": calibration.part_number,
            "calfu": calibration.force_unit,
            "caltu": calibration.torque_unit,
            "calcpf": calibration.counts_per_force,
            "calcpt": calibration.counts_per_torque,
        }


def _xml(root: str, elements: dict[str, object]) -> bytes:
    body = "".join(f"<{name}>{escape(str(value))}</{name}>\r\n" for name, value in elements.items())
    return f'<?xml version="1.0" encoding="ISO-8859-1"?>\r\n<{root}>\r\n{body}</{root}>\r\n'.encode("latin-1")


class _HttpServer(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], box: NetFtBox) -> None:
        super().__init__(address, _HttpHandler)
        self.box = box


class _HttpHandler(BaseHTTPRequestHandler):
    server: _HttpServer

    def do_GET(self) -> None:
        if self.server.box.faults.stall:
            return  # the connection closes without an answer
        content = self.server.box.page(self.path)
        self.send_response(404 if content is None else 200)
        self.send_header("Content-Type", "text/xml" if self.path.endswith("xml") else "text/html")
        self.send_header("Content-Length", str(len(content or b"")))
        self.end_headers()
        self.wfile.write(content or b"")

    def log_message(self, format: str, *args: object) -> None:
        """Discard log messages of the HTTP server."""


def _numbers(text: str) -> list[float]:
    numbers = [float(part) for part in text.split(",")]
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise ValueError(f"expected 6 numbers separated by commas, got {text!r}")
    return numbers


KINDS = {
    "netft": Kind(
        NetFtBox,
        "ati-netft",
        options={"rdt_port": 0, "rate_hz": 1000},
        settings={"tool-transform": ("tool_transform", _numbers), "bias": ("bias", _numbers)},
        at_host=True,
        # A real sensor has a bias of (15.4, -12.2, -1.7) N and (-1.2, -2.1, 0.05) N·m: philip-long/FoamCutting_kukalwr.
        bias_scale=(1.1, 2.1),
    )
}
