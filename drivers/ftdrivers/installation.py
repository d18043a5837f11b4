"""The command that adds an extra to this installation of ftdrive."""

import json
import os
import shlex
import sys
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

_NAME = "ftdrive"


def missing_extra(what: str, package: str, extra: str) -> str:
    """Return the error message that `what`, such as "--png", needs a package, with the command to install it."""
    return f"{what} needs {package}, of the extra {extra}: install it with `{install_command(extra)}`"


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation and keeps the installed extras.

    The command is one of `uv tool`, of pipx, of uv in a clone, or else of pip for this interpreter.
    """
    prefix = Path(sys.prefix)
    with suppress(OSError, ValueError, KeyError, StopIteration):
        if (receipt := prefix / "uv-receipt.toml").is_file():
            return _of_uv_tool(tomllib.loads(receipt.read_text(encoding="utf-8"))["tool"]["requirements"], extra)
        if (receipt := prefix / "pipx_metadata.json").is_file():
            given = str(json.loads(receipt.read_text(encoding="utf-8"))["main_package"]["package_or_url"])
            name, _, extras = given.partition("[")
            return shlex.join(["pipx", "install", "--force", _with(name, [*extras.strip("]").split(","), extra])])
    clone = _clone()
    if clone is not None and prefix == clone / ".venv":
        project = [] if Path.cwd() == clone else ["--project", str(clone)]
        return shlex.join(["uv", "sync", *project, "--inexact", "--extra", extra])
    wanted = _with(_NAME if clone is None else str(clone), [extra])
    wanted = shlex.quote(wanted) if clone is None else f"-e {shlex.quote(wanted)}"
    python = "python" if os.environ.get("VIRTUAL_ENV") == sys.prefix else shlex.quote(sys.executable)
    if find_spec("pip") is None:
        return f"uv pip install --python {shlex.quote(sys.executable)} {wanted}"
    return f"{python} -m pip install {wanted}"


def _with(name: str, extras: Iterable[str]) -> str:

    return f"{name}[{','.join(sorted({each.strip() for each in extras} - {''}))}]"


def _of_uv_tool(requirements: list[dict[str, Any]], extra: str) -> str:
    own = next(each for each in requirements if each["name"] == _NAME)
    place = next((str(own[key]) for key in ("editable", "directory", "path") if key in own), None)
    wanted = _with(place or _NAME, [*own.get("extras", ()), extra])
    if "git" in own:
        wanted += f" @ git+{own['git']}"
    command = ["uv", "tool", "install", *(["--editable"] if "editable" in own else []), wanted]
    for other in requirements:
        if other is not own:
            command += ["--with", other["name"]]
    return shlex.join(command)


def _clone() -> Path | None:
    """Return the folder of the clone that is installed in editable mode and has a lock file of uv; None without one."""
    try:
        about = json.loads(distribution(_NAME).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        return None
    if not about.get("dir_info", {}).get("editable"):
        return None
    folder = Path(unquote(urlsplit(about["url"]).path))
    return folder if (folder / "uv.lock").is_file() else None
