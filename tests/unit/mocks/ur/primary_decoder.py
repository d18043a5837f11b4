"""A second decoder of the primary interface, written by hand from the documented layout."""

import struct
from typing import Any


class Reader:
    """Takes big-endian numbers and texts from bytes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def take(self, layout: str) -> Any:
        """One number, or several as a list."""
        size = struct.calcsize(f">{layout}")
        values = list(struct.unpack(f">{layout}", self.data[:size]))
        self.data = self.data[size:]
        return values[0] if len(values) == 1 else values

    def text(self, size: int | None = None) -> str:
        found, self.data = self.data[:size], b"" if size is None else self.data[size:]
        return found.decode("latin-1")


def packages(stream: bytes) -> tuple[list[bytes], bytes]:
    """Whole packages at the start of a stream, and the rest."""
    found = []
    while len(stream) >= 4 and len(stream) >= (size := int.from_bytes(stream[:4], "big")):
        assert size >= 5
        found.append(stream[:size])
        stream = stream[size:]
    return found, stream


def decoded(package: bytes) -> dict[str, Any]:
    """One package by the names of its fields; every byte of it must have a meaning."""
    reader = Reader(package)
    size, kind = reader.take("iB")
    assert size == len(package)
    if kind == 16:
        return {"type": "state"} | _state(reader)
    if kind == 24:
        return {"type": "tolerances", "values": reader.take("22d")}
    assert kind == 20
    timestamp, source, message = reader.take("QbB")
    fields = _MESSAGES[message](reader)
    assert reader.data == b""
    return {"timestamp": timestamp, "source": source} | fields


def _version(reader: Reader) -> dict[str, Any]:
    project = reader.text(reader.take("B"))
    return {"type": "version", "project": project, "version": reader.take("BBi"), "build": reader.take("i")} | {
        "date": reader.text()
    }


def _unexplained(reader: Reader) -> dict[str, Any]:
    return {"type": "unexplained", "values": reader.take("iiB")}


def _key(reader: Reader) -> dict[str, Any]:
    codes = reader.take("ii")
    return {"type": "key", "codes": codes, "title": reader.text(reader.take("B")), "text": reader.text()}


def _exception(reader: Reader) -> dict[str, Any]:
    return {"type": "exception", "place": tuple(reader.take("ii")), "text": reader.text()}


def _error(reader: Reader) -> dict[str, Any]:
    code, argument, level, _kind, _data = reader.take("iiiII")
    return {"type": "error", "code": code, "argument": argument, "level": level, "text": reader.text()}


def _safety(reader: Reader) -> dict[str, Any]:
    _code, _argument, mode, _kind, _data = reader.take("iiBII")
    return {"type": "safety", "mode": mode}


_MESSAGES = {
    0: lambda reader: {"type": "text", "text": reader.text()},
    3: _version,
    5: _safety,
    6: _error,
    7: _key,
    10: _exception,
    12: _unexplained,
}


def _state(reader: Reader) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    while reader.data:
        size, kind = reader.take("IB")
        part = Reader(reader.data[: size - 5])
        reader.data = reader.data[size - 5 :]
        if kind not in _PARTS:
            parts.setdefault("others", {})[kind] = len(part.data)
            continue
        name, decode = _PARTS[kind]
        parts[name] = decode(part)
        assert part.data == b"", name
    return parts


def _mode(part: Reader) -> dict[str, Any]:
    flags = ("connected", "enabled", "power_on", "emergency", "protective", "running", "paused")
    names = (*flags, "robot_mode", "control")
    fields = {"timestamp": part.take("Q")} | dict(zip(names, part.take("7BbB"), strict=True))
    return fields | dict(zip(("fraction", "scaling", "limit", "reserved"), part.take("3dB"), strict=True))


def _joints(part: Reader) -> list[dict[str, Any]]:
    names = ("actual", "target", "speed", "current", "voltage", "motor", "micro", "mode")
    return [dict(zip(names, part.take("3d4fB"), strict=True)) for _ in range(6)]


def _kinematics(part: Reader) -> dict[str, Any]:
    fields = {"checksum": part.take("6I")}
    return fields | {name: part.take("6d") for name in ("theta", "a", "d", "alpha")} | {"status": part.take("I")}


def _configuration(part: Reader) -> dict[str, Any]:
    fields = {"limits": part.take("12d"), "motion": part.take("12d"), "defaults": part.take("5d")}
    fields |= {name: part.take("6d") for name in ("a", "d", "alpha", "theta")}
    return fields | dict(zip(("masterboard", "box", "robot_type", "sub_type"), part.take("4i"), strict=True))


_PARTS = {
    0: ("mode", _mode),
    1: ("joints", _joints),
    4: ("cartesian", lambda part: part.take("12d")),
    5: ("kinematics", _kinematics),
    6: ("configuration", _configuration),
}
