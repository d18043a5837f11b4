"""Plant small errors in a copy of the project, one at a time, and print which of them the fast tests find.

A mutant is given to the test files of its own folder, which is `tests/unit/ftdrive/session` for
`ftdrive/ftdrive/session/x.py`, and to every other one that reaches its line, by the coverage of one run of all fast
tests. For a line that runs only when its module is imported, or in other processes: that reaches the module.
Slow tests and those of ROS 2 are not tried: read what survives, because they may find it, or it may change nothing.
"""

import argparse
import ast
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from coverage import CoverageData

PROJECT = Path(__file__).parents[2]
NO_TESTS = 5  # the exit code of pytest where all tests of the files are slow

SWAPPED: dict[type[ast.AST], list[type[ast.AST]]] = {
    ast.Add: [ast.Sub], ast.Sub: [ast.Add], ast.Mult: [ast.Div], ast.Div: [ast.Mult], ast.Pow: [ast.Mult],
    ast.Mod: [ast.Mult], ast.FloorDiv: [ast.Mult], ast.BitAnd: [ast.BitOr], ast.BitOr: [ast.BitAnd],
    ast.And: [ast.Or], ast.Or: [ast.And],
    ast.Lt: [ast.LtE, ast.Gt], ast.LtE: [ast.Lt, ast.GtE], ast.Gt: [ast.GtE, ast.Lt], ast.GtE: [ast.Gt, ast.LtE],
    ast.Eq: [ast.NotEq], ast.NotEq: [ast.Eq], ast.Is: [ast.IsNot], ast.IsNot: [ast.Is],
    ast.In: [ast.NotIn], ast.NotIn: [ast.In],
}  # fmt: skip


class Mutant(NamedTuple):
    """A changed expression; `span` is its place in the file, in bytes."""

    path: Path
    line: int
    span: slice
    before: str
    after: str

    def __str__(self) -> str:
        return re.sub(r"\s+", " ", f"{self.path}:{self.line}: {self.before} → {self.after}")

    def plant(self, root: Path) -> None:
        source = (root / self.path).read_bytes()
        (root / self.path).write_bytes(source[: self.span.start] + self.after.encode() + source[self.span.stop :])


def expressions(node: ast.AST) -> Iterator[ast.expr]:
    """All expressions of a program; of a type, and inside an f-string (without exact places in Python 3.11), none."""
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name in {"annotation", "returns"} or not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            if isinstance(child, ast.expr):
                yield child
            yield from expressions(child)


def changes(node: ast.expr) -> Iterator[str]:
    """Everything that is done to one expression."""
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op):
            for other in SWAPPED.get(type(op), []):
                node.op = other()  # type: ignore[assignment]  # an operator of the same kind
                yield f"({ast.unparse(node)})"
            node.op = op
        case ast.Compare(ops=[op]):
            for other in SWAPPED[type(op)]:
                node.ops = [other()]  # type: ignore[list-item]  # an operator of the same kind
                yield f"({ast.unparse(node)})"
            node.ops = [op]
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            yield f"({ast.unparse(node.operand)})"
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            yield repr(number + 1 if isinstance(number, int) else 2 * number or 1.0)


def mutants_of(path: Path) -> Iterator[Mutant]:
    source = (PROJECT / path).read_bytes()
    starts = [0, *accumulate(map(len, source.splitlines(keepends=True)))]
    tree = ast.parse(source)
    conditions = {id(node.test) for node in ast.walk(tree) if isinstance(node, ast.If | ast.IfExp | ast.While)}
    for node in expressions(tree):
        if node.end_lineno is None or node.end_col_offset is None:
            continue
        span = slice(starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset)
        before = source[span].decode()
        if id(node) in conditions:
            yield Mutant(path, node.lineno, span, before, f"(not ({ast.unparse(node)}))")
        yield from (Mutant(path, node.lineno, span, before, after) for after in changes(node))


def folder_of_tests(path: Path) -> Path:
    """The folder of unit tests that mirrors the module's or, where there is none, the next one up."""
    top, *package_path = path.parent.parts
    folder = Path("tests/unit", top, *package_path[1:])
    while not (PROJECT / folder).is_dir():
        folder = folder.parent
    return folder


def reach_of(root: Path, data_file: Path) -> None:
    """Run the fast tests of the copy and write which of them reaches each line."""
    packages = [f"--cov={package.parent}" for package in root.glob("*/*/__init__.py") if package.parts[-3] != "tests"]
    options = ["-q", "-p", "no:cacheprovider", "--cov-context=test", "--cov-report=", *packages]
    environment = {**environment_of(root), "COVERAGE_FILE": str(data_file)}
    if subprocess.run([sys.executable, "-m", "pytest", *options], cwd=root, env=environment, check=False).returncode:
        sys.exit("Without a mutant the tests fail. Fix them.")


def tests_of(mutant: Mutant, reach: CoverageData) -> list[str]:
    """Test files of the mutant's folder, those that name its module first, then all others that reach it."""
    module = next((file for file in reach.measured_files() if Path(file).match(f"*/{mutant.path}")), None)
    contexts = reach.contexts_by_lineno(module) if module else {}
    of_line, of_module = (
        {file for line in lines for test in contexts.get(line, []) if (file := test.partition("::")[0])}
        for lines in ([mutant.line], contexts)
    )
    folder = folder_of_tests(mutant.path)
    at_home = {str(file.relative_to(PROJECT)) for file in (PROJECT / folder).rglob("test_*.py")}
    name = re.compile(rf"\b{mutant.path.stem}\b")

    def order(file: str) -> tuple[bool, bool, bool, str]:
        return file not in at_home, not name.search((PROJECT / file).read_text()), "tests/unit" not in file, file

    return sorted(at_home | (of_line or of_module), key=order)


def environment_of(root: Path) -> dict[str, str]:
    packages = os.pathsep.join(str(root / top) for top in ("ftdrive", "calib", "drivers", "mocks"))
    return {**os.environ, "PYTHONPATH": packages}


def outcome(root: Path, tests: list[str], limit_s: float) -> str:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", *tests]
    quiet = subprocess.DEVNULL
    environment = environment_of(root)
    with subprocess.Popen(
        command, cwd=root, env=environment, stdout=quiet, stderr=quiet, start_new_session=True
    ) as run:
        try:
            return "survived" if run.wait(limit_s) in {0, NO_TESTS} else "killed"
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            return "too slow"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "paths", nargs="+", help="packages or modules: calib, ftdrive/ftdrive/session, drivers/ftdrivers/clock.py"
    )
    parser.add_argument("--number", type=int, default=20, help="of mutants (default 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reach", type=Path, help="coverage of an earlier sample of the same tree; else written")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for the tests of one mutant (default 900)")
    options = parser.parse_args()

    patterns = [path if path.endswith(".py") else f"{path}/**/*.py" for path in options.paths]
    files = sorted(file for pattern in patterns for file in PROJECT.glob(pattern))
    every = [mutant for file in files for mutant in mutants_of(file.relative_to(PROJECT))]
    drawn = random.Random(options.seed).sample(every, min(options.number, len(every)))
    sys.stdout.write(f"{len(drawn)} of {len(every)} mutants\n")
    with TemporaryDirectory() as folder:
        left_out = shutil.ignore_patterns(".git", ".venv", ".*_cache", "__pycache__")
        root = shutil.copytree(PROJECT, Path(folder, "project"), ignore=left_out)
        data_file = options.reach.resolve() if options.reach else Path(folder, "reach")
        if not data_file.exists():
            reach_of(root, data_file)
        reach = CoverageData(str(data_file))
        reach.read()
        ends = []
        for mutant in drawn:
            mutant.plant(root)
            ends.append(outcome(root, tests_of(mutant, reach), options.limit))
            shutil.copy2(PROJECT / mutant.path, root / mutant.path)
            print(f"{ends[-1]:8} {mutant}", flush=True)  # noqa: T201
    sys.stdout.write(f"{ends.count('survived')} of {len(drawn)} survived\n")


if __name__ == "__main__":
    main()
