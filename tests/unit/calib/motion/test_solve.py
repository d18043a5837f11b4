"""What a recording in motion shows beside its fit: a coarse delay, another height, and what is missing."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import Known, NotObservable
from ftcalib.errors import BadDataset
from ftcalib.model import Array
from ftcalib.motion.model import HEIGHT, INERTIA, SIZE, wrench_of
from ftcalib.motion.samples import Motion, MotionRows
from ftcalib.motion.solve import (
    SLOW_RAD_S,
    _coarse_delay,
    _motion_findings,
    _other_wrench,
    _require_enough_motion,
    _select_rows,
)
from ftcalib.result import MotionResult
from tests.moving_load import Truth
from tests.unit.calib.motion.test_estimate import ROW_S, SIGMA, rows_of
from tests.unit.calib.motion.test_motion import load_of

TRUTH = load_of(Truth())
WEIGHT_N = Truth().mass_kg * 9.80665


def shifted(rows: MotionRows, by: int) -> MotionRows:
    """The same with the wrench so many rows later."""
    return replace(rows, wrench=np.roll(rows.wrench, by, axis=0))


def test_a_delay_that_explains_little_more_is_none() -> None:
    rows = shifted(rows_of(150, TRUTH), 20)  # farther than is looked for
    assert _coarse_delay(rows)[0] == 0.0
    noisy = rows_of(150, TRUTH, sigma=np.repeat([30.0, 3.0], 3))
    assert _coarse_delay(shifted(noisy, 3))[0] == 0.0
    with pytest.raises(BadDataset, match=r"only 4\.9 s of motion are free of gaps"):
        _coarse_delay(rows[:41])


def test_without_positions_slow_rows_count() -> None:
    rows = rows_of(100, TRUTH)
    rows = replace(rows, speed_rad_s=np.where(np.arange(100) < 42, 0.14, 0.16))
    assert _select_rows(rows, np.inf) is rows
    assert len(_select_rows(rows, SLOW_RAD_S)) == 42
    with pytest.raises(BadDataset, match=r"it lasts 4\.9 s"):
        _select_rows(rows[1:], SLOW_RAD_S)


def best_of(**values: Any) -> Any:
    """A fit as far as the findings read it."""
    n = len(values.get("kept", values.get("residuals", np.zeros((1, 6)))))
    covariance = np.zeros((SIZE, SIZE))
    usual = {
        "load": TRUTH,
        "covariance": covariance,
        "kept": np.ones(n, np.bool_),
        "residuals": np.zeros((n, 6)),
        "prior_share": np.zeros(8),
    }
    return SimpleNamespace(**{**usual, **values})


def about_one_axis() -> MotionRows:
    """The tool straight down, turned by the last joint alone."""
    rows = rows_of(60, TRUTH)
    spin = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_euler("z", np.linspace(0, 2, 60)[:, None])
    return replace(rows, motion=replace(rows.motion, R_base_flange=spin.as_matrix()))


@pytest.mark.slow
@pytest.mark.parametrize(("place", "sigma", "enough"), [(2, 0.29, True), (2, 0.31, False), (4, 0.51, False)])
def test_a_fit_with_large_errors_is_not_determined(place: int, sigma: float, enough: bool) -> None:
    covariance = np.zeros((SIZE, SIZE))
    covariance[place, place] = (sigma if place < 3 else sigma * WEIGHT_N) ** 2
    best = best_of(covariance=covariance)
    _require_enough_motion(about_one_axis(), best, Known())
    if enough:
        _require_enough_motion(about_one_axis(), best, None)
        return
    with pytest.raises(NotObservable, match="turn wrist 1 and wrist 2"):
        _require_enough_motion(about_one_axis(), best, None)
    if place == 2:
        _require_enough_motion(rows_of(60, TRUTH), best, None)  # the orientations would show it: the verdict names it


def motion_result(delay_s: float = 0.0, contacts: tuple[Any, ...] = ()) -> MotionResult:
    return MotionResult(np.zeros((3, 3)), delay_s, 0.04, np.zeros((23, 23)), 1.0, contacts)


def found(best: Any, motion: MotionResult, *, positions: bool = True, height_m: float | None = None) -> dict[str, Any]:
    rows = rows_of(100, TRUTH)
    return {one.code: one for one in _motion_findings(rows, rows[:80], best, motion, height_m, positions=positions)}


def test_what_a_recording_lacks_is_a_finding() -> None:
    assert found(best_of(), motion_result(-0.09)) == {}
    assert found(best_of(), motion_result(-0.11))["clock_offset"].values == {"delay_s": -0.11}
    touch = {"t_s": 1.0, "duration_s": 2.0, "force_N": 5.0}
    one = found(best_of(), motion_result(contacts=(touch, {**touch, "force_N": 9.0})))["contacts_left_out"].values
    assert one == {"count": 2, "share_percent": pytest.approx(100 * 4 / (80 * ROW_S)), "force_N": 9.0}
    assert "mostly_contact" in found(best_of(), motion_result(contacts=(touch,) * 3))
    missing = found(best_of(), motion_result(), positions=False)["positions_missing"].values
    turned = np.linalg.norm(rows_of(100, TRUTH).motion.Omega_rad2_s2[:80], ord=2, axis=(1, 2))
    assert missing["share_percent"] == pytest.approx(80)
    assert missing["force_N"] == pytest.approx(Truth().mass_kg * np.sqrt(np.mean(turned**2)))  # at 1 m


def test_a_height_that_differs_is_named() -> None:
    covariance = np.zeros((SIZE, SIZE))
    for sigma_m, off_m, named in (
        (1e-4, 2.9e-3, False),
        (1e-4, -3.1e-3, True),
        (1e-3, 4.9e-3, False),
        (1e-3, 5.1e-3, True),
    ):
        covariance[HEIGHT, HEIGHT] = sigma_m**2
        findings = found(best_of(covariance=covariance), motion_result(), height_m=TRUTH.height_m + off_m)
        assert ("height_differs" in findings) == named
        if named:
            values = findings["height_differs"].values
            assert [values[name] for name in ("height_mm", "sigma_mm", "configured_mm")] == pytest.approx(
                [40, 1e3 * sigma_m, 40 + 1e3 * off_m]
            )


def test_what_the_motion_does_not_show_is_named() -> None:
    share = np.full(8, 0.29)
    share[[1, 6]] = 0.31
    covariance = np.zeros((SIZE, SIZE))
    covariance[INERTIA, INERTIA] = np.eye(6)
    assert found(best_of(prior_share=share.copy(), covariance=covariance), motion_result())["motion_slow"].values == {
        "names": "the inertia (yy), the height"
    }
    known = found(best_of(prior_share=share.copy()), motion_result())["motion_slow"].values  # a point mass
    assert known == {"names": "the height"}
    assert "motion_slow" not in found(best_of(prior_share=share), motion_result(), positions=False)


def test_a_wrench_without_weight_and_one_of_another_recording_are_named() -> None:
    rows = rows_of(200, TRUTH)
    still = Motion(rows.motion.R_base_flange, 0 * rows.motion.acceleration_m_s2, 0 * rows.motion.Omega_rad2_s2)

    def named(wrench: Array, residuals: Array) -> list[tuple[str, Any]]:
        seen = replace(rows, wrench=wrench)
        return [(one.code, one.values) for one in _other_wrench(seen, seen, best_of(residuals=residuals), [])]

    assert named(rows.wrench, np.tile(SIGMA, (200, 1))) == []
    weight = wrench_of(TRUTH, still)
    ((code, values),) = named(rows.wrench - 0.9 * weight, np.tile(SIGMA, (200, 1)))
    assert code == "wrench_compensated"
    assert values["mass_kg"] == pytest.approx(Truth().mass_kg, rel=0.05)
    assert values["weight_N"] == pytest.approx(0.1 * WEIGHT_N, rel=0.2)
    assert named(rows.wrench - 0.4 * weight, np.tile(SIGMA, (200, 1))) == []  # more than half of the weight is left
    other = np.random.default_rng(1).normal(size=(200, 6))
    ((code, values),) = named(other, 0.5 * other)
    assert (code, round(values["left_percent"])) == ("other_recording", 50)
    assert named(other, 0.25 * other) == []
