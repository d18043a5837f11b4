"""The report of a solve: a headline that its own residuals do not refute, and tables without a cut number."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import click
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Finding, Known, Parameters, Setup, solve
from ftcalib.compare import MethodResult, compare
from ftcalib.errors import NotObservable
from ftcalib.model import DriftResult, SPECIAL_R_flange_base, predict
from ftcalib.result import Method
from ftcalib.routine import DriftCheck
from ftdrive.commands.solve import solve_command
from ftdrive.errors import ConfigError
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.report import print_comparison, print_result
from ftdrive.words.result import drift_in_use, drift_in_words
from tests.unit.ftdrive.exports.example import calibration as followed
from tests.unit.ftdrive.fake_cell import Lab

SIGMA = np.repeat([2e-3, 1e-4], 3)
R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
TILTED = Parameters(  # 0.5 kg under a base that is 1.9 degrees off level
    Rotation.from_euler("z", 80, degrees=True).as_matrix(),
    np.array([0.06, -0.15, -4.9]),
    np.array([3.0, -5.0, 8.0]),
    np.array([0.01, -0.02, 0.09]),
    np.array([0.1, 0.2, -0.3]),
)


@pytest.fixture(autouse=True, scope="module")
def _few_simulations() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftcalib.solver.SIMULATIONS", 20)  # of the covariance of a published method
        yield


def tilted(*, measured: bool = True) -> CalibrationDataset:
    wrench = predict(TILTED, R24) + np.random.default_rng(3).normal(size=(24, 6)) * SIGMA
    cov = np.tile(np.diag(SIGMA**2), (24, 1, 1)) if measured else None
    return CalibrationDataset(R24, wrench, cov, np.zeros(24, np.int64), np.full(24, np.nan))


def test_the_printed_result_separates_free_air_and_contact(capsys: pytest.CaptureFixture[str]) -> None:
    result = solve(tilted())
    print_result(result)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(" under contact: "))
    sigma_N = np.sqrt(result.likely_error()[0] ** 2 + _share(result) * 100.0**2)
    assert f"100 N at the tip ± {sigma_N:.2g} N (1 sigma)" in line
    print_result(solve(tilted(), known=Known(mass_kg=0.61)))
    assert "under contact" not in capsys.readouterr().out, "a rejected result promises nothing"


def _share(result: CalibrationResult) -> float:
    """Squared error of a force at 200 mm below the flange, relative to the force, over random directions."""
    force = np.random.default_rng(7).normal(size=(20_000, 3))
    force /= np.linalg.norm(force, axis=1)[:, None]
    p = result.R_flange_sensor.T @ [0.0, 0.0, 0.2]
    C = result.contact.covariance(np.concatenate([force, np.cross(p, force)], axis=1))
    return float(np.trace(C[:, :3, :3], axis1=1, axis2=2).mean())


def terminal(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    monkeypatch.setattr(answer, "soft_wrap", False)
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", str(width))


def test_a_robot_on_a_wall_is_declared_by_an_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    R_wall_floor = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    floor = tilted()
    replace(floor, R_base_flange=R_wall_floor @ floor.R_base_flange).save(tmp_path / "data.json")
    solve_command.main([str(tmp_path / "data.json"), "--json", "--up", "-1,0,0"], standalone_mode=False)
    assert [one["code"] for one in json.loads(capsys.readouterr().out)["findings"]] == ["base_leans"]


@pytest.mark.slow
def test_calibrate_solve_and_library_say_the_same(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    lab.arm.set_status(payload_kg=2.5)
    lab.cell = replace(lab.cell, workcell=replace(lab.cell.workcell, mounting="3"))
    outcome = lab.calibrate()
    assert outcome is not None
    assert outcome.dataset is not None
    records = outcome.run.records()
    lean = np.radians(3)
    setup = Setup(
        up_in_base=(np.sin(lean), 0, np.cos(lean)), cylinders_m=[(0.0, 0.2, 0.1)], payload_kg=2.5, sensor_mass_kg=None
    )
    result = solve(outcome.dataset, g_m_s2=outcome.result.g_m_s2, setup=setup)
    assert [one.code for one in result.findings] == ["payload_mismatch", "gain_unknown", "base_leans"]
    assert (result.verdict, result.findings) == (outcome.result.verdict, outcome.result.findings)
    capsys.readouterr()
    print_result(outcome.result, drift=outcome.drift, records=records)
    by_calibrate = capsys.readouterr().out
    solve_command.main([str(outcome.run.folder)], standalone_mode=False)
    assert capsys.readouterr().out == by_calibrate
    solve_command.main([str(outcome.run.folder), "--json"], standalone_mode=False)
    found = json.loads(capsys.readouterr().out)
    assert found["hints"] == []
    assert found["verdict"] == "usable"
    assert [Finding.from_dict(one) for one in found["findings"]] == list(result.findings)
    assert [one["words"] for one in found["findings"]] == list(result.reasons)


def test_a_method_that_lacks_the_mass_says_how_to_give_it() -> None:
    with pytest.raises(NotObservable, match="--mass-kg"):
        solve(tilted(), "carlson-cayley")


def shown(compared: list[MethodResult], capsys: pytest.CaptureFixture[str]) -> list[str]:
    print_comparison(compared)
    return capsys.readouterr().out.splitlines()


@pytest.fixture(scope="module")
def compared() -> list[MethodResult]:
    return compare(tilted(), known=Known(mass_kg=0.5))


@pytest.mark.parametrize(("width", "vectors"), [(80, False), (200, True)])
def test_a_narrow_terminal_gets_no_vectors_and_nothing_is_cut(
    width: int,
    vectors: bool,
    compared: list[MethodResult],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal(monkeypatch, width)
    lines = shown(compared, capsys)
    assert "…" not in "".join(lines)
    assert [line.split()[0] for line in lines[2:]] == list(get_args(Method))
    assert max(map(len, lines)) <= max(width, 80)
    assert ("force bias" in lines[0]) == vectors
    for line, one in zip(lines[2:], compared, strict=True):
        assert f" {one.mass_kg:.5f} " in line


def rows_of(text: str) -> dict[str, list[str]]:
    lines = [re.split(r"\s{2,}", line.strip()) for line in text.splitlines()]
    return {
        name: cells for name, *cells in lines if cells and name.rpartition(", ")[2] in {"kg", "mm", "N", "N·m", "deg"}
    }


def test_the_table_has_the_estimates_in_the_units_that_it_names(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "verbose", True)
    print_result(followed(gravity_N=2 * 9.80665 * np.array([np.sin(0.02), 0.0, -np.cos(0.02)])))
    found = {name: float(cells[0]) for name, cells in rows_of(capsys.readouterr().out).items()}
    vectors = {
        "centre of mass {}, mm": (10.0, -20.0, 50.0),
        "force bias {}, N": (1.0, -2.0, 0.0),
        "torque bias {}, N·m": (0.1, -0.2, 0.3),
        "flange to sensor {}, deg": (0.0, 0.0, 90.0),
        "gravity in base {}, N": (0.3922, 0.0, -19.6094),
    }
    expected = {name.format(axis): v for name, values in vectors.items() for axis, v in zip("xyz", values, strict=True)}
    tilt = {"mass, kg": 2.0, "base tilt alpha, deg": 0.0, "base tilt beta, deg": -np.degrees(0.02)}
    assert found == pytest.approx({**expected, **tilt}, abs=6e-4)


def drifted(change: float, *, torque: float = 0.0, elapsed_s: float = 120.0) -> DriftCheck:
    return DriftCheck(np.array([change, 0, 0, torque, 0, 0]), np.repeat([0.01, 0.001], 3), elapsed_s)


RETAKEN = "after the return to it"


@pytest.mark.parametrize(
    ("drift", "words", "bad"),
    [
        (drifted(0.039), "first pose again after 120 s, 0.039 N, 0.0000 N·m away: none seen", False),
        (drifted(-0.041), "first pose again after 120 s, 0.041 N, 0.0000 N·m away: 0.021 N/min", True),
        (drifted(0.0, torque=0.006), "first pose again after 120 s, 0.000 N, 0.0060 N·m away: 0.003 N·m/min", True),
        (drifted(0.5, elapsed_s=-6), f"first pose, repeated 6 s {RETAKEN}, 0.500 N, 0.0000 N·m away: 5 N/min", True),
        (drifted(1.0, elapsed_s=0.1), "first pose again after 0 s, 1.000 N, 0.0000 N·m away: 60 N/min", True),
    ],
)  # fmt: skip
def test_a_drift_is_that_of_a_minute_if_it_exceeds_the_noise(drift: DriftCheck, words: str, bad: bool) -> None:
    assert drift_in_words(drift) == (words, bad)


def test_a_drift_in_the_fit_is_said_with_what_it_means_for_the_next_use(capsys: pytest.CaptureFixture[str]) -> None:
    drift = DriftResult(np.array([0.3, 0.0, 0.4, 0.0, 0.03, 0.04]), np.array([0.01, 0.02, 0.01, 1e-3, 2e-3, 1e-3]))
    quality = {
        "bias_growth_per_min": [0, 0.3, 0.4, 0, 0, 0.002],
        "worst_pose": 3,
        "residual_sigma": [1.0, 1.0, 2.34],
        "loo_force_rms_N": 0.01,
        "loo_torque_rms_Nm": 0.001,
    }
    moved = followed()
    mean_bias = moved.parameters.bias - [0.0, 0.25, 0, 0, 0, 0.01]
    print_result(replace(moved, drift=drift, mean_bias=mean_bias, quality=quality), drift=drifted(0.5), every=True)
    lines = " ".join(capsys.readouterr().out.split())
    assert "drift: first pose again" in lines
    assert "pose 3, 2.3 sigma; each pose" in lines
    assert "drift in the fit: 0.500 ± 0.020 N, 0.0500 ± 0.0020 N·m from the first pose to the last" in lines
    assert "next use: the result has the bias of the last pose, 0.25 N, 0.010 N·m from the mean; it changes" in lines
    assert "it changes by 0.50 N, 0.0020 N·m per minute. Tare before use." in lines
    assert drift_in_use(followed()) is None
    in_motion = replace(moved, drift=drift, mean_bias=mean_bias, quality={"loo_force_rms_N": 0.01, "worst_pose": 3})
    assert drift_in_use(in_motion) is None


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--level-deg", "-1", "-1.0 is not in the range 0<=x<=180"),
        ("--mounting-deg", "nan,0,0", "--mounting-deg is 'nan,0,0': give 3 numbers"),
        ("--mass-kg", "0", "0.0 is not in the range x>0"),
        ("--up", "0,0,0", "--up is 0,0,0, which is not a direction: give 0,0,1"),
    ],
)
def test_an_impossible_known_value_is_reported_as_it_was_given(
    option: str, value: str, words: str, tmp_path: Path
) -> None:
    tilted().save(tmp_path / "data.json")
    with pytest.raises((click.UsageError, ConfigError)) as error:
        solve_command.main([str(tmp_path / "data.json"), option, value], standalone_mode=False)
    assert words in str(error.value)


def test_the_truth_stands_beside_with_the_error_in_sigmas(capsys: pytest.CaptureFixture[str]) -> None:
    truth = followed().to_dict() | {
        "mass_kg": 2.0 - 3 * followed().sigma["mass_kg"],
        "force_bias_N": [0.995, -2.0, 0.0],
    }
    print_result(followed(), truth=truth)
    out = capsys.readouterr().out
    rows = rows_of(out)
    assert rows["mass, kg"][-1] == "+3.0"
    assert rows["force bias x, N"] == ["0.9950", "1.0000", "0.0010", "+5.0"]
    assert "truth: a free tool reads 0.0050 N, 0.00000 N·m rms; before 19.7 N, 0.96 N·m" in out
