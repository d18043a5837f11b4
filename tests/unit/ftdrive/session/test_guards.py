"""Each row of the hazard table that software can see: what is seen, and what it is called."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.session.guards import (
    ContactGuard,
    ExpectedMotion,
    Guard,
    Limits,
    ModelGuard,
    PathGuard,
    RangeGuard,
    SafetyGuard,
    Seen,
    SensorGuard,
    SettingsGuard,
    StallGuard,
    Tripped,
)
from ftdrivers.errors import DeviceFault
from ftdrivers.interfaces import ArmState
from ftdrivers.ur.kinematics import MODELS
from tests.unit.ftdrive.fake_cell import STATUS

Array = NDArray[np.float64]

LIMITS = Limits()
CERTIFIER = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene())
OWN = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)], MODELS["UR5e"]), Scene())
START = np.radians([45.0, -100, 60, -50, 90, 45])
GOAL = np.radians([45.0, -100, 60, -140, 45, 90])
WEIGHT = np.array([0.0, 0.0, 12.0, 0.1, 0.0, 0.0])


def state(q: Array) -> ArmState:
    at = CERTIFIER.arm.frames(q)
    return ArmState(0, 0.0, q, np.zeros(6), at.R_base_flange[0], at.flange_m[0])


class Looks:
    """Feeds one guard with looks 10 ms apart."""

    def __init__(self, guard: Guard, *, moving: bool = True) -> None:
        self.guard = guard
        self.motion = ExpectedMotion(START, GOAL, moving=True) if moving else ExpectedMotion(GOAL, GOAL, moving=False)
        self.state = state(START + 0.4 * (GOAL - START) if moving else GOAL)
        self.t_s, self.sample = 0.0, 0
        self.rng = np.random.default_rng(0)
        guard.begin(self.seen())

    def seen(self, *, new: bool = True, **different: Any) -> Seen:
        self.t_s, self.sample = self.t_s + 0.01, self.sample + new
        wrench = WEIGHT + self.rng.normal(0, 0.03, 6)
        usual: dict[str, Any] = {"state": self.state, "status": STATUS, "wrench": wrench, "turn_rad_s": 0.0}
        return Seen(t_s=self.t_s, dt_s=0.01, motion=self.motion, sample=self.sample, **(usual | different))

    def trips(self, times: int = 1, *, new: bool = True, **different: Any) -> Tripped | None:
        try:
            for _ in range(times):
                self.guard.look(self.seen(new=new, **different))
        except Tripped as trip:
            return trip
        return None

    def trip(self, times: int = 1, *, new: bool = True, **different: Any) -> Tripped:
        trip = self.trips(times, new=new, **different)
        assert trip is not None
        return trip


def test_joints_that_leave_the_straight_line_are_seen() -> None:
    looks = Looks(PathGuard(LIMITS))
    on_the_way = START + 0.3 * (GOAL - START)
    for joint, allowed_deg in ((0, 0.5), (2, 0.5), (4, 2.0)):
        off = np.zeros(6)
        off[joint] = np.radians(0.8 * allowed_deg)
        assert looks.trips(state=state(on_the_way + off)) is None
        trip = looks.trip(state=state(on_the_way + 1.6 * off))
        assert (trip.hazard, f"joint {joint + 1}" in str(trip)) == (2, True)


def test_an_arm_that_is_moved_while_it_should_stand_has_another_client() -> None:
    looks = Looks(PathGuard(LIMITS), moving=False)
    assert looks.trips(50) is None
    assert looks.trip(state=state(GOAL + np.radians([0, 0, 0, 0, 0, 0.6]))).hazard == 21


def test_only_an_arm_that_comes_no_nearer_has_stalled() -> None:
    looks, at = Looks(StallGuard(LIMITS)), state(START)
    for share in np.linspace(0, 1, 1500):  # 15 s for one move
        assert looks.trips(state=replace(at, q_rad=START + share * (GOAL - START))) is None
    looks = Looks(StallGuard(LIMITS))
    trip = looks.trip(1010, status=replace(STATUS, speed_slider=0.0))
    assert (trip.hazard, "slider 0 %" in str(trip)) == (22, True)
    assert 10.0 < looks.t_s < 10.1


@pytest.mark.parametrize("by", ["place", "angle"])
@pytest.mark.parametrize(("certifier", "right_m", "wrong_m"), [(CERTIFIER, 0.018, 0.022), (OWN, 0.0015, 0.0025)])
def test_a_flange_where_this_arm_cannot_have_it_is_seen(
    by: str, certifier: Certifier, right_m: float, wrong_m: float
) -> None:
    """Nominal kinematics are farther from a real arm than its own."""
    looks, right = Looks(ModelGuard(LIMITS, certifier)), state(GOAL)
    off = {"place": np.array([0, 0, right_m]), "angle": np.zeros(3)}[by]
    assert looks.trips(state=replace(right, p_base_flange_m=np.add(right.p_base_flange_m, off))) is None
    turn = Rotation.from_rotvec([0.0, 0.0, 3 * wrong_m]).as_matrix()
    wrong = (
        replace(right, p_base_flange_m=np.add(right.p_base_flange_m, [0, 0, wrong_m]))
        if by == "place"
        else replace(right, R_base_flange=right.R_base_flange @ turn)
    )
    assert looks.trip(state=wrong).hazard == 8


def test_settings_changed_on_the_way_are_seen() -> None:
    looks = Looks(SettingsGuard())
    assert looks.trips(20) is None
    assert looks.trip(status=replace(STATUS, tcp_offset=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))).hazard == 8
    assert looks.trip(status=replace(STATUS, payload_kg=0.0)).hazard == 7
    assert looks.trip(status=replace(STATUS, p_flange_payload_m=(0.0, 0.0, 0.1))).hazard == 7


@pytest.mark.parametrize(
    ("different", "hazard"),
    [
        ({"fault": "protective stop: …", "safety_mode": "protective stop"}, 10),
        ({"fault": DeviceFault("emergency stop", "…"), "safety_mode": "robot emergency stop"}, 11),
        ({"fault": "safeguard stop: …", "safety_mode": "safeguard stop"}, 11),
        ({"fault": "recovery mode: …", "safety_mode": "recovery"}, 12),
        ({"fault": "robot mode 5 (idle): …", "robot_mode": "idle"}, 12),
        ({"safety_mode": "reduced"}, 12),
        ({"program": "paused"}, 21),
        ({"program": "stopped"}, 21),
    ],
)
def test_every_stop_and_change_of_the_controller_is_seen_at_once(different: dict[str, Any], hazard: int) -> None:
    looks = Looks(SafetyGuard())
    assert looks.trips(5) is None
    assert looks.trip(status=replace(STATUS, **different)).hazard == hazard


@pytest.mark.parametrize(("moving", "after_s"), [(True, 0.1), (False, 0.5)])
def test_a_silent_sensor_is_seen_in_time(moving: bool, after_s: float) -> None:
    looks = Looks(SensorGuard(LIMITS), moving=moving)
    assert looks.trips(50) is None
    before_s = looks.t_s
    assert looks.trip(100, new=False).hazard == 15
    assert after_s < looks.t_s - before_s < after_s + 0.015


def test_a_sensor_that_repeats_itself_and_one_that_says_nothing_are_seen() -> None:
    looks = Looks(SensorGuard(LIMITS))
    before_s = looks.t_s
    trip = looks.trip(100, wrench=WEIGHT)
    assert (trip.hazard, "repeated" in str(trip)) == (15, True)
    assert 0.2 < looks.t_s - before_s < 0.225
    assert Looks(SensorGuard(LIMITS)).trip(wrench=np.full(6, np.nan)).hazard == 15


def test_an_axis_near_the_end_of_its_range_is_seen() -> None:
    guard = RangeGuard(LIMITS, np.array([100.0, 100, 200, 5, 5, 5]))
    assert Looks(guard).trips(wrench=np.array([80.0, 0, 150, 4, 0, 0])) is None
    trip = Looks(guard).trip(wrench=np.array([0.0, 0, 0, 0, -4.6, 0]))
    assert (trip.hazard, "92 %" in str(trip), "Ty" in str(trip)) == (13, True, True)
    assert Looks(RangeGuard(LIMITS, None)).trips(wrench=np.full(6, 1e4)) is None


def contact(*, known: bool = True, quiet: float = 0.03) -> ContactGuard:
    guard = ContactGuard(LIMITS, 1.5, 0.2, 1.4, np.full(6, quiet))
    if known:
        guard.predict = lambda _: WEIGHT
    return guard


@pytest.mark.parametrize("moving", [True, False])
def test_a_push_is_seen_once_the_tool_is_known(moving: bool) -> None:
    looks = Looks(contact(), moving=moving)
    assert looks.trips(200) is None
    assert looks.trips(50, wrench=np.add(WEIGHT, [6, 0, 0, 0, 0, 0])) is None
    before_s = looks.t_s
    assert looks.trip(50, wrench=np.add(WEIGHT, [0, 14, 0, 0, 0, 0])).hazard == 14
    assert looks.t_s - before_s < 0.05
    assert Looks(contact(), moving=moving).trip(50, wrench=np.add(WEIGHT, [0, 0, 0, 0, 0, 2.0])).hazard == 14


def test_a_turning_arm_is_given_room_in_torque_for_what_the_tool_itself_gives() -> None:
    twisted = np.add(WEIGHT, [0, 0, 0, 0, 0.95, 0])  # 0.8 N·m, and at 1 rad/s 1.2 N of allowance on 0.2 m
    assert Looks(contact()).trips(50, wrench=twisted, turn_rad_s=1.0) is None
    assert "0.88 N·m" in str(Looks(contact()).trip(50, wrench=twisted, turn_rad_s=0.0))
    assert Looks(contact(), moving=False).trip(50, wrench=twisted).hazard == 14


def test_before_the_tool_is_known_any_tool_may_turn_over_but_no_more() -> None:
    looks = Looks(contact(known=False))
    assert looks.trips(20, wrench=-WEIGHT) is None
    assert looks.trip(wrench=np.add(WEIGHT, [0, 0, -50, 0, 0, 0])).hazard == 14


def test_one_bad_sample_is_no_contact() -> None:
    looks = Looks(contact(), moving=False)
    assert looks.trips(10) is None
    assert looks.trips(wrench=np.add(WEIGHT, [9, 0, 0, 0, 0, 0])) is None
    assert looks.trips(10) is None


def test_a_noisy_sensor_is_given_more_room() -> None:
    pushed = np.add(WEIGHT, [12, 0, 0, 0, 0, 0])
    assert Looks(contact(quiet=2.0), moving=False).trips(30, wrench=pushed) is None
    assert Looks(contact(quiet=0.1), moving=False).trip(30, wrench=pushed).hazard == 14


def test_a_protective_stop_is_reported_with_the_payload_that_may_have_caused_it() -> None:
    stopped = replace(STATUS, fault=DeviceFault("protective stop", "…"), safety_mode="protective stop")
    assert "1.50 kg" in str(Looks(SafetyGuard()).trip(status=stopped))
    without = str(Looks(SafetyGuard()).trip(status=replace(stopped, payload_kg=None)))
    assert without.endswith("payload or centre of mass")
    braked = replace(STATUS, fault=DeviceFault("emergency stop", "…"), safety_mode="robot emergency stop")
    assert "payload" not in str(Looks(SafetyGuard()).trip(status=braked))
