"""A session with a weighed load on the tool: payload first, the load named in the questions, hung at the first pose."""

from dataclasses import replace

import pytest

from ftdrive.commands.calibrate import refuse_contradictions
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.planning.planner import USUAL_POSTURE_RAD
from ftdrive.runs.load import Load
from ftdrive.session.events import Noted
from tests.unit.ftdrive.fake_cell import Lab

GRIPPED = Load.of("2.0", None, gripped=True)
HUNG = Load.of("2.0", "tip=0,0,200", gripped=False)


def weigh(lab: Lab, tool_kg: float | None, payload_kg: float) -> None:
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, mass_kg=tool_kg))
    lab.arm.set_status(payload_kg=payload_kg)


@pytest.mark.parametrize(
    ("tool_kg", "payload_kg", "words"),
    [
        (1.0, 1.0, "set the payload to 3.00 kg"),
        (None, 1.0, "the mass of sensor, tool and load, above 2.00 kg"),
        (4.0, 6.0, "at least 6.00 kg, but the arm carries 5 kg: take a lighter load"),
    ],
)
def test_the_payload_must_be_the_total(tool_kg: float | None, payload_kg: float, words: str, lab: Lab) -> None:
    weigh(lab, tool_kg, payload_kg)
    with pytest.raises(NotAccepted, match=words):
        lab.calibrate(load=GRIPPED)
    assert lab.arm.moves == []


@pytest.mark.slow
def test_a_gripped_load_is_asked_for(lab: Lab) -> None:
    weigh(lab, 1.0, 3.0)
    assert lab.calibrate(load=GRIPPED) is not None
    assert "2 kg firmly" in lab.operator.asked[0].text
    header = lab.run().header()
    assert Load.of_header(header) == GRIPPED
    assert header["config"]["tool"]["mass_kg"] == 1.0, "the run keeps the mass of the tool alone"


@pytest.mark.slow
def test_a_load_is_hung_when_the_arm_stands_at_the_first_pose(lab: Lab) -> None:
    weigh(lab, 1.0, 3.0)
    lab.arm.q = USUAL_POSTURE_RAD
    lab.calibrate(load=HUNG)
    asked = [question.text for question in lab.operator.asked]
    assert "the weight off" in asked[0]
    assert "Is the space below and beside it free of people" in asked[1]
    assert sum("hang a load of 2 kg at tip now" in text for text in asked) == 1
    assert all(record.swings for record in lab.run().records())
    assert any("repeated while it swings" in event.words for event in lab.operator.of(Noted))


@pytest.mark.parametrize(
    "given",
    [{"--load", "--sweep"}, {"--load", "--from"}, {"--load", "--quick"}, {"--at"}, {"--load", "--at", "--gripped"}],
)
def test_options_that_contradict_a_load_are_refused(given: set[str]) -> None:
    with pytest.raises(ConfigError):
        refuse_contradictions(dict.fromkeys(sorted(given), "given"))
