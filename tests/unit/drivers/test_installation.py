"""The command that adds an extra fits the installation, and keeps what it has."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ftdrivers import installation
from ftdrivers.installation import install_command, missing_extra


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make an environment with nothing that says who made it."""
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "executable", "/env of mine/bin/python")
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    monkeypatch.setattr(installation, "distribution", lambda _: SimpleNamespace(read_text=lambda _: None))
    monkeypatch.setattr(installation, "find_spec", lambda _: object())
    return tmp_path


@pytest.mark.parametrize(
    ("requirements", "command"),
    [
        ('{ name = "ftdrive" }', "uv tool install 'ftdrive[viz]'"),
        (
            '{ name = "ftdrive", extras = ["record", "viz"] }, { name = "acme" }',
            "uv tool install 'ftdrive[record,viz]' --with acme",
        ),
        ('{ name = "ftdrive", editable = "/src" }', "uv tool install --editable '/src[viz]'"),
        ('{ name = "ftdrive", git = "https://x.org/f" }', "uv tool install 'ftdrive[viz] @ git+https://x.org/f'"),
    ],
)
def test_uv_tool(prefix: Path, requirements: str, command: str) -> None:
    (prefix / "uv-receipt.toml").write_text(f"[tool]\nrequirements = [{requirements}]\n")
    assert install_command("viz") == command


@pytest.mark.parametrize(
    ("installed", "wanted"), [("ftdrive", "ftdrive[viz]"), ("ftdrive[stream, record]", "ftdrive[record,stream,viz]")]
)
def test_pipx(prefix: Path, installed: str, wanted: str) -> None:
    (prefix / "pipx_metadata.json").write_text(json.dumps({"main_package": {"package_or_url": installed}}))
    assert install_command("viz") == f"pipx install --force '{wanted}'"


def test_pip(prefix: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_extra("--png", "matplotlib", "viz") == (
        "--png needs matplotlib, of the extra viz: install it with "
        "`'/env of mine/bin/python' -m pip install 'ftdrive[viz]'`"
    )
    monkeypatch.setenv("VIRTUAL_ENV", str(prefix))
    assert install_command("viz") == "python -m pip install 'ftdrive[viz]'"
    monkeypatch.setattr(installation, "find_spec", lambda _: None)
    assert install_command("viz") == "uv pip install --python '/env of mine/bin/python' 'ftdrive[viz]'"


@pytest.mark.parametrize("name", ["uv-receipt.toml", "pipx_metadata.json"])
def test_a_damaged_receipt_is_none(prefix: Path, name: str) -> None:
    (prefix / name).write_text("[")
    assert install_command("viz").endswith("-m pip install 'ftdrive[viz]'")
