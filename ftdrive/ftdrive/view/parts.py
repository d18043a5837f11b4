"""Parts of a page as plain values, which `shell/page.js` draws. Every text is shown as text, never as HTML."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

Part = dict[str, Any]
"""A part of a page: its `kind`, and values that JSON can have."""

BAD: Final = "bad"
WARN: Final = "warn"
GOOD: Final = "good"
ASK: Final = "ask"
QUIET: Final = "quiet"


def lines(*texts: str, head: str = "", tone: str = "") -> Part:
    """Texts below each other, with a heading; a tone colours them."""
    return {"kind": "lines", "head": head, "lines": [text for text in texts if text], "tone": tone}


def reading(
    label: str, value: str, unit: str, *, sigma: str = "", note: str = "", size: str = "", tone: str = ""
) -> Part:
    """One measured value in `numbers`, of size `huge`, `large` or the usual one; `sigma` stands behind the value."""
    return {"label": label, "value": value, "unit": unit, "sigma": sigma, "note": note, "size": size, "tone": tone}


def readings(*rows: Part, head: str = "") -> Part:
    """Values that are read from afar, made by `number`."""
    return {"kind": "numbers", "head": head, "rows": list(rows)}


def text_table(rows: Iterable[Sequence[str]], columns: Sequence[str] = (), head: str = "") -> Part:
    """Rows of texts; a text with newlines has several lines."""
    return {"kind": "table", "head": head, "columns": list(columns), "rows": [list(row) for row in rows]}


def bar(label: str, value: float, limit: float, text: str, *, signed: bool = True, tone: str = "") -> Part:
    """One value in `bars`, drawn from zero towards its limit: in the middle if it is `signed`, else at the left."""
    share = float(np.clip(np.nan_to_num(value / limit), -1, 1)) if limit > 0 else 0.0
    return {"label": label, "share": round(share, 3), "text": text, "signed": signed, "tone": tone}


def bars(*rows: Part, head: str = "") -> Part:
    """Values beside their limits, made by `bar`."""
    return {"kind": "bars", "head": head, "rows": list(rows)}


def controls(*found: Part, head: str = "", note: str = "") -> Part:
    """Buttons and fields, made by the functions below."""
    return {"kind": "controls", "head": head, "note": note, "controls": list(found)}


def button(name: str, label: str, *, key: str = "", tone: str = "", disabled: bool = False) -> Part:
    """A button; `key` is that of the terminal for the same."""
    return {"name": name, "type": "button", "label": label, "key": key, "tone": tone, "disabled": disabled}


def text_field(name: str, label: str, value: str, **more: Any) -> Part:
    """A line to type; `more` are `words` below it with a `tone`, and `disabled`, as for the fields below."""
    return {"name": name, "type": "text", "label": label, "value": value, **more}


def choice(name: str, label: str, value: str, options: Iterable[str], **more: Any) -> Part:
    """One of some texts."""
    return {"name": name, "type": "select", "label": label, "value": value, "options": list(options), **more}


def check_box(name: str, label: str, *, value: bool) -> Part:
    """A check box."""
    return {"name": name, "type": "check", "label": label, "value": value}


def slider(name: str, label: str, value: float, most: float, *, step: float = 1.0, text: str = "") -> Part:
    """A slider from 0 to `most`; `text` says its value in words."""
    return {"name": name, "type": "range", "label": label, "value": value, "max": most, "step": step, "text": text}


def rounded_list(values: ArrayLike, digits: int = 5) -> Any:
    """Return an array as nested lists with so many significant digits; what is not finite becomes None."""
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(all="ignore"):
        size = 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(np.where(array == 0, 1.0, array)))))
        rounded = np.round(array * size) / size
    short = np.asarray(rounded, dtype=object)
    short[~np.isfinite(rounded)] = None
    return short.tolist()
