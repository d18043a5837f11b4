"""Forward model of runs with known loads, and the standard deviations of their disturbances.

    reading = (I + E) blk(R', R') w + b - h (w - w before) + noise      w = [m u; s x u], R = R_flange_sensor

about the sensor origin, in flange axes, with u the acceleration of gravity, m the sum of the masses and s the sum of
mass times position. A weight on a string is a mass at the knot. Each run has its own bias b.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.display import Displayed
from ftcalib.model import Array, cross, rotation_of, skew
from ftcalib.sensor_matrix import SensorMatrix, ranges

# Standard deviation of the position of the sensor origin, m, an error common to all declared positions.
ORIGIN_M = 0.0005
# Usual standard deviation of each disturbance, and the sigma of its logarithm. If the noise of the poses was not
# measured, it is part of the white noise.
SIZES: Mapping[str, tuple[float, float]] = {
    "white_N": (0.01, 1.5),
    "white_Nm": (0.0005, 1.5),
    "walk_N": (0.01, 1.5),
    "walk_Nm": (0.0003, 1.5),
    "rotation_rad": (0.00035, 1.0),
    "floor": (0.001, 1.0),
    "hysteresis": (0.001, 1.0),
    "matrix": (1.0, 0.5),
}
_WIDTHS = np.array([width for _, width in SIZES.values()])
# Uninformative priors, one sigma: rotation, tilt, mass of the tool, positions, bias of force and torque.
_ANY_RAD, _ANY_TILT, _ANY_KG, _ANY_M = np.pi, 0.3, 100.0, 0.5
_ANY_BIAS = np.repeat([1e4, 1e3], 3)
# Smallest sigma of a mass.
_LEAST_KG = 1e-6


@dataclass(frozen=True, slots=True)
class KnownLoad:
    """Weighed load on the tool, rigid or hung from a point.

    Examples
    --------
    >>> import ftcalib
    >>> ftcalib.KnownLoad("tip", 2.0, 0.002, (0.0, 0.0, 0.2)).place_sigma_m
    0.0005
    """

    name: str
    mass_kg: float
    mass_sigma_kg: float
    p_flange_m: tuple[float, float, float] | None = None
    """Suspension point, or centre of mass of a rigid load, from the centre of the flange face, m; None: unknown."""
    place_sigma_m: float = 0.0005
    """Standard deviation of the position per axis, m."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoadRun(Displayed):
    """Run of static poses with one load on the tool, or with the tool alone.

    Examples
    --------
    >>> import ftcalib, ftdrive
    >>> ftcalib.LoadRun("tool", ftdrive.read_dataset("poses.csv")).load is None
    True
    """

    name: str
    dataset: CalibrationDataset
    load: KnownLoad | None = None


Kind = Literal["mass", "place", "tool_mass", "moved", "bumped", "touched", "pulled"]


@dataclass(frozen=True, slots=True)
class Mistake:
    """Mistake in a run, with additional free quantities that model its effect."""

    kind: Kind
    run: int = 0
    """Index of the run with the mistake; unused if the mistake is the mass of the tool."""
    pose: int = 0
    """Index of the pose: the first after a change, or the one in which the tool was touched."""

    @property
    def sigma(self) -> Array:
        """Prior standard deviations of the additional free quantities, kg, m, N or N·m."""
        return np.array(_MISTAKES[self.kind])


# Prior standard deviations of the free quantities of each mistake.
_MISTAKES: Mapping[Kind, list[float]] = {
    "mass": [1.0],
    "place": [0.1] * 3,
    "tool_mass": [1.0],
    "moved": [0.02] * 3,
    "bumped": [3.0] * 3 + [0.2] * 3,
    "touched": [5.0] * 3 + [0.5] * 3,
    "pulled": [1.0] * 2,
}


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Model of the runs, linearised at its current values; each list has one entry per run."""

    J: list[Array]
    """(6n, k) derivatives of the readings with respect to all unknowns."""
    residual: list[Array]
    """(6n,) residuals: readings minus those of the model."""
    noise: list[Mapping[str, Array]]
    """(6n, 6n) covariances of the disturbances for standard deviation 1, by their name in `SIZES`."""
    readout: list[Array]
    """(6, 6) matrix that maps a wrench in flange axes to the reading."""
    wrench: list[Array]
    """(n, 6) true wrench of the load on the sensor, in sensor axes."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluated:
    """Marginal likelihood at given standard deviations of the disturbances, and the Gauss-Newton step."""

    cost: float
    """-2 log marginal likelihood up to a constant, including the priors of the sizes."""
    gradient: Array
    """Derivative of the cost with respect to the logarithms of the sizes."""
    step: Array
    """(k,) Gauss-Newton step of all unknowns."""
    covariance: Array
    """(k, k) covariance of all unknowns."""
    unexplained: list[tuple[Array, Array]]
    """For each run, its weighted residual (6n,) and the covariance (6n, 6n) of that under the model."""

    def gain_of(self, run: int, columns: Array, sigma: Array) -> float:
        """Return the cost reduction from further quantities with derivatives (6n, m) and priors `sigma` in one run."""
        residual, projection = self.unexplained[run]
        b, M = (columns.T @ residual) * sigma, columns.T @ projection @ columns * np.outer(sigma, sigma)
        with_prior = np.eye(len(b)) + M
        return float(b @ np.linalg.solve(with_prior, b) - np.linalg.slogdet(with_prior)[1])


class LoadModel:
    """Model of runs with known loads: all unknowns at their current values.

    The initial values are a mounting and `tool`: mass (kg) and centre of mass from the sensor origin, flange axes. The
    direction of `gravity_base_m_s2` is declared, and also estimated. `tool_mass_kg` is the weighed mass with its sigma.
    """

    mistakes: tuple[Mistake, ...] = ()

    def __init__(
        self,
        runs: Sequence[LoadRun],
        prior: SensorMatrix,
        R_flange_sensor: Array,
        tool: tuple[float, Array],
        *,
        p_flange_sensor_m: Array,
        gravity_base_m_s2: Array,
        tool_mass_kg: tuple[float, float] | None = None,
    ) -> None:
        self.runs, self.prior, self.R = list(runs), prior, np.array(R_flange_sensor)
        self.loads = [run.load for run in runs if run.load is not None]
        self.g = np.asarray(gravity_base_m_s2)
        self._across = float(np.linalg.norm(self.g)) * np.linalg.svd(self.g[None])[2][1:].T
        names = ["rotation", "matrix", "tilt", "tool", "origin", "hysteresis"]
        sizes = [3, 36, 2, 4, 3, 6, *[4] * len(self.loads), *[6] * len(self.runs)]
        names += [f"load {k}" for k in range(len(self.loads))] + [f"bias {k}" for k in range(len(self.runs))]
        ends = np.cumsum(sizes).tolist()
        self.at = {name: slice(end - size, end) for name, size, end in zip(names, sizes, ends, strict=True)}
        # The rotation is stored in R, to which steps are applied; its entry in the vector of unknowns stays 0.
        self.x, self.expected, sigma = np.zeros(ends[-1]), np.zeros(ends[-1]), np.ones(ends[-1])
        mass_kg, com_m = tool
        self._set("matrix", prior.error.ravel())
        self._set("tool", np.array([mass_kg, *com_m]))
        sigma[self.at["rotation"]], sigma[self.at["tilt"]], sigma[self.at["origin"]] = _ANY_RAD, _ANY_TILT, ORIGIN_M
        sigma[self.at["tool"]] = [_ANY_KG, _ANY_M, _ANY_M, _ANY_M]
        if tool_mass_kg is not None:
            self.expected[self.at["tool"].start], sigma[self.at["tool"].start] = tool_mass_kg
        for k, load in enumerate(self.loads):
            known = load.p_flange_m is not None
            place = np.asarray(load.p_flange_m) - p_flange_sensor_m if known else np.asarray(com_m)
            self._set(f"load {k}", np.array([load.mass_kg, *place]))
            place_sigma = load.place_sigma_m if known else _ANY_M
            sigma[self.at[f"load {k}"]] = [max(load.mass_sigma_kg, _LEAST_KG), *[place_sigma] * 3]
        for k in range(len(self.runs)):
            sigma[self.at[f"bias {k}"]] = _ANY_BIAS
        self.information = np.diag(sigma**-2.0)
        # Of the prior only the sensor's matrix is used, because the mounting may have changed since.
        self._matrix_information = np.linalg.inv(prior.covariance[3:, 3:])

    def _set(self, name: str, values: Array) -> None:
        self.x[self.at[name]] = self.expected[self.at[name]] = values

    def with_mistake(self, mistake: Mistake) -> "LoadModel":
        """Return a copy of the model that allows for one more mistake, at the current values of the unknowns."""
        other, size = copy(self), len(mistake.sigma)
        end = len(self.x)
        other.at = {**self.at, f"mistake {len(self.mistakes)}": slice(end, end + size)}
        other.mistakes = (*self.mistakes, mistake)
        other.x, other.expected = (np.concatenate([v, np.zeros(size)]) for v in (self.x, self.expected))
        other.information = np.zeros((end + size, end + size))
        other.information[:end, :end] = self.information
        other.information[end:, end:] = np.diag(mistake.sigma**-2.0)
        return other

    def move(self, step: Array) -> None:
        """Add a step to all unknowns."""
        self.R = rotation_of(step[self.at["rotation"]]) @ self.R
        self.x = self.x + step
        self.x[self.at["rotation"]] = 0.0

    @property
    def error(self) -> Array:
        """(6, 6) error matrix E of the sensor: reading = (I + E) wrench."""
        return self.x[self.at["matrix"]].reshape(6, 6)

    def linear(self) -> Linear:
        """Return the model linearised at the current values."""
        at, x = self.at, self.x
        g = self.g + self._across @ x[at["tilt"]]
        turn = np.kron(np.eye(2), self.R.T)
        N = (np.eye(6) + self.error) @ turn
        tool_kg, tool_m = x[at["tool"]][0], x[at["tool"]][1:]
        result, load = Linear([], [], [], [], []), 0
        for k, run in enumerate(self.runs):
            R, n = run.dataset.R_base_flange, len(run.dataset)
            u, du = g @ R, np.swapaxes(R, 1, 2) @ self._across
            M, s = tool_kg, tool_kg * tool_m
            if run.load is not None:
                own = x[at[f"load {load}"]]
                place = own[1:] + x[at["origin"]]
                M, s = M + own[0], s + own[0] * place
            w = np.concatenate([M * u, cross(s, u)], axis=1)
            read = w @ turn.T
            J = np.zeros((n, 6, len(x)))
            J[..., at["rotation"]] = N @ np.concatenate([skew(w[:, :3]), skew(w[:, 3:])], axis=1)
            J[..., at["matrix"]] = np.einsum("ab,nj->nabj", np.eye(6), read).reshape(n, 6, 36)
            J[..., at["tilt"]] = N @ np.concatenate([M * du, skew(s) @ du], axis=1)
            J[..., at["tool"]] = N @ _known_load_columns(tool_kg, tool_m, u)
            if run.load is not None:
                J[..., at[f"load {load}"]] = N @ _known_load_columns(own[0], place, u)
                J[..., at["origin"]] = J[..., at[f"load {load}"]][..., 1:]
                load += 1
            J[..., at[f"bias {k}"]] = np.eye(6)
            swing = np.diff(read, axis=0, prepend=read[:1])
            J[:, range(6), range(at["hysteresis"].start, at["hysteresis"].stop)] = -swing
            model = w @ N.T + x[at[f"bias {k}"]] - swing * x[at["hysteresis"]]
            for i, mistake in enumerate(self.mistakes):
                if mistake.run == k or mistake.kind == "tool_mass":
                    columns = self.columns_of(mistake, k, J, N)
                    J[..., at[f"mistake {i}"]] = columns
                    model = model + columns @ x[at[f"mistake {i}"]]
            off = N @ np.concatenate([M * skew(u), skew(s) @ skew(u)], axis=1)
            result.J.append(J.reshape(6 * n, -1))
            result.readout.append(N)
            result.residual.append((run.dataset.wrench - model).ravel())
            result.noise.append(_disturbance_covariances(off, read, self.prior.lever_m))
            result.wrench.append(read)
        return result

    @property
    def tool_is_weighed(self) -> bool:
        """Whether the weighed mass of the tool is known to the model."""
        return bool(self.information[self.at["tool"].start, self.at["tool"].start] > _ANY_KG**-2.0)

    def load_of(self, run: int) -> int:
        """Return the index in `loads` of the load that a run has on the tool."""
        return sum(earlier.load is not None for earlier in self.runs[:run])

    def columns_of(self, mistake: Mistake, run: int, J: Array, readout: Array) -> Array:
        """Return the derivative (n, 6, m) of the readings of a run with respect to the free quantities of a mistake."""
        kind, n = mistake.kind, len(J)
        if kind == "tool_mass":
            return np.asarray(J[..., self.at["tool"]][..., :1])
        if kind in ("bumped", "touched"):
            columns = np.zeros((n, 6, 6))
            columns[mistake.pose : (mistake.pose + 1 if kind == "touched" else None)] = np.eye(6)
            return columns
        own = J[..., self.at[f"load {self.load_of(mistake.run)}"]]
        if kind == "mass":
            return np.asarray(own[..., :1])
        if kind == "pulled":
            R_base_flange = self.runs[run].dataset.R_base_flange
            across = np.swapaxes(R_base_flange, 1, 2) @ (self._across / np.linalg.norm(self.g))
            place = self.x[self.at[f"load {self.load_of(mistake.run)}"]][1:]
            return np.asarray(readout @ np.concatenate([across, skew(place) @ across], axis=1))
        columns = np.array(own[..., 1:])
        if kind == "moved":
            columns[: mistake.pose] = 0.0
        return columns

    def evaluate(self, logarithms: Array, linear: Linear) -> Evaluated:
        """Return the marginal likelihood for sizes of `SIZES` times exp(`logarithms`)."""
        sizes = sizes_of(logarithms)
        P, matrix, lag = self.information.copy(), self.at["matrix"], self.at["hysteresis"]
        P[matrix, matrix] = self._matrix_information / sizes["matrix"] ** 2
        P[lag, lag] = np.eye(6) / sizes["hysteresis"] ** 2
        off = self.expected - self.x
        H, v, cost, solved = P.copy(), P @ off, -np.linalg.slogdet(P)[1], []
        for run, J, r, parts in zip(self.runs, linear.J, linear.residual, linear.noise, strict=True):
            L = cho_factor(self.noise(run, parts, sizes), lower=True, check_finite=False)
            WJ, Wr = cho_solve(L, J, check_finite=False), cho_solve(L, r, check_finite=False)
            H, v, cost = H + J.T @ WJ, v + WJ.T @ r, cost + 2 * np.log(np.diag(L[0])).sum()
            solved.append((L, WJ, Wr))
        C = np.asarray(np.linalg.inv(H))
        step = C @ v
        left = off - step
        cost += np.linalg.slogdet(H)[1] + left @ P @ left
        gradient, unexplained = dict.fromkeys(sizes, 0.0), []
        for (L, WJ, Wr), J, r, parts in zip(solved, linear.J, linear.residual, linear.noise, strict=True):
            a = Wr - WJ @ step
            cost += (r - J @ step) @ a
            projection = cho_solve(L, np.eye(len(r)), check_finite=False) - WJ @ C @ WJ.T
            unexplained.append((a, projection))
            for name, part in parts.items():
                gradient[name] += 2 * sizes[name] ** 2 * (np.sum(projection * part) - a @ part @ a)
        for name, own in (("matrix", matrix), ("hysteresis", lag)):
            z, prior = left[own], P[own, own]
            gradient[name] = 2 * (len(z) - z @ prior @ z - np.sum(C[own, own] * prior))
        y = np.asarray(logarithms) / _WIDTHS
        return Evaluated(float(cost + y @ y), np.array([*gradient.values()]) + 2 * y / _WIDTHS, step, C, unexplained)

    def noise(self, run: LoadRun, parts: Mapping[str, Array], sizes: Mapping[str, float]) -> Array:
        """Return the covariance (6n, 6n) of the readings of a run."""
        n = len(run.dataset)
        S = np.asarray(sum(sizes[name] ** 2 * part for name, part in parts.items()))
        if run.dataset.wrench_cov is not None:
            S.reshape(n, 6, n, 6)[range(n), :, range(n)] += run.dataset.wrench_cov
        return S


def sizes_of(logarithms: Array) -> dict[str, float]:
    """Return the sizes of the disturbances by name, from the logarithms of their ratios to the usual sizes."""
    return {name: usual * float(np.exp(y)) for (name, (usual, _)), y in zip(SIZES.items(), logarithms, strict=True)}


def _known_load_columns(mass_kg: float, place_m: Array, u: Array) -> Array:
    """Return the derivative (n, 6, 4) of the wrench with respect to mass and position of a load, in flange axes."""
    columns = np.zeros((len(u), 6, 4))
    columns[:, :3, 0], columns[:, 3:, 0], columns[:, 3:, 1:] = u, cross(place_m, u), -mass_kg * skew(u)
    return columns


def _disturbance_covariances(by_orientation: Array, wrench: Array, lever_m: float) -> dict[str, Array]:
    n, F = len(wrench), ranges(lever_m)
    before = np.minimum.outer(np.arange(n), np.arange(n)).astype(float)
    turned = np.zeros((n, 6, n, 6))
    turned[range(n), :, range(n)] = by_orientation @ np.swapaxes(by_orientation, 1, 2)
    force, torque = np.diag(np.repeat([1.0, 0.0], 3)), np.diag(np.repeat([0.0, 1.0], 3))
    load = np.sum((wrench / F) ** 2, axis=1)
    return {
        "white_N": np.kron(np.eye(n), force),
        "white_Nm": np.kron(np.eye(n), torque),
        "walk_N": np.kron(before, force),
        "walk_Nm": np.kron(before, torque),
        "rotation_rad": turned.reshape(6 * n, 6 * n),
        "floor": np.kron(np.diag(load), np.diag(F**2)),
    }
