"""A calibration that was edited by hand, or made in an emulated cell: refused, or marked in every output."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ftcalib import CalibrationResult
from ftdrive.recording import Recorder
from tests.calibrated_runs import calibrated_run
from tests.unit.ftdrive.recorded import block, calibration, info

Ran = tuple[int, str, str]
SEED = 77
"""Of runs in an emulated cell, which no other test solves."""


@pytest.fixture(scope="module")
def peg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "peg.csv"
    recorder = Recorder([path], info(), {})
    recorder.add(block(1200), [])
    recorder.end()
    return path


@pytest.fixture
def run(run: Callable[..., Ran], peg: Path) -> Callable[..., Ran]:
    """Run a command line beside `c.json` and a recording `peg.csv`."""
    calibration().save(Path("c.json"))
    shutil.copy(peg, "peg.csv")
    return run


def add_6_N() -> None:
    document = json.loads(Path("c.json").read_text())
    document["force_bias_N"][2] += 6.0
    Path("c.json").write_text(json.dumps(document))


USES = {
    "compensate": ["compensate", "peg.csv", "--calibration", "c.json"],
    "export": ["export", "calibration", "c.json", "--format", "ros2-control"],
    "live": ["live", "--replay", "peg.csv", "--calibration", "c.json", "--once"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", USES)
def test_an_edited_calibration_is_refused_unless_it_is_forced_and_then_marked(
    name: str, run: Callable[..., Ran]
) -> None:
    add_6_N()
    code, out, err = run(*USES[name])
    assert (code, out) == (6, "")
    assert "error: c.json: the content is not that of calibration" in err
    assert "--force" in err
    code, out, err = run(*USES[name], "--force")
    assert code == 0, err
    if name != "live":
        assert "EDITED BY HAND" in out
    code, out, err = run(*USES[name], "--force", "--json")
    assert json.loads(out)["marks"] == ["EDITED BY HAND"]


@pytest.mark.parametrize("words", [["report", "c.json", "--format", "json"], ["diff", "c.json", "c.json"]])
def test_nothing_calls_an_edited_calibration_good(words: list[str], run: Callable[..., Ran]) -> None:
    add_6_N()
    code, out, err = run(*words)
    assert (code, out) == (6, "")
    assert "the file is damaged or was edited" in err


@pytest.fixture
def emulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CalibrationResult:
    """That of an emulated cell, in `e.json` and in the run `runs/e`."""
    monkeypatch.chdir(tmp_path)
    station = {"sensor": "can"}
    folder = calibrated_run(Path("runs"), "e", SEED, header={"station": station})
    result = CalibrationResult.load(folder / "calibration.json")
    assert result.provenance["station"] == station
    result.save(Path("e.json"))
    replace(calibration(), provenance={"station": station}).save(Path("d.json"))  # of the devices of the recording
    return result


@pytest.mark.slow
@pytest.mark.usefixtures("emulated")
def test_every_output_of_an_emulated_calibration_says_so(
    run: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftdrive.report.figures.draw_figure", lambda *_: "")  # figures take most of the time
    run("report", "e.json", "-o", "report.html")
    assert "The cell was EMULATED: these are not the values of a real tool." in Path("report.html").read_text("utf-8")
    assert list(json.loads(run("report", "e.json", "--format", "json")[1])["marks"]) == ["EMULATED"]
    _, out, _ = run("history", "runs")
    assert "gripper EMULATED" in " ".join(out.split())
    (row,) = json.loads(run("history", "runs", "--json")[1])["results"]
    assert row["emulated"] is True
    assert run("diff", "e.json", "c.json")[1].splitlines()[0].endswith("EMULATED  e.json")
    assert run("diff", "c.json", "c.json", "--json")[1].count('"emulated": false') == 2
    for form in ("ros2-control", "urdf", "kth"):
        _, out, err = run(
            "export", "calibration", "e.json", "--format", form, "--max-force-error", "9", "--height", "40"
        )
        assert "EMULATED ftdrive calibration" in out
        assert "note: The cell was EMULATED" in err
    assert json.loads(run("export", "calibration", "e.json", "--format", "json")[1])["marks"] == ["EMULATED"]
    assert run("compensate", "peg.csv", "--calibration", "d.json")[1].startswith(" The cell was EMULATED")
    _, out, _ = run("live", "--replay", "peg.csv", "--calibration", "d.json", "--once", "--json")
    assert json.loads(out)["marks"] == ["EMULATED"]
