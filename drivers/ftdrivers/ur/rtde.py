"""A small RTDE client, which reads all values from a controller.

The receiving side of ur_rtde is not used: it blocks the interpreter if the controller accepts a connection and sends
nothing, repeats its last values after a lost connection, has no consistent snapshot, and cannot parse `tcp_offset`,
which the flange pose needs. Only a subscription with inputs writes to the controller; the others cannot disturb a
program.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2, general-purpose registers.
Checked on hardware: no.
"""

import contextlib
import logging
import socket
import struct
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError, StreamBroken, Unreachable

log = logging.getLogger(__name__)

PORT: Final = 30004

REQUEST_PROTOCOL_VERSION: Final = ord("V")
GET_CONTROLLER_VERSION: Final = ord("v")
SETUP_OUTPUTS: Final = ord("O")
SETUP_INPUTS: Final = ord("I")
START: Final = ord("S")
DATA: Final = ord("U")

_HEADER: Final = struct.Struct(">HB")  # header of a package: its whole size, its type
_FORMATS: Final[Mapping[str, tuple[str, tuple[int, ...]]]] = {
    "UINT32": (">u4", ()),
    "INT32": (">i4", ()),
    "DOUBLE": (">f8", ()),
    "VECTOR3D": (">f8", (3,)),
    "VECTOR6D": (">f8", (6,)),
}
_INPUTS: Final[Mapping[str, str]] = {"INT32": "i", "DOUBLE": "d"}
_RECEIVE_BYTES: Final = 65536
# Highest RTDE rates, Hz: of the CB3 generation, and of the e-Series and later ones.
_FULL_RATE_HZ: Final = (125.0, 500.0)
# Numbers of the registers for RTDE clients since PolyScope 3.9 and 5.3. Lower ones are for fieldbuses and PLCs.
FIRST_REGISTER: Final = 24
LAST_REGISTER: Final = 47
# Rate at which a client reads the requests of a program on the controller, Hz.
_REQUESTS_HZ: Final = 125.0
_SILENT_S: Final = 1.0


def encode(kind: int, payload: bytes = b"") -> bytes:
    """Return the bytes of an RTDE package with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def encode_setup_outputs(frequency_Hz: float, names: tuple[str, ...]) -> bytes:
    """Return the bytes of the request for a recipe of outputs."""
    return encode(SETUP_OUTPUTS, struct.pack(">d", frequency_Hz) + ",".join(names).encode("ascii"))


def _encode_setup_inputs(names: tuple[str, ...]) -> bytes:
    """Return the bytes of the request for a recipe of inputs."""
    return encode(SETUP_INPUTS, ",".join(names).encode("ascii"))


def take_package(buffer: bytearray) -> tuple[int, bytes] | None:
    """Remove the first package from `buffer` and return (type, payload); return None while it is incomplete.

    Raises `ProtocolError` if the buffer does not begin with a package.
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
    """Decode the version of the controller: major, minor, bugfix, build."""
    if len(payload) != 16:
        raise ProtocolError(f"RTDE version of {len(payload)} bytes, 16 expected: {payload.hex(' ')}")
    major, minor, bugfix, build = struct.unpack(">4I", payload)
    return major, minor, bugfix, build


@dataclass(frozen=True, slots=True)
class Recipe:
    """The layout in which the controller sends the requested outputs."""

    id: int
    types: tuple[str, ...]

    @classmethod
    def decode(cls, payload: bytes) -> "Recipe":
        """Decode the answer to a request for outputs. An unknown output has the type `NOT_FOUND`."""
        try:
            return cls(payload[0], tuple(payload[1:].decode("ascii").split(",")))
        except (IndexError, UnicodeDecodeError) as error:
            raise ProtocolError(f"RTDE recipe cannot be read: {payload.hex(' ')}") from error

    def check(self, payload: bytes) -> None:
        """Raise `ProtocolError` if a data package does not have the length of this recipe."""
        size = _layout(self.types).itemsize
        if len(payload) != size or payload[0] != self.id:
            raise ProtocolError(
                f"RTDE data of {len(payload)} bytes, {size} expected for recipe {self.id}: {payload.hex(' ')}"
            )

    def taken(self, names: Sequence[str]) -> list[str]:
        """Return those of the inputs that belong to another client or a fieldbus."""
        return [name for name, kind in zip(names, self.types, strict=False) if kind == "IN_USE"]

    def columns(self, payloads: Sequence[bytes]) -> list[NDArray[Any]]:
        """Decode n checked data packages; return one array per output, (n,) or (n, length of the vector)."""
        table = np.frombuffer(b"".join(payloads), _layout(self.types))
        return [table[str(k)].astype(table[str(k)].dtype.newbyteorder("=")) for k in range(len(self.types))]


@lru_cache(maxsize=16)
def _layout(types: tuple[str, ...]) -> np.dtype[Any]:
    """Return the layout of a data package, which begins with the number of the recipe."""
    if unknown := [kind for kind in types if kind not in _FORMATS]:
        raise ProtocolError(f"RTDE outputs have unknown types: {', '.join(unknown)}")
    return np.dtype([("recipe", "u1"), *((str(k), *_FORMATS[kind]) for k, kind in enumerate(types))])


class _Connection:
    """A connection to the RTDE server. The constructor raises `OSError` if it is not established within `timeout_s`."""

    def __init__(self, host: str, timeout_s: float, clock: Clock) -> None:
        self._clock = clock
        self._deadline_s = clock.now_s() + timeout_s
        self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # send each package at once
        self._timeout_s = timeout_s
        self._buffer = bytearray()

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Read the next package and return (type, payload)."""
        while (package := take_package(self._buffer)) is None:
            self._receive(timeout_s)
        return package

    def read_all(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Read all packages that have arrived, at least one. The socket is empty afterwards."""
        while not (packages := list(iter(lambda: take_package(self._buffer), None))):
            self._receive(timeout_s)
        return packages

    def _receive(self, timeout_s: float) -> None:
        """Wait for bytes, then read all that have arrived."""
        if timeout_s != self._timeout_s:
            self._socket.settimeout(timeout_s)  # avoided if unchanged: it is a system call
            self._timeout_s = timeout_s
        received = b"\0" * _RECEIVE_BYTES
        while len(received) == _RECEIVE_BYTES:
            received = self._socket.recv(_RECEIVE_BYTES)
            if not received:
                raise StreamBroken("the controller closed the connection")
            self._buffer += received

    def ask(self, request: bytes) -> bytes:
        """Send a request and return the payload of the answer, which has the type of the request.

        The time-out of the connection applies to all its requests together.
        """
        self._socket.sendall(request)
        while True:
            kind, payload = self.read(max(self._deadline_s - self._clock.now_s(), 1e-3))
            if kind == request[2]:
                return payload
            log.debug("RTDE package of type %d instead of an answer: %s", kind, payload.hex(" "))

    def send(self, package: bytes) -> None:
        """Send a package that has no answer."""
        self._socket.sendall(package)

    def close(self) -> None:
        """Close the connection, and wake a thread that reads."""
        with contextlib.suppress(OSError):  # the connection may be lost already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class Subscription:
    """Receives outputs of a controller at `frequency_Hz`, and is connected while it exists.

    It may also own inputs, which no other client can write meanwhile.

    Parameters
    ----------
    host : str
        Address of the controller.
    outputs : mapping of str to str
        Name and type of every output, such as ``{"timestamp": "DOUBLE"}``.
    frequency_Hz : float
        Rate, at most that of the controller: 500 Hz, or 125 Hz of the CB3 generation.
    timeout_s : float
        Time-out of the complete start-up.
    clock : Clock
        Clock of the time-outs.
    inputs : mapping of str to str
        Name and type of every input that `write` sets; INT32 or DOUBLE.

    Raises
    ------
    Unreachable
        No device answers at the address.
    ConnectError
        There is no RTDE server, outputs or inputs have other types, or another client owns the inputs.
    """

    def __init__(
        self,
        host: str,
        outputs: Mapping[str, str],
        frequency_Hz: float,
        *,
        timeout_s: float,
        clock: Clock = REAL,
        inputs: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        where = f"{host}:{PORT}"
        self.version = (0, 0, 0, 0)
        """Version of the controller: major, minor, bugfix, build."""
        self.rate_Hz = frequency_Hz
        """Rate at which the controller sends samples, Hz."""
        self.is_full_rate = False
        self.missing: list[str] = []
        """Outputs that this controller does not know. Samples do not have them."""
        try:
            self._connection = _Connection(host, timeout_s, clock)
        except OSError as error:
            raise Unreachable(f"{where} cannot be reached ({error})", _fix_of(error, host)) from error
        try:
            self._greet(host, outputs, inputs)
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

    def read(self, timeout_s: float) -> list[bytes]:
        """Read all samples that have arrived since the last call, at least one, for `decode`.

        Raises `TimeoutError` if none arrives, `OSError` or `StreamBroken` after a lost connection, or `ProtocolError`.
        """
        while True:
            if samples := [payload for kind, payload in self._connection.read_all(timeout_s) if kind == DATA]:
                for sample in samples:
                    self._recipe.check(sample)
                return samples

    def decode(self, samples: Sequence[bytes]) -> dict[str, NDArray[Any]]:
        """Decode n samples; return arrays (n,) or (n, length of the vector) by the name of each known output."""
        return dict(zip(self._names, self._recipe.columns(samples), strict=True))

    def write(self, values: Sequence[float]) -> None:
        """Set all inputs, in their order. Not thread-safe. Raises `OSError` if the connection was lost."""
        self._connection.send(encode(DATA, self._inputs.pack(self._input_recipe, *values)))

    def close(self) -> None:
        """Close the connection, and wake a thread that reads. Idempotent."""
        self._connection.close()

    def _greet(self, host: str, outputs: Mapping[str, str], inputs: Mapping[str, str]) -> None:
        ask = self._connection.ask
        if ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02")) != b"\x01":
            raise ProtocolError("the controller refuses protocol version 2")
        self.version = decode_version(ask(encode(GET_CONTROLLER_VERSION)))
        full_Hz = _FULL_RATE_HZ[self.version[0] >= 5]
        self.rate_Hz, self.is_full_rate = min(self.rate_Hz, full_Hz), self.rate_Hz >= full_Hz
        self._recipe = Recipe.decode(ask(encode_setup_outputs(self.rate_Hz, tuple(outputs))))
        if len(self._recipe.types) == len(outputs):
            self.missing = [name for name, kind in zip(outputs, self._recipe.types, strict=True) if kind == "NOT_FOUND"]
        known = {name: kind for name, kind in outputs.items() if name not in self.missing}
        self._names = tuple(known)
        if not known:
            return
        if self.missing:
            self._recipe = Recipe.decode(ask(encode_setup_outputs(self.rate_Hz, self._names)))
        if self._recipe.types != tuple(known.values()):
            raise ProtocolError(f"{', '.join(known)} have the types {', '.join(self._recipe.types)}")
        if inputs:
            self._claim(host, inputs)
        if ask(encode(START)) != b"\x01":
            raise ProtocolError("the controller does not start the stream")

    def _claim(self, host: str, inputs: Mapping[str, str]) -> None:
        recipe = Recipe.decode(self._connection.ask(_encode_setup_inputs(tuple(inputs))))
        if taken := recipe.taken(tuple(inputs)):
            self.close()
            raise registers_taken(host, taken)
        if "NOT_FOUND" in recipe.types:
            version = ".".join(map(str, self.version[:3]))
            raise ConnectError(
                f"PolyScope {version} on {host} has no input registers 24 to 47 for RTDE clients",
                "update the controller to 3.9, 5.3 or later",
            )
        if recipe.types != tuple(inputs.values()):
            raise ProtocolError(f"{', '.join(inputs)} have the types {', '.join(recipe.types)}")
        self._input_recipe = recipe.id
        self._inputs = struct.Struct(">B" + "".join(_INPUTS[kind] for kind in recipe.types))


def _fix_of(error: OSError, host: str) -> str:
    if isinstance(error, ConnectionRefusedError):
        return (
            f"check that {host} is the robot controller, switched on and started; enable RTDE on the pendant under "
            "Settings, Security, Services"
        )
    if isinstance(error, socket.gaierror):
        return "give the controller's IPv4 address: on the pendant, Settings, System, Network shows it"
    return f"ping {host}; check that the controller is switched on, its cable, and firewalls between"


def registers_in_use(host: str, names: tuple[str, ...], *, timeout_s: float, clock: Clock = REAL) -> list[str]:
    """Return the names of those RTDE inputs that belong to another client or a fieldbus. No input is changed.

    Raises `StreamBroken` without a connection, `DeviceTimeout` without an answer, `ProtocolError` for an invalid one.
    """
    try:
        connection = _Connection(host, timeout_s, clock)
        try:
            connection.ask(encode(REQUEST_PROTOCOL_VERSION, b"\x00\x02"))
            recipe = Recipe.decode(connection.ask(_encode_setup_inputs(names)))
        finally:
            connection.close()
    except TimeoutError as error:
        raise DeviceTimeout(f"{host}:{PORT} did not answer within {timeout_s:.1f} s", "check the robot") from error
    except OSError as error:
        raise StreamBroken(f"{host}:{PORT} was lost ({error})", "check the robot and the cable") from error
    return recipe.taken(names)


def registers_taken(host: str, names: Sequence[str]) -> ConnectError:
    """Return the error to raise if RTDE inputs belong to another client; `names` may lack some of them."""
    which = f" ({names[0]} and {len(names) - 1} more)" if names else ""
    return ConnectError(
        f"another client controls {host} and holds its RTDE registers{which}",
        "end it, or disable EtherNet/IP, PROFINET and other fieldbuses on the controller; wait 30 s after a cut cable",
    )


class ProgramRegisters:
    """Registers for a program on the controller: inputs with the answers of this client, and two outputs with requests.

    Parameters
    ----------
    host : str
    first : int
        Number of the first register of each kind.
    integers, doubles : int
        Number of inputs of each kind.
    timeout_s : float
        Time-out of the connection.
    clock : Clock
        Clock of the time-out.

    Raises
    ------
    ValueError
        The registers are not reserved for RTDE clients.
    ConnectError
        No device answers, another client or a fieldbus owns a register, or this version has no such registers.
    """

    def __init__(
        self, host: str, first: int, integers: int, doubles: int, *, timeout_s: float = 2.0, clock: Clock = REAL
    ) -> None:
        if not FIRST_REGISTER <= first <= LAST_REGISTER + 1 - max(integers, doubles):
            raise ValueError(f"registers from {first} are not within {FIRST_REGISTER} to {LAST_REGISTER}")
        inputs = {f"input_int_register_{first + i}": "INT32" for i in range(integers)}
        inputs |= {f"input_double_register_{first + i}": "DOUBLE" for i in range(doubles)}
        self._names = tuple(f"output_int_register_{first + i}" for i in range(2))
        self._link = Subscription(
            host, dict.fromkeys(self._names, "INT32"), _REQUESTS_HZ, timeout_s=timeout_s, clock=clock, inputs=inputs
        )
        self._lock = threading.Lock()
        self._failure: DeviceError | None = None
        self._request: tuple[int, int] | None = None
        self._reader = threading.Thread(target=self._read, name="program registers", daemon=True)
        self._reader.start()

    @property
    def request(self) -> tuple[int, int] | None:
        """Number and command of the last request of the program; None before the first sample.

        Raises `DeviceError` if the connection was lost.
        """
        if self._failure is not None:
            raise self._failure
        return self._request

    def write(self, integers: Sequence[int], doubles: Sequence[float]) -> None:
        """Set all inputs in one cycle. Raises `DeviceError` if the connection was lost."""
        try:
            with self._lock:
                # One package is processed in one cycle of the controller. The IO client of ur_rtde writes one package
                # per register, so a program could read half of an answer.
                self._link.write([*integers, *doubles])
        except OSError as error:
            raise StreamBroken(f"the registers cannot be written ({error})", "check robot and cable") from error
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Close the connection. The registers keep their last values. Idempotent."""
        self._link.close()
        self._reader.join(1.0)

    def _read(self) -> None:
        try:
            while True:
                values = self._link.decode(self._link.read(_SILENT_S))
                number, command = (int(np.asarray(values[name])[-1]) for name in self._names)
                self._request = number, command
        except (OSError, StreamBroken, ProtocolError, struct.error) as error:
            self._failure = StreamBroken(f"the controller's registers were lost ({error})", "check robot and cable")
