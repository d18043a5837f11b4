"""An emulated arm with the imperfections of a real one, run in this process as fast as the computer can."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ftdrive.live.samples import Paired
from ftmocks.clock import CellClock
from ftmocks.imperfections import Imperfections
from ftmocks.kinematics import MODELS, vector6
from ftmocks.ur import motion
from ftmocks.ur.controller_program import ControllerProgram
from ftmocks.ur.production import Job, Production
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.world import Truth, World
from tests.moving_load import flange
from tests.unit.mocks.real_time import RealTime

Array = NDArray[np.float64]
HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
PERIOD_S = 0.002
HEIGHT_M = 0.03


class Turns(ControllerProgram):
    """Moves of all joints, mostly of the wrist, between random postures, with rests."""

    def __init__(self, robot: Robot, seed: int, speed_rad_s: float, rest_s: tuple[float, float] = (0.8, 2.0)) -> None:
        super().__init__("turns")
        self._robot, self._rng, self._speed, self._rest_s = robot, np.random.default_rng([seed, 3]), speed_rad_s, rest_s
        self._steps = self._run()

    def step(self) -> bool:
        next(self._steps)
        return True

    def _run(self) -> Any:
        arm, home = self._robot.arm, np.array(self._robot.arm.q)
        while True:
            goal = vector6(home + np.radians(self._rng.uniform(-1, 1, 6) * [40, 15, 15, 80, 80, 150]))
            arm.start(motion.JointMove(arm.dh, goal, self._speed, 2.5), self.name)
            yield from arm.until_finished(self.name)
            for _ in range(round(self._rng.uniform(*self._rest_s) / PERIOD_S)):
                yield


@dataclass(frozen=True)
class Recorded:
    """Samples and poses at 500 Hz on one clock; each pose is that which the controller reports at the time."""

    t_s: Array
    raw: Array
    """(n, 6)"""
    q_rad: Array
    """(n, 6) measured."""
    ideal: Array
    """(n, 6) the wrench without noise, contact and ripple, measured without delay."""
    vibration: Array
    """(n, 6) ripple that was put in."""
    contact: Array
    """(n, 6)"""
    bias: Array
    """(n, 6)"""
    part_kg: Array
    """(n,)"""

    def paired(self, rows: slice = slice(None), push: Array | None = None) -> Paired:
        """Return samples as the stream pairs them."""
        t_s = self.t_s[rows]
        n = len(t_s)
        R, p = flange(self.q_rad[rows])
        raw = self.raw[rows] if push is None else self.raw[rows] + push[rows]
        start = range(len(self.t_s))[rows].start
        return Paired(
            t_host_ns=np.rint(1e9 * t_s).astype(np.int64) + 10**12,
            t_device_s=np.full(n, np.nan),
            seq=start + np.arange(n),
            status=np.zeros(n, np.uint32),
            raw=raw,
            q_rad=self.q_rad[rows],
            R_base_flange=R,
            p_base_flange_m=p,
        )

    def save(self, path: Path) -> None:
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        with np.load(path) as file:
            return cls(**file)


def cell(seed: int, **changes: Any) -> Truth:
    """The truth of an emulated cell, whose sensor is 30 mm above the flange."""
    return replace(Truth.drawn(seed), p_flange_sensor_m=np.array([0.0, 0.0, HEIGHT_M]), **changes)


def record(
    truth: Truth,
    seconds: float,
    seed: int,
    *,
    speed_rad_s: float | None = None,
    job: Job | None = None,
    imperfections: Imperfections = Imperfections(),  # noqa: B008 - frozen
) -> Recorded:
    """Let the arm turn between random postures, or work as a production program does."""
    real = RealTime()
    world = World(truth, MODELS["UR5e"], HOME, seed, CellClock(real), imperfections)
    robot = Robot(world, RobotSettings())
    program = Production(robot, job) if job else Turns(robot, seed, speed_rad_s or 1.0)
    assert robot.start_soon(program, by="operator", obstacle=robot.obstacle)
    columns: list[list[Array]] = [[] for _ in range(7)]
    times, parts, start_s = [], [], robot.cycle_s
    for _ in range(round(seconds / PERIOD_S)):
        t_s = robot.cycle_s + PERIOD_S
        robot.tick(t_s)
        at = np.array([t_s])
        ripple = world.ripple_wrench(at)[0]
        contact, bias = world.contact_wrench(t_s), world.bias(t_s)
        ideal = world.load_wrench(t_s) + bias
        for column, value in zip(
            columns, (world.measure_at(at)[0], robot.measured_q, ideal, ripple, contact, bias), strict=False
        ):
            column.append(np.asarray(value))
        times.append(t_s - start_s)
        parts.append(world.truth.mass_kg - truth.mass_kg)
    robot.stop_program("end of the test")
    world.clock.close()
    raw, q, ideals, vibration, contacts, biases = (np.array(column) for column in columns[:6])
    return Recorded(np.array(times), raw, q, ideals, vibration, contacts, biases, np.array(parts))
