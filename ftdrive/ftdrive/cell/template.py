"""A configuration as a TOML file with comments: of `ftdrive init` and of `ftdrive config show`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from inspect import getdoc
from itertools import groupby
from textwrap import wrap
from typing import Any

from ftdrive.cell.config import FORMAT, RULES, SECTIONS, CellConfig, as_toml

# Longest line of a file.
WIDTH = 120


def cell_file(cell: CellConfig, found: Sequence[str]) -> str:
    """Return a cell as a file; `workcell.measured` is false in it, whatever the cell has.

    Parameters
    ----------
    cell : CellConfig
        Keys that `init` does not ask for are commented out, so that the user's file still counts.
    found : sequence of str
        What the devices report about themselves.
    """
    values = {f"{section}.{key}": value for section, keys in cell.to_dict().items() for key, value in keys.items()}
    values["workcell.measured"] = False
    asked = {key for key, rule in RULES.items() if rule.option} | {"workcell.measured"}
    asked |= {"robot.simulate"} if cell.robot.simulate else set()
    lines = [
        *(f"# {''.join(c if c.isprintable() else '?' for c in words)}" for words in found),
        "# To print the values in force and their origins: ftdrive config show --origin",
    ]
    return document(values, lambda key: RULES[key].description, head=["", *lines], active=lambda key: key in asked)


def document(
    values: Mapping[str, Any],
    comment: Callable[[str], str],
    *,
    head: Sequence[str] = (),
    active: Callable[[str], bool] = lambda _: True,
    width: int = WIDTH,
) -> str:
    """Return values by key, such as "robot.host", as a file; those that are None or not active are commented out."""
    lines = [f'format = "{FORMAT}"', *head]
    for section, keys in groupby(values, lambda key: key.split(".")[0]):
        about = wrap(getdoc(SECTIONS[section]) or "", width - 2)
        lines += ["", *(f"# {part}" for part in about), f"[{section}]"]
        for key in keys:
            lines += _entry(key.split(".")[1], values[key], comment(key), active(key), width)
    return "".join(f"{line}\n" for line in lines)


def _entry(name: str, value: Any, comment: str, active: bool, width: int) -> Iterator[str]:
    """Yield the lines of one value: its comment behind it where there is room, else above it."""
    text = f"{name} =" if value is None else f"{name} = {as_toml(value)}"
    line = f"{text if active and value is not None else f'# {text}':<32} # {comment}".removesuffix(" # ").rstrip()
    if len(line) <= width:
        yield line
        return
    yield from (f"# {part}" for part in wrap(comment, width - 2))
    if len(text) > width and isinstance(value, tuple | list):
        yield from (f"{name} = [", *(f"  {as_toml(row)}," for row in value), "]")
    else:
        yield line.removesuffix(f" # {comment}").rstrip()
