"""Answers about a cell: what makes them wrong, what devices report, and the draft that keeps them."""

from pathlib import Path

import pytest

from ftdrive.cell.config import settings
from ftdrive.checks import description
from ftdrive.checks.description import BY_KEY, MODEL, ROBOT, TOOL, WALLS, Description, saved_at
from ftdrive.errors import ConfigError
from ftdrivers.clock import REAL

ANSWERS = {
    ROBOT: ["10.0.0.2"],
    MODEL: ["ur5e"],
    "sensor.url": ["ati-can://can0"],
    "sensor.height_mm": ["3.3 cm"],
    TOOL: ["0:33:80", "33 90 50 45 0"],
    WALLS: ["+x 80 cm", "0.6:0:0.8:-400"],
}


@pytest.fixture
def described() -> Description:
    made = Description(REAL, {key: setting.value for key, setting in settings().items()})
    made.texts = {key: list(texts) for key, texts in ANSWERS.items()}
    return made


@pytest.mark.parametrize("key", [ROBOT, MODEL, "sensor.url", "sensor.height_mm", TOOL])
def test_what_must_be_answered_is_named(described: Description, key: str) -> None:
    del described.texts[key]
    with pytest.raises(ConfigError, match=f"{BY_KEY[key].option} is missing and has no default"):
        described.cell()


def test_a_wall_is_judged_whatever_else_is_wrong(described: Description) -> None:
    described.texts["sensor.height_mm"] = ["high"]
    described.judge(BY_KEY[WALLS], "+x 800")
    with pytest.raises(ConfigError, match="from the arm's shoulder"):
        described.judge(BY_KEY[WALLS], "+x 20")


def test_the_model_is_asked_for_where_no_robot_reports_it(
    described: Description, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = {"10.0.0.2": "UR5e", "10.0.0.3": "UR10e"}
    given = []

    def identify(host: str, model: str | None, _: object) -> tuple[str, str]:
        given.append(model)
        return models[host], f"{models[host]}, serial 1"

    monkeypatch.setattr(description, "_identify_robot", identify)
    assert BY_KEY[MODEL] in described.questions
    for host, model in models.items():
        described.look(ROBOT, host)
        assert (described.model, BY_KEY[MODEL] in described.questions) == (model, False)
    # The second arm is not expected to be the first one.
    assert given == ["ur5e", None]
    assert described.found() == {"robot": "UR10e, serial 1", "sensor": "not read when this file was written"}
    described.keep(ROBOT, "10.0.0.4")
    assert BY_KEY[MODEL] in described.questions
    assert MODEL not in described.answered
    assert "serial" not in described.found()["robot"]


def test_a_draft_of_an_emulated_cell_has_no_addresses_for_a_real_one(described: Description, tmp_path: Path) -> None:
    emulated = Description(REAL, {}, simulate=True)
    emulated.texts, emulated.answered = described.texts, set(described.texts)
    emulated.reports = {ROBOT: "UR5e, serial 1"}
    emulated.save(tmp_path / "draft")
    again = Description(REAL, {})
    again.load(tmp_path / "draft")
    assert again.texts.keys() == again.answered == ANSWERS.keys() - {ROBOT, MODEL, "sensor.url"}
    assert again.reports == {}


@pytest.mark.parametrize("content", ["", "[]", '{"format": "ftdrive.draft/1"}', '{"format": "ftdrive.draft/9"}'])
def test_a_broken_draft_is_named(tmp_path: Path, content: str) -> None:
    draft = tmp_path / "draft"
    draft.write_text(content)
    for read in (saved_at, Description(REAL, {}).load):
        with pytest.raises(ConfigError, match=r"draft .* delete it"):
            read(draft)
