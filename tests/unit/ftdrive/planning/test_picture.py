"""The picture of a plan: what is in it. How it looks is looked at by eye."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.planning.drawing import draw_plan
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour

TUBE, LUMP = Cylinder(0.0, 0.2, 0.1), Cylinder(0.05, 0.15, 0.05, 0.08, 0.0)
WALL, BOX = Plane((-1.0, 0.0, 0.0), -0.8), Box((0.5, 0.5, 0.0), (0.7, 0.7, 0.2))
SLANTING = Plane((0.6, 0.48, 0.64), -0.9)


def certifier_of(tool: tuple[Cylinder, ...] = (TUBE,), scene: Scene | None = None) -> Certifier:
    return Certifier(ArmModel("ur5e", tool), scene or Scene())


@pytest.fixture(scope="module")
def plan() -> Plan:
    certifier = certifier_of()
    return plan_tour(certifier, poses=6, speeds=Speeds(), guess=guess_of(certifier))


@pytest.mark.slow
def test_tool_surroundings_and_the_way_are_drawn(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = pytest.importorskip("matplotlib.figure")
    saved = list[Any]()
    monkeypatch.setattr(figures.Figure, "savefig", lambda figure, *_, **__: saved.append(figure))
    stands = np.array(plan.steps[0].q_rad) + np.radians([20, 0, 0, 0, 0, 0])
    around = Scene((BASE_PLANE, WALL, SLANTING), (BOX,))
    draw_plan(plan, certifier_of(), tmp_path / "bare.png", ())
    draw_plan(plan, certifier_of((TUBE, LUMP), around), tmp_path / "all.png", np.array([stands, plan.steps[0].q_rad]))
    areas = [[len(axes.patches) for axes in figure.axes] for figure in saved]
    assert np.subtract(areas[1], areas[0]).tolist() == [7, 8, 8]  # 6 lumps, the box, and the wall
    lines = [[len(axes.lines) for axes in figure.axes] for figure in saved]
    assert np.subtract(lines[1], lines[0]).tolist() == [1, 2, 2]  # the way, and the edge of the wall
    assert [figure.axes[2].get_xlim()[1] > 0.8 for figure in saved] == [False, True]  # the wall
    titles = [figure.get_suptitle() for figure in saved]
    for words in ("slanting planes (1)", "green"):
        assert [words in title for title in titles] == [False, True]
    first, second, *others = plan.steps
    moving = replace(plan, steps=(first, replace(second, q_rad=(0.5, *second.q_rad[1:])), *others))
    draw_plan(moving, certifier_of(), tmp_path / "moving.png", ())
    assert ("WHOLE ARM moves" in saved[2].get_suptitle()) > ("WHOLE ARM" in titles[0])


@pytest.mark.slow
def test_a_picture_is_never_overwritten(plan: Plan, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib.figure")
    (path := tmp_path / "plan.png").touch()
    with pytest.raises(FileExistsError, match="never overwritten"):
        draw_plan(plan, certifier_of(), path, ())
