"""`fleet solve` as a command; the solver runs in this process."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ftcalib import Finding
from ftdrive import __version__
from ftdrive.fleet import workers
from ftdrive.fleet.workers import Workers
from ftdrive.store.store import Store
from tests.calibrated_runs import calibrated_run
from tests.edited_files import edit

Ran = tuple[int, str, str]


@pytest.fixture
def run(run: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    @contextmanager
    def here(_: int | None) -> Iterator[Workers]:
        with ThreadPoolExecutor(1) as thread:
            yield Workers(1, thread.submit, BrokenExecutor)

    monkeypatch.setattr(workers, "local_workers", here)
    return partial(run, "fleet", "solve")


@pytest.mark.slow
def test_the_runs_of_the_store_are_solved_and_the_report_names_what_differs(
    run: Callable[..., Ran], tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    old = calibrated_run(runs, "old", day=-400)
    worse = calibrated_run(runs, "worse")

    def worsen(document: dict[str, Any]) -> None:
        document["force_bias_N"][2] += 1.0
        few = Finding.of("few_poses", n_poses=5, recommended=6)
        document |= {"findings": [few.to_dict()], "verdict": "usable"}

    edit(worse / "calibration.json", worsen)
    damaged = calibrated_run(runs, "damaged")
    Store().index(runs)
    (damaged / "dataset.json").write_text("{}")

    code, out, err = run("--since", "2026-07-31")
    lines = out.splitlines()
    assert code == 7
    assert "1 of 2 runs could not be solved" in err
    assert lines[:2] == [
        f"2 runs with ftdrive {__version__}: 1 solved now, 0 before, 1 failed.",
        "0 unchanged, 1 changed by more than 3 sigma, 1 with another verdict.",
    ]
    assert lines[2].startswith(f"changed: {worse}: force_bias_N.z changed by -")
    assert lines[3] == f"verdict: {worse}: usable before, now good"
    assert lines[4].startswith(f"failed: {damaged}: the field 'format' is missing")
    assert not list(old.glob("solved-*"))

    code, out, _ = run("--json", worse, old)
    found = json.loads(out)
    assert code == 0
    assert (found["schema_version"], found["version"]) == (1, __version__)
    assert (found["runs"], found["solved_before"], found["unchanged"], found["failed"]) == (2, 1, 1, [])
    (changed,) = found["changed"]
    assert (changed["run"], changed["parameter"]) == (str(worse), "force_bias_N.z")
    assert changed["sigmas"] < -3
    assert found["other_verdict"] == [{"run": str(worse), "before": "usable", "now": "good", "finding": None}]
