"""`fleet accuracy` as a command; the solver runs in this process."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from ftcalib import CalibrationResult
from ftdrive import __version__
from ftdrive.store.store import Store
from tests.calibrated_runs import calibrated_run, white_run
from tests.edited_files import edit

Ran = tuple[int, str, str]


@pytest.fixture
def run(fleet_here: Callable[..., Ran]) -> Callable[..., Ran]:
    return partial(fleet_here, "accuracy")


def too_sure(folder: Path) -> Path:
    """Make the stated sigmas of a run three times too small."""
    path = folder / "calibration.json"
    result = CalibrationResult.load(path)
    path.unlink()
    replace(result, covariance=result.covariance / 9).save(path)
    return folder


def test_runs_of_the_store_are_checked_and_the_sigmas_that_do_not_hold_are_named(
    run: Callable[..., Ran], tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    honest, wrong = white_run(runs, "honest"), too_sure(white_run(runs, "wrong"))
    Store().index(runs)
    code, out, err = run("--draws", "20")
    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert lines[0] == f"{honest}: 20 draws of 8 poses with the measured noise"
    assert lines[1].split("  ")[-1] == "inside 95 %"
    assert [line[:17].strip() for line in lines[2:8]] == [
        *("mounting rotation", "gravity force", "force bias", "centre of mass", "torque bias", "mass")
    ]
    assert lines[9:11] == ["0 draws were rejected, 0 were not observable.", "The stated sigmas hold."]
    assert lines[11].startswith(f"{wrong}: 20 draws")
    assert lines[21].startswith("The stated sigma of the mounting rotation is too small: the scatter is ")
    assert all(line.endswith(" times as large.") for line in lines[21:])

    code, out, _ = run("--json", "--draws", "20", wrong)
    found = json.loads(out)
    assert code == 0
    assert (found["schema_version"], found["version"]) == (1, __version__)
    assert (found["draws"], found["seed"], found["failed"]) == (20, 0, [])
    (one,) = found["runs"]
    assert (one["run"], one["poses"], one["components"], one["rejected"]) == (str(wrong), 8, {}, 0)
    force = one["groups"]["force_bias_N"]
    assert force["ratio"] == pytest.approx(force["scatter"] / force["stated"])
    assert not force["holds"]
    assert f"{force['ratio']:.2f} times" in lines[23]


def test_a_run_that_fails_and_one_without_a_calibration(run: Callable[..., Ran], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    (calibrated_run(runs, "rejected") / "calibration.json").unlink()
    (calibrated_run(runs, "damaged") / "dataset.json").write_text("{}")
    few = white_run(runs, "few")
    edit(few / "calibration.json", lambda document: document.update(weights=[1, 1, 1, 0, 0, 0, 0, 0]))
    code, out, err = run("runs", "--draws", "20")
    assert code == 7
    assert "they have no calibration: 1 runs; `ftdrive solve RUN` shows why." in err
    assert "1 of 2 runs could not be solved" in err
    failed, head, *rest = out.splitlines()
    assert failed.startswith(f"failed: {runs / 'damaged'}: dataset.json: the field 'format' is missing")
    assert head == f"{few}: 20 draws of 3 poses with the measured noise"
    assert rest == [
        "0 draws were rejected, 20 were not observable.",
        "Only 0 draws were accepted, too few for a statement: take more with --draws.",
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "2", "--cluster", "dask://host:1"], "--workers and --cluster exclude one another"),
        ([".", "--store", "sqlite:////x"], "RUNS and --store exclude one another"),
        (["--draws", "19"], "19 is not in the range"),
        (["--seed", "-1"], "-1 is not in the range"),
    ],
)
def test_a_mistake_is_one_sentence(run: Callable[..., Ran], arguments: list[str], words: str) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert words in err
