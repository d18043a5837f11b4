"""Bias and part of a program that picks, carries, places and touches, while the bias drifts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftdrive.live.samples import LoadEvent, Tracked
from ftdrive.live.tracking import Tracker, Window

NOISE = np.repeat([0.08, 0.004], 3)
G_M_S2, WINDOW_S = 9.81, 0.15
DRIFT = np.array([0.8, -0.5, 0.33, 0.02, 0.01, -0.02]) / 3600
"""1 N an hour."""


class Program:
    """A tool that turns, and what the tracker says of each window."""

    def __init__(self, seed: int) -> None:
        self.rng, self.tracker = np.random.default_rng(seed), Tracker(1.2, np.array([0.0, 0.0, 0.06]))
        self.R, self.t_s, self.part_kg, self.p_m = Rotation.identity(), 0.0, 0.0, np.array([0, 0.01, 0.12])
        self.events: list[LoadEvent] = []
        self.off = list[float]()
        """Largest error of the bias in each window, in sigmas."""
        self.last: Tracked | None = None

    def turn(self, windows: int) -> None:
        axis = self.rng.standard_normal(3)
        self._pass(windows, axis / np.linalg.norm(axis) * self.rng.uniform(0.5, 1.2), np.zeros(6))

    def touch(self, windows: int) -> None:
        force = self.rng.standard_normal(3) * self.rng.uniform(3, 12)
        self._pass(windows, np.zeros(3), np.r_[force, np.cross([0.01, 0, 0.12], force)])

    def _pass(self, windows: int, turn_rad_s: Array, contact: Array) -> None:
        for _ in range(windows):
            self.t_s += WINDOW_S
            self.R = Rotation.from_rotvec(turn_rad_s * WINDOW_S) * self.R
            gravity = self.R.inv().apply([0, 0, -G_M_S2])
            weight_N, bias = self.part_kg * gravity, DRIFT * self.t_s
            wrench = bias + np.r_[weight_N, np.cross(self.p_m, weight_N)] + contact
            wrench = wrench + NOISE * self.rng.standard_normal(6)
            self.last = self.tracker.update(
                Window(
                    t_s=self.t_s,
                    residual=wrench,
                    felt_m_s2=gravity,
                    lever_s2=np.zeros((3, 3)),
                    p_sensor_near_m=np.array([0.0, 0.0, 0.12]),
                    noise=np.diag(NOISE**2),
                    state=0,
                    systematic=np.zeros((6, 6)),
                    turning_rad_s2=0.0,
                    tensor_Nm=0.0,
                    p_base_flange_m=np.zeros(3),
                )
            )
            self.events += self.last.events
            self.off.append(float(np.abs((self.last.bias - bias) / self.last.sigma).max()))


@pytest.mark.slow
def test_parts_and_contacts_do_not_reach_the_bias() -> None:
    program, steps = Program(1), list[float]()
    program.turn(30)
    for _ in range(12):
        program.turn(8)
        program.touch(4)
        program.part_kg = program.rng.uniform(0.1, 3)
        steps.append(program.part_kg)
        program.touch(2)
        program.turn(12)
        assert program.last is not None
        if program.events[-1].kind == "load":  # not seen if the tool turns about the vertical
            assert program.last.part_kg == pytest.approx(program.part_kg, abs=5 * program.last.part_sigma_kg)
        program.touch(4)
        steps.append(-program.part_kg)
        program.part_kg = 0.0
        program.touch(2)
        program.turn(12)
        program.touch(6)
        program.turn(6)
    assert max(program.off) < 3.5
    assert np.mean(np.array(program.off) < 3) > 0.99
    loads = [event.size for event in program.events if event.kind == "load"]
    assert 0.9 * len(steps) <= len(loads) <= len(steps)
    assert 10 <= sum(event.kind == "contact" for event in program.events) <= 15


def test_the_uncertainty_grows_while_the_bias_cannot_be_seen() -> None:
    program = Program(2)
    program.turn(30)
    before = program.last
    program.touch(500)
    after = program.last
    assert before is not None
    assert after is not None
    assert before.last_seen_s == pytest.approx(2 * WINDOW_S)  # two windows wait
    assert after.last_seen_s == pytest.approx(502 * WINDOW_S)
    assert (after.sigma > 1.1 * before.sigma).all()
