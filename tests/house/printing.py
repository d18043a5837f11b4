"""Calls that print without `ftdrive.terminal.text.visible`, by which a file or a device could command the terminal."""

import ast
import re
from pathlib import Path

PRINTING = re.compile("print|Console|click|StreamHandler|stdout|stderr")
"""No hit is without one of these."""
SAFE = {"visible", "in_whole_words"}
HOME = {"text.py", "console.py"}
"""They make text visible."""


def is_hit(node: ast.AST) -> bool:
    """Recognise a call that prints, unless what it prints is the result of a safe function."""
    match node:
        case ast.Call(args=[ast.Call(func=ast.Name(id=name)), *_]) if name in SAFE:
            return False
        # By default it escapes all but printable ASCII.
        case ast.Call(args=[ast.Call(func=ast.Attribute(value=ast.Name(id="json"), attr="dumps"), keywords=[]), *_]):
            return False
        case ast.Call(func=ast.Name(id="print" | "Console")):
            return True
        case ast.Call(func=ast.Attribute(value=ast.Name(id="click"), attr="echo" | "secho" | "prompt" | "confirm")):
            return True
        case ast.Call(func=ast.Attribute(value=ast.Name(id="logging"), attr="StreamHandler")):
            return True
        case ast.Call(func=ast.Attribute(value=ast.Attribute(attr=stream), attr="write" | "writelines")):
            return stream.lstrip("_") in {"stdout", "stderr"}
    return False


def prints_in(folder: Path) -> list[str]:
    """Return the place of each, `file:line`."""
    return [
        f"{path}:{node.lineno}"
        for path in sorted(folder.rglob("*.py"))
        if path.parent.name != "terminal" or path.name not in HOME
        if PRINTING.search(text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and is_hit(node)
    ]
