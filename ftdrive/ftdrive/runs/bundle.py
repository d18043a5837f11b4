"""A bundle: a run folder as one zip file without addresses or names, which `replay` and `solve` can read.

bundle.json         ftdrive.bundle/1: name of the run, whether it is emulated, what was redacted, what was left out
environment.json    versions of all packages, and checks of the computer without devices
sensor.json         the sensor matrices in the current folder; transcripts/... of `ftdrive transcript record`: redacted
<run>/...           the files of the run folder; text files are redacted, poses are copied byte by byte
"""

import getpass
import io
import ipaddress
import json
import os
import platform
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import UTC, datetime
from errno import EINVAL
from functools import partial
from importlib.metadata import distributions
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, Final

from ftcalib.errors import BadDataset, UsageError
from ftcalib.files import (
    JSON,
    check_format,
    is_changed,
    object_text,
    open_file,
    parsed_json,
    read_file,
    read_object,
    write_new,
)
from ftcalib.files import MOST_BYTES as _MOST_IN_MEMORY
from ftdrive.cell.config import recorded_cell
from ftdrive.checks.computer import SensorAddress, can_interfaces, check_disk, check_permissions, check_workcell
from ftdrive.errors import BadBundle
from ftdrive.runs import is_run
from ftdrive.runs.calibration import sensor_files, versions
from ftdrive.runs.numbers import CRC, ZIP_DAMAGE, line_with_crc, parse_line
from ftdrive.runs.run import LOCK, Run

_HOME = re.compile(r"(?:/home|/Users|[A-Za-z]:\\Users)[/\\]([^/\\\s\"':;,<>]+)")
_URL_HOST = re.compile(r"\b([a-z][a-z0-9+-]*)://(?:[^/@\s]*@)?([A-Za-z0-9][A-Za-z0-9.-]*)")
_IPV4 = re.compile(r"(?<![\w.])\d{1,3}(?:\.\d{1,3}){3}(?![\w.]\d|\w)")
_IPV6 = re.compile(r"(?<![\w:.])[0-9A-Fa-f]*:[0-9A-Fa-f:]+(?![\w:.])")
_MAC = re.compile(r"(?<![\w:-])(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}(?![\w:-])")
_HOST_FIELD = re.compile(r'"host": ?"([A-Za-z0-9.-]+)"|"said": ?{[^}]*"robot": ?"([A-Za-z0-9.-]+)"')
# Schemes with these endings have no host of the cell in their URLs, so its name is not redacted.
_NO_NETWORK = ("can", "emulated", "http", "https", "file")
# Names of accounts and hosts that identify no person, so they are kept; home directories with them are redacted.
_NOT_PERSONAL = {"root", "user", "robot", "ur", "admin", "ubuntu", "operator", "localhost"}
# Fields of JSON files that are not redacted, because four numbers separated by dots are versions there.
_VERSIONS = ("versions", "packages", "firmware")
# Bytes of a transcript are text if at least this share is printable. Others are measurements, which stay unchanged.
_TEXT_SHARE = 0.9
# Fields of a transcript that contain bytes to or from a sensor, in hexadecimal form.
_ON_THE_WIRE = ("hex", "request", "reply")


# Function that returns the replacement for a match of a kind such as "ip".
_Instead = Callable[[str, re.Match[str]], str]


class Redaction:
    """Replaces IP and MAC addresses, host names, user names and home directories with placeholders.

    Equal values get equal placeholders. Serial numbers, names of serial ports and loopback addresses are kept. Call
    `learn` with all texts first, because a name that one file reveals may appear without context in another.
    """

    def __init__(self) -> None:
        self.placeholders: dict[str, str] = {}
        """Placeholder of each redacted value; never written to a file."""
        self._names: dict[str, str] = {}
        # ignore errors, because the user of a container may have no name
        with suppress(OSError, KeyError):
            self._learn_name("user", getpass.getuser())
        self._learn_name("host", platform.node())
        self._home = str(Path.home())

    @property
    def counts(self) -> dict[str, int]:
        """Number of different redacted values by kind: ip, mac, host, user, home."""
        kinds = [placeholder.strip("<>").partition("-")[0] for placeholder in self.placeholders.values()]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}

    def learn(self, text: str) -> None:
        """Collect the names of hosts and users that occur in the paths, URLs and host fields of a file's text."""
        for value in _texts_of_file(text):
            for user in _HOME.findall(value):
                self._learn_name("user", user)
            for scheme, host in _URL_HOST.findall(value):
                if not scheme.endswith(_NO_NETWORK):
                    self._learn_name("host", host)
        for found in _HOST_FIELD.finditer(text):
            self._learn_name("host", found[1] or found[2])

    def file(self, text: str) -> str:
        """Return the text of a file with redacted values if it is JSON or JSON lines, else with all text redacted.

        Checksums that were valid are computed again; others stay invalid, so that damage is still detected.
        """
        if (document := _parse_document(text)) is not None:
            if isinstance(document, dict) and "checksum" in document and not is_changed(document):
                return object_text(self.json(document), allow_nan=True)
            return json.dumps(self.json(document), indent=1) + "\n"
        return "\n".join(map(self._line, text.splitlines())) + ("\n" if text.endswith("\n") else "")

    def _line(self, line: str) -> str:
        document = _parse_document(line)
        if document is None:
            return self.text(line)
        if isinstance(document, dict) and CRC in document and (event := parse_line(line)) is not None:
            return line_with_crc(self.json(event))
        return json.dumps(self.json(document))

    def json(self, value: JSON, key: str = "") -> JSON:
        """Return a JSON value with its strings redacted, but not its keys; `key` is the field that contains it."""
        # Parsed values are redacted, because escape sequences of JSON could hide a name.
        if key in _VERSIONS:
            return value
        if isinstance(value, dict):
            return {name: self.json(item, name) for name, item in value.items()}
        if isinstance(value, list):
            return [self.json(item) for item in value]
        if not isinstance(value, str):
            return value
        return self._wire(value) if key in _ON_THE_WIRE else self.text(value)

    def text(self, text: str) -> str:
        """Return a string in which addresses and names are replaced by placeholders."""
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
        """Redact hexadecimal bytes if they are text: each address or name becomes as many letters x."""
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
            number = 1 + sum(placeholder.startswith(f"<{kind}-") for placeholder in self.placeholders.values())
            self.placeholders[found[0]] = f"<{kind}-{number}>"
        return self.placeholders[found[0]]


def _is_address(text: str) -> bool:
    """Return whether a text is an IP address, except a loopback address or 0.0.0.0."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return False
    return not address.is_loopback and not address.is_unspecified


def _parse_document(text: str) -> JSON | None:
    """Return the JSON object or list in a text; None for any other text."""
    try:
        document = parsed_json(text)
    except ValueError:
        return None
    return document if isinstance(document, (dict, list)) else None


def _texts_of_file(text: str) -> Iterator[str]:
    """Yield the string values in a file's JSON, with escape sequences decoded, and its lines that are not JSON."""
    for part in [text] if _parse_document(text) is not None else text.splitlines():
        document = _parse_document(part)
        yield from [part] if document is None else _values(document)


def _values(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _values(item)


FORMAT: Final = "ftdrive.bundle/1"
# Largest total size of an unpacked bundle, bytes. One hour of samples at 7 kHz takes 3 GB.
MOST_BYTES: Final = 4_000_000_000
MOST_FILES: Final = 20_000
_COPY_AGAIN: Final = "copy the bundle again, or ask for a new one"


def write_bundle(folder: Path, path: Path, transcripts: Sequence[Path] = ()) -> tuple[dict[str, int], list[str]]:
    """Write a run folder, transcripts and the sensor matrices to a new zip file, completely or not at all.

    Returns the number of different redacted values by kind, and the files that are neither text nor poses, which are
    left out because they cannot be redacted. Raises `BadDataset` if the folder is not a run folder, and `OSError` if
    `path` exists or cannot be written.
    """
    folder = folder.resolve()
    if not is_run(folder):
        raise BadDataset(f"{folder} is not a run folder: it has no run.json")
    redaction, left_out = Redaction(), []
    texts = {"environment.json": json.dumps(_environment(folder))}
    poses: dict[str, bytes] = {}
    members = (path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    for file in sorted(path for path in members if path.name != LOCK):
        name = file.relative_to(folder.parent).as_posix()
        # Reading a pipe may never end, and large files do not fit into memory.
        is_readable = file.is_file() and not file.is_symlink() and file.stat().st_size <= _MOST_IN_MEMORY
        content = read_file(file) if is_readable else None
        if content is not None and file.suffix == ".npz":
            poses[name] = content
        elif content is not None and (text := _decode_text(content)) is not None:
            texts[name] = text
        else:
            left_out.append(file.relative_to(folder).as_posix())
    for number, file in enumerate(transcripts, 1):
        if (text := _decode_text(read_file(file))) is None:
            raise BadBundle(f"{file} is not a text file: give a file written by `ftdrive transcript record`")
        texts[f"transcripts/{number}-{file.name}"] = text
    for file in sensor_files():
        if (text := _decode_text(read_file(file))) is not None:
            texts[file.name] = text
    for text in texts.values():
        redaction.learn(text)
    clean = {name: redaction.file(text) for name, text in texts.items()}
    emulated = None
    with suppress(BadDataset):  # because damaged runs are bundled too
        emulated = Run(folder).header().get("station") is not None
    about = {
        "format": FORMAT,
        "created_utc": datetime.now(UTC).isoformat(),
        "run": folder.name,
        "emulated": emulated,
        "redacted": redaction.counts,
        "left_out": left_out,
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bundle.json", json.dumps(about, indent=1))
        for name, text in clean.items():
            archive.writestr(name, text)
        for name, content in poses.items():  # already compressed
            archive.writestr(name, content, zipfile.ZIP_STORED)
    write_new(path, buffer.getvalue())
    return redaction.counts, left_out


@contextmanager
def unpack(source: Path) -> Iterator[Path]:
    """Yield the run folder in a bundle, unpacked until the block ends; for another source, yield it unchanged.

    Raises
    ------
    BadBundle
        The zip file is damaged, is not a bundle, is too large, or contains paths that lead out of its folder.
    """
    if source.suffix.lower() != ".zip" or source.is_dir():
        yield source
        return
    with TemporaryDirectory(prefix="ftdrive-") as folder:
        yield _extract(source, Path(folder))


def _extract(source: Path, folder: Path) -> Path:
    if (size := source.stat().st_size) > MOST_BYTES:
        raise BadBundle(f"{source} has {size / 1e9:.0f} GB, above the limit of {MOST_BYTES / 1e9:g} GB: check the name")
    try:
        with open_file(source) as file, zipfile.ZipFile(file) as archive:
            _require_harmless(archive.infolist())
            archive.extractall(folder)
        return _run_in(folder)
    except BadBundle as error:
        raise BadBundle(f"{source}: {error}") from error
    except FileNotFoundError as error:
        raise BadBundle(f"{source} is not a bundle, because it has no bundle.json: {_COPY_AGAIN}") from error
    except (*ZIP_DAMAGE, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, EINVAL):  # such as for a full disk
            raise
        raise BadBundle(f"{source} is not a zip file or is damaged ({error}): {_COPY_AGAIN}") from error


def _run_in(folder: Path) -> Path:
    about = read_object(folder / "bundle.json", BadBundle)
    check_format(about, FORMAT, BadBundle)
    run = folder / str(about.get("run"))
    if run.parent != folder or not is_run(run):
        raise BadBundle(f"it has no run {about.get('run')!r}: {_COPY_AGAIN}")
    return run


def _require_harmless(members: Sequence[zipfile.ZipInfo]) -> None:
    """Raise `BadBundle` for dangerous names or stated sizes of files; `zipfile` never unpacks more than is stated."""
    if len(members) > MOST_FILES or sum(member.file_size for member in members) > MOST_BYTES:
        limits = f"{MOST_BYTES / 1e9:g} GB or {MOST_FILES} files"
        raise BadBundle(f"its unpacked content exceeds {limits}: do not use this file, or unpack it by hand")
    for member in members:
        path = PurePosixPath(member.filename)
        if path.is_absolute() or ".." in path.parts or "\\" in member.filename or ":" in member.filename:
            raise BadBundle(f"the name {member.filename!r} leads out of its folder: do not use this file")
    if len({member.filename for member in members}) < len(members):
        raise BadBundle(f"two files have the same name: {_COPY_AGAIN}")


def _decode_text(content: bytes) -> str | None:
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def _environment(folder: Path) -> dict[str, Any]:
    """Return the content of environment.json: versions, and checks of this computer and the run's configuration."""
    packages = {about["Name"]: about["Version"] for about in (each.metadata for each in distributions())}
    facts: dict[str, Any] = {
        "versions": versions(),
        "packages": dict(sorted(packages.items(), key=lambda item: item[0].lower())),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "can_interfaces": can_interfaces(),
    }
    try:
        cell = recorded_cell(Run(folder).header()["config"])
        checks = [check_disk(folder), check_workcell(cell, cell.robot.model)]
        checks += check_permissions(SensorAddress.of(cell.sensor.url))
    # no error, because damaged runs are bundled too
    except (BadDataset, UsageError, TypeError) as error:
        return facts | {"error": str(error)}
    return facts | {"checks": [asdict(check) for check in checks]}
