"""What identifies a network or a person in the files of a run, and its replacement by a placeholder."""

import getpass
import ipaddress
import json
import platform
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from ftcalib.files import JSON, is_changed, object_text, parsed_json
from ftdrive.runs.run import CRC, event_of, with_crc32

_HOME = re.compile(r"(?:/home|/Users|[A-Za-z]:\\Users)[/\\]([^/\\\s\"':;,<>]+)")
_URL_HOST = re.compile(r"\b([a-z][a-z0-9+-]*)://(?:[^/@\s]*@)?([A-Za-z0-9][A-Za-z0-9.-]*)")
_IPV4 = re.compile(r"(?<![\w.])\d{1,3}(?:\.\d{1,3}){3}(?![\w.]\d|\w)")
_IPV6 = re.compile(r"(?<![\w:.])[0-9A-Fa-f]*:[0-9A-Fa-f:]+(?![\w:.])")
_MAC = re.compile(r"(?<![\w:-])(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}(?![\w:-])")
_HOST_FIELD = re.compile(r'"host": ?"([A-Za-z0-9.-]+)"|"said": ?{[^}]*"robot": ?"([A-Za-z0-9.-]+)"')
_NO_NETWORK = ("can", "emulated", "http", "https", "file")
"""Ends of the schemes of addresses whose middle names no host of the cell."""
_NOT_PERSONAL = {"root", "user", "robot", "ur", "admin", "ubuntu", "operator", "localhost"}
"""Names of accounts and hosts that identify nothing; their home directories are redacted."""
_VERSIONS = ("versions", "packages", "firmware")
"""Fields whose four numbers are no address."""
_TEXT_SHARE = 0.9
"""Bytes of which so many are printable are text. Others are measurements, which stay as they are."""
_ON_THE_WIRE = ("hex", "request", "reply")
"""Fields of a transcript: bytes in hex."""


_Instead = Callable[[str, re.Match[str]], str]
"""From the kind of what was found, and its match, to what stands in its place."""


class Redaction:
    """Replaces IP and MAC addresses, host names, user names and home directories; equal ones by equal placeholders.

    Serial numbers and names of serial ports stay, and so do loopback addresses. First `learn` from all texts, because a
    name that one file gives away may stand alone in another.
    """

    def __init__(self) -> None:
        self.placeholders: dict[str, str] = {}
        """From what was redacted to its placeholder: never written to a file."""
        self._names: dict[str, str] = {}
        with suppress(OSError, KeyError):  # a container may have no name for its user
            self._learn_name("user", getpass.getuser())
        self._learn_name("host", platform.node())
        self._home = str(Path.home())

    @property
    def counts(self) -> dict[str, int]:
        """Different values redacted of each kind: ip, mac, host, user, home."""
        kinds = [placeholder.strip("<>").partition("-")[0] for placeholder in self.placeholders.values()]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}

    def learn(self, text: str) -> None:
        """Learn names of hosts and users from a file: from paths, addresses, and the fields that name a host."""
        for value in _strings(text):
            for user in _HOME.findall(value):
                self._learn_name("user", user)
            for scheme, host in _URL_HOST.findall(value):
                if not scheme.endswith(_NO_NETWORK):
                    self._learn_name("host", host)
        for found in _HOST_FIELD.finditer(text):
            self._learn_name("host", found[1] or found[2])

    def file(self, text: str) -> str:
        """Redact a text file: the values of JSON, one document or one a line, and anything else as it stands.

        Checksums that fitted the content fit the redacted content too; others stay, so that damage is still noticed.
        """
        if (document := _document(text)) is not None:
            if isinstance(document, dict) and "checksum" in document and not is_changed(document):
                return object_text(self.json(document), allow_nan=True)
            return json.dumps(self.json(document), indent=1) + "\n"
        lines = [self._line(line) for line in text.splitlines()]
        return "\n".join(lines) + ("\n" if text.endswith("\n") else "")

    def _line(self, line: str) -> str:
        document = _document(line)
        if document is None:
            return self.text(line)
        if isinstance(document, dict) and CRC in document and (event := event_of(line)) is not None:
            return json.dumps(with_crc32(self.json(event)))
        return json.dumps(self.json(document))

    def json(self, value: JSON, key: str = "") -> JSON:
        """Redact all texts in a value of JSON; its keys stay."""
        if key in _VERSIONS:
            return value
        if isinstance(value, dict):
            return {name: self.json(one, name) for name, one in value.items()}
        if isinstance(value, list):
            return [self.json(one) for one in value]
        if not isinstance(value, str):
            return value
        return self._wire(value) if key in _ON_THE_WIRE else self.text(value)

    def text(self, text: str) -> str:
        """Redact one text."""
        return self._redacted(text, self._placeholder)

    def _redacted(self, text: str, instead: _Instead) -> str:
        text = _HOME.sub(partial(instead, "home"), text)
        if len(self._home) > 1:
            text = re.sub(rf"{re.escape(self._home)}(?![\w.-])", partial(instead, "home"), text)
        text = _MAC.sub(partial(instead, "mac"), text)
        for pattern in (_IPV4, _IPV6):
            text = pattern.sub(lambda found: instead("ip", found) if _is_address(found[0]) else found[0], text)
        for name, kind in sorted(self._names.items(), key=lambda item: -len(item[0])):
            text = re.sub(rf"(?<![\w<-]){re.escape(name)}(?![\w>-])", partial(instead, kind), text)
        return text

    def _wire(self, text: str) -> str:
        """Mask what bytes in hex spell, where they are text; their number stays, because lengths were sent too."""
        try:
            sent = bytes.fromhex(text)
        except ValueError:
            return self.text(text)
        if sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in sent) < _TEXT_SHARE * len(sent):
            return text
        return self._redacted(sent.decode("latin-1"), self._mask).encode("latin-1").hex()

    def _mask(self, kind: str, found: re.Match[str]) -> str:
        self._placeholder(kind, found)
        return "x" * len(found[0])

    def _learn_name(self, kind: str, name: str) -> None:
        try:
            ipaddress.ip_address(name)
        except ValueError:
            if len(name) > 1 and name.lower() not in _NOT_PERSONAL:
                self._names.setdefault(name, kind)
                if kind == "host" and "." in name:
                    self._learn_name(kind, name.partition(".")[0])

    def _placeholder(self, kind: str, found: re.Match[str]) -> str:
        if found[0] not in self.placeholders:
            number = 1 + sum(one.startswith(f"<{kind}-") for one in self.placeholders.values())
            self.placeholders[found[0]] = f"<{kind}-{number}>"
        return self.placeholders[found[0]]


def _is_address(text: str) -> bool:
    """Check for an IP address that other computers can reach."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return False
    return not address.is_loopback and not address.is_unspecified


def _document(text: str) -> JSON | None:
    """Parse an object or a list of JSON; None for anything else."""
    try:
        document = parsed_json(text)
    except ValueError:
        return None
    return document if isinstance(document, (dict, list)) else None


def _strings(text: str) -> Iterator[str]:
    """Yield the texts of a file: those in its JSON without escapes, and lines that are none."""
    documents = [text] if _document(text) is not None else text.splitlines()
    for part in documents:
        document = _document(part)
        yield from [part] if document is None else _values(document)


def _values(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _values(one)
