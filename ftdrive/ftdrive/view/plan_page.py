"""The browser page of a plan: the motion along the tour, the swept volume, and the largest move."""

import threading
from time import monotonic
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds, move_duration_s, tips
from ftdrive.planning.plan import Plan
from ftdrive.view import scene
from ftdrive.view.page import Page
from ftdrive.view.parts import Part, button, check_box, choice, controls, lines, slider
from ftdrivers.ur.kinematics import Array

_FRAME_S: Final = 0.04
_SPEEDS: Final = {f"{speed:g} ×": speed for speed in (0.5, 1, 2, 4, 8)}
PLAN_LEGEND: Final = (
    *((scene.ARM, "body", "arm"), (scene.TOOL, "body", "tool"), (scene.PATH, "line", "path of the tool tip")),
    *((scene.GHOST, "ball", "ball to keep free"), (scene.OBSTACLE, "body", "surroundings")),
)
"""Rows of the legend for what `plan_parts` draws, and for the arm."""


class PlanTimeline:
    """The joint angles of a plan over time, preceded by the approach `way_rad` (k + 1, 6), if there is one."""

    def __init__(self, plan: Plan, way_rad: ArrayLike = ()) -> None:
        self.plan, way, tour = plan, np.reshape(way_rad, (-1, 6)), [step.q_rad for step in plan.steps]
        slow, turns_rad = Speeds.first_run(), np.abs(np.diff(way, axis=0)).max(axis=1)
        # From the end of the approach to the first pose, no time passes: a resumed run may approach another pose.
        approach_s = [*move_duration_s(turns_rad, slow.joint_rad_s, slow.joint_rad_s2), *([0.0] if len(way) else [])]
        self._nodes_rad = np.array([*way, *tour, tour[0]])
        self._t_s = np.cumsum([0.0, *approach_s, *(step.duration_s for step in plan.steps)])
        self.begins_s, self.end_s = self._t_s[len(way) : -1], float(self._t_s[-1])
        self.q_rad = self.at(np.union1d(self._t_s, np.arange(0, self.end_s, 0.1)))

    def at(self, t_s: ArrayLike) -> Array:
        """Return the joint angles (..., 6), rad, at times (...), s."""
        return np.stack(
            [np.interp(np.asarray(t_s, dtype=np.float64), self._t_s, joint) for joint in self._nodes_rad.T], axis=-1
        )

    def move(self, t_s: float) -> int:
        """Return the index of the plan's move at a time, s; -1 during the approach."""
        return int(np.searchsorted(self.begins_s, t_s, side="right")) - 1

    def slider(self, t_s: float) -> Part:
        """Return the slider for the time along the plan, set to a time, with a text that states pose and time."""
        pose = f"pose {self.move(t_s) + 1} of {len(self.begins_s)}, " if self.move(t_s) >= 0 else "approach, "
        words = f"{'' if self.plan.sweep else pose}{t_s:.0f} of {self.end_s:.0f} s"
        return slider("along", "Along the plan", round(t_s, 1), round(self.end_s, 1), step=0.1, text=words)


class PlanPage:
    """Fills a page with a plan and its animation; `certifier` must belong to the same arm, tool and scene."""

    def __init__(self, page: Page, plan: Plan, certifier: Certifier) -> None:
        self._page, self._plan, self._arm, self._tour = page, plan, certifier.arm, PlanTimeline(plan)
        self._volumes = _swept_scene(certifier, self._tour.q_rad)
        self._lock = threading.Lock()
        self._chosen: dict[str, Any] = {"along": 0.0, "play": False, "speed": "1 ×", "swept": False}
        self._drawn: dict[str, Any] = {}
        page.put(plan_parts(certifier, self._tour))
        for name in ("previous", "next", "largest", *self._chosen):
            page.on(name, lambda _, value, name=name: self._choose(name, value))  # type: ignore[misc]
        self.draw()

    def _choose(self, name: str, value: Any) -> None:
        with self._lock:
            begins_s, now_s = self._tour.begins_s, self._chosen["along"]
            goals_s = {
                "previous": begins_s[np.searchsorted(begins_s, now_s - _FRAME_S) - 1],
                "next": begins_s[np.searchsorted(begins_s, now_s + _FRAME_S) % len(begins_s)],
                "largest": begins_s[np.argmax([step.turn_rad for step in self._plan.steps])],
            }
            if name in goals_s:
                self._chosen |= {"along": float(goals_s[name]), "play": False}
            else:
                self._chosen[name] = not self._chosen["play"] if name == "play" else value

    def draw(self) -> None:
        """Draw the page if a viewer has changed something or the arm has moved."""
        with self._lock:
            chosen = dict(self._chosen)
        if chosen == self._drawn:
            return
        self._drawn, t_s, swept = chosen, chosen["along"], chosen["swept"]
        head, *words = describe_move(self._plan, self._tour.move(t_s))
        rows = [*PLAN_LEGEND, *([(scene.TOOL, "body", "space swept by the tool")] if swept else [])]
        shown = controls(
            button("previous", "Previous pose"),
            button("play", "Pause" if chosen["play"] else "Play", tone="good"),
            button("next", "Next pose"),
            button("largest", "Largest move"),
            self._tour.slider(t_s),
            choice("speed", "Speed", chosen["speed"], _SPEEDS),
            check_box("swept", "Space swept by the tool", value=swept),
        )
        parts = {"scene/legend": scene.legend(*rows), "state": lines(*words, head=head), "controls": shown}
        volumes = self._volumes if swept else dict.fromkeys(self._volumes)
        self._page.put({**scene.arm_parts(self._arm, self._tour.at(t_s)), **volumes, **parts})

    def play(self, ended: threading.Event) -> None:
        """Animate the arm along the tour and draw what viewers choose, until `ended` is set."""
        then_s = monotonic()
        while not ended.wait(_FRAME_S):
            passed_s, then_s = monotonic() - then_s, monotonic()
            with self._lock:
                if self._chosen["play"]:
                    passed_s *= _SPEEDS[self._chosen["speed"]]
                    self._chosen["along"] = (self._chosen["along"] + passed_s) % self._tour.end_s
            self.draw()


def plan_parts(certifier: Certifier, tour: PlanTimeline) -> dict[str, Part | None]:
    """Return parts that draw the surroundings, the ball to keep free and the tool tip's path, and the camera."""
    arm, size_m, plan = certifier.arm, scene.size_of(certifier), tour.plan
    farthest = int(np.argmax([part.to_m for part in arm.tool]))
    look_at = 0.7 * arm.frames(tour.q_rad[:1]).wrist_m[0]
    return {
        **scene.surroundings(certifier.scene, size_m),
        "scene/ball": scene.ball(plan.ball_m, scene.GHOST, alpha=0.15, at=plan.ball_centre_m),
        "scene/path": scene.path(tips(arm, tour.q_rad)[:, farthest], scene.PATH),
        "scene/camera": scene.camera(look_at, look_at + 0.6 * size_m * np.array([1.0, 1.0, 0.6])),
    }


def _swept_scene(certifier: Certifier, q_rad: Array) -> dict[str, Part | None]:
    bodies = certifier.arm.bodies(q_rad[:: max(1, len(q_rad) // 250)])
    copies = np.concatenate([bodies.centre_m, scene.turned_up(bodies.axis)], axis=-1)
    sizes = zip(bodies.half_length_m, bodies.radius_m, bodies.rounding_m, strict=True)
    parts = [scene.body(*size, scene.TOOL, alpha=0.15, copies=copies[:, i]) for i, size in enumerate(sizes)]
    return {f"scene/swept/{i}": parts[i] for i in scene.carried_bodies(certifier.arm)}


def describe_move(plan: Plan, move: int) -> tuple[str, str, str]:
    """Return three texts: about a move of a plan (-1: the approach), its smallest clearance, the space to keep free."""
    if move < 0:
        return "From the present posture to the first pose", "This approach is confirmed separately.", ""
    step, following = plan.steps[move], plan.steps[(move + 1) % len(plan.steps)]
    turn_deg, speed_deg_s = np.degrees([step.turn_rad, step.speed_rad_s])
    what = f"Move {move + 1} of {len(plan.steps)}, R{step.number:02d} to R{following.number:02d}: {turn_deg:.0f}°"
    if plan.sweep is not None:
        what = f"Sweep of {plan.sweep.duration_s:.0f} s"
    nearest = f"Nearest: {1e3 * step.clearance_m:.0f} mm, {step.limited_by}."
    return f"{what} at {speed_deg_s:.0f} °/s", nearest, plan.room_in_words()
