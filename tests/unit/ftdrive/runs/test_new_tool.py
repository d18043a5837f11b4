"""Which earlier result may serve a new tool."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult, Setup
from ftcalib.findings import Finding
from ftdrive.errors import ConfigError
from ftdrive.runs import source
from ftdrive.runs.motion import MotionRecording
from ftdrive.runs.run import Run
from ftdrive.runs.source import require_same_cell
from ftdrivers.interfaces import ArmStates, FtSamples
from tests.moving_load import Truth, record, sweep
from tests.unit.ftdrive.stream.simulated import calibrated, calibrated_from

TRUTH = Truth()


def of(sensor: str, arm: str, mount: str | None = None) -> dict[str, Any]:
    return {"devices": {"sensor": {"serial": sensor}, "arm": {"serial": arm}}, "setup": {"mount": mount}}


def earlier(**provenance: Any) -> CalibrationResult:
    return replace(calibrated(), provenance=provenance)


def test_the_same_cell_may_and_what_is_not_named_is_not_compared() -> None:
    require_same_cell(earlier(**of("FT1", "A1", "front")), of("FT1", "A1", "front"))
    require_same_cell(earlier(**of("FT1", "A1")), {"source": "poses.csv"})
    require_same_cell(earlier(), of("FT1", "A1"))


@pytest.mark.parametrize(
    ("now", "words"),
    [(of("FT2", "A1", "front"), "sensor FT1"), (of("FT1", "A2"), "arm A1"), (of("FT1", "A1", "back"), "mount front")],
)
def test_another_cell_may_not(now: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        require_same_cell(earlier(**of("FT1", "A1", "front")), now)


def test_a_rejected_result_may_not() -> None:
    rejected = Finding("not_a_known_code", "reject")
    with pytest.raises(ConfigError, match="rejected"):
        require_same_cell(replace(earlier(), findings=(rejected,)), {})


@pytest.mark.slow
def test_a_run_in_motion_is_solved_with_the_earlier_result_that_it_keeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = record(TRUTH, sweep(8.0), 8.0, 1, rates_Hz=(250.0, 250.0))
    nothing = np.zeros((len(recorded.t_pose_s), 6))
    states = ArmStates(
        (1e9 * recorded.t_pose_s).astype(np.int64),
        recorded.t_pose_s,
        nothing,
        nothing,
        recorded.R_base_flange,
        recorded.p_base_flange_m,
    )
    t_ns = (1e9 * recorded.t_s).astype(np.int64)
    samples = FtSamples.of(t_ns, np.arange(len(t_ns)), recorded.wrench)
    before = calibrated_from({**TRUTH.to_dict(), "noise_force_N": 0.05, "noise_torque_Nm": 0.002})
    run = Run.create(tmp_path, "tool", {"mode": "sweep", "earlier": before.to_dict()})
    MotionRecording(samples, states, 250.0).save(run.new_path("motion", ".npz"))
    monkeypatch.setattr(source, "circumstances_of", lambda _: source.Circumstances(9.80665, Setup(), of("FT1", "A1")))
    assert source.solve_in_motion(run).provenance["parent"] == {"id": before.id}
    with pytest.raises(ConfigError, match="of the sensor FT2"):
        source.solve_in_motion(run, earlier=replace(before, provenance=of("FT2", "A1")))
