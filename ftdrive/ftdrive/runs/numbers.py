"""Array files and JSON lines in a run; each array and each line has a checksum."""

import io
import json
import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any, Final

from ftcalib.files import MOST_BYTES, parsed_json, read_file, write_new

# Errors of `zipfile` for a damaged file, besides OSError. Damage that looks like encryption gives RuntimeError.
ZIP_DAMAGE: Final = (
    *(EOFError, MemoryError, OverflowError, RuntimeError, ValueError),
    *(lzma.LZMAError, struct.error, zipfile.BadZipFile, zlib.error),
)
# Errors that `read_arrays` raises for a damaged file; TokenError is from numpy's parser of the header.
DAMAGE: Final = (*ZIP_DAMAGE, KeyError, OSError, TypeError, tokenize.TokenError)
# Name of the field with the checksum of a JSON line: the CRC-32 of its other fields as JSON with sorted keys.
CRC: Final = "crc32"


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool) -> None:
    """Write named arrays to a new .npz file; return once it is on disk."""
    import numpy as np

    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    write_new(path, buffer.getvalue())


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the named arrays in an .npz file. Raises one of the errors in `DAMAGE` if it is damaged."""
    import numpy as np

    with zipfile.ZipFile(io.BytesIO(read_file(path))) as file:
        if (size := sum(member.file_size for member in file.infolist())) > MOST_BYTES:
            raise ValueError(f"its unpacked size is {size / 1e6:.0f} MB, above {MOST_BYTES / 1e6:.0f} MB")
        # `ZipFile.read` reads to the end of each array, where its CRC-32 is checked; `numpy.load` may stop before.
        return {
            name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(file.read(name)), allow_pickle=False)
            for name in file.namelist()
        }


def parse_line(line: str) -> dict[str, Any] | None:
    """Return the object in a line made by `line_with_crc`; None if the line is damaged."""
    try:
        content = parsed_json(line)
    except ValueError:
        return None
    if not isinstance(content, dict):
        return None
    return content if content.pop(CRC, None) == _crc32(content) else None


def line_with_crc(content: Mapping[str, Any]) -> str:
    """Return an object as a JSON line with its CRC-32, without a newline."""
    return json.dumps({**content, CRC: _crc32(content)})


def append_lines(file: FileIO, begin: int, objects: Sequence[Mapping[str, Any]]) -> None:
    """Append objects as lines to an unbuffered file of size `begin`. If an `OSError` is raised, none is in the file."""
    content = "".join(line_with_crc(item) + "\n" for item in objects).encode()
    try:
        while content:
            content = content[file.write(content) :]
    except OSError:
        # an incomplete line would make the next appended line unreadable
        file.truncate(begin)
        raise


def _crc32(content: Mapping[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"
