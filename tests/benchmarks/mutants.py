"""Plant small errors in a copy of the project, one at a time, and print which of them the fast tests find.

    uv run python -m tests.benchmarks.mutants    # compare with the kept list: which survive now, and did not before
    uv run python -m tests.benchmarks.mutants calib ftdrive/ftdrive/session --number 20

A mutant is given to the tests of its own folder that reach its line, by the coverage of one run of all fast tests, and
to all others that do if it survives; the folder is `tests/unit/ftdrive/session` for `ftdrive/ftdrive/session/x.py`.
Slow tests and those of ROS 2 are not tried: read what survives, because they may find it, or it may change nothing.
"""

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from coverage import CoverageData

PROJECT = Path(__file__).parents[2]
PACKAGES = ("calib", "drivers", "ftdrive")
KEPT = PROJECT / "tests/baselines/mutants.json"
NO_TESTS = {0, 4, 5}  # exit codes of pytest: none failed, one is not there, all are slow

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
    statement: str
    """The line of the file, without its indentation."""

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
    lines = source.splitlines(keepends=True)
    starts = [0, *accumulate(map(len, lines))]
    tree = ast.parse(source)
    conditions = {id(node.test) for node in ast.walk(tree) if isinstance(node, ast.If | ast.IfExp | ast.While)}
    for node in expressions(tree):
        if node.end_lineno is None or node.end_col_offset is None:
            continue
        span = slice(starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset)
        before, line = source[span].decode(), lines[node.lineno - 1].decode().strip()
        negated = [f"(not ({ast.unparse(node)}))"] if id(node) in conditions else []
        yield from (Mutant(path, node.lineno, span, before, after, line) for after in [*negated, *changes(node)])


def folder_of_tests(path: Path) -> str:
    """The folder of unit tests that mirrors the module's or, where there is none, the next one up."""
    top, *package_path = path.parent.parts
    folder = Path("tests/unit", top, *package_path[1:])
    while not (PROJECT / folder).is_dir():
        folder = folder.parent
    return f"{folder}/"


def reach_of(root: Path, data_file: Path) -> CoverageData:
    """Which fast tests reach each line: of an earlier sample of the same tree, else of a run of them in the copy."""
    if not data_file.exists():
        packages = [
            f"--cov={package.parent}" for package in root.glob("*/*/__init__.py") if package.parts[-3] != "tests"
        ]
        options = ["-q", "-p", "no:cacheprovider", "--cov-context=test", "--cov-report=", *packages]
        environment = {**environment_of(root), "COVERAGE_FILE": str(data_file)}
        if subprocess.run(
            [sys.executable, "-m", "pytest", *options], cwd=root, env=environment, check=False
        ).returncode:
            sys.exit("Without a mutant the tests fail. Fix them.")
    reach = CoverageData(str(data_file))
    reach.read()
    return reach


def tests_of(mutant: Mutant, reach: CoverageData) -> tuple[list[str], list[str]]:
    """The tests that reach the mutant's line: those of its folder, and all others.

    A line that runs only when its module is imported, or in other processes, has the files that reach its module.
    """
    module = next((file for file in reach.measured_files() if Path(file).match(f"*/{mutant.path}")), None)
    contexts = reach.contexts_by_lineno(module) if module else {}
    tests = {test.rpartition("|")[0] for test in contexts.get(mutant.line, []) if test}
    if not tests:
        tests = {test.partition("::")[0] for line in contexts.values() for test in line if test}
    folder = folder_of_tests(mutant.path)
    return sorted(one for one in tests if one.startswith(folder)), sorted(
        one for one in tests if not one.startswith(folder)
    )


def environment_of(root: Path) -> dict[str, str]:
    packages = os.pathsep.join(str(root / top) for top in ("ftdrive", "calib", "drivers", "mocks"))
    return {**os.environ, "PYTHONPATH": packages}


def outcome(root: Path, mutant: Mutant, reach: CoverageData, limit_s: float, first: str = "") -> str:
    """The test that kills a mutant, "too slow", or "" if it survives the tests of its folder and all others."""
    mutant.plant(root)
    for tests in ([first] if first.startswith("tests/") else [], *tests_of(mutant, reach)):
        if not tests:
            continue
        (root / "chosen").write_text("\n".join(tests))
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "-rfE", "@chosen"]
        with subprocess.Popen(
            command,
            cwd=root,
            env=environment_of(root),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as run:
            try:
                said = run.communicate(timeout=limit_s)[0]
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                return "too slow"
        # Pytest ends alike where a file cannot be imported and where a test is not there. Names of parameters change.
        if failed := re.search(r"^(?:FAILED|ERROR) (tests/.+?)(?:\[| - |$)", said, re.MULTILINE):
            return failed[1]
        if run.returncode not in NO_TESTS:
            return "its import"
    return ""


def tried(
    mutants: Iterable[tuple[Mutant, str]], reach_file: Path | None, limit_s: float
) -> Iterator[tuple[Mutant, str]]:
    """Try mutants, each with the test that has killed it before, in a copy of the project."""
    with TemporaryDirectory() as folder:
        left_out = shutil.ignore_patterns(".git", ".venv", ".*_cache", "__pycache__")
        root = shutil.copytree(PROJECT, Path(folder, "project"), ignore=left_out)
        reach = reach_of(root, reach_file.resolve() if reach_file else Path(folder, "reach"))
        for mutant, first in mutants:
            yield mutant, outcome(root, mutant, reach, limit_s, first)
            shutil.copy2(PROJECT / mutant.path, root / mutant.path)


def found_again(kept: Mapping[str, str], every: Mapping[Path, list[Mutant]]) -> Mutant | None:
    """The mutant of a kept one: of the same line of the same file, else of such a line anywhere; None if it is gone."""
    at_home = every.get(Path(kept["file"]), [])
    for mutants in (at_home, [mutant for file in every.values() for mutant in file]):
        for mutant in mutants:
            if (mutant.statement, mutant.before, mutant.after) == (kept["line"], kept["before"], kept["after"]):
                return mutant
    return None


def compare(options: argparse.Namespace) -> None:
    """Print which kept mutants survive now and were killed before."""
    if not KEPT.exists():
        sys.exit(f"{KEPT} does not exist: write it with --keep, before you change the product")
    every = {path: list(mutants_of(path)) for path in files_of(PACKAGES)}
    kept = json.loads(KEPT.read_text())
    again = [(mutant, one["killed_by"]) for one in kept if (mutant := found_again(one, every)) and one["killed_by"]]
    survivors = 0
    for mutant, by in tried(again, options.reach, options.limit):
        if not by:
            survivors += 1
            print(f"survives {mutant}", flush=True)  # noqa: T201
    killed = sum(bool(one["killed_by"]) for one in kept)
    sys.stdout.write(f"{killed} were killed: {survivors} of them survive now, {killed - len(again)} are gone\n")
    sys.exit(bool(survivors))


def files_of(paths: Iterable[str]) -> list[Path]:
    patterns = [path if path.endswith(".py") else f"{path}/**/*.py" for path in paths]
    return [file.relative_to(PROJECT) for file in sorted(file for one in patterns for file in PROJECT.glob(one))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "paths", nargs="*", help="packages or modules: calib, ftdrive/ftdrive/session, drivers/ftdrivers/clock.py"
    )
    parser.add_argument("--number", type=int, default=20, help="of mutants of each path (default 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reach", type=Path, help="coverage of an earlier sample of the same tree; else written")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for the tests of one mutant (default 900)")
    parser.add_argument("--keep", action="store_true", help=f"try 60 of each package and keep the list in {KEPT.name}")
    options = parser.parse_args()
    if not (options.paths or options.keep):
        compare(options)

    drawn = list[Mutant]()
    for path in PACKAGES if options.keep else options.paths:
        every = [mutant for file in files_of([path]) for mutant in mutants_of(file)]
        number = 60 if options.keep else options.number
        drawn += random.Random(options.seed).sample(every, min(number, len(every)))
    ends = list[dict[str, str]]()
    for mutant, by in tried(((one, "") for one in drawn), options.reach, options.limit):
        ends.append(
            {"file": str(mutant.path), "line": mutant.statement, "before": mutant.before, "after": mutant.after}
        )
        ends[-1]["killed_by"] = by
        print(f"{'killed' if by else 'survived':8} {mutant}  {by}", flush=True)  # noqa: T201
    sys.stdout.write(f"{sum(not one['killed_by'] for one in ends)} of {len(drawn)} survived\n")
    if options.keep:
        KEPT.write_text(json.dumps(ends, indent=0, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
