"""Lengths, masses, rows and walls as people write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrive.cell.units import DEG_S, KG, MM, SIDES, parse_quantity, row, side_of, wall
from ftdrive.errors import ConfigError
from ftdrive.planning.planner import plane_from_mm


@pytest.mark.parametrize(
    ("text", "mm"),
    [("33", 33), ("33,5", 33.5), (" 33 mm", 33), ("1.1cm", 11), ("1,3 IN", 33.02), ("−5", -5), (",5", 0.5)],
)
def test_lengths(text: str, mm: float) -> None:
    assert parse_quantity("--height", text, MM) == mm


@pytest.mark.parametrize(("text", "kg"), [("1.2 kg", 1.2), ("450 g", 0.45), ("0,255", 0.255), ("2 lb", 0.90718474)])
def test_masses(text: str, kg: float) -> None:
    assert parse_quantity("--tool-mass", text, KG) == kg


@pytest.mark.parametrize(("units", "text"), [(MM, "1,200"), (KG, "-1,200 g"), (DEG_S, "12,000")])
def test_a_comma_that_may_separate_thousands_is_not_guessed(units: dict[str, str], text: str) -> None:
    with pytest.raises(ConfigError, match="ambiguous"):
        parse_quantity("--x", text, units)


@pytest.mark.parametrize("text", ["0:60:88,9", "0 60 88.9", "0, 60, 88.9", "0 mm 6 cm 3.5 in", "0 ; 60mm:88.9 mm"])
def test_rows(text: str) -> None:
    assert row("--tool", text, (3, 5)) == [0, 60, 88.9]


@pytest.mark.parametrize("text", ["0:60", "0:60:90:1", "0,60,90", "0:x:90", ""])
def test_what_is_no_row(text: str) -> None:
    with pytest.raises(ConfigError, match="3 or 5 numbers"):
        row("--tool", text, (3, 5))


@given(st.sampled_from([*SIDES]), st.integers(1, 40000))
def test_a_wall_is_on_its_side_and_the_arm_on_the_other(side: str, tenths: int) -> None:
    mm = tenths / 10
    plane_mm = wall("--plane", f"{side} {mm:g} mm")
    axis = {"x": 0, "y": 1}.get(side[-1], 2)
    there = [0.0, 0.0, 0.0]
    there[axis] = -mm / 1e3 if side in ("-x", "-y", "below") else mm / 1e3
    plane = plane_from_mm(plane_mm)
    assert sum(n * p for n, p in zip(plane.normal, there, strict=True)) == pytest.approx(plane.offset_m)
    assert plane.offset_m < 0  # the origin of the base is free
    assert side_of(plane_mm) == f"{side} {mm:g} mm"


@pytest.mark.parametrize("text", ["x 800", "+x", "800", "+x -5", "left 800", "+x 800 900", ""])
def test_what_is_no_wall(text: str) -> None:
    with pytest.raises(ConfigError, match="--plane is"):
        wall("--plane", text)


def test_a_slanting_wall_is_a_normal() -> None:
    assert wall("--plane", "0.6:0:0.8:-400") == [0.6, 0, 0.8, -400]
    assert wall("--plane", "+x:800") == wall("--plane", "-1:0:0:-800") == [-1, 0, 0, -800]
    assert side_of((0.6, 0, 0.8, -400)) == side_of((1, 0, 0, 800)) == ""
