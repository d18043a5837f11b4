"""Calibration of a sensor's matrix from runs with known loads: a joint fit of all runs, and detection of mistakes.

Source: S. Traversaro, D. Pucci, F. Nori, "In situ calibration of six-axis force-torque sensors using accelerometer
measurements", ICRA 2015 (arXiv 1410.0885), extended by a prior on the matrix, unknown positions and disturbances.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from ftcalib.display import Displayed
from ftcalib.errors import NotObservable
from ftcalib.files import JSON
from ftcalib.findings import Finding, Verdict, ordered, verdict_of
from ftcalib.known import Setup
from ftcalib.loads.model import SIZES, Evaluated, LoadModel, LoadRun, Mistake, sizes_of
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array
from ftcalib.sensor_matrix import SensorMatrix, ranges
from ftcalib.solver import solve

# A mistake must reduce -2 log likelihood by this much, in addition to `_penalty`.
_CLEARLY = 12.0
_MOST_MISTAKES = 4
# Number of candidate mistakes, the most promising ones, for which the whole fit is repeated.
_TRIED = 4
# A residual above this share of the load means that the sensor is not linear.
_MOST_REMAINING = 0.03
# An entry of the matrix may differ from its prior by at most this many sigmas of the prior.
_MOST_CHANGE = 5.0
_POUND_KG = 0.45359237
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoadSolution(Displayed):
    """Result of runs with known loads: the matrix of the sensor, estimated loads and findings."""

    sensor: SensorMatrix
    findings: tuple[Finding, ...]
    loads: tuple[Mapping[str, JSON], ...]
    """Estimates for each run with a load: `run`, `name`, `mass_kg`, `mass_sigma_kg`, `p_flange_m`, `p_sigma_m`."""
    sizes: Mapping[str, float]
    """Estimated standard deviations of the disturbances of the readings, by name and unit."""
    remaining: tuple[float, ...]
    """Rms residual of each run, relative to its load; force and torque are in units of the measuring ranges."""
    tool_mass_kg: float
    tool_mass_sigma_kg: float

    @property
    def verdict(self) -> Verdict:
        """Verdict of the worst finding: a rejected matrix is not saved."""
        return verdict_of(self.findings)

    def to_dict(self) -> dict[str, JSON]:
        """Return the result as a JSON object."""
        return {
            "verdict": self.verdict,
            "findings": [finding.to_dict() for finding in self.findings],
            "loads": [dict(load) for load in self.loads],
            "sizes": dict(self.sizes),
            "remaining": list(self.remaining),
            "tool_mass_kg": self.tool_mass_kg,
            "tool_mass_sigma_kg": self.tool_mass_sigma_kg,
            "sensor": self.sensor.to_dict(),
        }


def solve_loads(
    runs: Sequence[LoadRun],
    prior: SensorMatrix | None = None,
    *,
    p_flange_sensor_m: Array | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup | None = None,
    tool_mass_kg: tuple[float, float] | None = None,
    provenance: Mapping[str, JSON] | None = None,
) -> LoadSolution:
    """Return the matrix of a sensor from runs with known loads.

    Parameters
    ----------
    runs : sequence of LoadRun
        Runs with the tool alone and with loads. Each has its own bias.
    prior : SensorMatrix, optional
        Matrix from earlier loads or from the data sheet; by default `SensorMatrix.usual()`.
    p_flange_sensor_m : array, shape (3,), optional
        Sensor origin from the centre of the flange face; by default at that centre. It affects the torque only.
    g_m_s2 : float
        Acceleration of gravity at the cell; its relative error is an error of all forces.
    setup : Setup, optional
        Description of the cell, whose up direction is the initial value of the direction of gravity.
    tool_mass_kg : float and float, optional
        Weighed mass of the tool, and its sigma.
    provenance : mapping, optional
        Stored with the matrix.

    Raises
    ------
    NotObservable
        No run has a known load, or no run determines the mounting.

    Examples
    --------
    Poses of a tool of 1.235 kg, taken here as a tool of 1.035 kg with a load of 0.2 kg:

    >>> import ftcalib, ftdrive
    >>> poses = ftdrive.read_dataset("poses.csv")
    >>> load = ftcalib.KnownLoad("tip", 0.2, 0.01)
    >>> solution = ftcalib.solve_loads([ftcalib.LoadRun("with load", poses, load)])
    >>> solution.sensor.source
    'loads'
    """
    if not any(run.load is not None for run in runs):
        raise NotObservable("no run has a known load: calibrate with --load, and give that run too.")
    setup, prior = setup or Setup(), prior or SensorMatrix.usual()
    begun = _first_model(runs, prior, p_flange_sensor_m, g_m_s2, setup, tool_mass_kg)
    model, logarithms, at = _fit_loads(copy(begun), np.zeros(len(SIZES)))
    while len(model.mistakes) < _MOST_MISTAKES and (better := _best_mistake(begun, model, logarithms, at)):
        model, logarithms, at = better
    swapped = _swapped(begun, at)
    sizes, remaining = sizes_of(logarithms), _remaining(model)
    sensor = SensorMatrix(
        model.error,
        at.covariance[:39, :39],
        "loads",
        prior.lever_m,
        max(sizes["floor"], max(remaining) / 2 if max(remaining) > _MOST_REMAINING else 0.0),
        {
            **(provenance or {}),
            "runs": [run.name for run in runs],
            "datasets": [run.dataset.sha256() for run in runs],
        },
    )
    tool = model.at["tool"].start
    return LoadSolution(
        sensor=sensor,
        findings=ordered(
            [swapped] if swapped else [*_load_findings(model, at), *_accuracy_limits(model, prior, remaining)]
        ),
        loads=tuple(_loads(model, at, p_flange_sensor_m)),
        sizes=sizes,
        remaining=tuple(remaining),
        tool_mass_kg=float(model.x[tool]),
        tool_mass_sigma_kg=float(np.sqrt(at.covariance[tool, tool])),
    )


def _first_model(
    runs: Sequence[LoadRun],
    prior: SensorMatrix,
    p_flange_sensor_m: Array | None,
    g_m_s2: float,
    setup: Setup,
    tool_mass_kg: tuple[float, float] | None,
) -> LoadModel:
    """Return the initial model, from the calibration of the run that determines the mounting best.

    It is a run without a load, if there is one, with the most poses.
    """
    first = max(runs, key=lambda run: (run.load is None, len(run.dataset)))
    alone = solve(first.dataset, g_m_s2=g_m_s2, setup=setup)
    mass_kg, com_m = alone.mass_kg, alone.R_flange_sensor @ alone.p_sensor_com_m
    if first.load is not None:
        mass_kg = max(mass_kg - first.load.mass_kg, 0.1 * mass_kg)
    return LoadModel(
        runs,
        prior,
        alone.R_flange_sensor,
        (mass_kg, com_m),
        p_flange_sensor_m=np.zeros(3) if p_flange_sensor_m is None else np.asarray(p_flange_sensor_m),
        gravity_base_m_s2=-g_m_s2 * setup.up,
        tool_mass_kg=tool_mass_kg,
    )


def _fit_loads(model: LoadModel, logarithms: Array) -> tuple[LoadModel, Array, Evaluated]:
    """Return a model with its best-fitting unknowns and the most likely sizes of the disturbances."""
    for _ in range(2):
        for _ in range(3):
            model.move(model.evaluate(logarithms, model.linear()).step)
        logarithms = _best_sizes(model, logarithms)
    model.move(model.evaluate(logarithms, model.linear()).step)
    return model, logarithms, model.evaluate(logarithms, model.linear())


def _best_sizes(model: LoadModel, logarithms: Array) -> Array:
    linear = model.linear()

    def cost(y: Array) -> tuple[float, Array]:
        at = model.evaluate(y, linear)
        return at.cost, at.gradient

    bounds = [(-5, 5)] * len(SIZES)
    best = minimize(cost, logarithms, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30})
    return np.asarray(best.x)


def _mistake_candidates(model: LoadModel, run: int) -> list[Mistake]:
    n, load = len(model.runs[run].dataset), model.runs[run].load
    mistakes = [Mistake("touched", run, pose) for pose in range(n)]
    mistakes += [Mistake("bumped", run, pose) for pose in range(2, n - 1)]
    if load is not None:
        mistakes += [Mistake("mass", run), Mistake("pulled", run)]
        mistakes += [Mistake("moved", run, pose) for pose in range(2, n - 1)]
        mistakes += [Mistake("place", run)] if load.p_flange_m is not None else []
    return [mistake for mistake in mistakes if mistake not in model.mistakes]


def _best_mistake(
    begun: LoadModel, model: LoadModel, logarithms: Array, at: Evaluated
) -> tuple[LoadModel, Array, Evaluated] | None:
    """Return the fit with the mistake that explains the readings best; None if there is no clear mistake.

    Each fit starts from the initial model, because a fit without the mistake may be far from the solution.
    """
    # Disturbances are limited to their usual sizes here: a mistake makes them larger, which would hide the mistake.
    usual, linear = np.minimum(logarithms, 0.0), model.linear()
    plain = model.evaluate(usual, linear)
    gains: dict[Mistake, float] = {}
    for run, (flat, readout) in enumerate(zip(linear.J, linear.readout, strict=True)):
        J = flat.reshape(-1, 6, flat.shape[1])
        for candidate in _mistake_candidates(model, run):
            columns = model.columns_of(candidate, run, J, readout).reshape(6 * len(J), -1)
            gains[candidate] = plain.gain_of(run, columns, candidate.sigma) - _penalty(candidate, model)
    weighed = Mistake("tool_mass")
    if model.tool_is_weighed and weighed not in model.mistakes:
        other = model.with_mistake(weighed)
        gains[weighed] = plain.cost - other.evaluate(usual, other.linear()).cost
    for mistake in model.mistakes:
        begun = begun.with_mistake(mistake)
    tried = [_fit_loads(begun.with_mistake(mistake), usual) for mistake in _most(gains)]
    if not tried:
        return None
    best = min(tried, key=lambda fit: fit[2].cost + _penalty(fit[0].mistakes[-1], model))
    gain = at.cost - best[2].cost - _penalty(best[0].mistakes[-1], model)
    return best if gain > _CLEARLY else None


def _most(gains: Mapping[Mistake, float]) -> list[Mistake]:
    """Return the candidate mistakes to fit: the best of each kind and run, if its predicted gain is sufficient."""
    best: dict[str, Mistake] = {}
    for mistake in sorted(gains, key=lambda candidate: -gains[candidate]):
        if gains[mistake] > _CLEARLY:
            best.setdefault(f"{mistake.kind} {mistake.run}", mistake)
    return list(best.values())[:_TRIED]


def _penalty(mistake: Mistake, model: LoadModel) -> float:
    """Return the additional gain required of a mistake because it could be in any of the poses."""
    per_pose = mistake.kind in ("touched", "bumped", "moved")
    return 2 * float(np.log(len(model.runs[mistake.run].dataset))) if per_pose else 0.0


def _remaining(model: LoadModel) -> list[float]:
    """Return the rms residual of each run, relative to its load."""
    linear, F = model.linear(), ranges(model.prior.lever_m)
    shares = []
    for r, wrench in zip(linear.residual, linear.wrench, strict=True):
        left = np.sum((r.reshape(-1, 6) / F) ** 2, axis=1) / 6
        shares.append(float(np.sqrt(left.mean() / np.mean(np.sum((wrench / F) ** 2, axis=1)))))
    return shares


def _found_load(model: LoadModel, run: int) -> tuple[float, Array]:
    """Return the estimated mass (kg) and position (3,) of the load of a run, from the sensor origin."""
    x = model.x
    own = x[model.at[f"load {model.load_of(run)}"]]
    mass_kg, place = float(own[0]), own[1:] + x[model.at["origin"]]
    for i, mistake in enumerate(model.mistakes):
        if mistake.run == run and mistake.kind == "mass":
            mass_kg += float(x[model.at[f"mistake {i}"]][0])
        if mistake.run == run and mistake.kind == "place":
            place = place + x[model.at[f"mistake {i}"]]
    return mass_kg, place


def _loads(model: LoadModel, at: Evaluated, p_flange_sensor_m: Array | None) -> list[Mapping[str, JSON]]:
    origin = np.zeros(3) if p_flange_sensor_m is None else np.asarray(p_flange_sensor_m)
    rows: list[Mapping[str, JSON]] = []
    for k, run in enumerate(model.runs):
        if run.load is None:
            continue
        mass_kg, place = _found_load(model, k)
        sigma = np.sqrt(np.diag(at.covariance)[model.at[f"load {model.load_of(k)}"]]).tolist()
        rows.append({
            "run": run.name, "name": run.load.name, "mass_kg": mass_kg, "mass_sigma_kg": sigma[0],
            "p_flange_m": (place + origin).tolist(), "p_sigma_m": sigma[1:],
        })  # fmt: skip
    return rows


def _load_findings(model: LoadModel, at: Evaluated) -> list[Finding]:
    findings = []
    touched: dict[int, list[int]] = {}
    for i, mistake in enumerate(model.mistakes):
        values, run = model.x[model.at[f"mistake {i}"]], model.runs[mistake.run]
        size = float(np.linalg.norm(values))
        sigma = np.sqrt(np.diag(at.covariance)[model.at[f"mistake {i}"]])
        name = "" if run.load is None else run.load.name
        if mistake.kind == "touched":
            touched.setdefault(mistake.run, []).append(mistake.pose + 1)
        elif mistake.kind == "bumped":
            force_N, torque_Nm = (float(np.linalg.norm(part)) for part in np.split(values, 2))
            findings.append(
                Finding.of("load_bias_stepped", run=run.name, pose=mistake.pose, force_N=force_N, torque_Nm=torque_Nm)
            )
        elif mistake.kind == "tool_mass":
            start = model.at["tool"].start
            found_kg, given_kg = float(model.x[start] + values[0]), float(model.expected[start])
            findings.append(
                Finding.of("load_tool_mass", found_kg=found_kg, sigma_kg=float(sigma[0]), given_kg=given_kg)
            )
        elif mistake.kind == "mass" and run.load is not None:
            findings.append(_mass_finding(name, _found_load(model, mistake.run)[0], float(sigma[0]), run.load.mass_kg))
        elif mistake.kind == "moved":
            findings.append(Finding.of("load_moved", name=name, moved_mm=1e3 * size, pose=mistake.pose))
        elif mistake.kind == "pulled":
            findings.append(Finding.of("load_pulled", name=name, force_N=size))
        elif run.load is not None and run.load.p_flange_m is not None:
            given = np.asarray(run.load.p_flange_m)
            found_mm, given_mm = (1e3 * (given + values)).round(1).tolist(), (1e3 * given).tolist()
            findings.append(
                Finding.of("load_place", name=name, found_mm=found_mm, given_mm=given_mm, off_mm=1e3 * size)
            )
    for run_row, poses in touched.items():
        findings.append(Finding.of("load_touched", run=model.runs[run_row].name, poses=sorted(poses)))
    return findings


def _mass_finding(name: str, found_kg: float, sigma_kg: float, given_kg: float) -> Finding:
    ratio = found_kg / given_kg
    if abs(ratio) < 0.05:
        return Finding.of("load_absent", name=name)
    for code, pounds in (("load_in_pounds", _POUND_KG), ("load_in_kilograms", 1 / _POUND_KG)):
        if abs(ratio / pounds - 1) < 0.03:
            return Finding.of(code, name=name, found_kg=found_kg, given_kg=given_kg)
    return Finding.of("load_mass", name=name, found_kg=found_kg, sigma_kg=sigma_kg, given_kg=given_kg)


def _swapped(begun: LoadModel, at: Evaluated) -> Finding | None:
    """Return a finding if swapping the declared positions of two loads explains the readings better."""
    rows = [k for k, run in enumerate(begun.runs) if run.load is not None and run.load.p_flange_m is not None]
    for a, b in combinations(rows, 2):
        first, second = (begun.at[f"load {begun.load_of(row)}"] for row in (a, b))
        exchanged = copy(begun)
        exchanged.x, exchanged.expected = begun.x.copy(), begun.expected.copy()
        for values in (exchanged.x, exchanged.expected):
            values[first][1:], values[second][1:] = values[second][1:].copy(), values[first][1:].copy()
        if at.cost - _fit_loads(exchanged, np.zeros(len(SIZES)))[2].cost > _CLEARLY:
            names = [load.name for row in (a, b) if (load := begun.runs[row].load) is not None]
            return Finding.of("loads_swapped", first=names[0], second=names[1])
    return None


def _accuracy_limits(model: LoadModel, prior: SensorMatrix, remaining: list[float]) -> list[Finding]:
    """Return findings for a nonlinear sensor, and for a matrix that contradicts its prior."""
    if model.mistakes:
        return []
    findings = []
    loaded = [share for run, share in zip(model.runs, remaining, strict=True) if run.load is not None]
    if (worst := max(loaded)) > _MOST_REMAINING:
        findings.append(Finding.of("sensor_not_linear", remaining_percent=100 * worst))
    change = (model.error - prior.error) / prior.sigma
    row, column = np.unravel_index(int(np.abs(change).argmax()), (6, 6))
    if (most := float(abs(change[row, column]))) > _MOST_CHANGE:
        findings.append(Finding.of("matrix_changed", sigmas=most, entry=f"{AXES[row]}{AXES[column]}"))
    return findings
