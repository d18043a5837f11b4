"""Yu's procedure on the emulated cell: 294 poses in one tour, and the eleven cases of Table III from them."""

import pytest

from ftcalib.compare import CASES
from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_eleven_cases_come_from_one_command(ftdrive: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    # The published methods know no gain and no cross-talk, and a busy computer reads only some samples of a pose.
    perfect = Station(
        "robotous-serial",  # 200 Hz, which costs less of a core than a fast sensor
        ["--gain", "0", "--cross-talk", "0", "--noise", "0.02,0.0008"],
        control_path="script",  # ur_rtde counts its time-outs in real time, which a busy computer exceeds
        values={"robot.speed_deg_s": 180.0, "robot.acceleration_deg_s2": 300.0},
    )
    monkeypatch.setattr(Station, "of", lambda *_: perfect)
    cases = ftdrive.json("solve", "--simulate", "--table-iii")["cases"]
    assert [(one["case"], one["method"], one["data"], one["test_set"]) for one in cases] == list(CASES)
    for one in cases:
        largest = one["test"]["largest"]
        assert 0 < max(largest[f"f{axis}_N"] for axis in "xyz") <= largest["force_N"] < 0.04
        assert 0 < max(largest[f"t{axis}_Nm"] for axis in "xyz") <= largest["torque_Nm"] < 0.002
        assert max(one["test"]["mass_error"], one["test"]["centre_error"]) < 0.002
