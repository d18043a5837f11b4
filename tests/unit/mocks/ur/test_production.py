"""The production program: its motion, its contacts and loads, and the truth that it writes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftmocks.clock import CellClock
from ftmocks.inertia import Body
from ftmocks.kinematics import MODELS, forward, vector6
from ftmocks.ur.modes import Runtime
from ftmocks.ur.production import Job, Production
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.world import Truth, World
from tests.unit.mocks.real_time import RealTime

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
CYCLE_S = 0.002


class Watched:
    """A robot at work: what the world felt in each cycle, and the lines of the file."""

    def __init__(self, path: Path, seconds: float = 5.0, *, scale: float = 5.0, **how: Any) -> None:
        world = World(Truth.drawn(2), MODELS["UR5e"], HOME, 2, CellClock(RealTime()))
        self.robot = Robot(world, RobotSettings(time_scale=scale))
        program = Production(self.robot, Job(str(path), **{"seed": 4, **how}))
        assert self.robot.start_soon(program, by="operator", obstacle=self.robot.obstacle)
        rows = []
        for _ in range(round(seconds / CYCLE_S)):
            t_s = self.robot.cycle_s + CYCLE_S
            self.robot.tick(t_s)
            rows.append(
                [t_s, *world.true_wrench(t_s), *world.contact_wrench(t_s), world.truth.mass_kg, *self.robot.arm.q]
            )
        assert self.robot.runtime == Runtime.PLAYING
        self.robot.stop_program("end of the test")
        self.lines = [json.loads(line) for line in path.read_text().splitlines()]
        self.t_ns = np.round(1e9 * np.array(rows)[:, 0])
        self.wrench, self.contact, self.mass_kg, self.q = np.split(np.array(rows)[:, 1:], [6, 12, 13], axis=1)

    def at_cycles(self, value: str) -> list[Any]:
        """What the file says in each cycle."""
        since = np.searchsorted([line["t_host_ns"] for line in self.lines], self.t_ns, side="right") - 1
        return [self.lines[k][value] for k in since]

    def events(self) -> list[str]:
        return [line["event"] for line in self.lines]


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    return Watched(tmp_path_factory.mktemp("production") / "truth.jsonl", slip_m=0.005)


def test_a_cycle_picks_places_and_touches(watched: Watched) -> None:
    picked = ["contact", "grasp", "free", "slip"]
    assert watched.events()[:10] == ["start", *picked, "contact", "release", "free", "contact", "free"]
    assert watched.events()[-1] == "end"
    times = [line["t_host_ns"] for line in watched.lines]
    assert times == sorted(times)
    for line in watched.lines:
        assert line["truth"]["mass_kg"] == pytest.approx(Truth.drawn(2).mass_kg + line["part_kg"])
    assert np.ptp(watched.q, axis=0)[3:].min() > 0.8, "the wrist turns"
    assert np.ptp(watched.q, axis=0)[0] > 1.0


def test_a_held_part_weighs_on_the_sensor(watched: Watched) -> None:
    robot = watched.robot
    truth = Truth.drawn(2)
    for k in (1000, 1800, 2400):
        R_base_sensor = forward(robot.arm.dh, watched.q[k])[:3, :3] @ truth.R_flange_sensor
        weight_N = R_base_sensor.T @ truth.gravity_m_s2 * watched.mass_kg[k]
        felt_N = watched.wrench[k, :3] - truth.force_bias_N - watched.contact[k, :3]
        assert np.linalg.norm(felt_N - weight_N) < 4.0 * watched.mass_kg[k], "the rest is inertia"


@pytest.mark.parametrize("how", [{"parts_kg": (2.0, 1.0)}, {"parts_kg": (-1.0, 1.0)}, {"slip_m": float("nan")}])
def test_an_impossible_job_is_refused(how: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="not possible"):
        Job(None, 0, **how)


def test_two_bodies_have_the_moments_of_their_points() -> None:
    rng = np.random.default_rng(0)
    points, masses = rng.normal(size=(8, 3)), rng.uniform(0.1, 1.0, 8)

    def body(points: np.ndarray, masses: np.ndarray) -> Body:
        com = masses @ points / masses.sum()
        arms = points - com
        tensor = sum(m * (a @ a * np.eye(3) - np.outer(a, a)) for m, a in zip(masses, arms, strict=True))
        return Body(float(masses.sum()), com, tensor / masses.sum())

    joined = body(points[:5], masses[:5]).joined(body(points[5:], masses[5:]))
    whole = body(points, masses)
    assert joined.mass_kg == pytest.approx(whole.mass_kg)
    np.testing.assert_allclose(joined.p_sensor_com_m, whole.p_sensor_com_m)
    np.testing.assert_allclose(joined.gyration_m2, whole.gyration_m2)
