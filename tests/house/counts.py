"""Print how many concepts the house has: `uv run python tests/house/counts.py`."""

import ast
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("calib", "drivers", "ftdrive")
HEADS = ("files", "lines", "comment %", "dataclasses", "public names")


def counted(package: str) -> tuple[int, ...]:
    """Files, lines, full-line comments, dataclasses, and functions and classes of modules without an underscore."""
    files = [path.read_bytes() for path in ROOT.glob(f"{package}/**/*.py")]
    tokens = [token for file in files for token in tokenize.tokenize(iter(file.splitlines(keepends=True)).__next__)]
    comments = sum(token.type == tokenize.COMMENT and token.line.lstrip().startswith("#") for token in tokens)
    lines = sum(len(file.splitlines()) for file in files)
    trees = [ast.parse(file) for file in files]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    dataclasses = [node for node in classes if any("dataclass" in ast.unparse(by) for by in node.decorator_list)]
    defined = [node for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    public = [node for node in defined if not node.name.startswith("_")]
    return len(files), lines, comments, len(dataclasses), len(public)


rows = {package: counted(package) for package in PACKAGES}
rows["sum"] = tuple(map(sum, zip(*rows.values(), strict=True)))
print(f"{'':8}" + "".join(f"{head:>14}" for head in HEADS))  # noqa: T201
for name, (files, lines, comments, dataclasses, public) in rows.items():
    print(f"{name:8}{files:14}{lines:14}{100 * comments / lines:14.1f}{dataclasses:14}{public:14}")  # noqa: T201
tests = sum(len(path.read_text("utf-8").splitlines()) for path in ROOT.glob("tests/**/*.py"))
print(f"{'tests':8}{'':14}{tests:14}")  # noqa: T201
