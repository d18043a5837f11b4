"""The options that describe a table of another program, for the commands that read one."""

import tomllib
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import click

from ftcalib.files import read_file
from ftdrive.commands.common import Number, numbers
from ftdrive.errors import ConfigError
from ftdrivers.errors import BadUrl

if TYPE_CHECKING:
    from ftdrivers.interfaces import Array

TABLE_NAMES = ("columns", "rate", "euler", "tcp", "wrench_frame", "sign", "model", "urdf")
_LINKS = ("tool0", "flange")


def TABLE(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a table, and pass them to the command as `TableOptions`; None if none is given."""

    @wraps(command)
    def with_table(
        columns: str | None,
        rate: float | None,
        euler: str | None,
        tcp: str | None,
        wrench_frame: Any,
        sign: str | None,
        model: str | None,
        urdf: str | None,
        **options: Any,
    ) -> None:
        if not any((columns, rate, euler, tcp, wrench_frame, sign, model, urdf)):
            command(table=None, **options)
            return
        import numpy as np
        from scipy.spatial.transform import Rotation

        from ftdrive.tables.table import TableOptions

        offset = [0.0] * 6 if tcp is None else numbers("--tcp", tcp, ",", (3, 6))
        turn = [*offset, 0.0, 0.0, 0.0][3:6]
        named, text = ({}, {}) if columns is None else _columns(columns)
        table = TableOptions(
            columns=named,
            separator=text.get("separator", ""),
            decimal=text.get("decimal", ""),
            rate_Hz=rate,
            euler=euler or "",
            wrench_axes=wrench_frame,
            R_flange_tcp=Rotation.from_rotvec(turn).as_matrix(),
            p_flange_tcp_m=np.array(offset[:3]),
            sign=-1 if sign == "-1" else 1,
            forward=_forward(model, urdf),
        )
        command(table=table, **options)

    found: Callable[..., None] = with_table
    for option in reversed(_OPTIONS):
        found = option(found)
    return found


_OPTIONS = (
    click.option(
        "--columns",
        metavar="NAMES",
        help='Columns of a table by our names, "t=Time [ms],fx=Force X", or a TOML file with [columns].',
    ),
    click.option(
        "--rate", metavar="HZ", type=Number(0, min_open=True), help="Samples a second of a table without times."
    ),
    click.option(
        "--euler", metavar="ORDER", help="Three angles: rpy, ABC, WPR, OAT, ZYX (axes of the tool), xyz (of the base)."
    ),
    click.option(
        "--tcp", metavar="X,Y,Z,RX,RY,RZ", help="TCP in the flange, m and rad, if the poses are those of the TCP."
    ),
    click.option(
        "--wrench-frame",
        type=click.Choice(["sensor", "flange", "tcp", "base"]),
        help="Axes of the wrench; tcp and base are about the TCP.  [default: by the layout, mostly sensor]",
    ),
    click.option("--sign", type=click.Choice(["1", "-1"]), help="-1 for a sensor that reports the reaction."),
    click.option("--model", help="Joint angles of a UR arm: its model, such as UR5e."),
    click.option("--urdf", metavar="FILE", help="Joint angles of another arm: URDF, FILE?flange=LINK&base=LINK."),
)


def _columns(text: str) -> tuple[Mapping[str, str], Mapping[str, Any]]:
    """Return the columns that an option or a TOML file names, and what the file says of the text.

    Raises `ConfigError` or `OSError`.
    """
    if text.endswith(".toml"):
        try:
            found = tomllib.loads(read_file(text).decode())
            columns = found["columns"] if "text" not in found else found.get("columns", {})
        except (KeyError, ValueError) as error:
            raise ConfigError(
                f'{text} names no columns ({error}): write [columns] and lines like fx = "Force X"'
            ) from error
        return {str(name): str(column) for name, column in columns.items()}, found.get("text", {})
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and column.strip() for name, _, column in pairs):
        raise ConfigError(f'--columns {text}: give NAME=COLUMN with commas between, such as "t=Time,fx=Force X"')
    return {name.strip(): column.strip() for name, _, column in pairs}, {}


def _forward(model: str | None, urdf: str | None) -> "Callable[[Array], tuple[Array, Array]] | None":
    """Return what makes poses of joint angles (n, 6). Raises `ConfigError`."""
    if model is not None and urdf is not None:
        raise ConfigError("--model and --urdf both describe the arm: leave one out")
    if urdf is not None:
        return _chain(urdf)
    if model is None:
        return None
    from ftdrive.planning.geometry.kinematics import frames
    from ftdrivers.ur.kinematics import MODELS, model_named

    if (name := model_named(model, 3)) is None:
        raise ConfigError(f"--model {model}: the models are {', '.join(MODELS)}; another arm needs --urdf FILE")

    def forward(q_rad: "Array") -> "tuple[Array, Array]":
        found = frames(MODELS[name], q_rad)
        return found.R_base_flange, found.flange_m

    return forward


def _chain(urdf: str) -> "Callable[[Array], tuple[Array, Array]]":
    from ftdrivers.ros2.poses import Chain

    file, _, query = urdf.partition("?")
    links = dict(parse_qsl(query))
    chain = failure = None
    for flange in [links["flange"]] if "flange" in links else _LINKS:
        try:
            chain = Chain(Path(file), links.get("base", ""), flange)
            break
        except BadUrl as error:
            failure = failure or error
    if chain is None:
        raise ConfigError(f"--urdf {urdf}: {failure}") from failure
    if len(chain.names) != 6:
        raise ConfigError(
            f"--urdf {urdf}: {len(chain.names)} joints move, 6 are read: give the links, FILE?flange=LINK"
        )
    names = chain.names

    def forward(q_rad: "Array") -> "tuple[Array, Array]":
        return chain.poses(dict(zip(names, q_rad.T, strict=True)))

    return forward
