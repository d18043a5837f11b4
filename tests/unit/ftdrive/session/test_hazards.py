"""The rows of the hazard table."""

import json
import re
from pathlib import Path

from ftdrive.session.events import GuardTripped
from ftdrive.session.hazards import Hazard


def test_the_table_has_a_row_for_each_hazard() -> None:
    readme = (Path(__file__).parents[4] / "docs/explanation/safety.md").read_text(encoding="utf-8")
    assert [int(row) for row in re.findall(r"^\| (\d+) \|", readme, re.MULTILINE)] == list(Hazard)


def test_json_has_the_number_of_the_row() -> None:
    event = GuardTripped(hazard=Hazard.CONTACT, words="31 N")
    assert json.loads(json.dumps(event.to_dict()))["hazard"] == 14
    assert f"{event.hazard}" == "14"
