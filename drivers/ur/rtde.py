"""A small RTDE client: everything that is read from a controller passes through it.

The receiving side of ur_rtde freezes the interpreter when the controller accepts and sends nothing. It repeats its last
values when a link is lost, has no snapshot, and cannot parse `tcp_offset`, which the flange pose needs. This client
never writes to the controller's registers, so it cannot disturb a program.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
Checked on hardware: no.
"""

import contextlib
import logging
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Final

from drivers.clock import REAL, Clock
from drivers.errors import ConnectError, DeviceTimeout, ProtocolError, StreamBroken, Unreachable

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
    "UINT32": "I",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
}


def encode(kind: int, payload: bytes = b"") -> bytes:
    """Build one package."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def encode_setup_outputs(frequency_Hz: float, names: tuple[str, ...]) -> bytes:
    """Build the request for one recipe of outputs."""
    return encode(SETUP_OUTPUTS, struct.pack(">d", frequency_Hz) + ",".join(names).encode("ascii"))


def encode_setup_inputs(names: tuple[str, ...]) -> bytes:
    """Build the request for one recipe of inputs."""
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
            f"RTDE package of {size} bytes, at least {_HEADER.size} expected", "check that this is an RTDE server"
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
    """How the controller packs the requested outputs."""

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
    """Return the layout of a data package, which begins with the recipe's number, and the place of each output."""
    if unknown := [kind for kind in types if kind not in _FORMATS]:
        raise ProtocolError(f"RTDE outputs have unknown types: {', '.join(unknown)}")
    formats = [_FORMATS[kind] for kind in types]
    ends = list(accumulate((int(one[:-1] or 1) for one in formats), initial=1))
    return struct.Struct(">B" + "".join(formats)), [slice(*pair) for pair in pairwise(ends)]


class _Connection:
    """One connection, one package at a time. Raises `OSError` when there is none within `timeout_s`."""

    def __init__(self, host: str, timeout_s: float, clock: Clock) -> None:
        self._clock = clock
        self._deadline_s = clock.now_s() + timeout_s
        self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        self._buffer = bytearray()

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Read the next package as (type, payload)."""
        self._socket.settimeout(timeout_s)
        while (package := take_package(self._buffer)) is None:
            received = self._socket.recv(4096)
            if not received:
                raise StreamBroken("the controller closed the connection")
            self._buffer += received
        return package

    def ask(self, request: bytes) -> bytes:
        """Send a request and return the payload of its answer, which has the type of the request.

        All answers have to arrive within the time-out of the connection.
        """
        self._socket.sendall(request)
        while True:
            kind, payload = self.read(max(self._deadline_s - self._clock.now_s(), 1e-3))
            if kind == request[2]:
                return payload
            log.debug("RTDE package of type %d instead of an answer: %s", kind, payload.hex(" "))

    def close(self) -> None:
        """Close, and wake a thread that reads."""
        with contextlib.suppress(OSError):  # it may be gone already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class Subscription:
    """Outputs of one controller, sent `frequency_Hz` times a second; connected while the object exists.

    Parameters
    ----------
    host : str
        Address of the controller.
    outputs : mapping of str to str
        Name and type of every output, such as ``{"timestamp": "DOUBLE"}``.
    frequency_Hz : float
        At most the controller's own rate.
    timeout_s : float
        Limit of the whole start-up.
    clock : Clock
        Measures it.

    Raises
    ------
    Unreachable
        Nothing answers at the address.
    ConnectError
        No RTDE, or outputs of other types.
    """

    def __init__(
        self, host: str, outputs: Mapping[str, str], frequency_Hz: float, *, timeout_s: float, clock: Clock = REAL
    ) -> None:
        where = f"{host}:{PORT}"
        self.version = (0, 0, 0, 0)
        """Of the controller: major, minor, bugfix, build."""
        self.missing: list[str] = []
        """Outputs that this controller does not know; samples lack them."""
        try:
            self._connection = _Connection(host, timeout_s, clock)
        except OSError as error:
            raise Unreachable(f"{where} cannot be reached ({error})", _fix_of(error, host)) from error
        try:
            self._greet(outputs, frequency_Hz)
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

    def read(self, timeout_s: float) -> list[tuple[float, ...]]:
        """Read the next sample: one tuple for each output.

        Raises `TimeoutError` when none arrives, `OSError` or `StreamBroken` on a lost connection, `ProtocolError`.
        """
        while True:
            kind, payload = self._connection.read(timeout_s)
            if kind == DATA:
                return self._recipe.unpack(payload)

    def close(self) -> None:
        """Close the connection, and wake a thread that reads. Idempotent."""
        self._connection.close()

    def _greet(self, outputs: Mapping[str, str], frequency_Hz: float) -> None:
        ask = self._connection.ask
        if ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02")) != b"\x01":
            raise ProtocolError("the controller refuses protocol version 2")
        self.version = decode_version(ask(encode(GET_CONTROLLER_VERSION)))
        self._recipe = Recipe.decode(ask(encode_setup_outputs(frequency_Hz, tuple(outputs))))
        if len(self._recipe.types) == len(outputs):
            self.missing = [name for name, kind in zip(outputs, self._recipe.types, strict=True) if kind == "NOT_FOUND"]
        known = {name: kind for name, kind in outputs.items() if name not in self.missing}
        if not known:
            return
        if self.missing:
            self._recipe = Recipe.decode(ask(encode_setup_outputs(frequency_Hz, tuple(known))))
        if self._recipe.types != tuple(known.values()):
            raise ProtocolError(f"{', '.join(known)} have the types {', '.join(self._recipe.types)}")
        if ask(encode(START)) != b"\x01":
            raise ProtocolError("the controller does not start the stream")


CONTROL_REGISTERS: Final = (
    *(f"input_int_register_{k}" for k in range(8)),
    *(f"input_double_register_{k}" for k in range(18)),
)
"""The inputs that ur_rtde's control interface writes, exclusively."""


def _fix_of(error: OSError, host: str) -> str:
    if isinstance(error, ConnectionRefusedError):
        return (
            f"check that {host} is the robot controller, switched on and started; enable RTDE at the pendant under "
            "Settings, Security, Services"
        )
    if isinstance(error, socket.gaierror):
        return "give the controller's IPv4 address: at the pendant, Settings, System, Network shows it"
    return f"ping {host}; check that the controller is switched on, its cable, and firewalls between"


def registers_in_use(host: str, names: tuple[str, ...], *, timeout_s: float, clock: Clock = REAL) -> list[str]:
    """Return which of these inputs belong to another client or a fieldbus; change none.

    Raises `StreamBroken`, `DeviceTimeout` or `ProtocolError`.
    """
    try:
        connection = _Connection(host, timeout_s, clock)
        try:
            connection.ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02"))
            recipe = Recipe.decode(connection.ask(encode_setup_inputs(names)))
        finally:
            connection.close()
    except TimeoutError as error:
        raise DeviceTimeout(f"{host}:{PORT} did not answer within {timeout_s:.1f} s", "check the robot") from error
    except OSError as error:
        raise StreamBroken(f"{host}:{PORT} was lost ({error})", "check the robot and the cable") from error
    return [name for name, kind in zip(names, recipe.types, strict=False) if kind == "IN_USE"]


def find_script_port(host: str, *, timeout_s: float) -> None:
    """Check that the controller accepts programs, without sending one. Raises `ConnectError`."""
    try:
        socket.create_connection((host, SCRIPT_PORT), timeout=timeout_s).close()
    except OSError as error:
        raise ConnectError(
            f"{host}:{SCRIPT_PORT}, which accepts programs, cannot be reached ({error})",
            "enable the real-time client interface under Settings, Security, Services, and check the firewall",
        ) from error
