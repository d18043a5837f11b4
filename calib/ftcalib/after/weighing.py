"""Weighing of a part held by the calibrated tool: mass and centre of mass from readings at rest.

With u the force of 1 kg in the sensor frame, a held part of mass m and centre of mass p adds

    force_N = m u        torque_Nm = (m p) x u        u = R_base_sensor.T @ g_base

which is linear in m and m p. Both are estimated by generalised least squares. The covariance contains the noise of the
readings, the errors of the calibration, which are common to all readings and grow with the held weight, and the drift
of the bias. One pose determines m p only perpendicular to gravity. A prior therefore places the part near a point of
the gripper, with a standard deviation `REACH_M`, and determines the centre of mass along gravity.

A weight exerts no force perpendicular to gravity and no torque about the vertical. Readings of either are a `Fault`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf

from ftcalib.after.state import USUAL_DRIFT_N, USUAL_DRIFT_NM, Update
from ftcalib.compensation import Compensator
from ftcalib.data.dataset import require_finite
from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import BadDataset
from ftcalib.model import Array, Parameters, jacobian, read_only, skew
from ftcalib.result import CalibrationResult
from ftcalib.rounding import to_place_of, with_sigma
from ftcalib.sensor_matrix import (
    LOAD,
    Calibrated,
    ContactResponse,
    ranges,
    response_columns,
    sensor_error_columns,
    shown_gain,
)

# Standard deviation per axis of the centre of mass of a part from the gripping point.
REACH_M = 0.1
# False-alarm probability of the test for a fault.
FALSE_ALARMS = 1e-5
# Number of sigmas above which a weighed mass counts as different from zero.
LEAST_SIGMAS = 4.0
# Usual drift of a bias, one standard deviation, N/h and N·m/h: warm sensors drift less.
_DRIFT_PER_H = np.repeat([5.0, 0.15], 3)
# Usual change of a bias within days, one standard deviation, N and N·m.
_USUAL_DRIFT = np.repeat([USUAL_DRIFT_N, USUAL_DRIFT_NM], 3)

# Why force and torque are not those of one weight: "contact", a force perpendicular to gravity; "cable", a torque that
# no weight near the gripper exerts; "changed", different weights in different poses; "lifted", less than the tool.
Fault = Literal["contact", "cable", "changed", "lifted"]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Weight(Displayed):
    """Weight of a part held by the tool. Arrays are read-only, in sensor axes, from the sensor origin.

    Examples
    --------
    Weigh the part in an emulated gripper:

    >>> import ftdrive
    >>> with ftdrive.open_stream(simulate=True) as stream:
    ...     weight = ftdrive.weigh(stream)
    >>> weight.is_something, weight.fault is None
    (False, True)
    """

    mass_kg: float
    mass_sigma_kg: float
    """Standard deviation from noise, calibration and drift, without the scale of the sensor (`scale_sigma`), kg."""
    least_kg: float
    """Smallest mass that this weighing could have distinguished from zero, kg."""
    p_sensor_com_m: Array
    """(3,) centre of mass in the sensor frame, m; meaningless unless `is_something` is true."""
    com_covariance: Array
    """(3, 3) covariance of the centre of mass, m²."""
    line: Array | None
    """(3,) unit vector along which only the prior determines the centre of mass; None with enough poses."""
    fault: Fault | None
    """Why the readings are not those of one weight; None if they are."""
    chi2: float
    dof: int
    poses: int
    scale_sigma: float = 0.0
    """Relative standard deviation of the sensor's scale, common to all weights and the tool; 0 if not determined."""
    in_motion: bool = False
    """Whether the part was weighed while the arm moved; `poses` is then 0."""
    moment: tuple[Array, Array] = field(default=(np.zeros(4), np.zeros((4, 4))), repr=False)
    """Mass and mass times centre of mass (4,), and their covariance."""

    def __post_init__(self) -> None:
        for name in ("p_sensor_com_m", "com_covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def _summary(self) -> Summary:
        mass = with_sigma(self.mass_kg, self.mass_sigma_kg)
        rows = [Row("smallest detectable mass", [to_place_of(self.least_kg, self.mass_sigma_kg)], "kg")]
        if self.is_something:
            rows.append(Row("centre of mass x, y, z", self.com_in_words, "mm in sensor axes"))
        return Summary(
            f"Weight {mass} kg (1 sigma)", rows, [] if self.fault is None else [f"not one weight: {self.fault}"]
        )

    @property
    def is_something(self) -> bool:
        """Whether a part was held: the measured mass differs significantly from zero."""
        return self.mass_kg > self.least_kg

    @property
    def com_sigma_m(self) -> Array:
        """(3,) standard deviations of the centre of mass along the sensor axes, m."""
        return np.asarray(np.sqrt(np.diag(self.com_covariance)))

    @property
    def com_in_words(self) -> list[str]:
        """Centre of mass x, y and z with standard deviations as text, mm in sensor axes."""
        return [with_sigma(1e3 * x, 1e3 * s) for x, s in zip(self.p_sensor_com_m, self.com_sigma_m, strict=True)]


def drift_since(seconds: float, per_h: Array = _DRIFT_PER_H) -> Array:
    """Return the sigma (6,) of a bias change over this time since zeroing, N and N·m; infinite time: never zeroed."""
    return np.asarray(np.minimum(per_h * max(seconds, 0.0) / 3600, _USUAL_DRIFT))


def weigh_load(  # noqa: PLR0913 - readings, noise and prior knowledge
    reference: Calibrated,
    R_base_flange: Array,
    wrench: Array,
    noise: Array,
    *,
    drift: Array,
    g_m_s2: float,
    p_sensor_near_m: Array,
    orientation_sigma_rad: float = 0.0,
    contact: ContactResponse | None = None,
) -> Weight:
    """Return the weight of a held part from readings at rest.

    Parameters
    ----------
    reference : CalibrationResult or Update
        Calibration of the empty gripper, or its tare.
    R_base_flange : array, shape (n, 3, 3)
        One pose is enough for the mass.
    wrench : array, shape (n, 6)
        Mean readings as measured, N and N·m, in the sensor frame.
    noise : array, shape (n, 6, 6)
        Covariances of the mean readings.
    drift : array, shape (6,)
        One standard deviation of the change of the bias since the reference, see `drift_since`.
    g_m_s2 : float
        Gravity of the calibration.
    p_sensor_near_m : array, shape (3,)
        Gripping point in the sensor frame.
    orientation_sigma_rad : float
        Standard deviation per axis of each reported orientation.
    contact : ContactResponse, optional
        Response of the sensor determined with known loads. It decodes mass and centre of mass, but not `moment`.

    Raises
    ------
    BadDataset
        Inconsistent shapes, or a tool without weight, for which the direction of gravity is unknown.
    """
    n = len(wrench)
    R_base_flange = require_finite("R_base_flange", R_base_flange, (n, 3, 3))
    wrench, noise = require_finite("wrench", wrench, (n, 6)), require_finite("noise", noise, (n, 6, 6))
    tool, response = reference.parameters, reference.shown_response
    known, weight_N = Calibrated(tool, reference.covariance, response), tool.weight_N
    if not weight_N > 0:
        raise BadDataset("the calibrated tool has no weight, so the direction of gravity is unknown: calibrate again.")
    left = np.asarray(Compensator(tool, response=response).batch(wrench, R_base_flange), dtype=np.float64)
    u = tool.gravity_force_base_N * (g_m_s2 / weight_N) @ (R_base_flange @ tool.R_flange_sensor)  # (n, 3)
    A = _unit_readings(u)
    gain, cross_talk_m = np.split(shown_gain(response), 2)
    A[:, :3, 0] += u @ gain.T
    A[:, 3:, 0] += u @ cross_talk_m.T

    def covariance_of(x: Array, *, sensor: bool = True) -> Array:
        return _covariance(known, x * g_m_s2, R_base_flange, noise, drift, orientation_sigma_rad, sensor=sensor)

    fit = _fit_load(left, A, covariance_of, p_sensor_near_m)
    x, S, dof = fit.x, fit.S, 6 * n - 1
    # A gain that depends on the load must not be reported as a contact.
    loads = LOAD * response_columns(_part(tool, x * g_m_s2), R_base_flange).reshape(6 * n, -1)
    S = S + loads @ loads.T
    chi2 = float(fit.misfit @ np.linalg.solve(S, fit.misfit) + np.sum((fit.near @ x) ** 2))
    fault = _fault(left, A, S, float(chi2_sf(dof, chi2)), n)
    if fault is None and x[0] < -LEAST_SIGMAS * fit.sigma_kg:
        fault = "lifted"
    true, of_sensor = fit, np.zeros((4, 4))
    if contact is not None:
        D = np.kron(np.eye(n), contact.decode(np.eye(6)).T)
        unit = _unit_readings(u)
        true = _fit_load(
            contact.decode(left), unit, lambda x: D @ covariance_of(x, sensor=False) @ D.T, p_sensor_near_m
        )
        by_reading = true.covariance @ true.H.T @ np.linalg.inv(true.S)
        of_sensor = _by_sensor(by_reading, float(true.x[0]), contact, unit @ true.x)
    com_m, sigma_kg = true.x[1:] / (true.x[0] or 1.0), true.sigma_kg
    T = np.column_stack([-com_m, np.eye(3)]) / max(abs(true.x[0]), 1e-9)
    com_covariance = T @ (true.covariance + of_sensor) @ T.T
    variances, axes = np.linalg.eigh(com_covariance)
    return Weight(
        mass_kg=float(true.x[0]),
        mass_sigma_kg=sigma_kg,
        least_kg=LEAST_SIGMAS * sigma_kg,
        p_sensor_com_m=com_m,
        com_covariance=com_covariance,
        line=read_only(axes[:, 2]) if variances[2] > (REACH_M / 2) ** 2 else None,
        fault=fault,
        chi2=chi2,
        dof=dof,
        poses=n,
        scale_sigma=float(np.sqrt(of_sensor[0, 0]) / max(abs(true.x[0]), 1e-9)),
        moment=(x, fit.covariance),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _LoadFit:
    """Least-squares estimate of mass, and mass times centre of mass, of a held part."""

    x: Array
    """(4,) mass and mass times centre of mass, kg and kg·m."""
    covariance: Array
    S: Array
    """(6n, 6n) covariance of the readings of all n poses."""
    H: Array
    """(6n, 4) derivative of the readings with respect to the estimates `x`."""
    near: Array
    """(3, 4) rows of the prior of the centre of mass, divided by its standard deviation."""
    misfit: Array
    """(6n,) residuals of the readings after the fit."""

    @property
    def sigma_kg(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))


def _fit_load(left: Array, A: Array, covariance_of: Callable[[Array], Array], p_sensor_near_m: Array) -> _LoadFit:
    """Return the generalised least-squares estimate; the covariance of the readings depends on the estimate."""
    n, x = len(left), np.zeros(4)
    for step in range(4):
        S = covariance_of(x)
        if step == 0:  # a first estimate of the mass from the forces alone
            rows = np.arange(6 * n).reshape(n, 6)[:, :3].ravel()
            a, W = A[:, :3, 0].ravel(), np.linalg.inv(S[np.ix_(rows, rows)])
            x[0] = a @ W @ left[:, :3].ravel() / (a @ W @ a)
            x[1:], sigma_kg = x[0] * p_sensor_near_m, float(1 / np.sqrt(a @ W @ a))
            continue
        W = np.linalg.inv(S)
        # The prior sigma of the moment m p is the reach times the mass, or times its sigma if that is larger.
        near = np.column_stack([-p_sensor_near_m, np.eye(3)]) / (REACH_M * max(abs(x[0]), sigma_kg))
        H = A.reshape(6 * n, 4)
        covariance = np.linalg.inv(H.T @ W @ H + near.T @ near)
        x = covariance @ H.T @ W @ left.ravel()
    return _LoadFit(x, covariance, S, H, near, left.ravel() - H @ x)


def _unit_readings(u: Array) -> Array:
    """Return the wrenches (n, 6, 4) of unit mass and unit moments for the wrench u (n, 3) of 1 kg."""
    A = np.zeros((len(u), 6, 4))
    A[:, :3, 0], A[:, 3:, 1:] = u, -skew(u)
    return A


def _by_sensor(by_reading: Array, mass_kg: float, contact: ContactResponse, held: Array) -> Array:
    """Return the covariance (4, 4) of an estimate due to errors of the sensor, for held wrenches (n, 6).

    `by_reading` (4, 6n) is the derivative of the estimate with respect to the readings.
    """
    by_entry = by_reading @ contact.error_columns(held).reshape(held.size, -1)
    # In the worst case nonlinear errors are equal in all poses.
    F = ranges(contact.sensor.lever_m)
    share = contact.sensor.floor**2 * np.sum((held / F) ** 2) / max(float(np.sum(held[:, :3] ** 2)), 1e-12)
    return np.asarray(by_entry @ contact.error_covariance @ by_entry.T + share * mass_kg**2 * np.diag(F[2:] ** 2))


def moment_as_read(moment: tuple[Array, Array], contact: ContactResponse) -> tuple[tuple[Array, Array], Array]:
    """Return mass and moment of a part as the sensor reads them over all directions, with covariances.

    `moment` contains the true mass (kg) and mass times centre of mass (kg·m) of the part (4,), and their covariance
    (4, 4). The results are the same values as read, and the covariance (4, 4) due to errors of the sensor.
    """
    (x, covariance), A = moment, _unit_readings(np.eye(3))
    by_reading = np.asarray(np.linalg.pinv(A.reshape(18, 4)), dtype=np.float64)
    T = by_reading @ np.linalg.solve(contact.decode(np.eye(6)).T, A).reshape(18, 4)
    return (T @ x, T @ covariance @ T.T), _by_sensor(by_reading, float(x[0]), contact, A @ x)


def true_tool(calibration: CalibrationResult) -> tuple[float, Array]:
    """Return mass (kg) and centre of mass (3,) of the tool, corrected for sensor errors known from loads."""
    if (contact := calibration.known_contact) is None:
        return calibration.mass_kg, calibration.p_sensor_com_m
    weight_N, p_sensor_com_m = contact.true_load(calibration.shown_response)
    return weight_N / calibration.g_m_s2, p_sensor_com_m


def _fault(left: Array, A: Array, S: Array, p_value: float, n: int) -> Fault | None:
    """Return why the readings are not those of one weight; each pose is tested alone, then all poses together."""
    parts = [S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)]
    alone = [_misfit(left[k, :3], A[k, :3, :1], part[:3, :3]) for k, part in enumerate(parts)]
    if min(chi2_sf(2, chi2) for chi2 in alone) < FALSE_ALARMS:
        return "contact"
    if p_value >= FALSE_ALARMS:
        return None
    if n == 1 or any(chi2_sf(3, _misfit(left[k], A[k], part)) < FALSE_ALARMS for k, part in enumerate(parts)):
        return "cable"
    return "changed"


def _misfit(y: Array, A: Array, S: Array) -> float:
    """Return chi2 of readings after fitting columns, which may be linearly dependent."""
    L = np.linalg.cholesky(S)
    y, A = np.linalg.solve(L, y), np.linalg.solve(L, A)
    scale = np.linalg.norm(A, axis=0)
    rest = y - A @ (np.linalg.pinv(A / scale, rcond=1e-6) @ y / scale)
    return float(rest @ rest)


def _covariance(
    known: Calibrated,
    x_N: Array,
    R_base_flange: Array,
    noise: Array,
    drift: Array,
    orientation_sigma_rad: float,
    *,
    sensor: bool,
) -> Array:
    """Return the covariance (6n, 6n) of readings minus prediction: noise, calibration and drift, for a held part.

    `x_N` is its weight and moment. If `sensor` is false, errors of the sensor for the part are left out.
    """
    tool, response = known.parameters, known.response
    n, held = len(noise), _part(tool, x_N)
    J, part = known.jacobian(R_base_flange), jacobian(held, R_base_flange)
    across = _projector_across(tool.gravity_force_base_N) * (x_N[0] / tool.weight_N)
    J[..., :3] += part[..., :3]
    J[..., 3:6] += part[..., 3:6] @ across
    turn = J[..., :3]
    single = noise + orientation_sigma_rad**2 * (turn @ np.swapaxes(turn, -1, -2))
    C = np.array(known.joint_covariance)
    C[range(6, 9), range(6, 9)] += drift[:3] ** 2
    C[range(12, 15), range(12, 15)] += drift[3:] ** 2
    of_sensor = np.zeros((6 * n, 6 * n))
    if response is not None and sensor:
        J[..., 15:] += response_columns(held, R_base_flange)
        errors = sensor_error_columns(tool, response, held, R_base_flange).reshape(6 * n, -1)
        of_sensor = errors @ errors.T
    K = J.reshape(6 * n, -1)
    return np.asarray(block_diag(*single) + K @ C @ K.T + of_sensor)


def _part(tool: Parameters, x_N: Array) -> Parameters:
    """Return parameters without bias for the weight (N) and moment (N·m) of a part."""
    com_m = x_N[1:] / x_N[0] if x_N[0] else np.zeros(3)
    return Parameters(tool.R_flange_sensor, x_N[0] * tool.down, np.zeros(3), com_m, np.zeros(3))


def _projector_across(v: Array) -> Array:
    return np.asarray(np.eye(3) - np.outer(v, v) / (v @ v))


def holding(empty: Calibrated, weight: Weight, g_m_s2: float) -> Update:
    """Return the calibrated tool and a weighed part as one load, which can be compensated and tared.

    The error of the weighing is taken as independent of that of the calibration.
    """
    tool = empty.parameters
    x, cov = weight.moment
    x_N, cov_N = x * g_m_s2, cov * g_m_s2**2
    W_N = tool.weight_N
    along, total_N = tool.down, W_N + float(x_N[0])
    com_m = (W_N * tool.p_sensor_com_m + x_N[1:]) / total_N
    C = empty.joint_covariance
    T, B = np.eye(len(C)), np.zeros((len(C), 4))
    T[3:6, 3:6] += x_N[0] / W_N * _projector_across(along)
    T[9:12, 9:12] *= W_N / total_N
    T[9:12, 3:6] = np.outer(tool.p_sensor_com_m - com_m, along) / total_N
    B[3:6, 0], B[9:12, 0], B[9:12, 1:] = along, -com_m / total_N, np.eye(3) / total_N
    covariance = T @ C @ T.T + B @ cov_N @ B.T
    joined = Parameters(tool.R_flange_sensor, total_N * along, tool.force_bias_N, com_m, tool.torque_bias_Nm)
    return Update(joined, covariance[:15, :15], 0.0, 0, response=empty.with_joint(covariance))
