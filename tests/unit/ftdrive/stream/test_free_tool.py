"""Bias, drift and part of a program that picks, carries, places and touches, while the bias drifts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftdrive.stream.free_tool import ANY_BIAS, FreeToolFilter
from ftdrive.stream.noise import REST, Window
from ftdrive.stream.samples import StreamEvent, Tracked

NOISE = np.repeat([0.08, 0.004], 3)
G_M_S2, WINDOW_S = 9.81, 0.15
DRIFT = np.array([0.8, -0.5, 0.33, 0.02, 0.01, -0.02]) / 3600
"""1 N an hour."""


def free_tool(mass_kg: float = 1.2, height_m: float = 0.06, *, is_known: bool = True, **options: Any) -> FreeToolFilter:
    found = FreeToolFilter(mass_kg, np.array([0.0, 0.0, height_m]), np.zeros(6), **options)
    if not is_known:
        found.expect(ANY_BIAS)
    return found


class Program:
    """A tool that turns, and what the tracker says of each window."""

    def __init__(self, seed: int) -> None:
        self.rng, self.tracker = np.random.default_rng(seed), free_tool(is_known=False)
        self.R, self.t_s, self.part_kg, self.p_m = Rotation.identity(), 0.0, 0.0, np.array([0, 0.01, 0.12])
        self.events: list[StreamEvent] = []
        self.off = list[float]()
        """Largest error of the bias in each window, in sigmas."""
        self.last: Tracked | None = None

    def turn(self, windows: int) -> None:
        axis = self.rng.standard_normal(3)
        self.hold(windows, axis / np.linalg.norm(axis) * self.rng.uniform(0.5, 1.2), np.zeros(6))

    def touch(self, windows: int) -> None:
        force = self.rng.standard_normal(3) * self.rng.uniform(3, 12)
        self.hold(windows, np.zeros(3), np.r_[force, np.cross([0.01, 0, 0.12], force)])

    def hold(self, windows: int, turn_rad_s: Array, contact: Array) -> None:
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
                    R_base_flange=self.R.as_matrix(),
                    p_base_flange_m=np.zeros(3),
                    as_read=np.eye(6),
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
        if program.events[-1].kind == "load-step":  # not seen if the tool turns about the vertical
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
    loads = [event.values["mass_kg"] for event in program.events if event.kind == "load-step"]
    assert 0.9 * len(steps) <= len(loads) <= len(steps)
    assert 10 <= sum(event.kind == "contact" for event in program.events) <= 15


WINDOW = Window(
    t_s=0.0,
    residual=np.zeros(6),
    felt_m_s2=np.array([1.0, -2.0, -9.0]),
    lever_s2=np.array([[-3.0, 1.0, 0.5], [0.2, -2.0, 0.7], [0.4, -0.6, -1.5]]),
    p_sensor_near_m=np.array([0.01, -0.02, 0.12]),
    noise=np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
    state=1,
    systematic=np.zeros((6, 6)),
    turning_rad_s2=2.0,
    tensor_Nm=0.05,
    R_base_flange=np.eye(3),
    p_base_flange_m=np.zeros(3),
    as_read=np.eye(6),
)


def at_rest(t_s: float, residual: Array) -> Window:
    return replace(
        WINDOW,
        t_s=t_s,
        residual=residual,
        noise=np.diag(NOISE**2 / 4),
        state=REST,
        lever_s2=np.zeros((3, 3)),
        turning_rad_s2=0.0,
        tensor_Nm=0.0,
    )


@pytest.mark.slow
def test_a_contact_that_grows_slowly_is_reported_once_and_covered_by_the_sigma() -> None:
    rng, tracker = np.random.default_rng(9), free_tool()
    contact, events = 3.0 * np.array([0.6, 0.0, -0.8, 0.005, 0.01, 0.0]), list[StreamEvent]()
    for t_s in np.arange(0.0, 400.0):
        held = contact * np.clip((t_s - 30) / 300, 0, 1) * (t_s < 360)
        tracked = tracker.update(at_rest(t_s, held + NOISE / 4 * rng.standard_normal(6)))
        events += tracked.events
        off = np.abs(tracked.bias)
        assert (off < np.maximum([0.2, 0.2, 0.2, 0.02, 0.02, 0.02], 3 * tracked.sigma)).all()
    slow, *others = (event for event in events if event.kind == "drift")
    assert not others
    assert 0.1 < slow.values["force_N"] < 1.0
    assert (tracked.sigma[:3] < 0.3).all()  # it has ended
    assert (off[:3] < 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize("rate_N_h", [0.0, 20.0])
def test_the_rate_of_a_drift_has_an_honest_sigma_and_is_reported_once(rate_N_h: float) -> None:
    squares, reported = [], 0
    for seed in range(4):
        rng, tracker = np.random.default_rng(seed), free_tool()
        for t_s in np.arange(0.0, 240.0):
            drift = rate_N_h * t_s / 3600 * np.array([0.6, 0, -0.8, 0, 0, 0])
            tracker.update(at_rest(t_s, drift + NOISE / 4 * rng.standard_normal(6)))
            reported += tracker.warning(1.0) is not None
        found, sigma_N_h = tracker.force_rate_N_h
        squares.append(((found - rate_N_h) / sigma_N_h) ** 2)
    assert np.mean(squares) < (3.0 if rate_N_h else 6.0)  # without a drift three axes count
    assert reported == (4 if rate_N_h else 0)
