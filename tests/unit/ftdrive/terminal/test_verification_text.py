"""A verification as it is printed."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

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


FAILED = replace(FOUND, passed=False)


@pytest.mark.parametrize(
    ("one", "verbose"),
    [
        pytest.param(verified(marks=("EMULATED",)), False, id="passed"),
        pytest.param(verified(FAILED, passed=False), False, id="failed"),
        pytest.param(verified(replace(FAILED, update=cast("Any", "bias")), passed=False), False, id="update"),
        pytest.param(verified(FOUND, passed=False), False, id="noisy"),
        pytest.param(verified(drift="bad"), False, id="drift"),
        pytest.param(verified(drift="ok"), True, id="small-drift-verbose"),
    ],
)
def test_what_is_printed(
    one: Any, verbose: bool, printed: Any, monkeypatch: pytest.MonkeyPatch, snapshot: SnapshotAssertion
) -> None:
    monkeypatch.setattr(messages, "verbose", verbose)
    assert "\n".join(printed(one)) == snapshot
