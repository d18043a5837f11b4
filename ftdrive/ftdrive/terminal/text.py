"""Text before it reaches a screen: what a file, a device or the network names cannot command the terminal."""

import re

import click

_CONTROL = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]|\r(?!\n)"
)
"""All but tab and the end of a line; with those that turn the direction of writing, and bytes that are no text."""


def visible(text: str) -> str:
    r"""Return text with control characters as in a Python string, such as `\x1b`; safe on any screen.

    Examples
    --------
    >>> print(visible("gripper\x1b[2J"))
    gripper\x1b[2J
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape", "surrogatepass").decode(), text)


def echo(text: str = "", *, bold: str = "", err: bool = False, nl: bool = True) -> None:
    """Print text on stdout, or stderr with `err`; `bold` is printed before it."""
    head = click.style(visible(bold), bold=True) if bold else ""
    click.echo(head + visible(text), err=err, nl=nl)
