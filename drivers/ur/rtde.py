"""A small RTDE client of our own, for what ur_rtde cannot do.

ur_rtde's constructors freeze the whole interpreter when the controller accepts and stays silent, so somebody has to
say hello first with a time-out. ur_rtde cannot parse `tcp_offset`, without which a TCP pose says nothing about the
flange. And it does not tell a sample that has just been taken from one that has waited in the socket while this process
was suspended. Nothing is ever written to the controller's registers here: this client cannot disturb a program.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
Checked on hardware: no.
"""

import contextlib
import copy
import logging
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from types import MappingProxyType
from typing import Final

from drivers._clock import awake_s
from drivers.errors import ConnectError, DeviceTimeout, DriverError, ProtocolError, StreamBroken, Unreachable

log = logging.getLogger(__name__)

PORT: Final = 30004
SCRIPT_PORT: Final = 30003

REQUEST_PROTOCOL_VERSION: Final = ord("V")
GET_CONTROLLER_VERSION: Final = ord("v")
SETUP_OUTPUTS: Final = ord("O")
SETUP_INPUTS: Final = ord("I")
START: Final = ord("S")
DATA: Final = ord("U")

_HEADER: Final = struct.Struct(">HB")  # size of the whole package, type
_FORMATS: Final = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}


def encode(kind: int, payload: bytes = b"") -> bytes:
    """Frame one package."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def encode_setup_outputs(frequency_Hz: float, names: tuple[str, ...]) -> bytes:
    """Frame the request for one recipe of outputs."""
    return encode(SETUP_OUTPUTS, struct.pack(">d", frequency_Hz) + ",".join(names).encode("ascii"))


def encode_setup_inputs(names: tuple[str, ...]) -> bytes:
    """Frame the request for one recipe of inputs."""
    return encode(SETUP_INPUTS, ",".join(names).encode("ascii"))


def take_package(buffer: bytearray) -> tuple[int, bytes] | None:
    """Remove the first package from `buffer` as (type, payload); None while it is incomplete.

    Raises `ProtocolError` when the buffer cannot begin with a package.
    """
    if len(buffer) < _HEADER.size:
        return None
    size, kind = _HEADER.unpack_from(buffer)
    if size < _HEADER.size:
        raise ProtocolError(
            f"RTDE package of {size} bytes, at least {_HEADER.size} expected", "is this an RTDE server?"
        )
    if len(buffer) < size:
        return None
    payload = bytes(buffer[_HEADER.size : size])
    del buffer[:size]
    return kind, payload


def decode_version(payload: bytes) -> tuple[int, int, int, int]:
    """Decode the controller's version: major, minor, bugfix, build."""
    if len(payload) != 16:
        raise ProtocolError(f"RTDE version of {len(payload)} bytes, 16 expected: {payload.hex(' ')}")
    major, minor, bugfix, build = struct.unpack(">4I", payload)
    return major, minor, bugfix, build


@dataclass(frozen=True, slots=True)
class Recipe:
    """How the controller packs the outputs that were asked for."""

    id: int
    types: tuple[str, ...]

    @classmethod
    def decode(cls, payload: bytes) -> "Recipe":
        """Decode the answer to a request for outputs. An unknown output has the type `NOT_FOUND`."""
        try:
            return cls(payload[0], tuple(payload[1:].decode("ascii").split(",")))
        except (IndexError, UnicodeDecodeError) as error:
            raise ProtocolError(f"RTDE recipe cannot be read: {payload.hex(' ')}") from error

    def unpack(self, payload: bytes) -> list[tuple[float, ...]]:
        """Unpack a data package into one tuple per output."""
        whole, fields = _layout(self.types)
        if len(payload) != whole.size or payload[0] != self.id:
            raise ProtocolError(
                f"RTDE data of {len(payload)} bytes, {whole.size} expected for recipe {self.id}: {payload.hex(' ')}"
            )
        values = whole.unpack(payload)
        return [values[field] for field in fields]


@lru_cache(maxsize=16)
def _layout(types: tuple[str, ...]) -> tuple[struct.Struct, list[slice]]:
    """Lay out a data package: all of it, the recipe's number first, and where in it each output is."""
    if unknown := [kind for kind in types if kind not in _FORMATS]:
        raise ProtocolError(f"RTDE output of unknown type: {', '.join(unknown)}")
    formats = [_FORMATS[kind] for kind in types]
    ends = list(accumulate((int(one[:-1] or 1) for one in formats), initial=1))
    return struct.Struct(">B" + "".join(formats)), [slice(*pair) for pair in pairwise(ends)]


class _Connection:
    """One connection, one package at a time."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._buffer = bytearray()

    def read(self, timeout_s: float | None) -> tuple[int, bytes]:
        """Read the next package as (type, payload)."""
        self._socket.settimeout(timeout_s)
        while (package := take_package(self._buffer)) is None:
            received = self._socket.recv(4096)
            if not received:
                raise StreamBroken("the controller closed the connection")
            self._buffer += received
        return package

    def ask(self, request: bytes, deadline: float) -> bytes:
        """Send a request and return the payload of its answer; an answer has the type of its request."""
        self._socket.sendall(request)
        while True:
            kind, payload = self.read(max(deadline - time.monotonic(), 1e-3))
            if kind == request[2]:
                return payload
            log.debug("RTDE package of type %d instead of an answer: %s", kind, payload.hex(" "))

    def close(self) -> None:
        """Close, and wake a thread that reads."""
        with contextlib.suppress(OSError):  # it may be gone already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class Subscription:
    """Outputs of one controller, sent `frequency_Hz` times a second; connected while it exists.

    Parameters
    ----------
    host : str
        Address of the controller.
    outputs : mapping of str to str
        Name and type of every output, such as ``{"timestamp": "DOUBLE"}``.
    frequency_Hz : float
        How often; at most the controller's own rate.
    timeout_s : float
        For the whole greeting.

    Raises
    ------
    Unreachable
        Nobody there.
    ConnectError
        No RTDE, or outputs of other types.
    """

    def __init__(self, host: str, outputs: Mapping[str, str], frequency_Hz: float, *, timeout_s: float) -> None:
        where = f"{host}:{PORT}"
        self.version = (0, 0, 0, 0)
        """Of the controller: major, minor, bugfix, build."""
        self.missing: list[str] = []
        """Outputs this controller does not know: the samples come without them."""
        try:
            self._connection = _Connection(socket.create_connection((host, PORT), timeout=timeout_s))
        except OSError as error:
            raise Unreachable(
                f"{where} cannot be reached ({error})",
                "check the address and the cable, that the robot controller is switched on, and that no firewall "
                "stands between",
            ) from error
        try:
            self._greet(outputs, frequency_Hz, time.monotonic() + timeout_s)
        except TimeoutError as error:
            self.close()
            raise ConnectError(
                f"{where} accepts the connection but did not answer within {timeout_s:.1f} s",
                "check that this is a robot controller and that it has finished starting",
            ) from error
        except (OSError, ProtocolError, StreamBroken) as error:
            self.close()
            raise ConnectError(
                f"{where} does not speak RTDE ({error})",
                "check that this is a robot controller and that RTDE is enabled under Settings, Security, Services",
            ) from error

    def read(self, timeout_s: float | None) -> list[tuple[float, ...]]:
        """Read the next sample: one tuple for each output.

        Raises `TimeoutError` when none comes, `OSError` or `StreamBroken` when the connection is lost, `ProtocolError`.
        """
        while True:
            kind, payload = self._connection.read(timeout_s)
            if kind == DATA:
                return self._recipe.unpack(payload)

    def close(self) -> None:
        """Let the connection go, and wake a thread that reads. Idempotent."""
        self._connection.close()

    def _greet(self, outputs: Mapping[str, str], frequency_Hz: float, deadline: float) -> None:
        ask = self._connection.ask
        if ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02"), deadline) != b"\x01":
            raise ProtocolError("protocol version 2 is refused")
        self.version = decode_version(ask(encode(GET_CONTROLLER_VERSION), deadline))
        self._recipe = Recipe.decode(ask(encode_setup_outputs(frequency_Hz, tuple(outputs)), deadline))
        if len(self._recipe.types) == len(outputs):
            self.missing = [name for name, kind in zip(outputs, self._recipe.types, strict=True) if kind == "NOT_FOUND"]
        known = {name: kind for name, kind in outputs.items() if name not in self.missing}
        if not known:
            return
        if self.missing:
            self._recipe = Recipe.decode(ask(encode_setup_outputs(frequency_Hz, tuple(known)), deadline))
        if self._recipe.types != tuple(known.values()):
            raise ProtocolError(f"{', '.join(known)} come as {', '.join(self._recipe.types)}")
        if ask(encode(START), deadline) != b"\x01":
            raise ProtocolError("the controller does not start the stream")


CONTROL_REGISTERS: Final = (
    *(f"input_int_register_{k}" for k in range(8)),
    *(f"input_double_register_{k}" for k in range(18)),
)
"""What ur_rtde's control interface writes to, and nobody else may."""


def registers_in_use(host: str, names: tuple[str, ...], *, timeout_s: float) -> list[str]:
    """Tell which of these inputs belong to another client or a fieldbus, leaving all of them as they are.

    Raises `StreamBroken`, `DeviceTimeout` or `ProtocolError`.
    """
    try:
        connection = _Connection(socket.create_connection((host, PORT), timeout=timeout_s))
        try:
            deadline = time.monotonic() + timeout_s
            connection.ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02"), deadline)
            recipe = Recipe.decode(connection.ask(encode_setup_inputs(names), deadline))
        finally:
            connection.close()
    except TimeoutError as error:
        raise DeviceTimeout(f"{host}:{PORT} did not answer within {timeout_s:.1f} s", "check the robot") from error
    except OSError as error:
        raise StreamBroken(f"{host}:{PORT} was lost ({error})", "check the robot and the cable") from error
    return [name for name, kind in zip(names, recipe.types, strict=False) if kind == "IN_USE"]


def find_script_port(host: str, *, timeout_s: float) -> None:
    """See whether the controller takes programs, sending none. Raises `ConnectError`."""
    try:
        socket.create_connection((host, SCRIPT_PORT), timeout=timeout_s).close()
    except OSError as error:
        raise ConnectError(
            f"{host}:{SCRIPT_PORT}, which takes programs, cannot be reached ({error})",
            "enable the real-time client interface under Settings, Security, Services, and look for a firewall between",
        ) from error


@dataclass(frozen=True, slots=True)
class Sample:
    """What the controller told once."""

    t_host_ns: int
    t_awake_s: float
    """When it came, by `awake_s`."""
    t_device_s: float
    outputs: Mapping[str, tuple[float, ...]]


class LiveReader:
    """The controller's version, and its clock, active TCP offset and modes, kept current by a thread.

    Every sample carries the controller's time, the same clock the poses of ur_rtde carry, so that a pose can be matched
    with the offset that was active when it was taken.
    """

    _outputs: Mapping[str, str] = MappingProxyType(
        {
            "timestamp": "DOUBLE",
            "robot_mode": "INT32",
            "safety_mode": "INT32",
            "safety_status_bits": "UINT32",
            "runtime_state": "UINT32",
            "speed_scaling": "DOUBLE",
            "target_speed_fraction": "DOUBLE",
            "tcp_offset": "VECTOR6D",
            "payload": "DOUBLE",
            "payload_cog": "VECTOR3D",
        }
    )
    _frequency_Hz = 125.0  # the full rate of the CB3 generation; e-Series arms send every fourth cycle
    _live_s = (0.002, 0.1)
    """How long one waits for a sample that has just been taken: 8 ms. What has piled up comes without waiting."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._stream: Subscription | None = None
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._newest: Sample | None = None
        self._live: Sample | None = None
        self._live_count = 0
        self._failure: DriverError | None = None
        self.version = (0, 0, 0, 0)
        """Of the controller, after `open`: major, minor, bugfix, build."""
        self.missing: frozenset[str] = frozenset()
        """What this controller does not know of what it was asked for, after `open`."""
        self.tells_tcp = False
        """Whether this controller tells its TCP offset; older ones do not."""
        self.silent = False
        """Whether nothing has come since somebody was told that the clock stands still."""

    def open(self, *, timeout_s: float) -> None:
        """Say hello and start to follow. Raises `ConnectError`."""
        self._stream = Subscription(self._host, self._outputs, self._frequency_Hz, timeout_s=timeout_s)
        self.version = self._stream.version
        self.missing = frozenset(self._stream.missing)
        self._names = [name for name in self._outputs if name not in self.missing]
        self.tells_tcp = "tcp_offset" in self._names
        self._thread = threading.Thread(target=self._run, args=(self._stream,), name="ur-live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let the connection go. Idempotent."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._thread is not None:
            self._thread.join(timeout=1.0)
            self._thread = None

    def now_s(self, *, limit_s: float) -> float:
        """Controller time of a sample taken after this call.

        However much has piled up in the sockets while this process was suspended: ur_rtde's samples of this time or
        later are new. Raises `StreamBroken` when the connection is lost and `DeviceTimeout` when the controller is
        silent for `limit_s`.
        """
        before = self._live_count
        return self._wait(lambda: self._live if self._live_count != before else None, limit_s).t_device_s

    def newest(self, *, since_s: float, limit_s: float) -> Sample:
        """Return the newest sample, taken at controller time `since_s` or later. Raises as `now_s`."""
        return self._wait(
            lambda: self._newest if self._newest is not None and self._newest.t_device_s >= since_s else None, limit_s
        )

    def live(self, *, max_age_s: float, limit_s: float) -> Sample:
        """Return the last sample that was new when it came, if that is `max_age_s` ago or less. Raises as `now_s`."""
        oldest_s = awake_s() - max_age_s
        return self._wait(
            lambda: self._live if self._live is not None and self._live.t_awake_s >= oldest_s else None, limit_s
        )

    def _wait(self, find: Callable[[], Sample | None], limit_s: float) -> Sample:
        silent_s = 0.0
        with self._changed:
            while True:
                self.check()
                if (found := find()) is not None:
                    return found
                if silent_s > limit_s:
                    self.silent = True
                    stands = "" if self._newest is None else f" at {self._newest.t_device_s:.3f} s"
                    raise DeviceTimeout(
                        f"the clock of {self._host} has stood still{stands} for {silent_s:.2f} s",
                        "check the robot and the network, and press the emergency stop if the arm moves",
                    )
                t0 = time.monotonic()
                self._changed.wait(0.02)
                # A process that was itself suspended has not been listening: that time does not count in full.
                silent_s += min(time.monotonic() - t0, 0.05)

    def check(self) -> None:
        """Raise what ended the stream, if it has ended."""
        if self._failure:
            raise copy.copy(self._failure) from self._failure

    def _run(self, stream: Subscription) -> None:
        """Follow the stream until it ends; what ended it is raised to whoever asks."""
        try:
            while True:
                t0 = awake_s()
                outputs = dict(zip(self._names, stream.read(None), strict=True))
                now_s = awake_s()
                with self._changed:
                    self.silent = False
                    self._newest = Sample(time.monotonic_ns(), now_s, outputs["timestamp"][0], outputs)
                    if self._live_s[0] <= now_s - t0 <= self._live_s[1]:
                        self._live = self._newest
                        self._live_count += 1
                    self._changed.notify_all()
        except (OSError, StreamBroken) as error:
            failure: DriverError = StreamBroken(
                f"the RTDE connection to {self._host} was lost ({error})",
                "check the robot and the cable, then open the arm again",
            )
        except ProtocolError as error:
            failure = error
        with self._changed:
            self._failure = failure
            self._changed.notify_all()
