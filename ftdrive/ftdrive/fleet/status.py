"""The state of each cell: its newest calibrations, when they are to be verified, and whether their bias drifts."""

from datetime import datetime, timedelta
from typing import Final

import numpy as np

from ftcalib.after.series import drift_onset
from ftdrive.fleet.cells import BiasChanges, Observed, when
from ftdrive.fleet.findings import findings
from ftdrive.fleet.state import BiasDrift, CellState, Fleet
from ftdrive.report.document import rounded
from ftdrive.runs.verification_record import VerificationRecord
from ftdrive.store.records import BriefVerification, StoredCell, StoredResult
from ftdrive.store.store import Store

# The level of a drift is the mean of the verifications of the last week.
LEVEL_DAYS: Final = 7.0
COMPONENTS: Final = tuple(f"{name} bias {axis}" for name in ("force", "torque") for axis in "xyz")


def fleet_state(store: Store, now: datetime) -> Fleet:
    """Return the state of all cells of a store, and what they show together.

    Raises
    ------
    BadStore
        The store cannot be read.
    """
    return fleet_of(Observed.read(store, now), store)


def fleet_of(observed: Observed, store: Store) -> Fleet:
    """Return the state of what was read; the store is asked for verifications older than that."""
    states = list[CellState]()
    for cell in observed.cells:
        found = [_state(cell, one, observed, store) for one in observed.newest(cell)]
        if not found or cell.tool not in {None, *(one.tool for one in found)}:
            found.append(CellState(cell.name, cell.tool, cell.arm_serial))
        states += sorted(found, key=lambda one: one.tool or "")
    return Fleet(tuple(states), findings(observed, states))


def _drift_of(changes: BiasChanges | None, start: datetime) -> BiasDrift | None:
    """Return the drift of a bias since its calibration at `start`; None with too few verifications."""
    if changes is None:
        return None
    onset = drift_onset(changes.t_days, changes.change, changes.sigma, changes.calibration_sigma)
    if onset is None:
        return None
    lately = changes.t_days > changes.t_days[-1] - LEVEL_DAYS
    level = float(np.abs(changes.in_sigmas[lately].mean(axis=0)).max())
    if not onset.found.any():
        return BiasDrift(level, found=False, words="")
    k = int(onset.p_value.argmin())
    rate, unit = 7 * float(onset.slope[k]), "N" if k < 3 else "N·m"
    since = start + timedelta(days=float(onset.t0_days[k]))
    others = int(onset.found.sum()) - 1
    more = f", and {others} more {'component' if others == 1 else 'components'}" if others else ""
    sign = "-" if rate < 0 else ""
    words = f"{COMPONENTS[k]} drifts by {sign}{rounded(abs(rate), 2)} {unit} a week since {since:%Y-%m-%d}{more}"
    return BiasDrift(level, found=True, words=words)


def _state(cell: StoredCell, result: StoredResult, observed: Observed, store: Store) -> CellState:
    calibrated = when(result)
    check: BriefVerification | VerificationRecord | None = next(reversed(observed.checks.get(result.id, ())), None)
    if check is None and observed.is_cut(result):
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
        temperature_C=next((one for one in temperatures if one is not None), None),
        drift=_drift_of(observed.changes.get(result.id), calibrated),
        weighings=observed.weighings.get((cell.name, result.tool, result.emulated)),
        emulated=result.emulated,
    )
