"""Comparison of all methods on the same data, and the cases of Yu's Table III."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.display import Displayed, Summary
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import JSON
from ftcalib.known import NOTHING, Known, Setup
from ftcalib.likelihood.session import Drift
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array, Parameters, angle_between, predict
from ftcalib.poses.selection import EVERY_SET, set_numbers
from ftcalib.published.methods import CARLSON, PUBLISHED, published
from ftcalib.result import CalibrationResult, Method
from ftcalib.solver import estimator_of, solve

# Largest number of cross-validation folds; with more poses a fold leaves out several.
_MOST_FOLDS = 50


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MethodResult(Displayed):
    """Result of one method, or the reason why the method failed."""

    method: Method
    reason: str | None = None
    parameters: Parameters | None = None
    mass_kg: float = np.nan
    rotation_difference_rad: float = np.nan
    """Angle to the mounting of the default method, or to the true mounting in Table III, rad."""
    force_rms_N: float = np.nan
    torque_rms_Nm: float = np.nan
    cv_force_rms_N: float = np.nan
    """Cross-validated rms force error, N, each pose predicted from all others; NaN if the method needs every pose."""
    cv_torque_rms_Nm: float = np.nan
    """Cross-validated rms torque error, N·m; NaN if the method needs every pose."""
    largest_errors: Array | None = None
    """(8,) largest errors on the test set in sensor axes: Fx, Fy, Fz and |F| in N, then Tx, Ty, Tz and |T| in N·m."""
    mass_error: float = np.nan
    """Relative error of the mass; NaN if the reference is zero."""
    centre_error: float = np.nan
    """Error of the centre of mass, relative to its distance from the sensor; NaN if that distance is zero."""

    def _summary(self) -> Summary:
        words = f"force {self.force_rms_N:.4f} N, torque {self.torque_rms_Nm:.5f} N·m rms of the residuals"
        return Summary(f"{self.method}: {words if self.reason is None else self.reason}")

    def to_dict(self) -> dict[str, JSON]:
        """Return the JSON object that `ftdrive solve --method all --json` prints for a method."""
        if self.parameters is None:
            return {"method": self.method, "reason": self.reason}
        force, torque = map(_or_none, (self.cv_force_rms_N, self.cv_torque_rms_Nm))
        test: dict[str, JSON] = {}
        if self.largest_errors is not None:
            names = ("fx_N", "fy_N", "fz_N", "force_N", "tx_Nm", "ty_Nm", "tz_Nm", "torque_Nm")
            largest = dict(zip(names, self.largest_errors.tolist(), strict=True))
            test["test"] = {
                "largest": largest,
                "mass_error": _or_none(self.mass_error),
                "centre_error": _or_none(self.centre_error),
            }
        return {
            "method": self.method,
            "mass_kg": self.mass_kg,
            "p_sensor_com_m": self.parameters.p_sensor_com_m.tolist(),
            "force_bias_N": self.parameters.force_bias_N.tolist(),
            "torque_bias_Nm": self.parameters.torque_bias_Nm.tolist(),
            "gravity_force_base_N": self.parameters.gravity_force_base_N.tolist(),
            "R_flange_sensor": self.parameters.R_flange_sensor.tolist(),
            "rotation_difference_rad": self.rotation_difference_rad,
            "residual": {"force_rms_N": self.force_rms_N, "torque_rms_Nm": self.torque_rms_Nm},
            "cross_validated": {"force_rms_N": force, "torque_rms_Nm": torque},
            **test,
        }


def compare(  # noqa: PLR0913 - one argument for each known quantity
    dataset: CalibrationDataset,
    *,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup = NOTHING,
    default: CalibrationResult | None = None,
    as_published: bool = False,
    test: CalibrationDataset | None = None,
    truth: Parameters | None = None,
) -> list[MethodResult]:
    """Return the results of all methods; for a method that fails on these data, the result holds the reason.

    Parameters
    ----------
    drift, known, g_m_s2, setup
        As for `solve`. Published methods that need gravity take it from `known`, or assume a level base.
    default : CalibrationResult, optional
        Result of the default method with the same arguments, if it was computed before.
    as_published : bool
        Run Carlson's methods as printed, without biases.
    test : CalibrationDataset, optional
        Poses of the free tool that are not used for fitting, for the columns of Yu's Table III.
    truth : Parameters, optional
        Reference for mass and centre of mass in these columns; by default the result of the default method.

    Raises
    ------
    NotObservable
        The default method cannot use these data.

    Examples
    --------
    >>> import ftdrive
    >>> compared = ftdrive.compare(ftdrive.read_dataset("poses.csv"))
    >>> compared[0].method, round(compared[0].mass_kg, 3)
    ('ml', 1.235)
    """
    if default is None:
        default = solve(dataset, "ml", drift=drift, known=known, g_m_s2=g_m_s2, setup=setup)
    compared = []
    for method in get_args(Method):
        try:
            if method == "ml":
                estimates = _estimates_of(default)
            elif method in PUBLISHED:
                estimates = _cross_validate(
                    dataset, method, known, g_m_s2, setup, as_published=as_published and method in CARLSON
                )
            else:
                estimates = _estimates_of(solve(dataset, method, drift=drift, known=known, g_m_s2=g_m_s2, setup=setup))
        except (NotObservable, BadDataset) as error:
            compared.append(MethodResult(method, str(error)))
            continue
        parameters, cv_force, cv_torque = estimates
        row = _describe(method, parameters, dataset, default.parameters, g_m_s2)
        row = replace(row, cv_force_rms_N=cv_force, cv_torque_rms_Nm=cv_torque)
        compared.append(row if test is None else _add_test(row, parameters, test, truth or default.parameters))
    return compared


_ALL = "A+B+C+E+F+G"  # Yu's sets except the test set D; E contains H
# Cases of Yu's Table III: number, method, sets for the estimate, set for the test (`ftcalib.poses.selection`).
CASES: tuple[tuple[int, Method, str, str], ...] = (
    *((1, "srom", "A", "D"), (2, "lrom", "A", "D"), (3, "lrom", "B", "D"), (4, "lrom", "B+C", "D")),
    *((5, "lrom", "H", "D"), (6, "lrom", "E", "D"), (7, "lrom", "E+F", "D"), (8, "mixed", "A+E", "D")),
    *((9, "lrom", "A+E", "D"), (10, "lrom", _ALL, "D"), (11, "lrom", "E", "G")),
)


def table_iii(
    dataset: CalibrationDataset,
    numbers: Sequence[int],
    truth: Parameters | None = None,
    *,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
) -> list[tuple[int, str, str, MethodResult]]:
    """Repeat the eleven cases of Yu's Table III.

    Parameters
    ----------
    dataset : CalibrationDataset
        Poses of the sets A to G in any order, from one session.
    numbers : sequence of int
        Number of each pose, as returned by `ftcalib.poses.selection.set_numbers`.
    truth : Parameters, optional
        Reference for mass, centre of mass and mounting; default: the maximum likelihood estimate from all poses but D.
    g_m_s2 : float
        Acceleration of gravity at the cell.

    Returns
    -------
    list of (int, str, str, MethodResult)
        Number of the case, sets of the estimate, set of the test, and the result with the columns of the table.

    Raises
    ------
    NotObservable
        Poses of a set are missing.
    """
    row_of = {int(number): row for row, number in enumerate(numbers)}
    counts = {name: sum(number not in row_of for number in set_numbers(name).tolist()) for name in EVERY_SET.split("+")}
    if missing := [f"{count} of {name}" for name, count in counts.items() if count]:
        raise NotObservable(f"poses of Table III are missing ({', '.join(missing)}): record all poses of {EVERY_SET}")

    def part(sets: str) -> CalibrationDataset:
        rows = [row_of[number] for name in sets.split("+") for number in set_numbers(name).tolist()]
        return CalibrationDataset.of(dataset.R_base_flange[rows], dataset.wrench[rows], t_s=dataset.t_s[rows])

    truth = truth or solve(part(_ALL)).parameters
    rows = []
    for number, method, data, test in CASES:
        fitted = part(data)
        parameters = published(method, fitted.R_base_flange, gravity_direction_base=-UP_IN_BASE)(fitted.wrench)
        row = _describe(method, parameters, fitted, truth, g_m_s2)
        rows.append((number, data, test, _add_test(row, parameters, part(test), truth)))
    return rows


def _describe(
    method: Method, parameters: Parameters, dataset: CalibrationDataset, reference: Parameters, g_m_s2: float
) -> MethodResult:
    mass_kg = parameters.weight_N / g_m_s2
    angle_rad = float(angle_between(parameters.R_flange_sensor, reference.R_flange_sensor))
    residuals = dataset.wrench - predict(parameters, dataset.R_base_flange)
    return MethodResult(method, None, parameters, mass_kg, angle_rad, *_rms_of_force_and_torque(residuals))


def _add_test(
    compared: MethodResult, parameters: Parameters, test: CalibrationDataset, truth: Parameters
) -> MethodResult:
    """Return the result of a method with the columns of Yu's Table III added."""
    force, torque = np.split(test.wrench - predict(parameters, test.R_base_flange), 2, axis=1)
    largest = [np.abs(np.column_stack([part, np.linalg.norm(part, axis=1)])).max(axis=0) for part in (force, torque)]
    weight_N, true_N = parameters.weight_N, truth.weight_N
    off_m = float(np.linalg.norm(parameters.p_sensor_com_m - truth.p_sensor_com_m))
    return replace(
        compared,
        largest_errors=np.concatenate(largest),
        mass_error=_share(abs(weight_N - true_N), true_N),
        centre_error=_share(off_m, float(np.linalg.norm(truth.p_sensor_com_m))),
    )


def _share(error: float, reference: float) -> float:
    return error / reference if reference else np.nan


def _or_none(value: float) -> float | None:
    return None if np.isnan(value) else value


def _estimates_of(result: CalibrationResult) -> tuple[Parameters, float, float]:
    return result.parameters, result.quality["loo_force_rms_N"], result.quality["loo_torque_rms_Nm"]


def _cross_validate(
    dataset: CalibrationDataset, method: Method, known: Known | None, g_m_s2: float, setup: Setup, *, as_published: bool
) -> tuple[Parameters, float, float]:
    R_base_flange, wrench = dataset.R_base_flange, dataset.wrench
    prepared = partial(estimator_of, method, known=known, g_m_s2=g_m_s2, setup=setup, as_published=as_published)
    parameters = prepared(R_base_flange)(wrench)
    left_out, fold_of = np.empty_like(wrench), np.arange(len(wrench)) % _MOST_FOLDS
    try:
        for fold in range(min(len(wrench), _MOST_FOLDS)):
            out = fold_of == fold
            without = prepared(R_base_flange[~out])(wrench[~out])
            left_out[out] = wrench[out] - predict(without, R_base_flange[out])
    except NotObservable:
        return parameters, np.nan, np.nan
    return parameters, *_rms_of_force_and_torque(left_out)


def _rms_of_force_and_torque(residuals: Array) -> tuple[float, float]:
    force, torque = (np.sqrt(np.mean(np.sum(part**2, axis=1))) for part in (residuals[:, :3], residuals[:, 3:]))
    return float(force), float(torque)
