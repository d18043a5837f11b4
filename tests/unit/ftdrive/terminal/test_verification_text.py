"""A verification as it is printed."""

import io
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from ftcalib.after.verification import Verification
from ftdrive.runs.verification import NO_LIMITS
from ftdrive.terminal.console import messages
from ftdrive.terminal.report import print_verification

FOUND = Verification(
    residual=np.array([[0.03, -0.04, 0.0, 0.003, 0.0, 0.004], [0.0, 0.0, -0.5, 0.0, 0.0, 0.0]]),
    predicted_sigma=np.array([[0.01, 0.02, 0.02, 0.001, 0.002, 0.002]] * 2),
    chi2=14.2,
    dof=12,
    p_value=0.288,
    passed=True,
    change=None,
    reason="the difference has a reason",
    bias_change=np.zeros(6),
    bias_sigma=np.ones(6),
    calibration_sigma=np.zeros(6),
    alternatives=(),
    update=None,
)


def verified(found: Verification = FOUND, *, passed: bool = True, drift: Any = None, marks: Any = ()) -> Any:
    wrench = np.array([[1.0, 2.0, -12.0, 0.1, 0.2, 0.3], [0.0, 0.0, -10.0, 0.0, 0.0, 0.0]])
    return SimpleNamespace(
        calibration=SimpleNamespace(id="29ce87aabbcc"),
        verification=found,
        records=[SimpleNamespace(pose=SimpleNamespace(number=number)) for number in (3, 12)],
        dataset=SimpleNamespace(wrench=wrench),
        limits=NO_LIMITS,
        force_N=np.array([0.05, 0.5]),
        torque_Nm=np.array([0.005, 0.0]),
        passed=passed,
        update=found.update,
        drift=drift,
        marks=marks,
        path="run/verification.json",
    )


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("ftdrive.words.result.find_moved", lambda _: [SimpleNamespace(words="R03 was not steady")])
    drift_words = "ftdrive.words.result.drift_in_words"
    monkeypatch.setattr(drift_words, lambda drift: ("0.1 N since the first pose", drift == "bad"))

    def run(one: Any) -> list[str]:
        print_verification(cast("Any", one))
        return [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]

    return run


def test_each_pose_has_what_was_measured_predicted_and_the_difference(printed: Any) -> None:
    assert printed(verified(marks=("EMULATED",))) == [
        "Verification 2 poses, calibration 29ce87",
        "EMULATED",
        "measured x, y, z predicted x, y, z differs ± 1 sigma",
        "R03 N 1.000 2.000 -12.000 0.970 2.040 -12.000 0.050 0.030",
        "N·m 0.1000 0.2000 0.3000 0.0970 0.2000 0.2960 0.0050 0.0030",
        "R12 N 0.000 0.000 -10.000 0.000 0.000 -9.500 0.500 0.030",
        "N·m 0.0000 0.0000 0.0000 0.0000 0.0000 0.0000 0.0000 0.0030",
        "PASS largest difference 0.50 N, 0.0050 N·m; chi2 14 for 12 degrees of freedom, p 0.29 "
        "(false alarms: 1 in 100, near the poses of the fit)",
        "? R03 was not steady",
        "Saved run/verification.json",
    ]


def test_a_failure_has_its_reason_and_what_helps(printed: Any) -> None:
    changed = replace(FOUND, passed=False)
    lines = printed(verified(changed, passed=False))
    assert lines[6].startswith("FAILED largest difference")
    assert lines[7] == "the difference has a reason"
    assert lines[-2] == "No update corrects the change: calibrate again."
    helped = replace(changed, update=cast("Any", "bias"))
    assert printed(verified(helped, passed=False))[-2] == "? R03 was not steady"
    noisy = printed(verified(FOUND, passed=False))
    assert noisy[-2].startswith("No significant change: the differences agree with their sigma.")
    assert "the difference has a reason" not in noisy


@pytest.mark.parametrize(
    ("drift", "verbose", "shown"), [("bad", False, True), ("ok", False, False), ("ok", True, True)]
)
def test_a_drift_is_printed_if_it_is_bad(
    drift: str, verbose: bool, shown: bool, printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "verbose", verbose)
    assert ("drift: 0.1 N since the first pose" in printed(verified(drift=drift))) is shown


def test_only_a_difference_beyond_three_sigma_is_marked(monkeypatch: pytest.MonkeyPatch, printed: Any) -> None:
    coloured = Console(file=(file := io.StringIO()), force_terminal=True, color_system="standard", width=120)
    monkeypatch.setattr("ftdrive.terminal.report.answer", coloured)
    printed(verified())
    assert re.findall(r"\x1b\[1;33m *([^ \x1b]*)", file.getvalue()) == ["0.500"]
