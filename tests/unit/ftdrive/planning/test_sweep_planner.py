"""A sweep: its limits, its proof beside brute force, its file."""

from dataclasses import replace

import numpy as np
import pytest

from ftdrive.errors import ConfigError
from ftdrive.planning import sweep_planner
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Scene
from ftdrive.planning.motion import Speeds, tips
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of
from ftdrive.planning.sweep_planner import plan_sweep

SPEEDS = Speeds()
STOP_RAD_S2 = float(np.radians(300))


def certifier_of(*boxes: Box, tool_m: float = 0.2) -> Certifier:
    return Certifier(ArmModel("UR5e", [Cylinder(0.0, tool_m, 0.1)]), Scene((BASE_PLANE,), boxes))


def planned(certifier: Certifier, seconds: float = 10.0) -> Plan:
    guess = replace(guess_of(certifier), mass_kg=1.2)
    return plan_sweep(certifier, USUAL_POSTURE_RAD, seconds, speeds=SPEEDS, stop_rad_s2=STOP_RAD_S2, guess=guess)


@pytest.fixture(autouse=True)
def _short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_planner, "RANDOM", 3)
    monkeypatch.setattr(sweep_planner, "CHANGED", 2)


@pytest.fixture(scope="module")
def plan() -> Plan:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_planner, "RANDOM", 3)
        patch.setattr(sweep_planner, "CHANGED", 2)
        return planned(certifier_of())


def test_every_limit_is_kept(plan: Plan) -> None:
    assert plan.sweep is not None
    t = np.arange(0.0, plan.sweep.duration_s, 0.002)
    assert np.abs(plan.sweep.at(t, 1)).max() <= SPEEDS.joint_rad_s
    assert np.abs(plan.sweep.at(t, 2)).max() <= SPEEDS.joint_rad_s2
    path_m = tips(certifier_of().arm, plan.sweep.at(t))
    assert SPEEDS.tip_m_s is not None
    assert np.linalg.norm(np.diff(path_m, axis=0), axis=2).max() / 0.002 <= 1.01 * SPEEDS.tip_m_s
    assert np.abs(plan.sweep.at(t) - plan.sweep.centre_rad).max() <= 1.02 * sweep_planner.MOST_RAD
    assert plan.arm_rests
    assert np.allclose(plan.nodes_rad, [USUAL_POSTURE_RAD])


def test_the_margins_hold_on_the_curve_and_beside_it(plan: Plan) -> None:
    assert plan.sweep is not None
    rng, certifier = np.random.default_rng(0), certifier_of()
    q = plan.sweep.at(np.arange(0.0, plan.sweep.duration_s, 0.05))
    off = np.zeros_like(q)
    off[:, 3:] = rng.uniform(-1, 1, (len(q), 3)) * plan.sweep.largest(2)[3:] * sweep_planner.SMOOTHED_S**2 / 2
    assert certifier.free(q + off).all()
    assert plan.certified
    plan.require(certifier)


def test_half_the_speed_is_the_same_path(plan: Plan) -> None:
    assert plan.sweep is not None
    half = plan.at_share(0.5)
    assert half.sweep is not None
    assert half.sweep.duration_s == 2 * plan.sweep.duration_s
    assert half.top_speed_rad_s == pytest.approx(plan.top_speed_rad_s / 2, rel=0.05)


def test_impossible_durations_and_cells_are_refused() -> None:
    with pytest.raises(ConfigError, match="10 to 120 s"):
        planned(certifier_of(), seconds=5.0)


def test_the_rows_of_a_sweep_are_its_motion_and_their_rates(plan: Plan) -> None:
    assert plan.sweep is not None
    arm, sweep, h = certifier_of().arm, plan.sweep, 1e-3
    found, rate = sweep_planner._flange_motion(arm, sweep)
    t = np.arange(0.0, sweep.duration_s, 0.12)

    def columns(t: np.ndarray) -> np.ndarray:
        before, at, after = (arm.frames(sweep.at(t + k * h)) for k in (-1, 0, 1))
        R = at.R_base_flange
        a = (before.flange_m - 2 * at.flange_m + after.flange_m) / h**2
        Rdd = (before.R_base_flange - 2 * R + after.R_base_flange) / h**2
        turning = (np.swapaxes(R, 1, 2) @ Rdd).reshape(-1, 9)
        return np.hstack([R.reshape(-1, 9), np.einsum("nji,nj->ni", R, a), turning])

    np.testing.assert_allclose(found.columns(), columns(t), atol=0.02)
    np.testing.assert_allclose(rate.columns(), (columns(t + 5 * h) - columns(t - 5 * h)) / (10 * h), atol=0.1)
