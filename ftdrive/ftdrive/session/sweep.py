"""The state machine of a sweep: a tour with one stop, at which the arm follows a curve and everything is recorded."""

from typing import Final

import numpy as np

from ftdrive.runs.motion import MotionRecording
from ftdrive.session.events import MotionRecorded, State
from ftdrive.session.operator import Question
from ftdrive.session.tour import Tour, question_of
from ftdrivers.sweep import Sweep

REST_S: Final = 2.0
"""Recorded before the sweep and after it."""
CURVE_S: Final = 0.01
"""Between two points of the curve that the guards compare with."""
_READ_S: Final = 1.0


class SweepTour(Tour):
    """Takes the arm to the centre of a sweep, along it, and back; after a stop it starts again."""

    recorded = False
    """Whether the whole sweep is on disk."""

    @property
    def undriven(self) -> list[int]:
        """The only stop, unless the whole sweep was driven."""
        return [] if self.recorded else [1]

    @property
    def _curve(self) -> Sweep:
        sweep = self._plan.sweep
        if sweep is None:
            raise TypeError(f"a plan of kind {self._plan.kind} has no sweep")
        return sweep

    @property
    def _begin_words(self) -> str:
        return f"The arm stands where the sweep of {self._curve.duration_s:.0f} s begins. Begin?"

    def _how_to_go_on(self, back: int | None, fixed: str) -> Question:
        del back  # there is no other pose
        ways = {"resume": f"sweep again from the start{fixed}", "quit": "stop; the next session starts again"}
        return question_of("A sweep that was stopped is not kept.", ways)

    def _take(self, stop: int, index: int) -> None:
        sweep, clock = self._curve, self._watcher.clock
        centre = self._nodes[index]
        curve = sweep.at(np.arange(0.0, sweep.duration_s + CURVE_S, CURVE_S))
        with self._sensor.follow() as wrench, self._arm.follow() as poses:
            self._rest(centre)
            self._confirm_first()
            self._require_at(centre)
            self._show_state(State.SWEEP, stop, f"{sweep.duration_s:.0f} s along the curve of the plan")
            self._now.standing = False
            began_s = clock.now_s()
            with self._watcher.watching(centre, centre, moving=True, curve_rad=curve):
                self._arm.sweep(sweep, guard=self._between_looks)
            duration_s = clock.now_s() - began_s
            self._now.standing = True
            self._rest(centre)
            rate_Hz = self._sensor.health().nominal_rate_Hz
            recording = MotionRecording(wrench.read(_READ_S), poses.read(_READ_S), rate_Hz)
        self._guarded.load.judge(recording.samples.wrench)
        path = self._book.run.new_path("motion", ".npz")
        recording.save(path)
        self.recorded = True
        self._guarded.show_new()
        self._journal.show(
            MotionRecorded(
                file=path.name,
                duration_s=duration_s,
                samples=len(recording.samples),
                states=len(recording.states),
                temperature_C=self._sensor.temperature_C(),
            ),
            sync=True,
        )

    def _compare_payload(self) -> None:
        """Nothing is weighed before the recording is solved."""

    def _confirm_first(self) -> None:
        if not self._now.confirmed:
            self._confirm(self._begin_words)

    def _rest(self, centre: np.ndarray) -> None:
        """Record the arm at rest, under guard."""
        clock = self._watcher.clock
        self._arm.wait_until_still(timeout_s=self._pace.sampling.still_timeout_s, guard=self._between_looks)
        with self._watcher.watching(centre, centre, moving=False):
            for _ in clock.looks(REST_S):
                self._between_looks()
                clock.sleep(0.02)
