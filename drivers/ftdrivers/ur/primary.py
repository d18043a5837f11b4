"""The primary interface of a controller, which accepts programs and reports when they start, end or fail.

A connection that was opened in local control is read-only: the controller ignores programs on it and reports error code
210. When the pendant is switched to local control, the controller closes the existing connections.

Ref: Universal Robots, "Primary and Secondary Interfaces" and "Client Interfaces" (messages, sub-packages);
`robot_message/*.cpp`, `robot_state/configuration_data.cpp` and `datatypes.h` of Universal Robots' client library; issue
459 of Universal_Robots_ROS_Driver about read-only connections.
Checked on hardware: no.
"""

import logging
import socket
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, ProtocolError
from ftdrivers.ur.kinematics import Kinematics

log = logging.getLogger(__name__)

PORT: Final = 30001

_HEADER: Final = struct.Struct(">iB")  # header of a package: its whole size, its type
_ROBOT_STATE, _ROBOT_MESSAGE = 16, 20
_MESSAGE: Final = struct.Struct(">QbB")  # start of a message: time stamp, source, type
_TEXT, _ERROR_CODE, _KEY, _EXCEPTION = 0, 6, 7, 10
_KEY_HEAD: Final = struct.Struct(">iiB")  # key message: code, argument, length of the title
_EXCEPTION_HEAD: Final = struct.Struct(">ii")  # line, column
_CODE_HEAD: Final = struct.Struct(">iiiBI")  # code, argument, level, type of the data (4 bytes in old documents), data
# Error code of a controller in local control that refuses a program. It may also close the connection.
_READ_ONLY_CODE: Final = 210
_KINEMATICS, _CONFIGURATION = 5, 6
# Layout of the kinematics sub-package: theta, a, d and alpha of all joints, after six checksums.
_KINEMATIC_DATA: Final = struct.Struct(">24x24d")
# Layout of the configuration sub-package: the robot type, after limits, defaults and lengths of the arm.
_ROBOT_TYPE: Final = struct.Struct(">432xi")
_ROBOT_TYPES: Final = MappingProxyType(
    {1: "UR5", 2: "UR10", 3: "UR3", 4: "UR16", 5: "UR18", 6: "UR8long", 7: "UR20", 8: "UR30", 9: "UR15"}
)
_LARGEST: Final = 1 << 20
_RECEIVE_BYTES: Final = 65536


@dataclass(frozen=True, slots=True)
class Started:
    """Message: a program has started on the controller."""

    name: str


@dataclass(frozen=True, slots=True)
class Stopped:
    """Message: a program has ended on the controller."""

    name: str


@dataclass(frozen=True, slots=True)
class Failed:
    """A program does not compile, or has ended with a run-time error."""

    line: int
    column: int
    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """An error code, such as C210A0."""

    code: int
    argument: int
    text: str

    @property
    def is_read_only(self) -> bool:
        """Whether the code means that this connection is read-only."""
        return self.code == _READ_ONLY_CODE


@dataclass(frozen=True, slots=True)
class Note:
    """A text that a program on the controller has sent with `textmsg`."""

    text: str


@dataclass(frozen=True, slots=True)
class RobotType:
    """The model of the arm without its generation; None if its number is unknown."""

    model: str | None


@dataclass(frozen=True, slots=True)
class FactoryKinematics:
    """The measured kinematic parameters of the arm; None if the controller sends impossible values."""

    kinematics: Kinematics | None


Message = Started | Stopped | Failed | Code | Note | RobotType | FactoryKinematics


def take_primary_package(buffer: bytearray) -> tuple[int, bytes] | None:
    """Remove the first package from `buffer` and return (type, payload); return None while it is incomplete.

    Raises `ProtocolError` if the buffer does not begin with a package.
    """
    if len(buffer) < _HEADER.size:
        return None
    size, kind = _HEADER.unpack_from(buffer)
    if not _HEADER.size <= size <= _LARGEST:
        raise ProtocolError(f"primary package of {size} bytes", "check that this is the primary interface of a robot")
    if len(buffer) < size:
        return None
    payload = bytes(buffer[_HEADER.size : size])
    del buffer[:size]
    return kind, payload


def decode(kind: int, payload: bytes) -> Iterator[Message]:
    """Yield the messages of a package that are used here. Truncated or unknown ones are skipped."""
    with suppress(struct.error):
        if kind == _ROBOT_STATE:
            yield from _decode_state(payload)
        elif kind == _ROBOT_MESSAGE:
            _, _, message = _MESSAGE.unpack_from(payload)
            yield from _decode_message(message, payload[_MESSAGE.size :])


def _decode_state(payload: bytes) -> Iterator[Message]:
    rest = bytearray(payload)
    with suppress(ProtocolError):
        while (part := take_primary_package(rest)) is not None:
            kind, content = part
            if kind == _KINEMATICS:
                yield FactoryKinematics(_kinematics(_KINEMATIC_DATA.unpack_from(content)))
            elif kind == _CONFIGURATION:
                yield RobotType(_ROBOT_TYPES.get(_ROBOT_TYPE.unpack_from(content)[0]))


def _kinematics(numbers: Sequence[float]) -> Kinematics | None:
    try:
        return Kinematics.of(numbers)
    except ValueError as error:
        log.warning("the kinematics of the arm cannot be used: %s", error)
        return None


def _decode_message(kind: int, content: bytes) -> Iterator[Message]:
    if kind == _TEXT:
        yield Note(_text(content))
    elif kind == _EXCEPTION:
        line, column = _EXCEPTION_HEAD.unpack_from(content)
        yield Failed(line, column, _text(content[_EXCEPTION_HEAD.size :]))
    elif kind == _ERROR_CODE:
        code, argument, *_ = _CODE_HEAD.unpack_from(content)
        yield Code(code, argument, _text(content[_CODE_HEAD.size :]))
    elif kind == _KEY:
        *_, length = _KEY_HEAD.unpack_from(content)
        title = _text(content[_KEY_HEAD.size : _KEY_HEAD.size + length])
        text = _text(content[_KEY_HEAD.size + length :])
        if title == "PROGRAM_XXX_STARTED":
            yield Started(text)
        elif title == "PROGRAM_XXX_STOPPED":
            yield Stopped(text)


def _text(data: bytes) -> str:
    return data.strip(b"\0").decode("utf-8", "replace")


class Primary:
    """A connection with a time-out for connecting and for each send. Raises `ConnectError` if it fails."""

    def __init__(self, host: str, *, timeout_s: float) -> None:
        self.closed = False
        """Whether the controller has closed the connection, for example because the pendant was switched to local."""
        try:
            self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        except OSError as error:
            raise _unreachable(host, PORT, error) from error
        self._timeout_s = timeout_s
        self._buffer = bytearray()

    def send(self, program: str) -> None:
        """Send a program, which replaces the running one. Raises `OSError` if the connection was lost."""
        self._socket.settimeout(self._timeout_s)
        self._socket.sendall(program.encode("ascii") + b"\n")

    def read(self, timeout_s: float = 0.0) -> list[Message]:
        """Return the messages that have arrived or arrive within `timeout_s`; none if the connection has ended."""
        messages: list[Message] = []
        try:
            self._socket.settimeout(timeout_s)
            while received := self._socket.recv(_RECEIVE_BYTES):
                self._buffer += received
                if len(received) < _RECEIVE_BYTES:
                    break
            self.closed = self.closed or not received
            while (package := take_primary_package(self._buffer)) is not None:
                messages += decode(*package)
        except (BlockingIOError, TimeoutError):
            pass
        except (OSError, ProtocolError) as error:
            log.info("primary interface: %s", error)
            self.closed = True
        return messages

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def read_arm(host: str, *, timeout_s: float, clock: Clock) -> tuple[str | None, Kinematics | None]:
    """Return model, without its generation, and measured kinematics of the arm; None for a missing value.

    Both are part of the first robot state that the controller sends on a connection.
    """
    model, kinematics = None, None
    try:
        primary = Primary(host, timeout_s=timeout_s)
    except ConnectError as error:
        log.info("%s", error)
        return None, None
    try:
        for left_s in clock.looks(timeout_s):
            messages = primary.read(max(min(left_s, clock.poll_s), 1e-3))
            for message in messages:
                if isinstance(message, RobotType):
                    model = message.model
                elif isinstance(message, FactoryKinematics):
                    kinematics = message.kinematics
            if primary.closed or any(isinstance(message, RobotType) for message in messages):
                break
    finally:
        primary.close()
    return model, kinematics


def find_program_port(host: str, port: int, *, timeout_s: float) -> None:
    """Raise `ConnectError` if the port for programs cannot be reached. No program is sent."""
    try:
        socket.create_connection((host, port), timeout=timeout_s).close()
    except OSError as error:
        raise _unreachable(host, port, error) from error


def _unreachable(host: str, port: int, error: OSError) -> ConnectError:
    name = "primary" if port == PORT else "real-time"
    return ConnectError(
        f"{host}:{port}, which accepts programs, cannot be reached ({error})",
        f"enable the {name} client interface under Settings, Security, Services, and check the firewall",
    )
