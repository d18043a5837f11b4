"""Running fit of the poses taken so far, their coverage, and the most useful next pose."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, NotObservable, solve
from ftcalib.compensation import Compensator
from ftcalib.judge.observability import (
    ACCEPTED_DELTA_CHI2,
    AMBIGUOUS_GAP,
    LEAST_POSES,
    RECOMMENDED_POSES,
    WEAK_GAP,
    axes_along,
    different_orientations,
    largest_gap,
)
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array, weight_and_tilt
from ftcalib.poses.information import Guess, Prediction, predicted_sigma
from ftcalib.poses.selection import next_pose
from ftcalib.routine import PoseRecord, dataset_from, is_return
from ftdrive.cell.config import USUAL_KG
from ftdrive.runs.load import Load
from ftdrive.session.events import Estimated

# Largest condition numbers of green coverage, as for gravity directions 50 to 60 degrees apart; see `Prediction`.
GREEN = {"cond9": 4.0, "cond_u1": 8.0}
# Largest condition numbers of amber coverage, as for gravity directions 30 to 45 degrees apart.
AMBER = {"cond9": 8.0, "cond_u1": 25.0}
# With a load, coverage is judged by cond_u1 alone: a hanging load limits the tilt, and the tool-only run gives cond9.
OF_A_LOAD = ("cond_u1",)
# Largest tilt of the tool in a suggested pose while a load hangs from it, with a margin for rounding.
HUNG_TILT_RAD = float(np.radians(76))
# A running fit is reliable if the sigma of the force that it predicts is at most this share of the weight.
TRUSTED_SHARE = 0.05


def free_wrench(result: CalibrationResult, R_base_flange: Array) -> Array:
    """Return the reading (6,), N and N·m, of the sensor with a free tool at an orientation R_base_flange (3, 3)."""
    # The sensor matrix, which decodes contacts, is not applied, because the guards compare readings as measured.
    compensator = Compensator(result.parameters, response=result.response)
    return np.asarray(-compensator(np.zeros(6), R_base_flange), dtype=np.float64)


class RunningFit:
    """Calibration from the poses so far, and the coverage of these poses.

    `down_base` (3,) is the unit vector down in base axes, used until the fit estimates it. With `advise` each estimate
    suggests the most useful next pose. A known `load` on the tool is part of what the sensor carries.
    """

    def __init__(
        self,
        *,
        g_m_s2: float = STANDARD_GRAVITY_M_S2,
        down_base: ArrayLike = (0.0, 0.0, -1.0),
        advise: bool = True,
        load: Load | None = None,
    ) -> None:
        self._g_m_s2 = g_m_s2
        self._advise, self._load = advise, load
        self._down_base = np.asarray(down_base, dtype=np.float64)
        self._records: dict[int, PoseRecord] = {}
        self.result: CalibrationResult | None = None
        """Result of `ftcalib.solve` for the poses so far; None while the poses do not determine it."""

    @property
    def weighed_kg(self) -> float | None:
        """Mass that the sensor carries, kg; None while the fit is not reliable."""
        result = self._trusted()
        if result is None or result.sigma["weight_N"] > TRUSTED_SHARE * result.weight_N:
            return None
        return result.mass_kg

    def add(self, record: PoseRecord) -> Estimated:
        """Add a pose, which replaces one with the same `stop`; return the new estimate."""
        self._records.pop(record.stop, None)
        residual = _surprise(self.result, record)
        self._records[record.stop] = record
        coverage = self._refit()
        R_base_flange, down = self._orientations(), self._down()
        gravity_flange = down @ R_base_flange
        light = _light(coverage, loaded=self._load is not None)
        tilt_rad = HUNG_TILT_RAD if self._load is not None and not self._load.gripped else np.pi
        values, sigma = ({}, {}) if self.result is None else _values_and_sigmas(self.result)
        return Estimated(
            poses=len(R_base_flange),
            values=values,
            sigma=sigma,
            residual_sigma=None if residual is None else residual[0],
            residual_force_N=None if residual is None else residual[1],
            faces=faces(gravity_flange),
            cond9=coverage.cond9,
            cond_u1=coverage.cond_u1,
            empty_cap_deg=float(np.degrees(largest_gap(gravity_flange)[0])),
            light=light,
            hint=_hint(R_base_flange, self._guess(), down, tilt_rad) if self._advise and light != "green" else "",
        )

    def remove(self, stop: int) -> None:
        """Remove the pose at a stop before it is taken again; ignore a stop without a pose."""
        if self._records.pop(stop, None) is None:
            return
        if self._records:
            self._refit()
        else:
            self.result = None

    def predict(self, R_base_flange: Array) -> Array | None:
        """Return the wrench (6,), N and N·m, of a free tool at this orientation (3, 3); None while it is uncertain.

        The wrench is uncertain before six poses, while another mounting of the sensor fits almost as well, and at
        orientations far from those taken. Any thread may call this method.
        """
        result = self._trusted()
        if result is None:
            return None
        sigma_N = float(np.sqrt(np.trace(result.wrench_covariance(R_base_flange)[:3, :3])))
        if sigma_N > TRUSTED_SHARE * result.weight_N:
            return None
        return free_wrench(result, R_base_flange)

    def _trusted(self) -> CalibrationResult | None:
        result = self.result
        if result is None or result.n_poses < RECOMMENDED_POSES:
            return None
        second = result.second_basin_chi2
        return result if second is None or second >= ACCEPTED_DELTA_CHI2 else None

    def _kept(self) -> list[PoseRecord]:
        return [self._records[stop] for stop in sorted(self._records)]

    def _orientations(self) -> Array:
        records = self._kept()
        return np.array([record.before.R_base_flange for record in records if not is_return(record, records)])

    def _refit(self) -> Prediction:
        R_base_flange = self._orientations()
        coverage = predicted_sigma(R_base_flange, self._guess())
        different = different_orientations(R_base_flange)
        # The orientations alone show that the solver would fail; do not spend time on it.
        hopeless = different < LEAST_POSES or np.isinf(coverage.cond9) or coverage.second_basin_gap < AMBIGUOUS_GAP
        self.result = None if hopeless else self._solved()
        return coverage

    def _solved(self) -> CalibrationResult | None:
        try:
            return solve(dataset_from(self._kept(), {}), g_m_s2=self._g_m_s2)
        except NotObservable:
            return None

    def _down(self) -> Array:
        result = self.result
        if result is None or result.p_wrong > 0.01 or result.weight_N == 0:
            return self._down_base
        return result.gravity_force_base_N / result.weight_N

    def _guess(self) -> Guess:
        """Return the estimated tool, or a typical one before the first fit, with the measured noise of the poses."""
        variance = np.mean([np.diag(record.mean.covariance) for record in self._records.values()], axis=0)
        _, alpha, beta = weight_and_tilt(self._down())
        noise: dict[str, Any] = {
            "sigma_force_N": float(np.sqrt(variance[:3].mean())),
            "sigma_torque_Nm": float(np.sqrt(variance[3:].mean())),
            "tilt_alpha_rad": alpha,
            "tilt_beta_rad": beta,
            "g_m_s2": self._g_m_s2,
        }
        result = self.result
        if result is None or result.mass_kg == 0:
            return Guess(USUAL_KG, **noise)
        return Guess(
            result.mass_kg, p_sensor_com_m=result.p_sensor_com_m, R_flange_sensor=result.R_flange_sensor, **noise
        )


def faces(gravity_flange: Array) -> tuple[int, int, int, int, int, int]:
    """Return how many of the directions (n, 3) are nearest to each axis: +x -x +y -y +z -z."""
    nearest = np.abs(gravity_flange).argmax(axis=1)
    negative = gravity_flange[np.arange(len(gravity_flange)), nearest] < 0
    a, b, c, d, e, f = np.bincount(2 * nearest + negative, minlength=6).tolist()
    return a, b, c, d, e, f


def _hint(R_base_flange: Array, guess: Guess, down_base: Array, most_tilt_rad: float) -> str:
    """Describe the simple motion from the last of the orientations (n, 3, 3) to the most useful next one."""
    last = R_base_flange[-1]
    words, candidates = _simple_motions(last, down_base)
    inside = np.flatnonzero(candidates[:, :, 2] @ down_base >= np.cos(most_tilt_rad))
    if len(inside):
        words, candidates = [words[i] for i in inside], candidates[inside]
    best = int(next_pose(R_base_flange, candidates, guess)[0])
    before, after = (_pointing_down(down_base @ R) for R in (last, candidates[best]))
    return f"{'keep' if before == after else 'point'} {after} down: {words[best]}"


def _simple_motions(last: Array, down_base: Array) -> tuple[list[str], Array]:
    """Return descriptions of simple motions on the pendant, and the orientations (m, 3, 3) that they lead to."""
    words, candidates = list[str](), list[Array]()
    for axis in "zxy":
        for angle_deg in (90, -90) if axis == "z" else (90, -90, 45, -45):
            turn = "turn the last joint by" if axis == "z" else f"tilt it about its own {axis} axis by"
            words.append(f"{turn} {angle_deg:+d}°")
            candidates.append(last @ Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix())
    for angle_deg in (90, -90):
        words.append(f"turn it about the vertical by {angle_deg:+d}°")
        candidates.append(Rotation.from_rotvec(-np.radians(angle_deg) * down_base).as_matrix() @ last)
    return words, np.array(candidates)


def _pointing_down(gravity_flange: Array) -> str:
    axes = axes_along(gravity_flange)
    if len(axes) == 1:
        return f"the tool's {axes[0]} axis"
    return f"the middle between the tool's {', '.join(axes[:-1])} and {axes[-1]} axes"


def _light(coverage: Prediction, *, loaded: bool = False) -> str:
    """Return the light for a coverage; never green with few poses, or if a second solution fits them as well."""
    values = {"cond9": coverage.cond9, "cond_u1": coverage.cond_u1}
    if loaded:
        values = {name: values[name] for name in OF_A_LOAD}
    if coverage.second_basin_gap < AMBIGUOUS_GAP or any(values[name] > AMBER[name] for name in values):
        return "red"
    few = coverage.n_poses < RECOMMENDED_POSES or coverage.second_basin_gap < WEAK_GAP
    return "amber" if few or any(values[name] > GREEN[name] for name in values) else "green"


def _surprise(result: CalibrationResult | None, record: PoseRecord) -> tuple[float, float] | None:
    """Return a new pose's residual from the fit of earlier poses: worst channel in sigmas, norm of the force in N."""
    if result is None:
        return None
    R_base_flange = record.before.R_base_flange
    residual = result.compensate(record.mean.mean, R_base_flange)
    noise = max(1.0, result.noise_factor) ** 2 * record.mean.covariance
    sigma = np.sqrt(np.diag(noise + result.wrench_covariance(R_base_flange)))
    return float(np.max(np.abs(residual) / sigma)), float(np.linalg.norm(residual[:3]))


def _values_and_sigmas(result: CalibrationResult) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return estimates and sigmas by name; `drift` (6,), N and N·m, if any, is the last bias minus the first."""
    sigma = dict(result.sigma)
    values = {name: getattr(result, name) for name in sigma}
    if result.drift is not None:
        values["drift"], sigma["drift"] = result.drift.change, result.drift.sigma
    return values, sigma
