"""Tables that cannot be used: one sentence says what was found, and what to type or to correct."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftdrive.errors import ConfigError
from ftdrive.tables.table import Table, TableOptions
from tests.unit.ftdrive.tables.test_layouts import POSES, RECORDING, W, columns, quaternion, t, text, wrench

PLAIN = t(POSES) | wrench(POSES) | quaternion(POSES)
MOVING = t(RECORDING) | wrench(RECORDING) | quaternion(RECORDING)


def without(*names: str) -> dict[str, np.ndarray]:
    return {name: values for name, values in PLAIN.items() if name not in names}


def renamed(**names: str) -> dict[str, np.ndarray]:
    return {names.get(name, name): values for name, values in PLAIN.items()}


def lines(table: dict[str, np.ndarray] = PLAIN, separator: str = ",", decimal: str = ".") -> list[str]:
    return text(table, separator, decimal).splitlines()


def replaced(row: int, old: str, new: str, separator: str = ",", decimal: str = ".") -> str:
    every = lines(separator=separator, decimal=decimal)
    cells = every[row].split(separator)
    cells[list(PLAIN).index(old)] = new
    every[row] = separator.join(cells)
    return "\n".join(every)


def named(options: TableOptions | None = None, **columns_: str) -> TableOptions:
    return options or TableOptions(columns=columns_)


TWO_FT = {
    f"/ft{i}/wrench/{kind}/{axis}": values
    for i in (1, 2)
    for (kind, axis), values in zip([(k, a) for k in ("force", "torque") for a in "xyz"], POSES.wrench.T, strict=True)
}

# Content, what the error says, and options.
BROKEN: dict[str, tuple[str | bytes, str, TableOptions]] = {
    # a column is missing
    **{
        f"without {name}": (
            text(without(name)),
            rf"no wrench among .* lacks {name}\. Name the columns: --columns .*{name}=…",
            named(),
        )
        for name in W.split()
    },
    "without qw": (
        text(without("qw")),
        r"no orientation among .* lacks qw\. Name the columns: --columns .*qw=…",
        named(),
    ),
    "without qx": (text(without("qx")), r"no orientation among .* lacks qx\. Name", named()),
    "without an orientation": (
        text(t(POSES) | wrench(POSES)),
        r"no orientation among the columns t, fx, .* --columns",
        named(),
    ),
    "without a wrench": (
        text(t(POSES) | quaternion(POSES)),
        r"no wrench among the columns t, qx, .* --columns",
        named(),
    ),
    "torque without mz": (
        text(renamed(tx="mx", ty="my", tz="m")),
        r"no wrench among .* lacks .*z\. Name .*tx=mx,ty=my,tz=…",
        named(),
    ),
    "matrix of eight": (
        text(
            t(POSES)
            | wrench(POSES)
            | columns("r11 r12 r13 r21 r22 r23 r31 r32", POSES.R.as_matrix().reshape(-1, 9)[:, :8])
        ),
        r"lacks r33",
        named(),
    ),
    "unknown names": (
        text(dict(zip("abcdefghijk", PLAIN.values(), strict=True))),
        r"no wrench among the columns a, b, .* --columns",
        named(),
    ),
    "joint angles": (
        text(t(POSES) | wrench(POSES) | columns("q1 q2 q3 q4 q5 q6", POSES.wrench)),
        r"joint angles .* add --model, such as UR5e, or --urdf FILE",
        named(),
    ),
    "three angles": (
        text(t(POSES) | wrench(POSES) | columns("euler_x euler_y euler_z", POSES.p_m)),
        r"the three angles is unknown: add --euler",
        named(),
    ),
    "no header": (text(PLAIN, header=False), r"no orientation among the columns 1, 2, .* --columns \"qx=…", named()),
    # two candidates
    "two sensors": (
        text(t(POSES) | TWO_FT | quaternion(POSES)),
        r"two candidates, /ft1/wrench/force/x and /ft2/.* --columns \"fx=…",
        named(),
    ),
    "a name twice": (text(PLAIN).replace("ty", "tx", 1), r"lacks ty", named()),
    "a column twice": (text(PLAIN | {"Fx": PLAIN["fx"]}), r"two candidates, fx and Fx\. Name the columns", named()),
    "two poses": (
        text(
            t(POSES)
            | wrench(POSES)
            | {
                f"/{arm}/pose/orientation/{c}": v
                for arm in ("a", "b")
                for c, v in zip("xyzw", POSES.R.as_quat().T, strict=True)
            }
        ),
        r"two candidates, /a/pose/orientation/x and /b/",
        named(),
    ),
    # cells
    **{
        f"{cell} for {name}": (
            replaced(5, name, cell),
            rf"line 6: {name} is '{cell}', which is not a number: correct or delete",
            named(),
        )
        for name, cell in (("fx", "abc"), ("tz", "1.2.3"), ("qw", "--"), ("t", "12:30"), ("fy", "#NUM!"))
    },
    "decimal comma in one cell": (
        replaced(5, "fx", "1,5", ";"),
        r"line 6: fx is '1,5', which has a decimal comma, unlike others",
        named(),
    ),
    "decimal point in one cell": (
        replaced(5, "fx", "1.5", ";", ","),
        r"line 6: fx is '1\.5', which has a decimal point, unlike others",
        named(),
    ),
    "decimal comma between commas": (replaced(5, "fx", "1,5"), r"line 6 has 12 values, other lines have 11", named()),
    "a blank cell": (replaced(5, "fx", ""), r"row 5: fx is missing or not a finite number", named()),
    "nan": (replaced(5, "ty", "nan"), r"row 5: ty is missing or not a finite number", named()),
    "inf": (replaced(5, "ty", "inf"), r"row 5: ty is missing or not a finite number", named()),
    "a value too many": (
        "\n".join([*lines()[:5], lines()[5] + ",7", *lines()[6:]]),
        r"line 6 has 12 values, other lines have 11",
        named(),
    ),
    "half a line": (
        "\n".join([*lines()[:5], lines()[5][:40], *lines()[6:]]),
        r"line 6 has \d+ values, other lines have 11",
        named(),
    ),
    "half a file": (
        text(PLAIN)[: len(text(PLAIN)) // 2].rpartition(",")[0],
        r"line \d+ has \d+ values, other lines have 11",
        named(),
    ),
    "zero sigma": (
        text(PLAIN | {f"sigma_{name}": 0 * PLAIN["t"] for name in W.split()}),
        r"row 1: the standard error 0 is not above 0",
        named(),
    ),
    "quaternion of length 2": (
        text(t(POSES) | wrench(POSES) | columns("qx qy qz qw", 2 * POSES.R.as_quat())),
        r"row 1: the quaternion has length 2",
        named(),
    ),
    "quaternion of zeros": (
        text(t(POSES) | wrench(POSES) | columns("qx qy qz qw", 0 * POSES.R.as_quat())),
        r"the quaternion has length 0",
        named(),
    ),
    "rotation vector in degrees": (
        text(t(POSES) | wrench(POSES) | columns("rx ry rz", np.degrees(POSES.R.as_rotvec()))),
        r"rotation vector of length \d+ is in degrees, or three Euler angles: .*\[deg\].*--euler",
        named(),
    ),
    "no row": (lines()[0], r"no row has two numbers or more", named()),
    "no common row": (
        text(
            t(POSES)
            | {name: np.where(np.arange(24) % 2, values, np.nan) for name, values in wrench(POSES).items()}
            | {name: np.where(np.arange(24) % 2, np.nan, values) for name, values in quaternion(POSES).items()}
        ),
        r"no row has both an orientation and a wrench",
        named(),
    ),
    # files
    "empty": ("", r"the file is empty", named()),
    "blank lines": ("\n\n \n", r"the file is empty", named()),
    "prose": ("this is a text\nwithout numbers, as it seems\n", r"no row has two numbers or more", named()),
    "binary": (bytes(range(256)) * 9, r"the file is not a text table", named()),
    "damaged gzip": (
        gzip.compress(text(PLAIN).encode())[:300] + b"\0" * 300,
        r"compressed file is damaged or incomplete",
        named(),
    ),
    "half a gzip": (gzip.compress(text(PLAIN).encode())[:-200], r"compressed file is damaged or incomplete", named()),
    "JSON": ('{"a": [1, 2, 3]}', r"no row has two numbers or more", named()),
    # units
    "force in mm": (
        text(renamed(fx="fx [mm]")),
        r"column 'fx \[mm\]' has the unit mm, which is not a unit of force .*--columns",
        named(),
    ),
    "torque in N": (text(renamed(tx="tx (N)")), r"'tx \(N\)' has the unit N, which is not a unit of torque", named()),
    "time in N": (text(renamed(t="t [N]")), r"has the unit N, which is not a unit of time", named()),
    "force in parsec": (text(renamed(fx="fx [pc]")), r"has the unit pc, which is not a unit of force", named()),
    "position in deg": (
        text(PLAIN | columns("x|[deg] y|[deg] z|[deg]".replace("|", "_"), POSES.p_m)),
        r"has the unit deg, which is not a unit of length",
        named(),
    ),
    "units below the names": (
        text(PLAIN, units=["s", *["V"] * 6, *[""] * 4]),
        r"has the unit V, which is not a unit of force",
        named(),
    ),
    # options
    "a column that is not there": (
        text(PLAIN),
        r"--columns fx=Force X: the columns are t, fx, .*give the name of a column, or its number",
        named(fx="Force X"),
    ),
    "a number beyond the last": (text(PLAIN), r"--columns fx=99: the columns are", named(fx="99")),
    "an unknown name of ours": (
        text(PLAIN),
        r"--columns force=fx: force is unknown; the names are t, fx, fy",
        named(force="fx"),
    ),
    "a wrong unit": (text(PLAIN), r"column 'fx' has the unit pc", named(fx="fx [pc]")),
    "one of two names": (
        text(PLAIN | {"FX": PLAIN["fx"]}),
        r"--columns fx=Fx: two columns have this name",
        named(fx="Fx"),
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_table_that_cannot_be_used_is_one_sentence(name: str, tmp_path: Path) -> None:
    content, words, options = BROKEN[name]
    path = tmp_path / "poses.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(BadDataset, match=f"^poses.csv: .*{words}") as error:
        Table(path, options).dataset()
    assert "\n" not in str(error.value)
    assert str(error.value).count("poses.csv") == 1


def recording(**changes: object) -> dict[str, np.ndarray]:
    return {**MOVING, **changes}  # type: ignore[dict-item]  # arrays


MOTION: dict[str, tuple[dict[str, np.ndarray], str, Callable[[Table], object]]] = {
    "no time": (
        wrench(RECORDING),
        r"no time among .*TableOptions\(columns={'t': '…'}\), or add rate_Hz=",
        lambda table: list(table.wrenches()),
    ),
    "ms or µs": (
        recording(t=100 * np.arange(600)),
        r"steps of 100 in the times may be ms or us: .*--columns \"t=t \[ms\]\"",
        lambda table: table,
    ),
    "no time in a row": (
        recording(t=np.where(np.arange(600) == 7, np.nan, RECORDING.t_s)),
        r"row 8: the time is missing",
        lambda table: list(table.wrenches()),
    ),
    "a force near the largest number": (
        recording(fz=np.where(np.arange(600) == 7, -1e308, RECORDING.wrench[:, 2])),
        r"row 8: fz is -1e\+308, more than any device reports",
        lambda table: list(table.wrenches()),
    ),
    "gravity alone": (
        t(RECORDING) | columns("gx gy gz", RECORDING.p_m),
        r"gravity does not determine the rotation about it",
        lambda table: list(table.poses()),
    ),
    "base axes without poses": (
        t(RECORDING) | columns(" ".join(f"actual_TCP_force_{i}" for i in range(6)), RECORDING.wrench),
        r"no orientation among",
        lambda table: list(table.wrenches()),
    ),
    "one row": (
        {name: values[:1] for name, values in MOVING.items()},
        r"the table has 1 rows of the wrench",
        lambda table: table.rate_Hz("wrench"),
    ),
}


@pytest.mark.parametrize("name", MOTION)
def test_a_recording_that_cannot_be_used_is_one_sentence(name: str) -> None:
    frame, words, use = MOTION[name]
    with pytest.raises(BadDataset, match=words):
        use(Table(frame))


@pytest.mark.parametrize(
    ("options", "words"), [({"euler": "abd"}, "--euler abd: give rpy, ABC"), ({"rate_Hz": -1.0}, "--rate -1")]
)
def test_an_option_that_cannot_be_is_rejected(options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        TableOptions(**options)  # type: ignore[arg-type]  # the point of the test
