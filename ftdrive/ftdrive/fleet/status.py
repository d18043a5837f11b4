"""The state of each cell from its newest calibrations and verifications, and findings across cells.

The findings are wrong payloads, moved bases, late verifications, refused weighings, and biases that depend on the
temperature. In the verifications of one calibration, the model of a bias component is d = a + b t + c T + e, with
sensor temperature T; the time t absorbs seasons and drift. All calibrations of one sensor have the same c.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from ftcalib.after.series import drift_onset, spans_temperature
from ftcalib.model import Array, angle_between_vectors, skew
from ftcalib.rounding import to_place_of
from ftdrive.fleet.cells import WINDOW, Changes, Observed, when
from ftdrive.fleet.state import BiasDrift, CellState, Fleet, FleetFinding, join_names
from ftdrive.runs.verification import VerificationRecord
from ftdrive.store.records import StoredCell, StoredResult
from ftdrive.store.store import Store

# The level of a drift is the mean over the verifications of the last week.
LEVEL_DAYS: Final = 7.0
COMPONENTS: Final = tuple(f"{name} bias {axis}" for name in ("force", "torque") for axis in "xyz")


def fleet_state(store: Store, now: datetime) -> Fleet:
    """Return the states of a store's cells, and findings across them; raises `BadStore` if it cannot be read."""
    return fleet_of(Observed.read(store, now), store)


def fleet_of(observed: Observed, store: Store) -> Fleet:
    """Return the states and findings from the contents of a store, which is queried again for older verifications."""
    states = list[CellState]()
    for cell in observed.cells:
        found = [_cell_state(cell, result, observed, store) for result in observed.newest(cell)]
        if not found or cell.tool not in {None, *(state.tool for state in found)}:
            found.append(CellState(cell.name, cell.tool, cell.arm_serial))
        states += sorted(found, key=lambda state: state.tool or "")
    return Fleet(tuple(states), _fleet_findings(observed, states))


def _drift_of(changes: Changes | None, start: datetime) -> BiasDrift | None:
    """Return the drift of the bias since its calibration at `start`; None with too few verifications."""
    if changes is None:
        return None
    t_days, change, sigma = changes["t_days"], changes["change"], changes["sigma"]
    onset = drift_onset(t_days, change, sigma, np.median(changes["calibration_sigma"], axis=0))
    if onset is None:
        return None
    lately = t_days > t_days[-1] - LEVEL_DAYS
    level = float(np.abs((change / sigma)[lately].mean(axis=0)).max())
    if not onset.found.any():
        return BiasDrift(level, found=False, words="")
    k = int(onset.p_value.argmin())
    rate, unit = 7 * float(onset.slope[k]), "N" if k < 3 else "N·m"
    since = start + timedelta(days=float(onset.t0_days[k]))
    others = int(onset.found.sum()) - 1
    more = f", and {others} more {'component' if others == 1 else 'components'}" if others else ""
    size = to_place_of(rate, abs(rate))
    words = f"{COMPONENTS[k]} drifts by {size} {unit} per week since {since:%Y-%m-%d}{more}"
    return BiasDrift(level, found=True, words=words)


def _cell_state(cell: StoredCell, result: StoredResult, observed: Observed, store: Store) -> CellState:
    calibrated = when(result)
    check: VerificationRecord | None = next(reversed(observed.checks.get(result.id, ())), None)
    if check is None and calibrated < observed.now - WINDOW:  # its verifications may be older than those already read
        check = store.last_verification(result.id)
    verified = None if check is None or check.created_utc is None else when(check)
    temperatures = (None if check is None else check.temperature_C, result.temperature_C)
    return CellState(
        cell=cell.name,
        tool=result.tool,
        arm_serial=result.arm_serial,
        sensor_serial=result.sensor_serial,
        sensor_model=result.sensor_model,
        calibration_id=result.id,
        verdict=result.verdict,
        calibrated=calibrated,
        verified=verified,
        passed=None if check is None else check.passed,
        change=None if check is None else check.change,
        due=max(calibrated, verified or calibrated) + timedelta(days=cell.verify_every_days),
        mass_kg=result.mass_kg,
        temperature_C=next((value for value in temperatures if value is not None), None),
        drift=_drift_of(observed.changes.get(result.id), calibrated),
        weighings=observed.weighings.get((cell.name, result.tool, result.emulated)),
        emulated=result.emulated,
    )


SIGMAS: Final = 4.0
# Centres of mass of one tool agree within the first distance, and that of a payload is wrong beyond the second.
# A limit smaller than 4 sigma is replaced by 4 sigma.
ALIKE_M, WRONG_M = 0.003, 0.005
# The same limits for masses, as fractions of the mass; one is wrong beyond the larger of `WRONG_SHARE` and `WRONG_KG`.
ALIKE_SHARE, WRONG_SHARE, WRONG_KG = 0.03, 0.1, 0.1
# Assumed upper bound on the mass of sensor and adapter, which the payload includes but the identified mass does not.
MOST_SENSOR_KG: Final = 1.0
TILTED_RAD: Final = np.deg2rad(0.1)
# Added to the sigma of a tilt, because the arm bends differently in each posture.
TILT_FLOOR_RAD: Final = np.deg2rad(0.02)
# Significance level for a turned base: a false finding in one of 50 fleets of 200 cells.
SURE: Final = 1e-4
# A verification counts as late this long after it was due.
LATE: Final = timedelta(days=1)
# A finding about refused weighings needs at least this many weighings in a day.
MANY_WEIGHINGS: Final = 10
# Refused weighings older than this are not reported.
RECENT: Final = timedelta(days=3)


def _fleet_findings(observed: Observed, states: Sequence[CellState]) -> tuple[FleetFinding, ...]:
    newest = [(cell.name, result) for cell in observed.cells for result in observed.newest(cell)]
    return (
        *_overdue(states, observed),
        *_bases(observed),
        *_payloads(newest),
        *_temperature_findings(observed),
        *_refused_weighings(states, observed),
    )


# ------------------------------------------------------------------------------------------------------------ schedule


def _overdue(states: Sequence[CellState], observed: Observed) -> Iterator[FleetFinding]:
    late = [(state.due, state.cell) for state in states if state.due is not None and state.due + LATE < observed.now]
    if late:
        due, worst = min(late)
        cells = tuple(sorted({cell for _, cell in late}))
        days = (observed.now - due).days
        what = f"The verification of {worst} is {days} d late"
        if len(cells) > 1:
            what = f"The verifications of {join_names(cells)} are late, that of {worst} by {days} d"
        yield FleetFinding("overdue", cells, f"{what}: run `ftdrive fleet verify --due`")


# ----------------------------------------------------------------------------------------------------------- weighings


def _refused_weighings(states: Sequence[CellState], observed: Observed) -> Iterator[FleetFinding]:
    """Yield findings about cells that refused most weighings of their last day."""
    first = (observed.now - RECENT).date().isoformat()
    for state in states:
        if state.weighings is None or state.weighings.day < first:
            continue
        refused = sum(state.weighings.refusals.values())
        tried = refused + state.weighings.weighings
        if tried >= MANY_WEIGHINGS and 2 * refused > tried:
            code = max(state.weighings.refusals.items(), key=lambda item: item[1])[0]
            yield FleetFinding(
                "weighing",
                (state.cell,),
                f"{state.cell}: {refused} of {tried} weighings with {state.tool or 'its tool'} were refused on "
                f"{state.weighings.day}, mostly because of '{code}': run `ftdrive weigh` at this cell to see why",
            )


# ---------------------------------------------------------------------------------------------------------------- base


def _bases(observed: Observed) -> Iterator[FleetFinding]:
    """Yield findings about bases turned between the last two calibrations; updates copy gravity and are skipped."""
    for name, results in observed.results.items():
        seen = list[StoredResult]()
        for result in reversed(results):
            if not seen or _turned(result, seen[0])[0] > 1e-9:
                seen.append(result)
            if len(seen) == 2:
                angle, p_value = _turned(*reversed(seen))
                if angle > TILTED_RAD and p_value < SURE:
                    yield FleetFinding(
                        "base",
                        (name,),
                        f"{name}: gravity has turned by {np.rad2deg(angle):.2f}° in the base between the calibrations "
                        f"of {when(result):%Y-%m-%d} and {when(seen[0]):%Y-%m-%d}: check the bolts and the frame under "
                        "the base, then calibrate the other tools of the cell again",
                    )
                break


def _turned(before: StoredResult, after: StoredResult) -> tuple[float, float]:
    """Return the angle between the gravity directions of two results, rad, and its p-value if the base is fixed."""
    weights = [result.parameters.weight_N for result in (before, after)]
    if not min(weights) > 0:
        return 0.0, 1.0
    old, new = before.parameters.down, after.parameters.down
    angle = angle_between_vectors(old, new)
    if angle <= TILTED_RAD:
        return angle, 1.0
    across = np.linalg.svd(skew(old))[0][:, :2]  # (3, 2)
    covariance = TILT_FLOOR_RAD**2 * np.eye(2)
    for result, weight in zip((before, after), weights, strict=True):
        covariance += across.T @ result.covariance[3:6, 3:6] @ across / weight**2
    change = across.T @ (new - old)
    return angle, float(chi2_sf(2, change @ np.linalg.solve(covariance, change)))


# ------------------------------------------------------------------------------------------------------------- payload


@dataclass(frozen=True, slots=True, eq=False)
class _Load:
    """A tool as identified in one cell, with the payload of its controller."""

    cell: str
    mass_kg: float
    mass_sigma_kg: float
    # (2,) offset of the tool's identified centre of mass from the flange axis, flange axes.
    off_axis_m: Array
    off_axis_sigma_m: Array
    payload_kg: float
    # (2,) centre of mass of the tool that the payload implies, if sensor and adapter are centred on the flange axis.
    configured_off_axis_m: Array | None


def _payloads(newest: Sequence[tuple[str, StoredResult]]) -> Iterator[FleetFinding]:
    """Yield findings about tools on which several cells agree, but whose payloads have another mass or centre."""
    tools = dict[str, list[_Load]]()
    for cell, result in newest:
        if result.tool is not None and result.payload_kg is not None and result.mass_kg > 0:
            tools.setdefault(result.tool, []).append(_tool_load(cell, result, result.payload_kg))
    for tool, loads in tools.items():
        if len(loads) > 1:
            yield from _centre(tool, loads)
            yield from _mass_findings(tool, loads)


def _tool_load(cell: str, result: StoredResult, payload_kg: float) -> _Load:
    """Return a tool with its payload; centred sensors and adapters do not change the moment about the flange axis."""
    R, covariance = result.parameters.R_flange_sensor, result.covariance
    arm_m = R @ result.parameters.p_sensor_com_m
    J = np.concatenate([-skew(arm_m), R], axis=1)  # derivative with respect to rotation and centre
    rows = np.r_[0:3, 9:12]
    sigma = np.sqrt(np.diag(J @ covariance[np.ix_(rows, rows)] @ J.T))
    com = result.payload_com_m
    configured = None if com is None else np.array(com[:2]) * payload_kg / result.mass_kg
    return _Load(cell, result.mass_kg, result.mass_sigma_kg, arm_m[:2], sigma[:2], payload_kg, configured)


def _centre(tool: str, loads: Sequence[_Load]) -> Iterator[FleetFinding]:
    centre = np.median([load.off_axis_m for load in loads], axis=0)
    alike = [load for load in loads if (abs(load.off_axis_m - centre) <= _either(ALIKE_M, load.off_axis_sigma_m)).all()]
    wrong = [
        load
        for load in alike
        if load.configured_off_axis_m is not None
        and (abs(load.configured_off_axis_m - load.off_axis_m) > _either(WRONG_M, load.off_axis_sigma_m)).any()
    ]
    yield from _wrong_payloads(
        wrong,
        lambda first, cells: (
            f"The tool {tool} has its centre of mass {_mm(centre)} mm off the flange axis, according to {cells}. "
            f"The payloads of their controllers imply other centres, such as {_mm(first.configured_off_axis_m)} mm"
        ),
    )


def _mass_findings(tool: str, loads: Sequence[_Load]) -> Iterator[FleetFinding]:
    mass_kg = float(np.median([load.mass_kg for load in loads]))
    wrong = []
    for load in loads:
        margin_kg = max(WRONG_KG, WRONG_SHARE * load.mass_kg, SIGMAS * load.mass_sigma_kg)
        above_kg = load.payload_kg - load.mass_kg
        alike = abs(load.mass_kg - mass_kg) <= max(ALIKE_SHARE * mass_kg, SIGMAS * load.mass_sigma_kg)
        if alike and not -margin_kg <= above_kg <= MOST_SENSOR_KG + margin_kg:
            wrong.append(load)
    yield from _wrong_payloads(
        wrong,
        lambda first, cells: (
            f"The tool {tool} weighs {mass_kg:.2f} kg without sensor and adapter, according to {cells}. "
            f"The payloads of their controllers disagree, such as {first.payload_kg:.2f} kg"
        ),
    )


def _wrong_payloads(wrong: Iterable[_Load], words: Callable[[_Load, str], str]) -> Iterator[FleetFinding]:
    """Yield a finding about two or more loads; `words` describes the first one and the names of all cells."""
    # A single wrong payload is a finding of its own calibration.
    loads = sorted(wrong, key=lambda load: load.cell)
    if len(loads) > 1:
        cells, first = tuple(load.cell for load in loads), loads[0]
        fix = "set the payloads with `ftdrive push`"
        yield FleetFinding("payload", cells, f"{words(first, join_names(cells))} in {first.cell}: {fix}")


def _either(least: float, sigma: Array) -> Array:
    return np.maximum(least, SIGMAS * sigma)


def _mm(point_m: Array | None) -> str:
    return "-" if point_m is None else "(" + ", ".join(f"{1e3 * value + 0.0:.0f}" for value in point_m) + ")"


# Significance level per component and sensor: in one of 80 fleets of 200 sensors, one sensor exceeds it by chance, and
# a finding needs two sensors.
SURE_OF_TEMPERATURE: Final = 1e-5
# A calibration counts for findings on temperature if it has at least this many verifications.
FEWEST: Final = 8


@dataclass(slots=True, eq=False)
class _SensorSums:
    """Sums (6,) for the regression of one sensor's bias on temperature, over its calibrations, and its cells."""

    cells: set[str]
    xx: Array
    xy: Array
    yy: Array
    dof: int = 0


def _temperature_findings(observed: Observed) -> Iterator[FleetFinding]:
    """Yield a finding per sensor model of which two or more sensors have a bias that depends on temperature."""
    models = dict[str, dict[str, _SensorSums]]()
    for cell in observed.cells:
        for result in observed.results[cell.name]:
            changes = observed.changes.get(result.id)
            if changes is not None and result.sensor_model and result.sensor_serial:
                _add(models.setdefault(result.sensor_model, {}), result.sensor_serial, cell.name, changes)
    for model, sensors in sorted(models.items()):
        yield from _finding(model, sensors)


def _add(sensors: dict[str, _SensorSums], serial: str, cell: str, changes: Changes) -> None:
    changes = changes[np.isfinite(changes["temperature_C"])]
    T = changes["temperature_C"]
    if not spans_temperature(T, FEWEST):
        return
    sums = sensors.setdefault(serial, _SensorSums(set(), np.zeros(6), np.zeros(6), np.zeros(6)))
    sums.cells.add(cell)
    sums.dof += len(T) - 3
    weight = 1 / changes["sigma"].T  # (6, n)
    base = np.stack([np.ones_like(T), changes["t_days"] - changes["t_days"].mean()], axis=1)
    Q, _ = np.linalg.qr(weight[..., None] * base)  # (6, n, 2)
    x, y = (
        part - (Q @ (Q.swapaxes(1, 2) @ part[..., None]))[..., 0] for part in (weight * T, weight * changes["change"].T)
    )
    sums.xx += np.sum(x * x, axis=1)
    sums.xy += np.sum(x * y, axis=1)
    sums.yy += np.sum(y * y, axis=1)


def _finding(model: str, sensors: Mapping[str, _SensorSums]) -> Iterator[FleetFinding]:
    following = {
        serial: sums for serial, sums in sorted(sensors.items()) if _p_values(sums).min() < SURE_OF_TEMPERATURE
    }
    if len(following) < 2:
        return
    cells = tuple(sorted({cell for sums in following.values() for cell in sums.cells}))
    slopes = np.max(
        [np.where(_p_values(one) < SURE_OF_TEMPERATURE, abs(one.xy / one.xx), 0.0) for one in following.values()],
        axis=0,
    )
    largest = (slopes[:3].max(), "N"), (slopes[3:].max(), "N·m")
    size = " and ".join(f"{to_place_of(slope, float(slope))} {unit}" for slope, unit in largest if slope)
    yield FleetFinding(
        "temperature",
        cells,
        f"The bias of {len(following)} of {len(sensors)} sensors {model} depends on their temperature, by up to "
        f"{size} per kelvin (in {join_names(cells)}): let them warm up before a calibration, and tare them at "
        "their working temperature",
    )


def _p_values(sums: _SensorSums) -> Array:
    """Return p-values (6,), for no effect of temperature on a bias component: the larger of a chi² and an F-test."""
    usable = sums.xx > 0
    chi2 = np.where(usable, sums.xy**2 / np.where(usable, sums.xx, 1.0), 0.0)
    rest = np.maximum(sums.yy - chi2, 1e-12) / sums.dof
    return np.maximum(chi2_sf(1, chi2), f_sf(1, sums.dof, chi2 / rest))
