"""The page of a plan: the tour in motion, what it sweeps over, and its largest move."""

import threading
from collections.abc import Sequence
from itertools import pairwise
from time import monotonic
from typing import Any, Final

import numpy as np

from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import tips
from ftdrive.planning.plan import Plan
from ftdrive.view.page import Page
from ftdrive.view.scene import GHOST, TOOL, DrawnArm, carried, draw_surroundings, revolved, size_of, turned_up
from ftdrivers.ur.kinematics import Array

_FRAME_RAD: Final = np.radians(3)
_FRAME_S: Final = 0.04
_TIP: Final = (200, 40, 40)


class PlanPage:
    """Fills a page with a plan.

    Parameters
    ----------
    certifier : Certifier
        For the same arm, tool and scene.
    way_rad : array, shape (k + 1, 6), optional
        From the present posture to the first pose; shown before the tour.
    """

    def __init__(self, page: Page, plan: Plan, certifier: Certifier, way_rad: Sequence[Array] | Array = ()) -> None:
        self._page, self._plan = page, plan
        self._q, self._move = path(plan, way_rad)
        self._arm = draw_plan(page, plan, certifier, self._q)
        gui = page.gui
        self._words = gui.add_markdown("")
        self._slider: Any = gui.add_slider("along the tour", min=0, max=len(self._q) - 1, step=1, initial_value=0)
        self._plays = gui.add_checkbox("play", initial_value=False)
        self._speed = gui.add_slider("speed", min=0.25, max=8.0, step=0.25, initial_value=1.0)
        swept = gui.add_checkbox("room that the tool sweeps over", initial_value=False)
        largest = gui.add_button("largest move")
        self._slider.on_update(lambda _: self.show())
        volumes = _swept(page, certifier, self._q[::3])

        def show_swept(_: object) -> None:
            for volume in volumes:
                volume.visible = swept.value

        swept.on_update(show_swept)

        largest.on_click(lambda _: self._go_to(self._largest))
        self.show()

    @property
    def _largest(self) -> int:
        move = int(np.argmax([step.turn_rad for step in self._plan.steps]))
        return int(np.flatnonzero(self._move == move)[0])

    def _go_to(self, at: int) -> None:
        self._slider.value = at
        self.show()

    def show(self) -> None:
        """Draw the arm where the slider is."""
        at = int(self._slider.value)
        with self._page.at_once():
            self._arm.show(self._q[at])
            self._words.content = describe(self._plan, int(self._move[at]))

    def play(self, ended: threading.Event) -> None:
        """Move along the tour while `play` is on, until the event."""
        at, then_s = 0.0, monotonic()
        while not ended.wait(_FRAME_S):
            now_s = monotonic()
            if self._plays.value:
                speed_rad_s = self._plan.steps[max(0, int(self._move[int(self._slider.value)]))].speed_rad_s
                at += (now_s - then_s) * self._speed.value * speed_rad_s / _FRAME_RAD
                if step := int(at):
                    at -= step
                    self._go_to((int(self._slider.value) + step) % len(self._q))
            then_s = now_s


def draw_plan(page: Page, plan: Plan, certifier: Certifier, q_rad: Array) -> DrawnArm:
    """Draw cell, free ball and the path of the tool's tip along joint vectors (n, 6); return the arm, at the first."""
    arm, size_m = certifier.arm, size_of(certifier)
    draw_surroundings(page.scene, certifier.scene, size_m)
    page.scene.add_icosphere(
        "/ball", plan.ball_m, GHOST, opacity=0.15, position=np.array(plan.ball_centre_m), cast_shadow=False
    )
    farthest = int(np.argmax([part.to_m for part in arm.tool]))
    tip = tips(arm, q_rad)[:, farthest]
    segments = np.stack([tip[:-1], tip[1:]], axis=1)
    page.scene.add_line_segments("/path of the tool tip", segments, _TIP, thickness=0.004)
    look_at = 0.7 * arm.frames(q_rad[:1]).wrist_m[0]
    page.look(look_at, look_at + 0.5 * size_m * np.array([1.0, 1.0, 0.6]))
    drawn = DrawnArm(page.scene, arm)
    drawn.show(q_rad[0])
    return drawn


def _swept(page: Page, certifier: Certifier, q_rad: Array) -> list[Any]:
    """Draw the tool at joint vectors (n, 6), invisible at first; one drawing for each of its cylinders."""
    arm = certifier.arm
    bodies = arm.bodies(q_rad)
    drawn = []
    for i in carried(arm):
        shape = revolved(bodies.half_length_m[i], bodies.radius_m[i], bodies.rounding_m[i])
        turns, places = turned_up(bodies.axis[:, i]), bodies.centre_m[:, i]
        drawn.append(
            page.scene.add_batched_meshes_simple(
                f"/swept/{arm.names[i]}", *shape, turns, places, batched_colors=TOOL, opacity=0.15, cast_shadow=False
            )
        )
        drawn[-1].visible = False
    return drawn


def path(plan: Plan, way_rad: Sequence[Array] | Array = ()) -> tuple[Array, Any]:
    """Joint vectors (m, 6) along all moves, and the move (m,) that each belongs to.

    The approach is move -1; the closed tour follows.
    """
    q = np.array([step.q_rad for step in plan.steps])
    legs = [(-1, start, end) for start, end in pairwise(way_rad)]
    legs += [(i, start, end) for i, (start, end) in enumerate(zip(q, np.roll(q, -1, axis=0), strict=True))]
    parts, moves = [], []
    for move, start, end in legs:
        n = max(1, int(np.ceil(np.abs(end - start).max() / _FRAME_RAD)))
        parts.append(start + np.linspace(0, 1, n, endpoint=False)[:, None] * (end - start))
        moves += [move] * n
    return np.concatenate([*parts, q[:1]]), np.array([*moves, len(q) - 1])


def describe(plan: Plan, move: int) -> str:
    """Return a move as text."""
    if move < 0:
        return "From the present posture to the first pose.\n\nIt is confirmed separately."
    step, following = plan.steps[move], plan.steps[(move + 1) % len(plan.steps)]
    turn_deg, speed_deg_s = np.degrees([step.turn_rad, step.speed_rad_s])
    what = f"Move **{move + 1} of {len(plan.steps)}**, R{step.number:02d} to R{following.number:02d}: {turn_deg:.0f}°"
    if plan.sweep is not None:
        what = f"Sweep of {plan.sweep.duration_s:.0f} s"
    return (
        f"{what} at {speed_deg_s:.0f}°/s.\n\nNearest: {1e3 * step.clearance_m:.0f} mm, {step.limited_by}.\n\n"
        f"{plan.room_in_words()}"
    )
