"""Find code that tests or edits an English sentence, as text that a program should have as data.

A sentence is an attribute, a name or a key such as `words`, `reason` or `message`, an error as text, what a function
`…in_words` returns, and a literal of two words or more that is neither a member of a `Literal` nor a key of a mapping.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

NAMES = {"words", "reason", "reasons", "message", "sentence", "hint", "hints", "note", "why", "advice"}
ATTRIBUTES = NAMES | {"found", "fix"}
ERRORS = {"error", "exc", "exception"}
TESTS_AND_EDITS = {
    *("startswith", "endswith", "removeprefix", "removesuffix", "replace", "translate", "find", "rfind", "index"),
    *("partition", "rpartition", "split", "rsplit", "strip", "lstrip", "rstrip", "count"),
}
OF_A_PATTERN = {"match", "search", "fullmatch", "findall", "finditer", "sub", "split"}


def declared(trees: Iterator[ast.Module]) -> set[str]:
    """Return the texts that are data by declaration: members of a `Literal`, keys of mappings, names of numbers."""
    found = set[str]()
    for tree in trees:
        for node in ast.walk(tree):
            keys: list[ast.expr | None] = []
            if isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("Literal"):
                keys = list(node.slice.elts) if isinstance(node.slice, ast.Tuple) else [node.slice]
            elif isinstance(node, ast.Dict):
                keys = [*node.keys, *(v for k, v in zip(node.keys, node.values, strict=True) if _is_number(k))]
            found |= {one.value for one in keys if isinstance(one, ast.Constant) and isinstance(one.value, str)}
    return found


def _is_number(node: ast.expr | None) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int)


def is_sentence(node: ast.expr, data: set[str]) -> bool:
    """Recognise an English sentence; `data` are texts that are none."""
    match node:
        case ast.Constant(value=str() as text):
            return sum(word.isalpha() for word in text.split()) > 1 and text not in data
        case ast.Name(id=name):
            return name in NAMES
        case ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=str() as name)):
            return name in ATTRIBUTES
        case ast.Subscript(value=inner):
            return is_sentence(inner, data)
        case ast.Call(func=ast.Name(id="str" | "repr"), args=[argument]):
            return any(isinstance(one, ast.Name) and one.id in ERRORS for one in ast.walk(argument))
        case ast.Call(func=ast.Name(id=name)):
            return name.endswith("in_words")
        case ast.Call(func=ast.Attribute(attr=name, value=owner)):
            return name.endswith("in_words") or name in {"sentence", "getMessage"} or is_sentence(owner, data)
    return False


def is_hit(node: ast.AST, data: set[str]) -> bool:
    """Recognise a comparison, a `match`, a method of a text or a pattern that tests or edits a sentence."""
    match node:
        case ast.Compare(left=left, ops=[ast.In() | ast.NotIn() | ast.Eq() | ast.NotEq()], comparators=[right]):
            sides = left, right
            empty = any(isinstance(side, ast.Constant) and not side.value for side in sides)
            return not empty and any(is_sentence(side, data) for side in sides)
        case ast.Match(subject=subject):
            return is_sentence(subject, data)
        case ast.Call(func=ast.Attribute(attr=method, value=owner), args=[*_, last]) if method in OF_A_PATTERN:
            return is_sentence(last, data) or (method in TESTS_AND_EDITS and is_sentence(owner, data))
        case ast.Call(func=ast.Attribute(attr=method, value=owner), args=arguments) if method in TESTS_AND_EDITS:
            literal = any(isinstance(one, ast.JoinedStr | ast.Constant) for one in arguments)
            return literal and any(is_sentence(one, data) for one in (owner, *arguments))
    return False


def sentences_in(folders: list[Path]) -> list[str]:
    """Return "file:line: code" for each hit below these folders."""
    sources = {path: path.read_text(encoding="utf-8") for folder in folders for path in sorted(folder.rglob("*.py"))}
    trees = {path: ast.parse(source) for path, source in sources.items()}
    data = declared(iter(trees.values()))
    return [
        f"{path}:{line}: {sources[path].splitlines()[line - 1].strip()}"
        for path, tree in trees.items()
        for line in sorted(
            {node.lineno for node in ast.walk(tree) if isinstance(node, ast.expr | ast.stmt) and is_hit(node, data)}
        )
    ]
