"""Refuses to run when another package named calib, drivers or mocks shadows ours."""

from importlib.util import find_spec
from pathlib import Path


def check() -> None:
    """Raise ImportError with both paths and the cure, unless the siblings stand beside this package."""
    home = Path(__file__).resolve().parent.parent
    for name in ("calib", "drivers", "mocks"):
        spec = find_spec(name)
        found = Path(spec.origin).resolve().parent if spec and spec.origin else None
        if found != home / name:
            raise ImportError(
                f"package '{name}' is found at {found}, but ftdrive needs the one at {home / name}: run ftdrive in an "
                "environment of its own (uv tool install or pipx), without PYTHONPATH, and not from a folder that "
                f"holds another '{name}'"
            )
