"""The page of URScript constructs lists what our programs use, and no more."""

import re
from pathlib import Path

import pytest

from ftdrive.exports.urscript import functions, program
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.planner import guess_of, plan_tour
from ftdrivers.ur.script_control import program_text, without_comments

PAGE = Path(__file__).parents[4] / "docs" / "reference" / "urscript-constructs.md"
KEYWORDS = {"def", "thread", "run", "kill", "while", "if", "elif", "else", "return", "halt", "global", "local"}
WORDS = KEYWORDS | {"and", "or", "not", "True", "False"}
SENT = [program_text(1, version, 5.0) for version in ((3, 15), (5, 4), (5, 15), (10, 11))]


@pytest.fixture(scope="module")
def programs() -> list[str]:
    certifier = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene())
    plan = plan_tour(certifier, poses=24, speeds=Speeds(), guess=guess_of(certifier)).marked(measured=True)
    exported = [program(plan, dwell_s=1.0), functions(24, example=True)]
    return [*SENT, *map(without_comments, exported)]


def constructs(text: str) -> set[str]:
    """Words of the language, functions of the controller, and forms."""
    code = re.sub(r'"[^"]*"|#.*', "", text)
    own = set(re.findall(r"(?:def|thread) (\w+)\(", code))
    found = WORDS & set(re.findall(r"\w+", code))
    found |= set(re.findall(r"\b([a-z]\w+)\(", code)) - own - WORDS
    forms = {"list[i]": r"\w\[[^]]+\] *[^ =]", "list[i] = value": r"\w\[[^]]+\] = ", "name=value": r"[(,] *\w+=\w"}
    return found | {form for form, pattern in forms.items() if re.search(pattern, code)}


def test_the_page_lists_the_constructs_of_our_programs(programs: list[str]) -> None:
    table = PAGE.read_text(encoding="utf-8").split("## Our programs")[1]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    listed = set(re.findall(r"`([^`]+)`", "".join(rows)))
    assert listed == set.union(*map(constructs, programs))


@pytest.mark.parametrize("text", SENT)
def test_nothing_is_sent_that_a_report_says_a_controller_rejects(text: str) -> None:
    lines = text.splitlines()
    assert not [line for line in lines if line.lstrip().startswith("#") or not line.strip()]
    depth, known, loops = 0, set[str](), list[int]()
    for line in lines:
        words = line.split()
        if words[0] in {"def", "thread", "while", "if"}:
            depth += 1
            loops += [depth] if words[0] == "while" else []
        elif words[0] == "end":
            loops = [loop for loop in loops if loop != depth]
            depth -= 1
        assert words[0] != "global" or depth == 1, line
        if assigned := re.match(r"\s*(?:global )?(\w+) = (.*)", line):
            name, value = assigned.groups()
            assert name in known or not loops, f"{name} has its first value in a loop"
            known.add(name)
            if value.startswith("run "):
                handles = re.findall(rf"\b{name} = (.*)", text)
                assert all(handle.startswith("run ") for handle in handles), name
    assert depth == 0
