"""A report: its formats agree with the result, nothing leaves the page, and names of devices stay text."""

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from markupsafe import escape
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.accuracy import error_map, tip_of
from ftcalib.errors import BadCalibration, BadDataset
from ftcalib.model import predict
from ftcalib.result import MotionResult
from ftcalib.routine import PoseRecord, TourPose
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cli import cli
from ftdrive.errors import ConfigError
from ftdrive.report.facts import comparison_facts, contact_error, facts_of
from ftdrive.report.figures import VARIABLES
from ftdrive.report.page import render_page as written
from ftdrive.report.sections import comparison, contact, coverage, cross_validation, sections_of
from ftdrive.report.subject import Subject, read_subject
from ftdrive.runs.run import Reading, Run
from ftdrive.runs.source import SolveOptions
from ftdrivers.interfaces import FtSamples
from tests.known_cells import TURNED as TRUTH

SIGMA = np.repeat([5e-3, 2e-4], 3)
EVIL = '<script>alert("x")</script>"><img src=http://x onerror=alert(1)> | `'
R8 = Rotation.random(8, rng=4).as_matrix()


@cache
def dataset(seed: int = 0) -> CalibrationDataset:
    wrench = predict(TRUTH, R8) + np.random.default_rng(seed).normal(0, SIGMA, (8, 6))
    cov = np.tile(np.diag(SIGMA**2), (8, 1, 1))
    return CalibrationDataset(R8, wrench, cov, np.full(8, 400), np.arange(8.0), {"by": EVIL})


@cache
def result(seed: int = 0) -> CalibrationResult:
    return solve(dataset(seed), provenance={"devices": {"sensor": {"serial": EVIL}}, EVIL: "1"})


@cache
def facts() -> Mapping[str, Any]:
    subject = Subject(Path(f"{EVIL}.csv"), result(), "", dataset(), solved_with={"drift": "auto"}, parent=result(1))
    return facts_of(replace(subject, parent_name=EVIL))


@pytest.mark.slow
def test_the_head_names_arm_sensor_tool_and_date(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = {"arm": {"model": "UR5e", "serial": "1"}, "sensor": {"model": "Mini45", "serial": "FT9"}}
    known = {"devices": devices, "setup": {"tool": "gripper"}, "created_utc": "2026-11-23T07:58:25+00:00"}
    about = facts_of(Subject(Path("poses.csv"), replace(result(), provenance=known), ""))["about"]
    assert about == "UR5e 1, Mini45 FT9, tool gripper, 2026-11-23 07:58 UTC"
    assert f"<p>{escape(facts()['about'])}</p>" in html()
    monkeypatch.setattr("ftdrive.report.figures.draw_figure", lambda *_: "")
    assert f"<p>{about}</p>" in written({**facts(), "about": about})


def test_nothing_is_cut_on_paper() -> None:
    printed = html().partition("@media print")[2].partition("</style>")[0]
    assert ".scroll { overflow: visible; }" in printed
    assert "white-space: normal" in printed


@cache
def html() -> str:
    return written(facts())


class Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.style = ""
        self.feed(html())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_data(self, data: str) -> None:
        if self.elements[-1:] and self.elements[-1][0] == "style":
            self.style += data
        else:
            self.text += data + "\n"

    def of(self, tag: str) -> Iterator[dict[str, str]]:
        return (attributes for name, attributes in self.elements if name == tag)


@cache
def page() -> Page:
    return Page()


def test_the_page_shows_the_numbers_of_the_result() -> None:
    text = page().text
    assert {table.caption for section in sections_of(facts()) for table in section.tables} <= {"", *text.splitlines()}
    assert result().id in text
    assert result().verdict.upper() in text
    assert f"{result().quality['loo_force_rms_N']:.3g}" in text
    assert str(result().provenance["dataset_sha256"]) in text
    estimate, sigma = map(float, text.partition("\nmass, kg\n")[2].split()[:2])
    assert sigma == pytest.approx(result().sigma["mass_kg"], rel=0.06)
    assert estimate == pytest.approx(result().mass_kg, abs=sigma / 10)
    assert html().count('<th scope="row">ml</th>') == 1
    assert all(section.title in page().text for section in sections_of(facts()))
    assert [section.name for section in sections_of(facts())] == [
        *("estimates", "error", "contact", "cross-validation", "residuals", "drift"),
        *("noise", "coverage", "tour", "comparison", "provenance"),
    ]


def test_a_result_in_motion_is_not_reported_as_poses() -> None:
    motion = MotionResult(2e-3 * np.eye(3), 0.003, 0.04, 1e-8 * np.eye(23), 0.9)
    found = facts_of(Subject(Path("sweep"), replace(result(), motion=motion), ""))
    named = {section.name: section for section in sections_of(found)}
    assert list(named) == [
        *("estimates", "error", "contact", "motion", "residuals", "coverage", "tour", "comparison", "provenance")
    ]
    assert "parts of the motion" in named["estimates"].text[0]
    assert [figure.name for figure in named["residuals"].figures] == ["time_residuals"]


def test_the_page_refers_to_nothing_outside_and_runs_nothing() -> None:
    assert not {name for name, _ in page().elements} & {"script", "link", "iframe", "object", "embed", "img", "image"}
    for _, attributes in page().elements:
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("href", "src", "xlink:href", "action", "data"):
            assert attributes.get(name, "#").startswith("#")
        assert not re.search(r"url\((?!#)", " ".join(attributes.values()))
    assert "@import" not in page().style
    assert "url(" not in page().style
    assert len(html().encode()) < 3_000_000


def test_ids_are_unique_and_references_lead_somewhere() -> None:
    ids = Counter(attributes["id"] for _, attributes in page().elements if "id" in attributes)
    assert ids.most_common(1)[0][1] == 1
    wanted = [attributes["href"] for _, attributes in page().elements if "href" in attributes]
    wanted += re.findall(r"url\((#[^)]*)\)", html())
    assert {one.removeprefix("#") for one in wanted} <= ids.keys()


def test_figures_take_their_ink_from_the_page() -> None:
    svg = html()[html().index("<svg") :]
    assert not [colour for colour in VARIABLES if colour in html()]
    assert "currentColor" in svg
    defined = set(re.findall(r"(--[\w-]+):", page().style))
    assert set(re.findall(r"var\((--[\w-]+)\)", html())) <= defined
    dark = page().style[page().style.index("prefers-color-scheme: dark") :]
    assert {"--paper", "--ink", "--series-0", "--series-1", "--series-2", "--grid", "--bad"} <= set(
        re.findall(r"(--[\w-]+):", dark[: dark.index("body")])
    )


def test_a_malicious_name_stays_text() -> None:
    assert page().text.count(EVIL) >= 3  # source, parent, serial number


def with_covariance(diagonal: Mapping[int, float]) -> CalibrationResult:
    covariance = np.zeros((15, 15))
    for k, variance in diagonal.items():
        covariance[k, k] = variance
    level = Parameters(np.eye(3), np.array([0, 0, -10.0]), np.zeros(3), np.array([0, 0, 0.1]), np.zeros(3))
    return replace(result(), parameters=level, covariance=covariance, response=None)


def test_the_error_map_follows_from_the_covariance() -> None:
    turned = error_map(with_covariance({2: 0.01**2}))["force_N"]  # about flange z: nothing while the tool is vertical
    np.testing.assert_allclose(np.array(turned["map"])[[0, -1]], 0, atol=1e-12)
    assert turned["largest"] == pytest.approx(10 * 0.01)
    assert turned["worst_direction"][2] == pytest.approx(0, abs=1e-12)
    assert np.array(turned["map"]).shape == (19, 37)
    biased = error_map(with_covariance({6: 0.03**2, 13: 0.004**2}))
    np.testing.assert_allclose(biased["force_N"]["map"], 0.03)
    assert biased["force_N"]["rms"] == pytest.approx(0.03)
    assert biased["torque_Nm"]["largest"] == pytest.approx(0.004)


def test_a_contact_has_the_sigma_of_its_sensor_with_and_without_loads() -> None:
    usual = SensorMatrix.usual()
    made = {"created_utc": "2026-11-20T08:00:00+00:00"}
    sensor = replace(
        usual, source="loads", error=0.02 * np.eye(6), covariance=usual.covariance / 100, floor=0.0, provenance=made
    )
    before, now = result(), replace(result(), sensor=sensor)
    assumed, known = (contact_error(one) for one in (before, now))
    assert (assumed["without_loads_N"], assumed["tool"]) == (None, None)
    assert known["without_loads_N"] == assumed["sigma_N"]
    assert max(known["sigma_N"][1:]) < 0.6 * max(assumed["sigma_N"])
    assert known["sigma_N"][0] == assumed["sigma_N"][0] == pytest.approx(before.likely_error()[0])
    assert known["tool"]["mass_kg"] == pytest.approx(before.mass_kg / 1.02)
    # The figure is the mean over all directions of what `contact_sigma` says of one.
    force = np.random.default_rng(2).normal(size=(4000, 3))
    force *= 100 / np.linalg.norm(force, axis=1)[:, None]
    wrench = np.concatenate([force, np.cross(tip_of(before), force)], axis=1)
    R = Rotation.random(len(force), rng=3).as_matrix()
    each = np.sqrt(np.mean(np.sum(before.contact_sigma(wrench, R)[:, :3] ** 2, axis=1)))
    assert assumed["sigma_N"][-1] == pytest.approx(each, rel=0.02)
    assert "errors of the sensor are assumed, not measured" in assumed["words"]
    assert "known from loads, sensor.json of 2026-11-20" in known["words"]
    assert any(f"the tool weighs {before.mass_kg / 1.02:.4f} kg" in one for one in contact({"contact": known}).text)
    differences = comparison({**facts(), "comparison": comparison_facts(now, before)}).text
    assert "assumed, not measured before, known from loads, sensor.json of 2026-11-20 08:00 now" in differences[1]


def test_the_tip_is_the_far_end_of_the_described_tool() -> None:
    R = result().R_flange_sensor
    np.testing.assert_allclose(R @ tip_of(result()), [0, 0, 0.2], atol=1e-12)
    setup = {"cylinders_mm": [[0, 40, 80], [40, 170, 20, 5, -3]], "height_mm": 30}
    described = replace(result(), provenance={"setup": setup})
    np.testing.assert_allclose(R @ tip_of(described), [0.005, -0.003, 0.14])


CONFIG = {
    "site": {"g_m_s2": 9.80665},
    "workcell": {"mounting": "floor"},
    "robot": {"host": "10.0.0.2"},
    "sensor": {"url": "ati-can://can0"},
}
DEVICES = {"arm": {"model": "UR5e", "serial": "1"}, "sensor": {"model": EVIL, "serial": "FT1"}}


def recorded(folder: Path, noise: float) -> Run:
    """A run of eight poses taken by hand; `noise` is added to each pose as a whole."""
    run = Run.create(folder, "manual", {"mode": "manual", "config": CONFIG, "devices": DEVICES})
    rng, n = np.random.default_rng(5), 100
    for stop, R in enumerate(R8, start=1):
        reading = Reading(stop * 10**9, np.zeros(6), R)
        wrench = predict(TRUTH, R) + rng.normal(0, noise, 6) * [1, 1, 1, 0.1, 0.1, 0.1] + rng.normal(0, SIGMA, (n, 6))
        t_ns = stop * 10**9 + np.arange(n) * 10**6
        samples = FtSamples.of(t_ns, np.arange(n), wrench)
        run.commit(PoseRecord(stop, TourPose(100 + stop, np.zeros(6)), reading, reading, samples, steady=stop != 3))
    return run


@pytest.fixture
def no_other_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the seconds that a comparison of methods takes."""
    monkeypatch.setattr("ftdrive.report.facts.compare", lambda *_, **__: [])


def command(*arguments: str | Path) -> Any:
    return CliRunner().invoke(cli, ["report", *map(str, arguments)])


@pytest.mark.slow
@pytest.mark.usefixtures("no_other_methods")
def test_a_rejected_run_gets_a_report_with_its_reasons(tmp_path: Path) -> None:
    run = recorded(tmp_path, noise=5.0)
    outcome = command(run.folder, "--format", "json")
    assert outcome.exit_code == 0, outcome.output
    found = json.loads(outcome.stdout)
    assert found["verdict"] == "rejected"
    assert "Do not use the calibration" in found["next_step"]
    assert any("R103 was not steady" in one["words"] for one in found["hints"])
    assert found["tour"]["devices"] == DEVICES
    assert not run.calibration_path.exists()


def test_a_saved_result_is_reported_with_the_data_of_its_run(tmp_path: Path) -> None:
    run = recorded(tmp_path, noise=0.0)
    saved = read_subject(run.folder, SolveOptions()).result
    saved.save(run.calibration_path)
    for source in (run.folder, run.calibration_path):
        subject = read_subject(source, SolveOptions(), run.calibration_path)
        assert subject.result.provenance == saved.provenance
        assert subject.dataset is not None
        assert len(subject.records) == 8
        assert subject.parent is not None
        assert subject.reproduce == run.solve_command
    moved = tmp_path / "calibration.json"
    saved.save(moved)
    assert read_subject(moved, SolveOptions()).dataset is None
    with pytest.raises(ConfigError, match="already solved"):
        read_subject(moved, SolveOptions(drift="none"))


def test_the_named_parent_is_found_beside_the_result_or_its_absence_is_reported(tmp_path: Path) -> None:
    result(1).save(tmp_path / "old.json")
    named = replace(result(), provenance={"parent": {"id": result(1).id, "path": "old.json"}})
    named.save(tmp_path / "new.json")
    assert read_subject(tmp_path / "new.json", SolveOptions()).parent is not None
    (tmp_path / "old.json").unlink()
    subject = read_subject(tmp_path / "new.json", SolveOptions())
    assert subject.parent is None
    assert "--parent" in subject.parent_name
    with pytest.raises((BadCalibration, OSError)):
        read_subject(tmp_path / "new.json", SolveOptions(), tmp_path / "old.json")


def test_a_result_without_its_data_is_reported_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    result().save(path)
    outcome = command(path, "-o", tmp_path / "report.json")
    assert outcome.exit_code == 0, outcome.output
    found = json.loads((tmp_path / "report.json").read_text())
    assert "report its run folder" in coverage(found).text[0]
    assert cross_validation(found).text[-1].startswith("The methods are not compared.")
    assert "does not" not in command(path, "--format", "json").output


@pytest.mark.parametrize("name", ["report.md", "report"])
def test_a_file_of_another_format_is_refused_before_any_work(name: str) -> None:
    error = command("--simulate", "-o", name).exception
    assert isinstance(error, ConfigError)
    assert str(error) == f"{name} does not have the suffix of a report: name it .html or .json, or give --format"


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "half.json"
    path.write_text('{"format": "ftd')
    with pytest.raises(BadDataset, match=r"half\.json"):
        read_subject(path, SolveOptions())


@pytest.mark.usefixtures("no_other_methods")
def test_no_report_is_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ftdrive.commands.report.render_page", lambda *_: "page")
    dataset().save(tmp_path / "dataset.json")
    (tmp_path / "report.html").write_text("mine")
    for n in (2, 3):
        assert f"Saved report-{n}.html" in command("dataset.json").stdout
    for arguments in (("-o", "report.html"), ("--format", "json", "-o", "report.html")):
        outcome = command("dataset.json", *arguments)
        assert isinstance(outcome.exception, ConfigError)
        assert "never overwritten" in str(outcome.exception)
    assert (tmp_path / "report.html").read_text() == "mine"


def test_a_page_without_its_extra_is_a_matter_of_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ConfigError, match="of the extra report"):
        written(facts())


@pytest.mark.usefixtures("no_other_methods")
def test_the_options_of_solve_are_those_that_reproduce_the_result(tmp_path: Path) -> None:
    path = tmp_path / "my poses.csv"
    rows = np.c_[np.swapaxes(R8, 1, 2).reshape(8, 9), dataset().wrench]
    header = "r11,r12,r13,r21,r22,r23,r31,r32,r33,fx,fy,fz,tx,ty,tz"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    outcome = command(path, "--orientation", "R_flange_base", "--drift", "none", "--format", "json")
    document = json.loads(outcome.stdout)
    assert document["reproduce"].endswith("my poses.csv' --orientation R_flange_base --drift none")
    assert document["result"]["mass_kg"] == pytest.approx(12 / 9.80665, rel=0.01)
