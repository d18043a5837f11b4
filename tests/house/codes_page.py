"""Write `docs/reference/finding-codes.md` from the table of codes: `uv run python tests/house/codes_page.py`."""

import re
from collections.abc import Iterator
from pathlib import Path

from ftcalib.findings import CODES

PAGE = Path(__file__).parents[2] / "docs/reference/finding-codes.md"

_HEAD = """\
# Finding codes

A finding is a code, a severity and values: `result.findings` in Python, `findings` in a calibration file and with
`--json`, where `words` has the sentence. `hints` of `calibrate`, `solve` and `report` are findings about single poses.
The worst severity gives the verdict:

| severity | verdict |
|---|---|
| `reject` | rejected |
| `limit` | usable at best |
| `note` | not affected |

Findings are ordered as in this table, notes last: a cause stands before its consequences, so fix the first one first.
[Methods](../explanation/methods.md#mistakes-in-the-data) explains how they are found.
Values are shown by their names, which end with their units. An unknown value is null.

| code | severity | found | fix |
|---|---|---|---|"""

_END = """
This page is generated: run `uv run python tests/house/codes_page.py` after a change of `ftcalib.findings.CODES`.
"""


def page() -> str:
    """Return the page in Markdown."""
    return "\n".join([_HEAD, *_rows(), _END])


def _rows() -> Iterator[str]:
    for name, code in CODES.items():
        severities = " or ".join(f"`{one}`" for one in code.severities)
        yield f"| `{name}` | {severities} | {_with_names(code.found)} | {_with_names(code.fix)} |"


def _with_names(template: str) -> str:
    """Write the values as their names; of a text that depends on a value, what stands there if it is known."""
    text = re.sub(r"\{\w+:\?([^|}]*)\|[^}]*\}", r"\1", template)
    text = re.sub(r"\{(\w+):units\}", r", as with `\1`", text)
    return re.sub(r"\{(\w+)(?::[^}]*)?\}", r"`\1`", text)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
