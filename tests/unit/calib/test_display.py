"""What `print` and a notebook show: short, escaped, and the numbers of the screens."""

import re
import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import ftcalib
from ftcalib.display import MOST_LINES, Displayed, Row, Summary, brief
from ftcalib.errors import UsageError
from ftcalib.findings import Finding
from ftcalib.model import PARAMETER_NAMES, predict
from ftcalib.poses.information import special
from ftcalib.result import CalibrationResult
from ftcalib.rounding import with_sigma
from tests.house.example_data import TRUTH

MARKUP = "<script>alert('&')</script>"


@pytest.fixture(scope="module")
def dataset() -> ftcalib.CalibrationDataset:
    R = special(range(1, 25))
    wrench = predict(TRUTH, R) + np.random.default_rng(4).normal(0, 0.01, (24, 6))
    return ftcalib.CalibrationDataset.of(R, wrench, wrench_cov=1e-4 * np.eye(6), t_s=np.arange(24.0))


@pytest.fixture(scope="module")
def result(dataset: ftcalib.CalibrationDataset) -> CalibrationResult:
    return ftcalib.solve(dataset)


def test_a_result_prints_its_verdict_estimates_and_findings_in_ten_lines(result: CalibrationResult) -> None:
    many = replace(result, findings=tuple(Finding.of("few_poses", n_poses=n, recommended=6) for n in (3, 4, 5)))
    for one in (result, many):
        lines = repr(one).splitlines()
        assert len(lines) <= MOST_LINES
        assert one.id in lines[0]
        assert lines[0].endswith(one.verdict.upper())
    mass = with_sigma(result.mass_kg, float(result.sigma["mass_kg"]))
    assert re.search(rf"^  mass +{re.escape(mass)} kg$", repr(result), re.MULTILINE)
    assert repr(many).splitlines()[-2:] == [
        "  there are only 3 poses: take 6 or more",
        "  there are only 4 poses: take 6 or more (and 1 more)",
    ]
    assert many._repr_html_().count("<li>") == 3


def test_known_values_are_fixed(dataset: ftcalib.CalibrationDataset) -> None:
    found = ftcalib.solve(dataset, known=ftcalib.Known(R_flange_sensor=TRUTH.R_flange_sensor))
    assert re.search("flange to sensor .* fixed, .* fixed, .* fixed deg", repr(found))


def test_a_motion_shows_as_much(result: CalibrationResult) -> None:
    motion = ftcalib.result.MotionResult(1e-3 * np.eye(3), 0.012, 0.03, 1e-8 * np.eye(23), 0.8)
    shown = replace(result, motion=motion)
    assert len(repr(shown).splitlines()) <= MOST_LINES
    assert "80 % used" in repr(shown)
    assert "inertia xy, xz, yz" in shown._repr_html_()


def test_html_escapes_every_text() -> None:
    summary = Summary(MARKUP, [Row(MARKUP, [MARKUP, "1"], MARKUP), Row("b", ["2"])], [MARKUP], MARKUP)
    html = summary.html()
    assert "<script" not in html
    assert html.count("&lt;") == 12
    widths = [[int(one or 1) for one in re.findall(r'<td (?:colspan="(\d)")?', row)] for row in html.split("<tr>")[1:]]
    assert widths == [[1, 1, 1], [3]]


@dataclass(frozen=True, repr=False)
class Many(Displayed):
    a: Any = 1.23456789
    b: Any = "x" * 100
    c: Any = ()
    d: Any = None
    e: Any = 1
    f: Any = 1
    g: Any = 1
    h: Any = 1
    i: Any = 1
    j: Any = 1


def test_any_other_object_shows_its_fields_in_ten_lines() -> None:
    lines = repr(Many(c=np.zeros((1000, 6)), d=Many(c=[0] * 100))).splitlines()
    assert len(lines) == MOST_LINES
    assert lines[0] == "Many"
    assert [line.split(None, 1)[1] for line in lines[1:5]] == ["1.23457", f"{'x' * 60}…", "array (1000, 6)", "Many"]
    assert lines[-1].split() == ["…", "2", "more"]
    assert brief([0] * 100) == "100 entries"
    assert brief(np.float64(0.5)) == "0.5"


def test_a_finding_and_a_dataset(dataset: ftcalib.CalibrationDataset) -> None:
    assert repr(Finding.of("few_poses", n_poses=5, recommended=6)) == (
        "few_poses (limit): there are only 5 poses: take 6 or more"
    )
    shown = repr(replace(dataset, meta={"source": MARKUP}))
    assert shown.startswith("Dataset of 24 poses")
    assert "0.01 N" in shown
    assert len(shown.splitlines()) <= MOST_LINES


def stand_in(monkeypatch: pytest.MonkeyPatch, present: str) -> None:
    """Let a package be the only one that makes a DataFrame, which is the dict that it was given."""
    for name in ("pandas", "polars"):
        package = ModuleType(name)
        package.DataFrame = dict  # type: ignore[attr-defined]  # all that is used of it
        monkeypatch.setitem(sys.modules, name, package if name == present else None)


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_a_result_becomes_a_frame_of_either_package(
    package: str, result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(monkeypatch, package)
    frame = result.to_frame()
    rows = dict(zip(frame["name"], zip(frame["value"], frame["sigma"], frame["unit"], strict=True), strict=True))
    assert set(PARAMETER_NAMES) < set(rows)
    assert rows["mass_kg"] == (result.mass_kg, result.sigma["mass_kg"], "kg")
    assert rows["torque_bias_Nm.z"] == (result.torque_bias_Nm[2], result.sigma["torque_bias_Nm"][2], "N·m")  # type: ignore[index]
    assert rows["R_flange_sensor.x"][2] == rows["tilt_alpha_rad"][2] == "rad"


def test_a_dataset_becomes_a_frame_that_is_read_again(
    dataset: ftcalib.CalibrationDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ftdrive

    stand_in(monkeypatch, "pandas")
    again = ftdrive.read_dataset(dataset.to_frame())
    assert dataset.wrench_cov is not None
    assert again.wrench_cov is not None
    for one, other in ((again.R_base_flange, dataset.R_base_flange), (again.wrench_cov, dataset.wrench_cov)):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_array_equal(again.wrench, dataset.wrench)


def test_a_missing_package_is_named_with_the_line_to_type(
    result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(monkeypatch, "")
    with pytest.raises(UsageError, match="pip install pandas"):
        result.to_frame()
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UsageError, match="pip install matplotlib"):
        result.plot()


def test_a_result_is_drawn_as_its_residuals(result: CalibrationResult) -> None:
    pytest.importorskip("matplotlib")
    figure = replace(result, weights=np.r_[0.0, np.ones(23)]).plot()
    force, torque = figure.axes
    lines = [line for line in force.lines if len(line.get_xdata()) == 24]
    np.testing.assert_array_equal([line.get_ydata() for line in lines], result.residuals[:, :3].T)
    assert len([line for line in torque.lines if len(line.get_xdata()) == 1]) == 3  # the rejected pose, an axis each
    assert figure._repr_png_().startswith(b"\x89PNG")
