"""The production program: its motion, its contacts and loads, and the truth that it writes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftmocks.clock import CellClock
from ftmocks.kinematics import MODELS, vector6
from ftmocks.ur.modes import Runtime
from ftmocks.ur.production import Job, Production
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.world import Truth, World
from tests.unit.mocks.real_time import RealTime

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
CYCLE_S = 0.002


@pytest.mark.slow
def test_a_cycle_picks_places_and_touches(tmp_path: Path) -> None:
    path = tmp_path / "truth.jsonl"
    world = World(Truth.drawn(2), MODELS["UR5e"], HOME, 2, CellClock(RealTime()))
    robot = Robot(world, RobotSettings(time_scale=5.0))
    program = Production(robot, Job(str(path), seed=4, slip_m=0.005))
    assert robot.start_soon(program, by="operator", obstacle=robot.obstacle)
    joints = []
    for _ in range(2500):
        robot.tick(robot.cycle_s + CYCLE_S)
        joints.append(robot.arm.q)
    assert robot.runtime == Runtime.PLAYING
    robot.stop_program("end of the test")
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    events = [line["event"] for line in lines]
    picked = ["contact", "grasp", "free", "slip"]
    assert events[:10] == ["start", *picked, "contact", "release", "free", "contact", "free"]
    assert events[-1] == "end"
    times = [line["t_host_ns"] for line in lines]
    assert times == sorted(times)
    for line in lines:
        assert line["truth"]["mass_kg"] == pytest.approx(Truth.drawn(2).mass_kg + line["part_kg"])
    assert np.ptp(joints, axis=0)[3:].min() > 0.8, "the wrist turns"
    assert np.ptp(joints, axis=0)[0] > 1.0


@pytest.mark.parametrize("how", [{"parts_kg": (2.0, 1.0)}, {"parts_kg": (-1.0, 1.0)}, {"slip_m": float("nan")}])
def test_an_impossible_job_is_refused(how: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="not possible"):
        Job(None, 0, **how)
