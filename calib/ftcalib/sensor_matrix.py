"""Errors of a sensor's matrix: which of them a tool shows, and how they affect the reading of a contact.

    reading = (I + E) wrench + bias        in the sensor frame, about its origin

In all orientations, a tool shows the effect of E on forces at its centre of mass: a gain of the force, and cross-talk
from force to torque,

    force_N = (1 + force_gain) u + force_bias_N        torque_Nm = p x u + cross_talk_m u + torque_bias_Nm

with u the weight in the sensor frame. Both matrices are symmetric, and the gain has zero trace: together with mounting,
weight and centre of mass they describe every linear response to one payload. A gain common to all axes cannot be
separated from the weight. Gain and cross-talk are eleven of the 36 numbers (`Response`). Three others are a rotation d
of the sensor, and three a shift of the centre of mass; both are part of the tool's estimates. In the axes of the
calibration, the reading of a contact is M times the contact, with

    M = I + E - blk([d]x, [d]x)        d: half the antisymmetric part of E_FF + E_FT [p]x, p the centre of mass

so the error of the decoded contact is linear in the error of E. Entries of E that no load has shown keep their prior. A
weighed tool determines one more number: the gain common to all axes at its centre of mass.

The errors of E and of the mounting are correlated. The mounting of a separate calibration has its own noise and the d
of the current E. If its poses are among those of the runs with loads, the joint fit contains the correlation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
from scipy.linalg import block_diag

from ftcalib.display import Displayed
from ftcalib.errors import BadCalibration
from ftcalib.files import JSON, check_format, read_object, write_object
from ftcalib.known import COMMON_SHARE, CROSS_TALK_SHARE, RANGE_LEVER_M, USUAL_GAIN, Setup
from ftcalib.model import (
    Array,
    Parameters,
    SPECIAL_R_flange_base,
    gravity_wrench,
    jacobian,
    keep_finite,
    read_only,
    skew,
)

FORMAT = "ftdrive.sensor/1"

# Nonlinear errors, relative to the load: the certificates of six sensors state 0.08 to 0.28 % of range.
FLOOR: Final = 0.0025
# Degrees of freedom of the prior on the common variance of a sensor's gain and cross-talk.
_USUAL_COUNTS = 2.0

# Limits for values in a sensor file: entries of E and their sigma relative to the ranges, lever (m), floor.
_LARGEST_ERROR, _LARGEST_SIGMA, _LEVERS_M, _LARGEST_FLOOR = 0.5, 0.5, (1e-3, 10.0), 0.5

_DIAGONAL = np.arange(0, 36, 7)

Source = Literal["assumed", "data sheet", "loads"]


def _symmetric(i: int, j: int) -> Array:
    matrix = np.zeros((3, 3))
    matrix[i, j] = matrix[j, i] = 1.0
    return matrix


_MIXED = [_symmetric(i, j) for i, j in ((0, 1), (0, 2), (1, 2))]
# (5, 3, 3) basis of the gain: independent coefficients of equal variance give independent entries of equal variance.
GAIN = np.array([np.diag([1.0, -1, 0]) / np.sqrt(2), np.diag([1.0, 1, -2]) / np.sqrt(6), *_MIXED])
# (6, 3, 3) basis of the cross-talk, m; its coefficients are relative to a force at the lever `RANGE_LEVER_M`.
CROSS_TALK_M = RANGE_LEVER_M * np.array([*(_symmetric(i, i) for i in range(3)), *_MIXED])
SIZE = len(GAIN) + len(CROSS_TALK_M)
# Prior standard deviation of each coefficient of gain and cross-talk, for a mounted or aged sensor.
USUAL = USUAL_GAIN * np.array([1.0, 1.0, *[CROSS_TALK_SHARE] * 9])
# Sum of the squared entries of each basis matrix of `GAIN` and `CROSS_TALK_M`, the latter relative to the lever.
SQUARES = np.array([1.0, 1, 2, 2, 2, 1, 1, 1, 2, 2, 2])

# Weights with which the squared coefficients of the gain add up to the variance of one of nine independent entries.
_WEIGHTS = np.array([1, 1, 2, 2, 2]) / 5
# Smallest sigma of the gain common to all axes, which no orientation shows.
LEAST_COMMON_GAIN = 0.002


def response_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Return the derivative (..., 6, 11) of the wrench with respect to the coefficients of gain and cross-talk."""
    u = gravity_wrench(parameters, R_base_flange)[..., :3]
    T = np.zeros((*u.shape[:-1], 6, SIZE))
    T[..., :3, :5] = np.einsum("kij,...j->...ik", GAIN, u)
    T[..., 3:, 5:] = np.einsum("kij,...j->...ik", CROSS_TALK_M, u)
    return T


def sensor_columns(parameters: Parameters, R_base_flange: Array) -> dict[str, Array]:
    """Return the derivatives of the wrench for the coefficients "gain" (..., 6, 5) and "cross_talk" (..., 6, 6)."""
    columns = response_columns(parameters, R_base_flange)
    return {"gain": columns[..., : len(GAIN)], "cross_talk": columns[..., len(GAIN) :]}


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Estimated gain and cross-talk of a sensor; components that were not found are zero. Arrays are read-only."""

    coefficients: Array
    """(11,) coefficients of the bases `GAIN` and `CROSS_TALK_M`."""
    covariance: Array
    """(26, 26) covariance of the 15 error coordinates of the parameters and of the coefficients."""

    def __post_init__(self) -> None:
        keep_finite(self, "the response's ", coefficients=(SIZE,), covariance=(15 + SIZE, 15 + SIZE))

    @property
    def force_gain(self) -> Array:
        """(3, 3) symmetric gain error with trace zero: (measured - true force) / true force."""
        return np.asarray(np.tensordot(self.coefficients[:5], GAIN, 1))

    @property
    def cross_talk_m(self) -> Array:
        """(3, 3) symmetric cross-talk: measured torque per force, N·m/N."""
        return np.asarray(np.tensordot(self.coefficients[5:], CROSS_TALK_M, 1))

    @property
    def sigma(self) -> dict[str, Array]:
        """(3, 3) standard deviations of the entries of `force_gain` and `cross_talk_m`, by name."""
        C = self.covariance[15:, 15:]
        return {
            name: np.sqrt(np.maximum(np.einsum("kij,kl,lij->ij", basis, C[own, own], basis), 0.0))
            for name, basis, own in (("force_gain", GAIN, slice(5)), ("cross_talk_m", CROSS_TALK_M, slice(5, None)))
        }

    @property
    def gain_sigma(self) -> float:
        """Standard deviation of the entries of the full gain matrix, inferred from its symmetric traceless part."""
        return float(np.sqrt(_WEIGHTS @ (self.coefficients**2 + np.diag(self.covariance)[15:])[:5]))

    def wrench(self, parameters: Parameters, R_base_flange: Array) -> Array:
        """Return the contribution (..., 6) of gain and cross-talk to the wrench of the weight."""
        return np.asarray(response_columns(parameters, R_base_flange) @ self.coefficients)

    def to_dict(self) -> dict[str, JSON]:
        """Return the object in a calibration file; only `coefficients` and `covariance` are read back."""
        return {
            "force_gain": self.force_gain.tolist(),
            "cross_talk_m": self.cross_talk_m.tolist(),
            "sigma": {name: value.tolist() for name, value in self.sigma.items()},
            "coefficients": self.coefficients.tolist(),
            "covariance": self.covariance.tolist(),
        }


def shown_gain(response: Response | None) -> Array:
    """Return the errors (6, 3) of force and torque per force at the centre of mass; zero without a response."""
    return np.zeros((6, 3)) if response is None else np.concatenate([response.force_gain, response.cross_talk_m])


class Calibrated:
    """Estimates of tool and sensor with covariance: a fit, a calibration, or an update of a calibration.

    The error coordinates are the 15 of `PARAMETER_NAMES` and, if a response was found, its 11 coefficients.
    """

    parameters: Parameters
    covariance: Array
    """(15, 15) covariance of the parameters alone."""
    response: Response | None
    """Gain and cross-talk of the sensor; None if not found."""

    def __init__(self, parameters: Parameters, covariance: Array, response: Response | None = None) -> None:
        self.parameters, self.covariance, self.response = parameters, covariance, response

    @property
    def joint_covariance(self) -> Array:
        """(15, 15) covariance of the parameters, or (26, 26) with gain and cross-talk if they were found."""
        return self.covariance if self.response is None else self.response.covariance

    @property
    def shown_response(self) -> Response | None:
        """Gain and cross-talk as found; in a calibration without them zero, with their posterior covariance."""
        return self.response

    def with_joint(self, covariance: Array) -> Response | None:
        """Return gain and cross-talk, if there are any, with another joint covariance."""
        return None if self.response is None else Response(self.response.coefficients, covariance)

    def jacobian(self, R_base_flange: Array, parameters: Parameters | None = None) -> Array:
        """Return the derivative (..., 6, 15 or 26) of the wrench with respect to the axes of `joint_covariance`."""
        p = self.parameters if parameters is None else parameters
        J = jacobian(p, R_base_flange)
        return J if self.response is None else np.concatenate([J, response_columns(p, R_base_flange)], axis=-1)

    def wrench_covariance(self, R_base_flange: Array) -> Array:
        """Return the covariance of the predicted wrench due to the uncertainty of the estimates.

        Parameters
        ----------
        R_base_flange : array, shape (..., 3, 3)

        Returns
        -------
        array, shape (..., 6, 6)
        """
        J = self.jacobian(np.asarray(R_base_flange, dtype=np.float64))
        return np.asarray(J @ self.joint_covariance @ np.swapaxes(J, -1, -2))

    def predicted_error(self) -> tuple[float, float]:
        """Return the rms error of the predicted wrench over all orientations, N and N·m, from noise alone.

        The mean square error is quadratic in the orientation matrix, so the rotations of the cube have the mean of all.
        """
        over = self.wrench_covariance(np.swapaxes(SPECIAL_R_flange_base, 1, 2))
        variance = np.diagonal(over, axis1=1, axis2=2).mean(axis=0)
        return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:].sum()))


# Standard deviation of the part of the gain that depends on the load.
LOAD: Final = 0.005


def sensor_error_columns(tool: Parameters, known: Response, p: Parameters, R_base_flange: Array) -> Array:
    """Return the effects of sensor errors on the reading of a load that the calibration of the tool does not show.

    The response to the tool applies to any load at its centre of mass. A load at another point has an additional
    torque, with unknown errors as large as those that the tool shows.

    Parameters
    ----------
    tool : Parameters
        Parameters of the calibrated tool.
    known : Response
        Gain and cross-talk of the tool, as found, or zero with their posterior covariance.
    p : Parameters
        Parameters of the load.
    R_base_flange : array, shape (n, 3, 3)

    Returns
    -------
    array, shape (n, 6, 38)
        One column per independent error, for one standard deviation, without the errors of `known`.
    """
    square = known.coefficients**2 + np.diag(known.covariance)[15:]
    in_force, in_torque = (float(np.sqrt(np.mean(part))) for part in np.split(square / USUAL**2, [5]))
    u, lever = gravity_wrench(p, R_base_flange)[:, :3], skew(p.p_sensor_com_m - tool.p_sensor_com_m)
    entries = USUAL_GAIN * np.where(np.eye(3) > 0, 1.0, CROSS_TALK_SHARE)
    columns = np.zeros((len(u), 6, 27))
    columns[:, :3, :9] = _products(np.eye(3), u @ lever.T, np.full((3, 3), in_force * entries[0, 1] / RANGE_LEVER_M))
    columns[:, 3:, 9:18] = _products(np.eye(3), u @ lever.T, in_torque * entries)
    columns[:, 3:, 18:] = _products(lever, u, in_force * entries)
    # Of the gain, only the part that depends on the load differs between tool and load.
    other = min(abs(p.weight_N / tool.weight_N - 1), 1.0) if tool.weight_N else 1.0
    loads = response_columns(p, R_base_flange) * np.minimum(np.sqrt(square), LOAD) * other
    return np.concatenate([columns, loads], axis=2)


def _products(A: Array, v: Array, sigma: Array) -> Array:
    """Return the derivative (n, 3, 9) of A E v with respect to E, times the sigmas (3, 3), for vectors v (n, 3)."""
    return np.asarray(np.einsum("ri,nj,ij->nrij", A, v, sigma).reshape(len(v), 3, 9))


_ENTRIES = np.eye(36).reshape(36, 6, 6)
"""(36, 6, 6) derivative of the error matrix E with respect to its entries, row by row."""


def ranges(lever_m: float) -> Array:
    """Return the measuring ranges (6,) relative to the force range; `lever_m` is torque range over force range."""
    return np.repeat([1.0, lever_m], 3)


def own_variances(gain_sigma: float, lever_m: float = RANGE_LEVER_M) -> Array:
    """Return the variances (36,) of the entries of E of a usual sensor, without the gain common to all axes.

    `gain_sigma` is the sigma of the diagonal, with the common part; `lever_m` is torque range over force range.
    """
    F = ranges(lever_m)
    share = np.where(np.eye(6) > 0, np.sqrt(1 - COMMON_SHARE), CROSS_TALK_SHARE)
    return np.asarray((gain_sigma * share * F[:, None] / F).ravel() ** 2)


def _gain_at(E: Array, p: Array) -> tuple[Array, Array]:
    """Return the errors of force and torque (..., 3, 3) that E causes per force at p."""
    P = skew(p)
    return E[..., :3, :3] + E[..., :3, 3:] @ P, E[..., 3:, :3] + E[..., 3:, 3:] @ P


def _vector_of(M: Array) -> Array:
    """Return the vectors (..., 3) of the antisymmetric part of matrices (..., 3, 3)."""
    A = (M - np.swapaxes(M, -1, -2)) / 2
    return np.stack([A[..., 2, 1], A[..., 0, 2], A[..., 1, 0]], axis=-1)


def _mounting_turn(E: Array, p: Array) -> Array:
    """Return the rotation vector (..., 3), sensor axes, by which E changes the estimated mounting of a tool at p."""
    return _vector_of(_gain_at(E, p)[0])


def shown_by(p: Array) -> Array:
    """Return the derivative (11, 36) of gain and cross-talk seen with a tool at p, with respect to the entries of E."""
    force, torque = _gain_at(_ENTRIES, p)
    torque = torque - skew(p) @ skew(_mounting_turn(_ENTRIES, p))
    parts = [
        np.einsum("kij,aij->ka", basis, M) / np.einsum("kij,kij->k", basis, basis)[:, None]
        for basis, M in ((GAIN, force), (CROSS_TALK_M, torque))
    ]
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False, repr=False)
class SensorMatrix(Displayed):
    """Prior knowledge of the errors of a sensor's matrix; arrays are read-only.

    Examples
    --------
    >>> import ftcalib
    >>> sensor = ftcalib.SensorMatrix.usual(0.02)
    >>> sensor.source, sensor.sigma.diagonal().round(3)
    ('assumed', array([0.02, 0.02, 0.02, 0.02, 0.02, 0.02]))
    """

    error: Array
    """(6, 6) error matrix E in the sensor frame, N and N·m: reading = (I + E) wrench + bias."""
    covariance: Array
    """(39, 39) covariance of a rotation of the sensor (3, rad, flange axes) and of the entries of E, row by row."""
    source: Source = "assumed"
    lever_m: float = RANGE_LEVER_M
    """Ratio of torque range to force range, m."""
    floor: float = FLOOR
    """Standard deviation of nonlinear errors, relative to the load; both in units of the measuring ranges."""
    provenance: Mapping[str, JSON] = field(default_factory=dict)
    """Origin of the matrix, such as serial number, sets of loads and date."""

    def __post_init__(self) -> None:
        keep_finite(self, "the sensor's ", error=(6, 6), covariance=(39, 39))
        if self.source not in ("assumed", "data sheet", "loads"):
            raise ValueError(f"the source is {self.source!r}, expected assumed, data sheet or loads")
        if not (0 < self.lever_m < np.inf and 0 <= self.floor < 1):
            raise ValueError(f"lever_m is {self.lever_m} and floor {self.floor}, expected positive numbers")

    @classmethod
    def usual(
        cls, gain_sigma: float = USUAL_GAIN, *, lever_m: float = RANGE_LEVER_M, source: Source = "assumed"
    ) -> Self:
        """Return the prior of a sensor that was not calibrated with known loads.

        Parameters
        ----------
        gain_sigma : float
            Standard deviation of the diagonal entries. Half of the variance is common to all axes, because calibration
            masses, ageing and temperature affect all of them. The others have half this sigma, relative to the ranges.
        source : {"assumed", "data sheet"}
        """
        covariance = np.diag(np.concatenate([np.full(3, np.pi**2), own_variances(gain_sigma, lever_m)]))
        covariance[np.ix_(3 + _DIAGONAL, 3 + _DIAGONAL)] += COMMON_SHARE * gain_sigma**2
        return cls(np.zeros((6, 6)), covariance, source, lever_m)

    @classmethod
    def declared(cls, setup: Setup) -> Self:
        """Return the prior of the sensor declared in the description of a cell."""
        source: Source = "assumed" if setup.sensor_accuracy_percent is None else "data sheet"
        return cls.usual(setup.gain_sigma, lever_m=setup.sensor_lever_m, source=source)

    @property
    def sigma(self) -> Array:
        """(6, 6) standard deviations of the entries of E."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]).reshape(6, 6))

    @cached_property
    def common(self) -> Array:
        """(36, 36) covariance of the entries of E due to the gain common to all axes."""
        shared = np.zeros((36, 36))
        shared[np.ix_(_DIAGONAL, _DIAGONAL)] = self.covariance[3 + _DIAGONAL[0], 3 + _DIAGONAL[1]]
        return shared

    def shown_variance(self, p_sensor_com_m: Array) -> Array:
        """Return the prior variance (11,) of the gain and cross-talk that a tool with this centre of mass shows."""
        H = shown_by(p_sensor_com_m)
        return np.asarray(np.einsum("ai,ij,aj->a", H, self.covariance[3:, 3:] - self.common, H))

    def hidden_covariance(self, parameters: Parameters) -> Array:
        """Return the prior covariance (15, 15) of mounting, weight and centre of mass due to errors of the sensor.

        Parameters
        ----------
        parameters : Parameters
            Parameters of the expected tool.
        """
        return _hidden_covariance(parameters, np.zeros(36), self.covariance[3:, 3:])

    def contact_response(
        self,
        parameters: Parameters,
        shown: Response | None = None,
        rotation_covariance: Array | None = None,
        excess: tuple[float, float] | None = None,
    ) -> "ContactResponse":
        """Return the response of the sensor to a contact, given the errors that the calibration of a tool shows.

        Parameters
        ----------
        parameters : Parameters
            Parameters of the tool.
        shown : Response, optional
            Gain and cross-talk of the tool, with their covariance. None: only the prior is used.
        rotation_covariance : array, shape (3, 3), optional
            Covariance of `R_flange_sensor` about the flange axes, rad², which affects the direction of a contact. None:
            exactly known or, for a matrix from loads whose fit contains this calibration, the covariance of that fit.
        excess : float and float, optional
            Relative excess of the measured over the weighed mass of the tool, and its sigma.
        """
        E, C = np.asarray(self.error), np.asarray(self.covariance[3:, 3:])
        p, R = parameters.p_sensor_com_m, parameters.R_flange_sensor
        if self.source == "loads" and rotation_covariance is None:
            T = block_diag(R.T, np.eye(36))
            return ContactResponse(self, parameters, E, T @ self.covariance @ T.T)
        # The zero covariance of a sensor that is declared perfect is not updated by a tool.
        if self.source != "loads" and shown is not None and C.any():
            H, coefficients, remaining = shown_by(p), shown.coefficients, shown.covariance[15:, 15:]
            # Posterior mean of the variance between axes (scaled inverse chi-square); the common part keeps its prior.
            squares = (coefficients**2 + np.diag(remaining)) / self.shown_variance(p)
            size = (_USUAL_COUNTS + float(squares.sum())) / (_USUAL_COUNTS + len(H) - 2)
            C = size * (C - self.common) + self.common
            if excess is not None:
                H = np.concatenate([H, _common_gain(p)])
                coefficients = np.append(coefficients, excess[0])
                remaining = block_diag(remaining, np.array([[excess[1] ** 2]]))
            prior = H @ C @ H.T
            gain = C @ H.T @ np.linalg.inv(prior)
            E, C = (gain @ coefficients).reshape(6, 6), C - gain @ (prior - remaining) @ gain.T
        turned = np.zeros((3, 3)) if rotation_covariance is None else R.T @ rotation_covariance @ R
        T = np.concatenate([_mounting_turn(_ENTRIES, p).T, np.eye(36)])
        return ContactResponse(self, parameters, E, T @ C @ T.T + block_diag(turned, np.zeros((36, 36))))

    def to_dict(self) -> dict[str, JSON]:
        """Return the document of a sensor file."""
        return {
            "format": FORMAT,
            "error": self.error.tolist(),
            "covariance": self.covariance.tolist(),
            "source": self.source,
            "lever_m": self.lever_m,
            "floor": self.floor,
            "provenance": dict(self.provenance),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Return the matrix in a sensor file's document. Raises `BadCalibration` for missing or implausible values."""
        check_format(document, FORMAT, BadCalibration)
        names = ("error", "covariance", "source", "lever_m", "floor", "provenance")
        try:
            _require_types(document)
            sensor = cls(*(document[name] for name in names))
            sensor._require_plausible()
        except KeyError as exc:
            raise BadCalibration(f"the sensor's file lacks the field {exc.args[0]}: the file is damaged.") from exc
        except (TypeError, ValueError, OverflowError) as exc:
            raise BadCalibration(f"the sensor's file cannot be read ({exc}): the file is damaged.") from exc
        return sensor

    def _require_plausible(self) -> None:
        """Raise `ValueError` for implausible errors or an invalid covariance."""
        if not (_LEVERS_M[0] <= self.lever_m <= _LEVERS_M[1] and self.floor <= _LARGEST_FLOOR):
            raise ValueError(f"lever_m {self.lever_m:g} and floor {self.floor:g} are implausible")
        relative = ranges(self.lever_m) / ranges(self.lever_m)[:, None]
        C = self.covariance
        variance = np.diag(C)
        least = float(np.linalg.eigvalsh((C + C.T) / 2)[0]) if variance.max() < np.pi**2 * 1e4 else -np.inf
        if (variance < 0).any() or not np.allclose(C, C.T, rtol=1e-6, atol=1e-12) or least < -1e-9 * variance.max():
            raise ValueError("the covariance is invalid: it is not symmetric, or a variance is negative or too large")
        for name, values, most in (
            ("error", np.abs(self.error) * relative, _LARGEST_ERROR),
            ("sigma", self.sigma * relative, _LARGEST_SIGMA),
        ):
            if (largest := float(values.max())) > most:
                raise ValueError(f"{name} has an entry of {100 * largest:.3g} %, which is implausible")

    def save(self, path: str | Path) -> None:
        """Write a new file; raises `FileExistsError` if it exists."""
        write_object(path, self.to_dict())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the matrix in a sensor file. Raises `BadCalibration` for invalid content, `OSError` if unreadable."""
        try:
            return cls.from_dict(read_object(path, BadCalibration))
        except BadCalibration as exc:
            raise BadCalibration(f"{Path(path).name}: {exc}") from exc


def _require_types(document: Mapping[str, Any]) -> None:
    """Raise `TypeError` for values that numpy would convert to numbers, such as strings and booleans."""
    for name in ("error", "covariance", "lever_m", "floor"):
        if any(type(value) not in (int, float) for value in np.array(document[name], object).flat):
            raise TypeError(f"{name} contains values that are not numbers")
    if not isinstance(document["provenance"], Mapping):
        raise TypeError("provenance is not an object")


@dataclass(frozen=True, eq=False)
class ContactResponse:
    """Response of a sensor to a contact, in the axes of a tool's calibration."""

    sensor: SensorMatrix
    parameters: Parameters
    """Parameters of the tool."""
    error: Array
    """(6, 6) estimated error matrix E of the sensor: reading = (I + E) wrench."""
    error_covariance: Array
    """(39, 39) covariance of the mounting (3, rad, sensor axes) and of the entries of E, row by row."""

    @cached_property
    def decoder(self) -> Array | None:
        """(6, 6) matrix from a reading minus the free-tool wrench to the contact wrench; None if it is the identity."""
        if not self.error.any():
            return None
        turn = skew(_mounting_turn(self.error, self.parameters.p_sensor_com_m))
        return read_only(np.linalg.inv(np.eye(6) + self.error - np.kron(np.eye(2), turn)))

    def decode(self, contact: Array) -> Array:
        """Return decoded contact wrenches (..., 6) from readings minus the free-tool wrench (..., 6)."""
        return contact if self.decoder is None else np.asarray(contact @ self.decoder.T)

    def error_columns(self, wrench: Array) -> Array:
        """Return the derivative (..., 6, 39) of decoded wrenches with respect to the errors in `error_covariance`."""
        turns = -np.kron(np.eye(2), skew(np.eye(3)))
        effects = np.concatenate([turns, _ENTRIES])
        if self.decoder is not None:
            effects = self.decoder @ effects
        return np.asarray(np.einsum("aij,...j->...ia", effects, wrench))

    @cached_property
    def hidden_covariance(self) -> Array:
        """(15, 15) mean square of the errors of mounting, weight and centre of mass that the sensor hides."""
        return _hidden_covariance(self.parameters, self.error.ravel(), self.error_covariance[3:, 3:])

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the true weight of the tool, due to the sensor's gain."""
        weight = self.parameters.gravity_force_base_N
        return float(np.sqrt(weight @ self.hidden_covariance[3:6, 3:6] @ weight) / max(weight @ weight, 1e-12))

    @cached_property
    def _by_products(self) -> Array:
        """(36, 36) matrix that maps the products w w' of a contact w to its covariance, both row by row."""
        columns = self.error_columns(np.eye(6))  # axes: wrench, axis of the decoded contact, error
        C = np.einsum("kia,ab,ljb->ijkl", columns, self.error_covariance, columns)
        F = ranges(self.sensor.lever_m)
        C += self.sensor.floor**2 * np.einsum("ij,kl->ijkl", np.diag(F**2), np.diag(F**-2.0))
        return np.asarray(C.reshape(36, 36))

    def covariance(self, wrench: Array) -> Array:
        """Return the covariance (..., 6, 6) of decoded contacts due to errors of the sensor, including the floor.

        Parameters
        ----------
        wrench : array, shape (..., 6)
            Contact wrenches, N and N·m.
        """
        wrench = np.asarray(wrench)
        products = (wrench[..., :, None] * wrench[..., None, :]).reshape(*wrench.shape[:-1], 36)
        return np.asarray((products @ self._by_products.T).reshape(*wrench.shape, 6))

    def sigma_at(self, p_sensor_m: Array) -> tuple[float, float]:
        """Return the rms errors of force (N) and torque (N·m) of a contact of 1 N at a point (3,), over all directions.

        The errors are norms of the error vectors.
        """
        # The covariance is quadratic in the force, so its mean over all directions equals that over three axes.
        C = self.covariance(np.concatenate([np.eye(3), np.cross(p_sensor_m, np.eye(3))], axis=1)).mean(axis=0)
        return float(np.sqrt(np.trace(C[:3, :3]))), float(np.sqrt(np.trace(C[3:, 3:])))

    def true_load(self, shown: Response) -> tuple[float, Array]:
        """Return the true weight (N) and centre of mass (3,) of the tool, by decoding its reading."""
        p = self.parameters
        reading = np.concatenate([np.eye(3), skew(p.p_sensor_com_m)]) * p.weight_N
        reading += p.weight_N * shown_gain(shown)
        force, torque = np.split(reading if self.decoder is None else self.decoder @ reading, 2)
        weight_N = float(np.trace(force)) / 3
        return weight_N, _vector_of(torque) / (weight_N or 1.0)


def _hidden_covariance(parameters: Parameters, mean: Array, C: Array) -> Array:
    """Return the mean square (15, 15) of hidden errors of a tool, for entries of E with mean (36,) and covariance C.

    An antisymmetric gain looks like a rotation of the mounting, an antisymmetric cross-talk like a shift of the centre
    of mass, and a gain common to all axes like a larger weight with a closer centre of mass. No orientation shows them.
    """
    p = parameters.p_sensor_com_m
    turn, (_, torque) = _mounting_turn(_ENTRIES, p), _gain_at(_ENTRIES, p)
    (scale,) = _common_gain(p)
    columns = np.zeros((15, 36))
    columns[:3] = parameters.R_flange_sensor @ turn.T
    columns[3:6] = np.outer(parameters.gravity_force_base_N, scale)
    columns[9:12] = (_vector_of(torque - skew(p) @ skew(turn)) - np.outer(scale, p)).T
    weight = np.zeros(15)
    weight[3:6] = parameters.gravity_force_base_N
    square = C + np.outer(mean, mean)
    least = max(LEAST_COMMON_GAIN**2 - float(scale @ square @ scale), 0.0)
    return np.asarray(columns @ square @ columns.T + least * np.outer(weight, weight))


def _common_gain(p: Array) -> Array:
    """Return the derivative (1, 36) of the gain common to all axes of a tool at p with respect to the entries of E."""
    force, _ = _gain_at(_ENTRIES, p)
    return np.asarray(np.trace(force, axis1=1, axis2=2)[None] / 3)
