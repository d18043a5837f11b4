"""A production program on the pendant, which picks, places and touches repeatedly, and records the true state.

The file has one JSON object per line with the state from its time on: ``t_host_ns`` on the cell's clock, ``event``,
whether the tool is in ``contact``, ``part_kg``, ``bias`` (6,) with its drift, and ``truth`` of tool and part together,
as in the first line of the station. Events are start, contact, grasp, release, slip, free and end. Readings are later
than these times by the delay of the sensor.

Between the sites, the wrist turns at random. A part is pressed against its support before it is grasped or released,
and the support then carries its weight. The tool is in contact for about a third of the time.

Not modelled: closing of the gripper, friction of contacts, springs.
"""

import json
import math
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ftmocks.arrays import Array
from ftmocks.disturbances import Ramp
from ftmocks.inertia import Body
from ftmocks.kinematics import forward, vector3, vector6
from ftmocks.ur import motion
from ftmocks.ur.controller_program import ControllerProgram
from ftmocks.ur.robot import Robot

FORMAT = "mocks.production/1"
SITES_DEG = {"pick": -35.0, "place": 35.0, "touch": 10.0}
"""Angle of the first joint at each site."""
WRIST_DEG = (50.0, 50.0, 90.0)
"""Largest rotation of the wrist joints between the sites, in both directions."""
APPROACH_M = 0.05
SPEED_RAD_S, ACCELERATION_RAD_S2 = (0.8, 1.6), 2.5
SPEED_M_S, ACCELERATION_M_S2 = 0.15, 1.0
PRESS_N, PRESS_S = (4.0, 20.0), (0.8, 2.0)
RISE_S = 0.04
"""Duration of the rise and of the fall of a contact force."""
GRASP_S = 0.2
PART_M = 0.04
"""Edge length of the cubic parts, m."""
NO_PART = Body(0.0, np.zeros(3), np.zeros((3, 3)))

Cycles = Generator[None, None, None]


@dataclass(frozen=True)
class Job:
    """Settings of the program.

    Parameters
    ----------
    file
        Path of the file with the true states; None for no file.
    seed
        Seed of parts, forces, times and rotations.
    parts_kg
        Smallest and largest mass of a part.
    contacts
        Whether the tool touches anything. The motion is the same.
    slip_m
        Distance by which a part slips in the gripper while it is carried.
    """

    file: str | None
    seed: int
    parts_kg: tuple[float, float] = (0.0, 3.0)
    contacts: bool = True
    slip_m: float = 0.0

    def __post_init__(self) -> None:
        low, high = self.parts_kg
        if not (0.0 <= low <= high < math.inf and 0.0 <= self.slip_m < math.inf):
            raise ValueError(f"parts of {low} to {high} kg, or a slip of {self.slip_m} m, are not possible")


class Production(ControllerProgram):
    """The program, which starts at the current posture.

    Raises
    ------
    OSError
        The file cannot be written.
    """

    def __init__(self, robot: Robot, job: Job) -> None:
        super().__init__("production")
        self._robot, self._world, self._job = robot, robot.world, job
        self._rng = np.random.default_rng([job.seed, 11])
        self._q = robot.arm.q
        self._tool = robot.world.truth
        self._part = NO_PART
        self._force_N: Array = np.zeros(3)
        self._p_sensor_m: Array = np.zeros(3)
        self._file = None if job.file is None else Path(job.file)
        if self._file is not None:
            self._file.write_text("", encoding="utf-8")
        self._last_s = 0.0
        self._steps = self._run()

    def step(self) -> bool:
        """Run one control cycle. The program never ends by itself."""
        next(self._steps)
        return True

    def close(self) -> None:
        """End the program. A part stays in the gripper."""
        self._steps.close()
        self._write("end")

    def _run(self) -> Cycles:
        self._write("start", format=FORMAT)
        while True:
            for site, work in (("pick", self._pick), ("place", self._place), ("touch", self._touch)):
                turns_deg = self._rng.uniform(-1.0, 1.0, 3) * WRIST_DEG
                aside_deg = self._rng.uniform(SITES_DEG["pick"], SITES_DEG["place"])
                yield from self._turn([aside_deg, 0.0, 0.0, *turns_deg])
                self._slip()
                yield from self._turn([SITES_DEG[site], 0.0, 0.0, 0.0, 0.0, self._rng.uniform(-20.0, 20.0)])
                yield from self._approach(APPROACH_M)
                yield from work()
                yield from self._approach(-APPROACH_M)

    def _turn(self, by_deg: list[float]) -> Cycles:
        goal = vector6(np.add(self._q, np.radians(by_deg)))
        speed = self._rng.uniform(*SPEED_RAD_S)
        yield from self._follow(motion.JointMove(self._robot.arm.dh, goal, speed, ACCELERATION_RAD_S2))

    def _approach(self, by_m: float) -> Cycles:
        dh, q = self._robot.arm.dh, self._robot.arm.q
        goal = forward(dh, q)
        goal[:3, 3] += by_m * goal[:3, 2]
        yield from self._follow(motion.LineMove(dh, np.eye(4), goal, SPEED_M_S, ACCELERATION_M_S2))

    def _follow(self, path: motion.Path) -> Cycles:
        self._robot.arm.start(path, self.name)
        yield from self._robot.arm.until_finished(self.name)

    def _wait(self, seconds: float) -> Cycles:
        for _ in range(math.ceil(seconds / (self._robot.period_s * self._robot.settings.time_scale))):
            yield

    def _touch(self) -> Cycles:
        yield from self._press(self._drawn_press(), 2 * self._tool.p_sensor_com_m)
        yield from self._wait(self._rng.uniform(*PRESS_S))
        self._leave()

    def _pick(self) -> Cycles:
        mass_kg = self._rng.uniform(*self._job.parts_kg)
        p_sensor_m = 2 * self._tool.p_sensor_com_m + self._rng.uniform(-PART_M, PART_M, 3) / 2
        yield from self._press(press_N := self._drawn_press(), p_sensor_m)
        yield from self._wait(0.5 * self._rng.uniform(*PRESS_S))
        part = Body(mass_kg, p_sensor_m, np.eye(3) * PART_M**2 / 6)
        self._hold("grasp", part, press_N + self._support_N(part))
        yield from self._wait(GRASP_S)
        self._leave()

    def _place(self) -> Cycles:
        press_N = self._drawn_press()
        yield from self._press(press_N + self._support_N(self._part), self._part.p_sensor_com_m)
        yield from self._wait(0.5 * self._rng.uniform(*PRESS_S))
        self._hold("release", NO_PART, press_N)
        yield from self._wait(GRASP_S)
        self._leave()

    def _slip(self) -> None:
        if self._job.slip_m and self._part.mass_kg:
            aside = self._rng.normal(size=3)
            p_sensor_m = self._part.p_sensor_com_m + self._job.slip_m * aside / np.linalg.norm(aside)
            self._hold("slip", self._part._replace(p_sensor_com_m=p_sensor_m), np.zeros(3))

    def _support_N(self, part: Body) -> Array:
        """Return the force (3,) of a support that carries a part, in base axes."""
        force_N: Array = -part.mass_kg * self._tool.gravity_m_s2
        return force_N

    def _drawn_press(self) -> Array:
        """Draw the force (3,) of a support on the tool in base axes, with a lateral part of up to a third."""
        size_N, aside = self._rng.uniform(*PRESS_N), self._rng.uniform(-0.33, 0.33, 2)
        force_N: Array = forward(self._robot.arm.dh, self._robot.arm.q)[:3, :3] @ [*(size_N * aside), -size_N]
        return force_N

    def _press(self, force_N: Array, p_sensor_m: Array) -> Cycles:
        self._p_sensor_m = p_sensor_m
        self._write("contact", contact=self._job.contacts)
        self._world.touch(self.name, self._contact(force_N))
        yield from self._wait(RISE_S)

    def _leave(self) -> None:
        """End the contact while the arm retreats."""
        contact = self._contact(np.zeros(3))
        self._world.touch(self.name, contact)
        self._write("free", later_s=contact.seconds)

    def _hold(self, event: str, part: Body, force_N: Array) -> None:
        """Change the part in the gripper and the force of its support at the same time."""
        self._part, self._force_N = part, force_N
        truth, robot = self._tool.holding(part), self._robot
        self._world.change_load(truth, self.name, self._contact(force_N))
        robot.payload_kg, robot.payload_cog_m = truth.payload_kg, vector3(truth.payload_cog_m)
        self._write(event, contact=event != "slip" and self._job.contacts)

    def _contact(self, force_N: Array) -> Ramp:
        before_N, self._force_N = self._force_N, force_N
        size, seconds = float(self._job.contacts), RISE_S / self._robot.settings.time_scale
        return Ramp(size * before_N, size * force_N, self._p_sensor_m, self._robot.cycle_s, seconds)

    def _write(self, event: str, *, later_s: float = 0.0, contact: bool = False, **more: Any) -> None:
        if self._file is None:
            return
        truth = self._world.truth
        t_s = self._last_s = max(self._last_s, self._robot.cycle_s + later_s)
        line = {
            "t_host_ns": round(1e9 * t_s),
            "event": event,
            "contact": contact,
            "part_kg": self._part.mass_kg,
            "bias": self._world.bias(t_s).tolist(),
            "truth": truth.to_json(),
            **more,
        }
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
