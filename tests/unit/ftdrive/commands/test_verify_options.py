"""Options of `ftdrive verify` that exclude one another, and the outcome that it prints."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ftcalib.after.state import reestimate
from ftcalib.after.verification import Verification
from ftdrive.commands import verify as command
from ftdrive.errors import ConfigError
from ftdrive.runs.run import Run
from ftdrive.runs.verification import NO_LIMITS, Limits, Verified
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.verifying import Verifying, save_wanted_update
from tests.unit.ftdrive.recorded import calibration


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    limits = {"force_N": 0.5, "torque_Nm": None}
    about = {"path": "cell/calibration.json", "id": "1" * 12, "poses": 3, "quick": False, "limits": limits}
    return Run.create(tmp_path, "verify", {"command": "verify", "mode": "auto", "verification": about}).folder


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--quick", "--poses", "3", "--simulate"), "--quick and --poses are mutually exclusive"),
        ((), "no calibration: give --calibration PATH, or --simulate"),
        (("--simulate", "--robot", "10.0.0.2"), "--robot cannot be combined with --simulate"),
        (("--resume", "RUN", "--quick"), "leave out --quick"),
        (("--resume", "RUN", "--max-force", "1"), "leave out --max-force or --max-torque"),
    ],
)
def test_options_that_contradict_are_refused(arguments: tuple[str, ...], words: str, begun: Path) -> None:
    given = [str(begun) if word == "RUN" else word for word in arguments]
    outcome = CliRunner().invoke(command.verify_command, given)
    assert isinstance(outcome.exception, ConfigError)
    assert words in str(outcome.exception)


def test_a_resumed_verification_keeps_its_options(begun: Path) -> None:
    options = SessionOptions(begun.parent, resume=begun)
    path, limits, options = Verifying.chosen(options, None, None, NO_LIMITS)
    assert (path, options.poses, limits) == (Path("cell/calibration.json"), 3, (0.5, None))
    calibrate = Run.create(begun.parent, "calibrate", {"mode": "auto"}).folder
    with pytest.raises(ConfigError, match="ftdrive calibrate --resume"):
        Verifying.chosen(replace(options, resume=calibrate), None, None, NO_LIMITS)


def failed(folder: Path, limits: Limits) -> Any:
    """A failed verification of two poses, without its files."""
    R, noise = np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]), np.eye(12) * 1e-4
    wrench = -calibration().compensate(np.zeros((2, 6)), R) + np.repeat([0.3, 0.0], 3)
    update = reestimate(calibration(), R, wrench, noise, "bias")
    change = np.full(6, 0.3), np.full(6, 0.1), np.zeros(6)
    found = Verification(
        np.full((2, 6), 0.3), np.full((2, 6), 0.1), 99.0, 12, 1e-9, False, "bias", "…", *change, (), update
    )
    path = folder / "verification.json"
    return Verified(Run(folder), calibration(), folder / "a.json", limits, None, (), found, None, path)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("update", "typed", "wanted"),
    [("no", "yes\n", False), ("yes", "", True), ("ask", "yes\n", True), ("ask", "no\n", False), ("ask", "", False)],
)
def test_an_update_is_saved_only_if_it_is_wanted(
    update: Any, typed: str, wanted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftdrive.session.verifying.save_update", lambda _: tmp_path)
    ask: Any = lambda question: command._ask_on_page(None, True, question)  # noqa: E731
    with CliRunner().isolation(typed) as (out, *_):
        found = save_wanted_update(failed(tmp_path, NO_LIMITS), update, ask)
        printed = out.getvalue().decode()
    assert (found is not None) is wanted
    if update == "ask":
        assert json.loads(printed.splitlines()[0])["text"].startswith("An update of the bias is sufficient.")
    assert save_wanted_update(failed(tmp_path, (1.0, None)), "yes", ask) is None
