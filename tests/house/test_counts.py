"""The ratchet: how much the product may have of what makes it hard to read.

A change that needs more of one row takes it from elsewhere, in the same change. A change that ends below 98 % of a row
lowers its ceiling here.
"""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.house import rooms

ROOT = Path(__file__).parents[2]
PACKAGES = ("calib", "drivers", "ftdrive")

CEILINGS = {
    "product lines": 70504,
    "files": 308,
    "dataclasses": 229,
    "public functions and classes": 1414,
    "import statements inside functions": 108,
    "test lines": 59989,
}
ROOMS = {
    "a: calibrate, to the first move": 70,
    "b: live --replay": 30,
    "c: solve of poses": 36,
    "d: solve of a recording in motion": 37,
}
"""Modules that a command walks through: the definition is that of `rooms.py`."""

LINES_OF_A_MODULE = 700
parsed = functools.cache(ast.parse)


def sentence(row: str, count: int, ceiling: int) -> str:
    """Return what to do if a count is beyond its ceiling or far below it, else an empty string."""
    if count > ceiling:
        return f"{row}: {count}, {count - ceiling} more than the ceiling. Take them from elsewhere in this change."
    if count < 0.98 * ceiling:
        return f"{row}: {count}, far below the ceiling of {ceiling}. Lower it to {count} in {Path(__file__).name}."
    return ""


def statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Yield the statements inside a node, at all depths."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, part, ()):
            yield child
            yield from statements(child)


def counts_of(sources: dict[str, str]) -> dict[str, int]:
    """Count what the product has, except for lines of tests."""
    trees = [parsed(source) for source in sources.values()]
    nodes = [[*statements(tree)] for tree in trees]
    public = [node for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    inside = 0
    for of_file in nodes:
        bodies = {
            line
            for node in of_file
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for line in range(node.body[0].lineno, (node.end_lineno or 0) + 1)
        }
        inside += sum(isinstance(node, ast.Import | ast.ImportFrom) and node.lineno in bodies for node in of_file)
    return {
        "product lines": sum(len(source.splitlines()) for source in sources.values()),
        "files": len(sources),
        "dataclasses": sum(
            any("dataclass" in ast.unparse(by) for by in node.decorator_list)
            for of_file in nodes
            for node in of_file
            if isinstance(node, ast.ClassDef)
        ),
        "public functions and classes": sum(not node.name.startswith("_") for node in public),
        "import statements inside functions": inside,
    }


def faults(sources: dict[str, str]) -> Iterator[str]:
    """Private names that another module imports, and modules that are too long."""
    for path, source in sources.items():
        if (more := len(source.splitlines()) - LINES_OF_A_MODULE) > 0:
            yield f"{path} has {LINES_OF_A_MODULE + more} lines, {more} too many: divide it by what a reader looks for."
        for node in statements(parsed(source)):
            for name in node.names if isinstance(node, ast.ImportFrom) else ():
                if name.name.startswith("_") and not name.name.startswith("__"):
                    yield f"{path}:{name.lineno} imports {name.name}: give it a public name, or move what uses it."


def product() -> dict[str, str]:
    return {
        str(path.relative_to(ROOT)): path.read_text("utf-8")
        for package in PACKAGES
        for path in sorted(ROOT.glob(f"{package}/**/*.py"))
    }


def test_the_product_holds_its_ceilings() -> None:
    counts = counts_of(product())
    counts["test lines"] = sum(len(path.read_text("utf-8").splitlines()) for path in ROOT.glob("tests/**/*.py"))
    assert counts.keys() == CEILINGS.keys()
    assert [said for row, count in counts.items() if (said := sentence(row, count, CEILINGS[row]))] == []


def test_no_module_is_too_long_or_imports_a_private_name_of_another() -> None:
    assert list(faults(product())) == []


@pytest.mark.slow
def test_the_walks_hold_their_ceilings() -> None:
    passed = rooms.walks()
    counts = {name: len(walk["rooms"]) for name, walk in passed.items()}
    assert [said for row, most in ROOMS.items() if (said := sentence(row, counts[row[0]], most))] == []
    text = rooms.PAGE.read_text(encoding="utf-8")
    # The other two have threads, whose order is not that of the next run.
    assert [name for name in "cd" if rooms.tree(passed[name]["rooms"]) not in text] == [], "run tests.house.rooms again"


PLAIN = {"calib/a.py": "class A:\n    pass\n\n\ndef f():\n    return 1\n"}


@pytest.mark.parametrize(
    ("row", "added"),
    [
        ("public functions and classes", "def g():\n    return 2\n"),
        ("dataclasses", "@dataclass(frozen=True)\nclass B:\n    b: int\n"),
        ("product lines", "\n"),
        ("files", None),
        ("import statements inside functions", "def _g():\n    import os\n"),
    ],
)
def test_more_of_a_row_fails_with_what_to_do(row: str, added: str | None) -> None:
    more = PLAIN | ({"calib/b.py": ""} if added is None else {"calib/a.py": PLAIN["calib/a.py"] + added})
    before, after = counts_of(PLAIN)[row], counts_of(more)[row]
    assert sentence(row, before, before) == ""
    assert sentence(row, after, before).endswith(", 1 more than the ceiling. Take them from elsewhere in this change.")


def test_a_count_far_below_its_ceiling_fails_with_what_to_do() -> None:
    assert sentence("files", 98, 100) == ""
    assert sentence("files", 97, 100).endswith("Lower it to 97 in test_counts.py.")


def test_a_long_module_and_a_private_import_fail_with_what_to_do() -> None:
    found = list(faults({"calib/a.py": "x = 1\n" * 701, "calib/b.py": "from ftcalib.a import _x\n"}))
    assert found[0].startswith("calib/a.py has 701 lines, 1 too many")
    assert found[1].startswith("calib/b.py:1 imports _x: give it a public name")
