"""The result of a calibration: estimates, their uncertainty, provenance and verdict."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from ftcalib.compensation import Compensator
from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import BadCalibration
from ftcalib.files import JSON, read_object, write_object
from ftcalib.findings import Finding, Verdict, verdict_of
from ftcalib.judge.verdict import SURE
from ftcalib.known import RANGE_LEVER_M
from ftcalib.model import (
    Array,
    DriftResult,
    Parameters,
    Rotations,
    is_rotation,
    keep_finite,
    matrices_of,
    weight_and_tilt,
)
from ftcalib.result_file import document_of, fields_of, is_edited
from ftcalib.rounding import counted
from ftcalib.sensor_matrix import SIZE, SQUARES, Calibrated, ContactResponse, Response, SensorMatrix
from ftcalib.shown import ShownEstimate, data_frame, shown_estimates, summary_rows, wrench_figure

# Number of sigmas of the sensor's gain above which the weighed and the estimated mass contradict each other.
_CONTRADICTS = 4.0

# Eigenvalues of a correlation matrix from here to 0 are rounding errors; a smaller one makes it invalid.
INDEFINITE = -1e-6

# SI unit of a quantity by the last part of its name; the mounting is a rotation vector in rad.
_SI: Mapping[str, str] = {
    "kg": "kg", "m": "m", "N": "N", "Nm": "N·m", "rad": "rad", "sensor": "rad", "m2": "kg·m²", "s": "s",
}  # fmt: skip

Method = Literal[
    "ml",
    "srom",
    "lrom",
    "mixed",
    "carlson-relaxation",
    "carlson-cayley",
    "carlson-eigen",
    "carlson-nullspace",
    "carlson-iterative",
    "carlson-polynomial",
    "vougioukas",
    "wang",
    "yang",
    "known-rotation",
    "yaw-only",
]
NoiseSource = Literal["measured", "residuals"]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MotionResult(Displayed):
    """Additional results of a recording in motion; arrays are read-only."""

    inertia_kg_m2: Array
    """(3, 3) inertia of the load about its centre of mass, in sensor axes."""
    delay_s: float
    """Delay of the wrench relative to the poses, s."""
    height_m: float
    """Height of the sensor origin above the flange face, m."""
    covariance: Array
    """(23, 23) covariance of the 15 error coordinates, ixx, iyy, izz, ixy, ixz, iyz, height and delay."""
    used_share: float
    """Share of the recording that was used. The rest was contact, a gap, or too fast to use without positions."""
    contacts: tuple[Mapping[str, float], ...] = ()
    """Contacts: time `t_s` after the first sample, `duration_s`, and filtered peaks `force_N` and `torque_Nm`."""

    def __post_init__(self) -> None:
        keep_finite(self, "the motion's ", inertia_kg_m2=(3, 3), covariance=(23, 23))
        contacts = tuple(MappingProxyType(dict(contact)) for contact in self.contacts)
        object.__setattr__(self, "contacts", contacts)

    @property
    def sigma(self) -> dict[str, Array | float]:
        """One standard deviation of each estimate, by its name."""
        std = np.sqrt(np.diag(self.covariance)[15:])
        inertia = std[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
        return {"inertia_kg_m2": inertia, "height_m": float(std[6]), "delay_s": float(std[7])}

    def to_dict(self) -> dict[str, JSON]:
        """Return the fields of a calibration file and of `--json`."""
        return {
            "inertia_kg_m2": self.inertia_kg_m2.tolist(),
            "delay_s": self.delay_s,
            "height_m": self.height_m,
            "used_share": self.used_share,
            "contacts": [dict(contact) for contact in self.contacts],
            "motion_covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self | None:
        """Return the motion result in the document of a calibration file; None for a static calibration."""
        if "inertia_kg_m2" not in document:
            return None
        names = ("inertia_kg_m2", "delay_s", "height_m", "motion_covariance", "used_share", "contacts")
        return cls(*(document[name] for name in names))


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationResult(Displayed, Calibrated):
    """Calibration: estimates with their covariance, provenance and verdict; arrays are read-only.

    Frames and signs are defined in docs/explanation/model.md.

    Examples
    --------
    >>> import ftdrive
    >>> result = ftdrive.solve(ftdrive.read_dataset("poses.csv"))
    >>> f"{result.mass_kg:.4f} kg, sigma {result.sigma['mass_kg']:.4f} kg, {result.verdict}"
    '1.2350 kg, sigma 0.0182 kg, good'
    """

    parameters: Parameters
    """Estimates; with `drift` the biases are those at the end of the session."""
    covariance: Array
    """(15, 15) covariance of the error coordinates `PARAMETER_NAMES`, from the noise and the `components`."""
    residuals: Array
    """(n, 6) measured minus predicted wrench, N and N·m, sensor axes; predicted with `response` and the mean bias."""
    chi2: float
    """Weighted sum of squared residuals of the used poses with the measured noise alone, without drift and
    `components`; with the noise from the residuals if it was not measured."""
    dof: int
    noise_source: NoiseSource
    """Source of the noise: the spread within each pose, or the residuals of the fit."""
    g_m_s2: float
    method: Method | Literal["motion"]
    findings: tuple[Finding, ...]
    """Findings that determine the verdict, in the order in which to fix them, followed by notes."""
    provenance: Mapping[str, JSON] = field(default_factory=dict)
    p_value: float | None = None
    """Probability of a larger chi2 under the measured noise alone; None if the noise was not measured."""
    measured_sigma: Array | None = None
    """(6,) measured standard deviation of the mean of a pose, rms over the poses, N and N·m; None = unknown."""
    weights: Array | None = None
    """(n,) 1 = used, 0 = rejected because it does not fit the others. None = all are used."""
    components: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the variance components, by name and unit: beyond the measured noise, or all of the noise
    if it was not measured. `walk_…` is the random walk of the bias per mean interval between poses, `slope_…` its
    linear change over the session, `rotation_rad` the orientation error of a pose per axis, `gain` and `cross_talk`
    the standard deviation of the entries of `response`, relative and relative to a lever of 50 mm, `hysteresis` the
    share of its last change by which an axis lags. `load_…`, `cable_…` and `kinematics_rad` are structured errors
    (`ftcalib.likelihood.structure`). In motion `rotation_rad` and `yielding_rad` are smooth rotations of arm and mount,
    and `slow_…` is slow noise."""
    drift: DriftResult | None = None
    """Drift of the bias; None if no drift was found, or if `drift="none"`."""
    mean_bias: Array | None = None
    """(6,) mean of the bias over the session, N and N·m; None without drift, or in a file of an earlier format."""
    response: Response | None = None
    """Gain and cross-talk of the sensor; None if not found, or if the method does not estimate them."""
    gain_sigma: float = 0.0
    """Standard deviation of the entries of the sensor's gain; None if no gain was found."""
    hidden_covariance: Array = field(default_factory=lambda: np.zeros((15, 15)))
    """(15, 15) covariance of the estimates due to errors of arm and mounts that the poses do not show."""
    cable_shift: Array | None = None
    """(15,) possible shift of the estimates by a cable that acts like a spring, as `covariance`; None without one."""
    second_basin_chi2: float | None = None
    """Increase of chi2 at the second best solution, under the noise model; None if there is no other."""
    quality: Mapping[str, JSON] = field(default_factory=dict)
    """Statistics behind the verdict: leave-one-out errors `loo_force_rms_N` and `loo_torque_rms_Nm`, errors
    `next_use_force_rms_N` and `next_use_torque_rms_Nm`, the same for `workspace` and, if the tour shows a drift, for
    `hour` (see `likely_error`), `bias_growth_per_min` (6; change of the bias in the minute after the last pose),
    `worst_pose` (row from 1), `residual_sigma` (n; 1 expected), `lag1` (correlation of successive residuals),
    `correlations` (pairs of parameters above 0.9)."""
    sensor: SensorMatrix | None = None
    """Errors of the sensor's matrix, from known loads or a data sheet; None: usual errors are assumed."""
    weighed_kg: tuple[float, float] | None = None
    """Weighed mass of the tool and its sigma, kg, which determine the gain common to all axes; None: not weighed."""
    motion: MotionResult | None = None
    """Additional results of a recording in motion; None for a calibration from static poses."""

    def __post_init__(self) -> None:
        for each in fields(Parameters):
            if not np.isfinite(value := getattr(self.parameters, each.name)).all():
                raise ValueError(f"{each.name} must be finite, not {value.tolist()}")
        if not is_rotation(self.R_flange_sensor):
            raise ValueError(f"R_flange_sensor must be a rotation matrix, not {self.R_flange_sensor.tolist()}")
        for name, choices in (("method", (*get_args(Method), "motion")), ("noise_source", get_args(NoiseSource))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} is {getattr(self, name)!r}, not one of {', '.join(choices)}")
        n = len(self.residuals)
        keep_finite(self, "", covariance=(15, 15), hidden_covariance=(15, 15), residuals=(n, 6))
        optional = {"measured_sigma": (6,), "weights": (n,), "cable_shift": (15,), "mean_bias": (6,)}
        keep_finite(self, "", **{name: shape for name, shape in optional.items() if getattr(self, name) is not None})
        if self.weighed_kg is not None:
            mass_kg, sigma_kg = self.weighed_kg
            if not (0 < mass_kg < np.inf and 0 <= sigma_kg < np.inf):
                raise ValueError(f"weighed_kg must be a mass and its sigma, not {list(self.weighed_kg)}")
            object.__setattr__(self, "weighed_kg", (float(mass_kg), float(sigma_kg)))
        require_positive_definite(self.joint_covariance)
        object.__setattr__(self, "components", MappingProxyType({k: float(v) for k, v in self.components.items()}))
        object.__setattr__(self, "findings", tuple(self.findings))
        for name in ("provenance", "quality"):
            try:
                value = json.loads(json.dumps(dict(getattr(self, name)), allow_nan=False))
            except (TypeError, ValueError) as exc:
                raise ValueError(f"{name} cannot be written as JSON ({exc})") from exc
            object.__setattr__(self, name, MappingProxyType(value))

    @property
    def id(self) -> str:
        """Identifier of the result: 12 hex digits of the SHA-256 of the values that determine the compensation.

        Two files with the same id compensate equally, whatever their provenance. The matrix of the sensor, which
        decodes contacts, is not part of the id, because all tools share it.
        """
        return self._id(self.response and self.response.to_dict())

    def _id(self, response: JSON) -> str:
        """Return the id for given numbers of `response`, whose sigmas may be rounded differently on other computers."""
        numbers = [getattr(self.parameters, each.name).tolist() for each in fields(Parameters)]
        numbers += [self.covariance.tolist(), self.gain_sigma, self.g_m_s2]
        if response is not None:
            numbers.append(response)
        if self.motion is not None:
            numbers += [self.motion.inertia_kg_m2.tolist(), self.motion.delay_s]
        return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:12]

    @property
    def is_edited(self) -> bool:
        """Whether the result is from a file that was edited after solving, and that `accept_edited` allowed."""
        return bool(self.provenance.get("edited"))

    @property
    def verdict(self) -> Verdict:
        """Verdict (good, usable or rejected) of the worst finding."""
        return verdict_of(self.findings)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences of the findings: the reasons for the verdict."""
        return tuple(finding.words for finding in self.findings)

    @property
    def n_poses(self) -> int:
        """Number of poses, including rejected ones."""
        return len(self.residuals)

    @property
    def noise_factor(self) -> float:
        """Ratio of the residuals to the measured noise: about 1 for a good fit."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def rejected_poses(self) -> tuple[int, ...]:
        """Rows of the rejected poses, counted from 1."""
        return () if self.weights is None else tuple(int(i) + 1 for i in np.flatnonzero(self.weights == 0))

    @property
    def p_wrong(self) -> float:
        """Probability that the second best solution is the true one: 1 / (1 + exp(second_basin_chi2 / 2))."""
        return 0.0 if self.second_basin_chi2 is None else float(expit(-self.second_basin_chi2 / 2))

    @property
    def R_flange_sensor(self) -> Array:
        """(3, 3) mounting of the sensor: maps sensor coordinates to flange coordinates."""
        return self.parameters.R_flange_sensor

    @property
    def gravity_force_base_N(self) -> Array:
        """(3,) weight of the load on the sensor, in base axes."""
        return self.parameters.gravity_force_base_N

    @property
    def force_bias_N(self) -> Array:
        """(3,) force bias in the sensor frame."""
        return self.parameters.force_bias_N

    @property
    def torque_bias_Nm(self) -> Array:
        """(3,) torque bias in the sensor frame, about the sensor origin."""
        return self.parameters.torque_bias_Nm

    @property
    def p_sensor_com_m(self) -> Array:
        """(3,) centre of mass in the sensor frame."""
        return self.parameters.p_sensor_com_m

    @property
    def weight_N(self) -> float:
        """Weight of the load on the sensor, N."""
        return self.parameters.weight_N

    @property
    def mass_kg(self) -> float:
        """Mass of the load on the sensor, kg: weight divided by `g_m_s2`."""
        return self.weight_N / self.g_m_s2

    @property
    def tilt_alpha_rad(self) -> float:
        """First tilt angle of the base, rad, see `ftcalib.model.weight_and_tilt`."""
        return weight_and_tilt(self.gravity_force_base_N)[1]

    @property
    def tilt_beta_rad(self) -> float:
        """Second tilt angle of the base, rad, see `ftcalib.model.weight_and_tilt`."""
        return weight_and_tilt(self.gravity_force_base_N)[2]

    @property
    def tool_covariance(self) -> Array:
        """(15, 15) covariance of the true mounting, weight and centre of mass, in the coordinates of `covariance`.

        It includes errors of arm, mounts, sensor and a cable that the session cannot separate from these parameters.
        `covariance` does not include them, because they cancel in the compensation.
        """
        hidden = self.contact.hidden_covariance + self.hidden_covariance
        lag, weight = self.components.get("hysteresis", 0.0), self.gravity_force_base_N
        hidden[3:6, 3:6] += lag**2 * np.outer(weight, weight)
        if self.cable_shift is not None:
            hidden += np.outer(self.cable_shift, self.cable_shift)
        # Exactly known values, such as a mass, have no hidden errors; `covariance` is zero along them.
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale[scale < 1e-12] = 1.0
        value, vector = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        free = vector[:, value > 1e-13]
        project = scale[:, None] * (free @ free.T) / scale
        project[np.diag(self.covariance) < 1e-24] = 0.0
        return np.asarray(self.covariance + project @ hidden @ project.T)

    @property
    def sigma(self) -> Mapping[str, Array | float]:
        """Standard deviation of every quantity by its name, from `tool_covariance`.

        The sigma of `R_flange_sensor` is (3,), in rad about the flange axes.
        """
        covariance = self.tool_covariance
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        weight, alpha, beta = _weight_and_tilt_sigma(self.gravity_force_base_N, covariance[3:6, 3:6])
        return {
            **{each.name: part for each, part in zip(fields(Parameters), std.reshape(5, 3), strict=True)},
            "weight_N": weight,
            "mass_kg": weight / self.g_m_s2,
            "tilt_alpha_rad": alpha,
            "tilt_beta_rad": beta,
            **({} if self.motion is None else self.motion.sigma),
        }

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the sensor's scale for the tool, which no orientation shows."""
        return float(np.hypot(self.contact.scale_sigma, self.components.get("hysteresis", 0.0)))

    def compensate(self, wrench: ArrayLike, R_base_flange: Rotations, *, response: bool = True) -> Array:
        """Subtract weight and bias to give the contact wrench.

        Parameters
        ----------
        wrench : array, shape (6,) or (n, 6)
            As measured, N and N·m, in the sensor frame.
        R_base_flange : array, shape (3, 3) or (n, 3, 3), or Rotation
        response : bool
            Whether to apply gain and cross-talk of the sensor to the weight. False: as in programs without them.

        Returns
        -------
        array, same shape as `wrench`
            Contact wrench on the sensor, in the sensor frame, about the sensor origin.
        """
        compensator = self.compensator if response else Compensator(self.parameters)
        return np.asarray(compensator(wrench, R_base_flange), dtype=np.float64)

    @cached_property
    def contact(self) -> ContactResponse:
        """Response of the sensor to a contact: decoder from readings to contact wrenches, and its remaining errors."""
        sensor = self.sensor or SensorMatrix.usual()
        # If this dataset is one of the runs with loads, their fit already contains the error of the rotation.
        is_of_loads = self.provenance.get("dataset_sha256") in (sensor.provenance.get("datasets") or ())
        rotation = None if is_of_loads else self.covariance[:3, :3]
        return sensor.contact_response(self.parameters, self.shown_response, rotation, self._excess(sensor))

    @property
    def known_contact(self) -> ContactResponse | None:
        """Response of the sensor to a contact, if it was determined with known loads; otherwise None."""
        return self.contact if self.sensor is not None and self.sensor.source == "loads" else None

    def _excess(self, sensor: SensorMatrix) -> tuple[float, float] | None:
        """Return the relative excess of the measured over the weighed mass of the tool, and its sigma."""
        if self.weighed_kg is None:
            return None
        mass_kg, sigma_kg = self.weighed_kg
        noise_kg = self.parameters.weight_sigma_N(self.covariance) / self.g_m_s2
        excess, sigma = self.mass_kg / mass_kg - 1, float(np.hypot(sigma_kg, noise_kg)) / mass_kg
        # A larger excess is not a gain error, but another tool or a wrong unit, which the verdict reports.
        return (excess, sigma) if abs(excess) <= _CONTRADICTS * np.hypot(sensor.sigma[0, 0], sigma) else None

    @property
    def shown_response(self) -> Response:
        """Gain and cross-talk as estimated; if not found, zero with the posterior covariance of usual errors.

        A fit of n poses determines a gain as well as n readings of the weight do; half of this information is used.
        """
        if self.response is not None:
            return self.response
        n = self.n_poses - len(self.rejected_poses)
        left_out: list[float] = [self.quality.get(name, np.inf) for name in ("loo_force_rms_N", "loo_torque_rms_Nm")]
        error = np.maximum(np.repeat(left_out, [5, 6]) / np.repeat([1.0, RANGE_LEVER_M], [5, 6]), 1e-12)
        shown = max(self.dof, 0) / (6 * n) / 2 * n * SQUARES * (self.weight_N / error) ** 2
        covariance = np.zeros((15 + SIZE, 15 + SIZE))
        covariance[:15, :15] = self.covariance
        usual = (self.sensor or SensorMatrix.usual()).shown_variance(self.p_sensor_com_m)
        covariance[range(15, 15 + SIZE), range(15, 15 + SIZE)] = 1 / (1 / np.maximum(usual, 1e-12) + shown)
        return Response(np.zeros(SIZE), covariance)

    def contact_sigma(self, wrench: ArrayLike, R_base_flange: Rotations) -> Array:
        """Return one standard deviation of each axis of a contact wrench: errors of the free tool and of the contact.

        Parameters
        ----------
        wrench : array, shape (6,) or (n, 6)
            Contact wrench from `compensate`, N and N·m, in the sensor frame.
        R_base_flange : array, shape (3, 3) or (n, 3, 3), or Rotation

        Returns
        -------
        array, same shape as `wrench`
            Standard deviations, without the noise of a sample.
        """
        contact, R = np.asarray(wrench, dtype=np.float64), matrices_of(R_base_flange)
        excess = np.square(self.likely_error()) - np.square(self.predicted_error())
        free = np.diagonal(self.wrench_covariance(R), axis1=-2, axis2=-1) + np.repeat(np.maximum(excess, 0.0) / 3, 3)
        loaded = self.contact.covariance(contact)
        return np.asarray(np.sqrt(free + np.diagonal(loaded, axis1=-2, axis2=-1)))

    @cached_property
    def compensator(self) -> Compensator:
        """Compensator for fast loops: single samples, samples into a buffer, or recordings."""
        return Compensator(self.parameters, response=self.response, decoder=self.contact.decoder)

    @property
    def noise_explains(self) -> bool:
        """Whether the residuals agree with the noise model.

        True for an update, which has too few poses for a test. For a calibration in motion, true unless slowly varying
        errors raise the expected error at the next use above the value predicted from the covariance.
        """
        if self.motion is not None:
            return bool((self.likely_error() <= np.array(self.predicted_error())).all())
        return not self.quality or (self.p_value is not None and self.p_value >= SURE)

    def likely_error(self, where: Literal["next_use", "workspace", "hour"] = "next_use") -> Array:
        """Return the rms error (2,) of compensating a free tool at the next use, N and N·m.

        If the measured noise explains the residuals, the error is `predicted_error`, otherwise the leave-one-out error,
        which applies to orientations like those of the tour. In both cases the drift of the bias in the minute after
        the last pose is added. For a recording in motion, load and smooth errors at rest in the recorded orientations
        give the error. "workspace": over all orientations; "hour": with an hour of drift, NaN without a drift.
        """
        if not self.quality:
            return np.array(self.predicted_error()) if where != "hour" else np.full(2, np.nan)
        units = "force_rms_N", "torque_rms_Nm"
        if where == "hour":
            return np.array([self.quality.get(f"hour_{unit}", np.nan) for unit in units], dtype=np.float64)
        # Files of version 0.1.0 and earlier have only the error of predicting each pose from all others.
        names = [name for name in (where, "next_use", "loo") if f"{name}_{units[0]}" in self.quality]
        return np.array([self.quality[f"{names[0]}_{unit}"] for unit in units], dtype=np.float64)

    def residual_summary(self) -> dict[str, float]:
        """Return rms and largest norm of the force and torque residuals over the poses."""
        force, torque = np.linalg.norm(self.residuals[:, :3], axis=1), np.linalg.norm(self.residuals[:, 3:], axis=1)
        return {
            "force_rms_N": float(np.sqrt(np.mean(force**2))),
            "force_max_N": float(force.max()),
            "torque_rms_Nm": float(np.sqrt(np.mean(torque**2))),
            "torque_max_Nm": float(torque.max()),
        }

    def _summary(self) -> Summary:
        amount = counted(self.n_poses, "pose") if self.motion is None else f"{100 * self.motion.used_share:.0f} % used"
        rows = summary_rows(self.estimates)
        force_N, torque_Nm = self.likely_error()
        rows.insert(6, Row("error of a free tool, rms", [f"{force_N:.4f} N", f"{torque_Nm:.5f} N·m"]))
        title = f"Calibration {self.id}, {amount}, method {self.method}, estimates ± 1 sigma"
        return Summary(title, rows, self.reasons, self.verdict)

    @property
    def estimates(self) -> list[ShownEstimate]:
        """Estimated quantities with their sigmas, in the order of display."""
        sigma = self.sigma
        values = {key: getattr(self if hasattr(self, key) else self.motion, key) for key in sigma}
        return shown_estimates({**values, "sigma": sigma, "covariance": self.covariance})

    def to_frame(self) -> Any:
        """Return the estimates as a pandas DataFrame, or as a Polars one if pandas is not installed.

        Returns
        -------
        DataFrame
            One row per number: `name`, such as ``p_sensor_com_m.x``, `value`, `sigma` and `unit` in SI. The mounting
            `R_flange_sensor` is given as its rotation vector. Sigma is 0 for exactly known values.

        Raises
        ------
        UsageError
            Neither package is installed.
        """
        rows = [
            (f"{key}.{axis}" if axis else key, float(value), float(sigma), _SI[key.rpartition("_")[2]])
            for estimate in self.estimates
            for key, sigmas in [(estimate.key, np.where(estimate.is_known, 0.0, estimate.sigma))]
            for axis, value, sigma in zip(estimate.axes, estimate.values, sigmas, strict=True)
        ]
        return data_frame(dict(zip(("name", "value", "sigma", "unit"), zip(*rows, strict=True), strict=True)))

    def plot(self) -> Any:
        """Return a plot of the residuals, measured minus predicted, of each pose or row of a recording in motion.

        Returns
        -------
        matplotlib.figure.Figure
            Forces above torques, in sensor axes. The band is one sigma of the measured noise, if known.

        Raises
        ------
        UsageError
            matplotlib is not installed.
        """
        return wrench_figure(
            np.arange(1.0, len(self.residuals) + 1),
            self.residuals,
            label="pose" if self.motion is None else "row of the recording",
            title=f"Measured minus predicted, {self.verdict.upper()}; band: one sigma",
            sigma=self.measured_sigma,
            marked=None if self.weights is None else self.weights == 0,
            points=True,
        )

    def to_dict(self) -> dict[str, JSON]:
        """Return the content of a calibration file."""
        force_N, torque_Nm = self.predicted_error()
        predicted = {"force_rms_N": force_N, "torque_rms_Nm": torque_Nm}
        document = document_of(self, residual=self.residual_summary(), predicted_error=predicted)
        return document if self.motion is None else {**document, **self.motion.to_dict()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], *, accept_edited: bool = False) -> Self:
        """Return the result from the document of a calibration file; unknown fields are ignored.

        Parameters
        ----------
        accept_edited : bool
            Whether to accept a document that does not match its checksum, id or verdict; `is_edited` is then true.

        Raises
        ------
        BadCalibration
        """
        try:
            result = cls(**fields_of(document), motion=MotionResult.from_dict(document))
            derived = {"id": result._id(document.get("response")), "verdict": result.verdict}
            edited = is_edited(document, derived, accept=accept_edited)
        except KeyError as exc:
            raise BadCalibration(f"the calibration lacks the field {exc.args[0]}: the file is damaged.") from exc
        except (AttributeError, TypeError, ValueError) as exc:
            raise BadCalibration(f"the calibration cannot be read ({exc}): the file is damaged.") from exc
        return replace(result, provenance={**result.provenance, "edited": True}) if edited else result

    def save(self, path: str | Path) -> None:
        """Write a new file; raises `FileExistsError` if it exists."""
        write_object(path, self.to_dict())

    @classmethod
    def load(cls, path: str | Path, *, accept_edited: bool = False) -> Self:
        """Return the result in a calibration file, see `from_dict`. An unreadable file raises `OSError`."""
        try:
            return cls.from_dict(read_object(path, BadCalibration, accept_changed=True), accept_edited=accept_edited)
        except BadCalibration as exc:
            raise BadCalibration(f"{Path(path).name}: {exc}") from exc


def require_positive_definite(covariance: Array) -> None:
    """Raise `ValueError` for a covariance with a negative eigenvalue; zero rows of exactly known values are ignored."""
    sigma = np.sqrt(np.abs(np.diag(covariance)))
    free = sigma > 0
    correlations = covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    least = float(np.linalg.eigvalsh(correlations)[0]) if free.any() else 0.0
    if least < INDEFINITE:
        raise ValueError(f"the covariance is not positive definite: its smallest normalised eigenvalue is {least:.2g}")


def _weight_and_tilt_sigma(F_b: Array, cov: Array) -> tuple[float, float, float]:
    """Return the standard deviations of weight (N), alpha and beta (rad) from the covariance of the gravity force.

    The sigma of an angle is limited to pi, where the linear propagation is no longer valid.
    """
    weight, _, _ = weight_and_tilt(F_b)
    if weight == 0.0:
        return float(np.sqrt(np.trace(cov))), float(np.pi), float(np.pi)
    x, y, z = F_b.tolist()
    h = float(np.hypot(x, z))
    out = np.array([x, 0.0, z]) / h if h > 0 else np.array([1.0, 0.0, 0.0])  # away from the base y axis
    gradients = np.array([F_b / weight, (h * np.array([0.0, 1.0, 0.0]) - y * out) / weight**2])
    variance = np.einsum("ki,ij,kj->k", gradients, cov, gradients)
    weight_sigma, alpha = np.sqrt(np.maximum(variance, 0.0)).tolist()  # rounding may make a zero variance negative
    along_beta = np.array([z, 0.0, -x])
    beta = float(np.sqrt(max(along_beta @ cov @ along_beta, 0.0))) / h**2 if h > 0 else float("inf")
    return weight_sigma, min(alpha, float(np.pi)), min(beta, float(np.pi))
