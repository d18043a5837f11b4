"""No command is silent for long on a terminal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftdrive import cli
from ftdrive.terminal.console import messages


def test_commands_that_take_long_say_at_what_they_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    R = Rotation.random(8, rng=1).as_matrix()
    wrench = np.c_[np.einsum("nji,j->ni", R, [0, 0, -10]), np.zeros((8, 3))] + 1e-3 * np.random.default_rng(1).normal(
        size=(8, 6)
    )
    header = "r11,r12,r13,r21,r22,r23,r31,r32,r33,fx,fy,fz,tx,ty,tz"
    np.savetxt("poses.csv", np.c_[R.reshape(8, 9), wrench], delimiter=",", header=header, comments="")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    seen = list[Any]()
    monkeypatch.setattr(messages, "status", _Status.of(seen))
    assert cli.run(["solve", "poses.csv"]) in {0, 7}
    assert "Solving 8 poses …" in seen


class _Status:
    def __init__(self, seen: list[Any]) -> None:
        self.update = seen.append

    @classmethod
    def of(cls, seen: list[Any]) -> Callable[[str], "_Status"]:
        def status(words: str) -> _Status:
            seen.append(words)
            return cls(seen)

        return status

    def __enter__(self) -> "_Status":
        return self

    def __exit__(self, *_: object) -> None:
        pass
