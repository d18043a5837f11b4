"""One fact has one wording: in the terminal, on the page, in the report and in JSON."""

import html
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from ftcalib import CalibrationResult
from ftcalib.findings import Verdict
from ftdrive.report.facts import facts_of
from ftdrive.report.page import templates, with_code
from ftdrive.report.sections import capitalized
from ftdrive.report.subject import Subject
from ftdrive.session.events import State, StateChanged
from ftdrive.terminal.report import print_result
from ftdrive.terminal.screen import draw_session
from ftdrive.view.outcome import conclude_calibration
from ftdrive.view.page import Page
from ftdrive.view.session_page import SessionPage
from ftdrive.words.session import SessionText, SessionView, state_in_words
from tests.finding_examples import examples
from tests.unit.ftdrive.exports.example import calibration
from tests.unit.ftdrive.fake_cell import Scripted


def read(result: CalibrationResult) -> str:
    environment = templates("ftdrive.report", "", "report", "")
    environment.filters["sentence"] = lambda text: with_code(capitalized(text))
    facts = facts_of(Subject(Path("poses.csv"), result, ""))
    page = environment.get_template("report.html.j2").render(facts=facts, sections=[], drawn={}, version="")
    return " ".join(html.unescape(re.sub("<[^>]*>", "", page)).split())


def shown(result: CalibrationResult) -> str:
    page = Page("ftdrive calibrate")
    conclude_calibration(page, result, [])
    return " ".join(str(json.loads(page.since(0)[1])).split())


def test_every_finding_is_worded_alike(capsys: pytest.CaptureFixture[str]) -> None:
    every = tuple(examples())
    result = replace(calibration(), findings=every)
    print_result(result, every=True)
    terminal, report = " ".join(capsys.readouterr().out.split()), read(result).lower().replace("`", "")
    for one in every:
        assert one.found in terminal
        assert one.fix in terminal
        assert one.words.lower().replace("`", "") in report
    assert [one["words"] for one in result.to_dict()["findings"]] == [one.words for one in every]


@pytest.mark.parametrize("verdict", get_args(Verdict))
def test_a_verdict_and_its_error_are_worded_alike(verdict: Verdict, capsys: pytest.CaptureFixture[str]) -> None:
    some = {"good": "base_leans", "usable": "few_poses", "rejected": "repeated_poses"}[verdict]
    result = replace(calibration(), findings=tuple(one for one in examples() if one.code == some))
    print_result(result)
    terminal, page, report = " ".join(capsys.readouterr().out.split()), shown(result), read(result)
    error = re.search(rf"{verdict.upper()} (compensation error [^)]*\))", terminal)
    assert error is not None
    assert error[1] in page
    assert error[1].removeprefix("compensation ") in report
    for one in result.findings:
        assert one.found in terminal
        assert f"fix: {one.fix}" in terminal
        assert one.found in page
        assert f"fix: {one.fix}" in page
    assert verdict.upper() in page
    assert verdict.upper() in report
    assert result.to_dict()["verdict"] == verdict


@pytest.mark.parametrize("state", State)
def test_every_state_of_a_session_is_worded_alike(state: State) -> None:
    event, view = StateChanged(state=state, stop=3, stops=25, number=7, words="because"), SessionView()
    view.update(event, time.monotonic())
    where, said, words = state_in_words(view, time.monotonic())
    screen = "\n".join(line.plain for line in draw_session(view, time.monotonic()).renderables)  # type: ignore[union-attr]
    page = Page("ftdrive calibrate")
    operator = SessionPage(page, Scripted(), "calibrate")
    operator.show(event)
    operator.draw()
    part = json.loads(page.since(0)[1])["state"]
    assert said.startswith(state.upper())
    assert f"{where}  {said}  {words}" in screen
    assert (part["head"], part["lines"]) == (f"{where}  {said}", [words])
    assert event.to_dict()["state"] == state
    for line in SessionText(verbose=True).lines(event):
        assert line.words in {"Tour", "Motion"} or line.words.lower() == f"{state}: {words}"
