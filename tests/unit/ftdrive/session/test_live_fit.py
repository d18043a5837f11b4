"""The fit while poses come in, what is said about what is missing, and what is said at the end about odd poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import Finding, Parameters, solve
from ftcalib.model import predict
from ftcalib.poses.information import TOOL_DOWN_R_base_flange, special
from ftcalib.poses.selection import tilted_candidates
from ftcalib.routine import PoseRecord, TourPose, dataset_from
from ftdrive.planning.search.nodes import NUMBERS
from ftdrive.runs.load import Load
from ftdrive.runs.pose_hints import hints
from ftdrive.session.events import Estimated
from ftdrive.session.live_fit import RunningFit
from ftdrivers.interfaces import FtSamples
from tests.known_cells import UPSIDE_DOWN
from tests.pose_sets import AMBIGUOUS_6

Array = NDArray[np.float64]

SAMPLES = 200
SIGMA = np.repeat([0.3, 0.3 * 0.025], 3)
"""Of one sample."""
TRUTH = replace(UPSIDE_DOWN, gravity_force_base_N=np.array([0.3, -0.2, -11.0]))
TOUR = NUMBERS


@dataclass
class Reading:
    t_host_ns: int
    q_rad: Array
    R_base_flange: Array


def record(
    stop: int, R_base_flange: Array, number: int, *, bump_N: float = 0.0, truth: Parameters = TRUTH
) -> PoseRecord:
    rng = np.random.default_rng(stop)
    wrench = predict(truth, R_base_flange) + rng.normal(size=(SAMPLES, 6)) * SIGMA
    wrench[:, 0] += bump_N
    start_ns = stop * 4_000_000_000
    reading = Reading(start_ns, np.zeros(6), R_base_flange)
    samples = FtSamples.of(start_ns + np.arange(SAMPLES) * 10_000_000, np.arange(SAMPLES), wrench)
    return PoseRecord(stop, TourPose(number, np.zeros(6)), reading, reading, samples, steady=True)


def records(R_base_flange: Array) -> list[PoseRecord]:
    return [record(stop, R, stop) for stop, R in enumerate(R_base_flange, start=1)]


@cache
def taken_once() -> Sequence[PoseRecord]:
    numbers = [*TOUR, TOUR[0]]
    return [record(stop, R, n) for stop, (n, R) in enumerate(zip(numbers, special(numbers), strict=True), start=1)]


def tour() -> list[PoseRecord]:
    """24 poses and the return to the first."""
    return list(taken_once())


def run(taken: list[PoseRecord], running: RunningFit | None = None) -> Estimated:
    """Take all poses in and return what the last one gives, without a fit after each, which takes long."""
    running = running or RunningFit()
    running._records = {one.stop: one for one in taken[:-1]}
    return running.add(taken[-1])


def test_six_well_conditioned_poses_with_two_solutions_are_red_and_give_no_numbers() -> None:
    event = run(records(special(AMBIGUOUS_6)))
    assert event.cond9 < 1.3
    assert event.light == "red"
    assert event.values == {}


def test_following_the_hints_from_tool_down_leads_to_green_soon() -> None:
    running, R, seen = RunningFit(), TOOL_DOWN_R_base_flange, list[Estimated]()
    for stop in range(1, 15):
        event = running.add(record(stop, R, stop))
        seen.append(event)
        if event.light == "green":
            break
        R = follow(event.hint, R)
    assert seen[-1].light == "green"
    assert seen[-1].poses <= 9
    assert not seen[-1].hint
    assert [light for light, _ in pairwise([*(e.light for e in seen), ""])].count("red") < 6


def follow(words: str, R: Array) -> Array:
    """Do as the hint says, as a person would read it, and check where it says the axes will point."""
    where, turn = words.split(": ")
    angle = np.radians(float(turn.rsplit(" ", 1)[1].rstrip("°")))
    if "last joint" in turn:
        R = R @ Rotation.from_rotvec([0, 0, angle]).as_matrix()
    elif "vertical" in turn:
        R = Rotation.from_rotvec([0, 0, angle]).as_matrix() @ R
    else:
        axis = "xyz".index(turn.split(" axis")[0][-1])
        R = R @ Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    down = -R[2]  # base -z in the flange
    for k, axis_name in enumerate("xyz"):
        assert (f"+{axis_name}" in where) == (down[k] > np.sin(np.radians(22.5)))
        assert (f"-{axis_name}" in where) == (down[k] < -np.sin(np.radians(22.5)))
    return np.asarray(R)


# At the end: what happened at which pose.

Disturbed = Callable[[int, Array, np.random.Generator], Array]


def disturbed(wrench_of: Disturbed) -> list[PoseRecord]:
    """Take the tour with wrenches (6,) that depend on the stop, the orientation and chance."""
    rng = np.random.default_rng(0)
    taken = []
    for one in tour():
        noise = one.samples.wrench - one.samples.wrench.mean(axis=0) + rng.normal(size=6) * SIGMA / np.sqrt(SAMPLES)
        wrench = wrench_of(one.stop, one.before.R_base_flange, rng) + noise
        taken.append(replace(one, samples=FtSamples.of(one.samples.t_host_ns, one.samples.seq, wrench)))
    return taken


def said(taken: list[PoseRecord]) -> tuple[Finding, ...]:
    return hints(solve(dataset_from(taken, {})), taken)


def changed(taken: list[PoseRecord]) -> Finding:
    """What changed between two poses, without any hint about single ones."""
    result = solve(dataset_from(taken, {}))
    assert hints(result, taken) == ()
    (change,) = (one for one in result.findings if one.code in {"com_shifted", "bias_stepped", "load_changed"})
    return change


def name(stop: int) -> str:
    return f"R{TOUR[stop - 1]:02d}"


@pytest.mark.slow
def test_nothing_is_said_of_quiet_runs_and_inexact_arms_and_no_pose_is_named_where_the_sensor_wanders() -> None:
    def rough(_: int, R: Array, rng: np.random.Generator) -> Array:
        return predict(TRUTH, R @ Rotation.from_rotvec(rng.normal(size=3) * 0.002).as_matrix())

    def drifting(stop: int, R: Array, _: np.random.Generator) -> Array:
        return np.asarray(predict(TRUTH, R) + 0.5 * stop / 25 * np.eye(6)[0])

    def wandering(_: int, R: Array, rng: np.random.Generator) -> Array:
        bias[:] += rng.normal(size=6) * np.repeat([0.03, 0.0005], 3)
        return np.asarray(predict(TRUTH, R) + bias)

    bias = np.zeros(6)
    for wrench_of in (lambda _, R, __: predict(TRUTH, R), rough):
        assert said(disturbed(wrench_of)) == ()
    for drifts in (drifting, wandering):
        (hint,) = said(disturbed(drifts))
        assert hint.code == "sensor_drifts"


@pytest.mark.slow
def test_a_cable_that_pulls_in_three_poses_is_named_with_them() -> None:
    pull = np.array([0.3, 0.2, 0.4, 0.01, -0.03, 0.03])
    found = said(disturbed(lambda stop, R, _: predict(TRUTH, R) + (stop in {5, 6, 14}) * pull))
    assert [one.code for one in found] == ["pose_off"] * 3 + ["cable_pulls"]
    assert found[-1].values["poses"] == [name(5), name(6), name(14)]


@pytest.mark.slow
def test_a_load_that_shifts_is_named_with_the_pose_from_which_on() -> None:
    shifted = replace(TRUTH, p_sensor_com_m=TRUTH.p_sensor_com_m + np.array([0.004, 0.002, 0]))
    change = changed(disturbed(lambda stop, R, _: predict(shifted if stop >= 6 else TRUTH, R)))
    assert (change.code, change.values["pose"]) == ("com_shifted", 6)


@pytest.mark.slow
def test_a_tare_in_mid_tour_is_a_step_of_the_bias() -> None:
    step = np.array([0.3, 0, 0.2, 0, 0, 0])
    change = changed(disturbed(lambda stop, R, _: predict(TRUTH, R) + (stop >= 10) * step))
    assert (change.code, change.values["pose"]) == ("bias_stepped", 10)
    assert change.values["force_N"] == pytest.approx(np.linalg.norm(step), abs=0.03)


@pytest.mark.slow
def test_a_part_that_is_lost_in_mid_tour_changes_the_load() -> None:
    lighter = replace(TRUTH, gravity_force_base_N=0.95 * TRUTH.gravity_force_base_N)
    change = changed(disturbed(lambda stop, R, _: predict(lighter if stop >= 14 else TRUTH, R)))
    assert (change.code, change.values["pose"]) == ("load_changed", 14)
    assert change.values["change_N"] == pytest.approx(-0.05 * np.linalg.norm(TRUTH.gravity_force_base_N), rel=0.1)


@pytest.mark.slow
def test_a_pose_that_moved_is_named_and_not_explained_otherwise() -> None:
    taken = tour()
    turned = Reading(0, np.zeros(6), taken[6].before.R_base_flange @ Rotation.from_rotvec([0, 0, 0.01]).as_matrix())
    taken[6] = replace(record(7, taken[6].before.R_base_flange, TOUR[6], bump_N=1.0), after=turned, steady=False)
    taken[8] = replace(taken[8], steady=False)
    turned_by = {"pose": name(7), "turn_deg": pytest.approx(np.degrees(0.01))}
    assert [(one.code, dict(one.values)) for one in said(taken)] == [
        ("pose_turned", turned_by),
        ("pose_unsteady", {"pose": name(9)}),
    ]


def test_a_first_pose_that_is_touched_at_the_end_is_no_drift() -> None:
    (hint,) = said(disturbed(lambda stop, R, _: predict(TRUTH, R) + (stop == 25) * np.array([0.5, 0, 0, 0, 0, 0])))
    assert (hint.code, hint.values["pose"]) == ("return_differs", name(1))


def test_tilts_with_a_hanging_load_are_enough_for_its_run() -> None:
    """Alone they would leave the mounting uncertain, which the run of the tool has."""
    tilts = tilted_candidates(np.radians([45, 75]), 4, 0.0, (0.0, 0.0, -1.0))
    hung = Load.of("2.0", "tip=0,0,200", gripped=False)
    assert (run(records(tilts)).light, run(records(tilts), RunningFit(load=hung)).light) == ("amber", "green")


@pytest.mark.slow
def test_a_bumped_pose_stands_out_when_it_comes_and_can_be_taken_again() -> None:
    running, taken = RunningFit(), tour()
    run(taken[:13], running)
    quiet = running.add(taken[13])
    assert quiet.residual_sigma is not None
    assert quiet.residual_sigma < 5
    bumped = running.add(record(15, special([TOUR[14]])[0], TOUR[14], bump_N=1.0))
    assert bumped.residual_sigma is not None
    assert bumped.residual_sigma > 8
    assert bumped.residual_force_N == pytest.approx(1.0, abs=0.2)
    running.remove(15)
    assert running.result is not None
    assert running.result.n_poses == 14
    again = running.add(taken[14])
    assert again.poses == 15
    assert again.residual_sigma is not None
    assert again.residual_sigma < 5
    running.remove(99)
