"""Parts of a page as plain values, which `shell/page.js` draws. All text is shown as text, never as HTML."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

Part = dict[str, Any]
"""A part of a page as JSON: its `kind`, and the values that this kind of part needs."""

BAD: Final = "bad"
WARN: Final = "warn"
GOOD: Final = "good"
ASK: Final = "ask"
QUIET: Final = "quiet"


def lines(*texts: str, head: str = "", tone: str = "") -> Part:
    """Return a part with a heading and lines of text, in the colour of the `tone`, such as `BAD`."""
    return {"kind": "lines", "head": head, "lines": [text for text in texts if text], "tone": tone}


def reading(
    label: str, value: str, unit: str, *, sigma: str = "", note: str = "", size: str = "", tone: str = ""
) -> Part:
    """Return a measured value for `readings`; `size` is "huge", "large" or "", and `sigma` is shown after the value."""
    return {"label": label, "value": value, "unit": unit, "sigma": sigma, "note": note, "size": size, "tone": tone}


def readings(*rows: Part, head: str = "") -> Part:
    """Return a part with measured values, each made by `reading`."""
    return {"kind": "numbers", "head": head, "rows": list(rows)}


def text_table(rows: Iterable[Sequence[str]], columns: Sequence[str] = (), head: str = "") -> Part:
    """Return a part with a table of texts; a text with newlines has several lines."""
    return {"kind": "table", "head": head, "columns": list(columns), "rows": [list(row) for row in rows]}


def bar(label: str, value: float, limit: float, text: str, *, signed: bool = True, tone: str = "") -> Part:
    """Return a value for `bars`: a bar from zero towards a limit; zero is in the middle if `signed`, else left."""
    share = float(np.clip(np.nan_to_num(value / limit), -1, 1)) if limit > 0 else 0.0
    return {"label": label, "share": round(share, 3), "text": text, "signed": signed, "tone": tone}


def bars(*rows: Part, head: str = "") -> Part:
    """Return a part with bars, each made by `bar`."""
    return {"kind": "bars", "head": head, "rows": list(rows)}


def controls(*found: Part, head: str = "", note: str = "") -> Part:
    """Return a part with controls: buttons, fields, lists, check boxes and sliders, made by the functions below."""
    return {"kind": "controls", "head": head, "note": note, "controls": list(found)}


def button(name: str, label: str, *, key: str = "", tone: str = "", disabled: bool = False) -> Part:
    """Return a button for `controls`; `key` is the key for the same action in the terminal."""
    return {"name": name, "type": "button", "label": label, "key": key, "tone": tone, "disabled": disabled}


def text_field(name: str, label: str, value: str, **more: Any) -> Part:
    """Return a text field for `controls`; `more` may be `words` below the field, their `tone`, and `disabled`."""
    return {"name": name, "type": "text", "label": label, "value": value, **more}


def choice(name: str, label: str, value: str, options: Iterable[str], **more: Any) -> Part:
    """Return a drop-down list of texts for `controls`; `more` as for `text_field`."""
    return {"name": name, "type": "select", "label": label, "value": value, "options": list(options), **more}


def check_box(name: str, label: str, *, value: bool) -> Part:
    """Return a check box for `controls`."""
    return {"name": name, "type": "check", "label": label, "value": value}


def slider(name: str, label: str, value: float, most: float, *, step: float = 1.0, text: str = "") -> Part:
    """Return a slider from 0 to `most` for `controls`; `text` states its value in words."""
    return {"name": name, "type": "range", "label": label, "value": value, "max": most, "step": step, "text": text}


def rounded_list(values: ArrayLike, digits: int = 5) -> Any:
    """Return an array as nested lists with `digits` significant digits; values that are not finite become None."""
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(all="ignore"):
        size = 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(np.where(array == 0, 1.0, array)))))
        rounded = np.round(array * size) / size
    short = np.asarray(rounded, dtype=object)
    short[~np.isfinite(rounded)] = None
    return short.tolist()
