"""Cells, results and verifications of a fleet as the store has them, without files."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import numpy as np

from ftcalib.model import Array
from ftdrive.fleet.state import Fleet
from ftdrive.fleet.status import fleet_state
from ftdrive.runs.verification import VerificationRecord, newest
from ftdrive.runs.weighings import REFUSALS, WeighingDay, sum_up
from ftdrive.store.records import StoredCell, StoredResult
from ftdrive.store.store import Store
from tests.unit.ftdrive.stream.simulated import calibrated

NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)
SIGMA = np.repeat([0.01, 0.0005], 3)
"""Of the bias by one verification."""
FIELDS = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")


def cell(name: str, **more: Any) -> StoredCell:
    about = {"arm_serial": None, "robot_host": f"host-{name}", "sensor_url": "ati-can://can0", "tool": "gripper"}
    return StoredCell(**{"name": name, "config": f"/cells/{name}.toml", "verify_every_days": 7.0, **about, **more})


def result(name: str, days_ago: float, *, step: Array | None = None, **more: Any) -> StoredResult:
    """A calibration of the cell `name`; `step` (15,) moves its numbers."""
    parameters = calibrated().parameters.moved(np.zeros(15) if step is None else step)
    numbers = {key: getattr(parameters, key).tolist() for key in FIELDS}
    id_ = f"{name}-{days_ago:g}"
    values = {
        "id": id_,
        "path": f"/runs/{id_}/calibration.json",
        "run": id_,
        "created_utc": time(days_ago),
        "tool": "gripper",
        "arm_serial": f"arm-{name}",
        "arm_model": "UR5e",
        "sensor_serial": f"ft-{name}",
        "sensor_model": "Mini45",
        "robot_host": f"host-{name}",
        "mount": None,
        "verdict": "good",
        "n_poses": 24,
        "mass_kg": float(np.linalg.norm(parameters.gravity_force_base_N)) / 9.80665,
        "g_m_s2": 9.80665,
        "numbers": numbers | {"covariance": calibrated().covariance.tolist()},
        "dataset_sha256": None,
        "parent": None,
        "update": None,
        "temperature_C": None,
        "payload_kg": None,
        "payload_com_m": None,
    }
    return StoredResult(**(values | more))


def check(of: StoredResult, days_ago: float, *, passed: bool = True, **more: Any) -> VerificationRecord:
    id_ = f"{of.id}-verified-{days_ago:g}"
    values = {
        "id": id_,
        "path": f"/runs/{id_}/verification.json",
        "calibration_id": of.id,
        "created_utc": time(days_ago),
        "passed": passed,
        "change": None if passed else "bias",
        "reason": None,
        "temperature_C": None,
        "bias_change": None,
        "bias_change_sigma": SIGMA.tolist(),
        "calibration_sigma": (SIGMA / 2).tolist(),
    }
    return VerificationRecord(**(values | more))


def daily(of: StoredResult, days: int, seed: int = 0, added: Array | None = None, **more: Any) -> list[Any]:
    """Verifications of the last days; `added` (days, 6) in sigmas is put on the noise."""
    values = np.random.default_rng(seed).normal(size=(days, 6)) + (0.0 if added is None else added)
    return [check(of, days - 1 - i, bias_change=(SIGMA * row).tolist(), **more) for i, row in enumerate(values)]


def weighed(name: str, days_ago: float, **more: Any) -> WeighingDay:
    """The last weighing of the cell `name`."""
    at = time(days_ago)
    values: dict[str, Any] = {
        "id": f"weighings-{name}-{days_ago:g}",
        "path": f"/weighings/{name}-{days_ago:g}.ndjson",
        "tool": "gripper",
        "arm_serial": f"arm-{name}",
        "sensor_serial": f"ft-{name}",
        "robot_host": f"host-{name}",
        "calibration_id": f"{name}-1",
        "emulated": False,
        "size": 1000,
        "day": at[:10],
        "weighings": 7,
        "refusals": dict.fromkeys(REFUSALS, 0) | {"cable": 2},
        "last_utc": at,
        "mass_kg": 0.25,
        "mass_sigma_kg": 1e-3,
    }
    return WeighingDay(**(values | more))


def time(days_ago: float) -> str:
    return (NOW - timedelta(days=days_ago)).isoformat(timespec="microseconds")


@dataclass
class FakeStore:
    """The reading half of a store."""

    kept_cells: Sequence[StoredCell] = ()
    kept_results: Sequence[StoredResult] = ()
    kept_checks: Sequence[VerificationRecord] = field(default_factory=list)
    kept_weighings: Sequence[WeighingDay] = ()

    def cells(self) -> list[StoredCell]:
        return sorted(self.kept_cells, key=lambda one: one.name)

    def fleet(
        self, newest: int, since: datetime
    ) -> tuple[list[StoredCell], list[StoredResult], list[VerificationRecord], list[WeighingDay]]:
        return self.cells(), self._newest_accepted(newest), self._checks(since), sum_up(self.kept_weighings)

    def _newest_accepted(self, most: int) -> list[StoredResult]:
        found = sorted(self.kept_results, key=lambda one: (one.created_utc or "", one.id), reverse=True)
        count = Counter[tuple[str | None, ...]]()
        kept = []
        for one in found:
            key = (one.arm_serial, one.robot_host, one.tool)
            if one.verdict != "rejected" and one.created_utc is not None and count[key] < most:
                count[key] += 1
                kept.append(one)
        return kept[::-1]

    def _checks(self, since: datetime) -> list[VerificationRecord]:
        start = since.isoformat(timespec="microseconds")
        found = [one for one in self.kept_checks if (one.created_utc or "") >= start]
        return sorted(found, key=lambda one: (one.created_utc or "", one.id))

    def last_verification(self, calibration_id: str) -> VerificationRecord | None:
        found = [one for one in self.kept_checks if one.calibration_id == calibration_id]
        return newest(found)


def store(
    cells: Sequence[StoredCell],
    results: Sequence[StoredResult],
    checks: Sequence[Any] = (),
    weighings: Sequence[WeighingDay] = (),
) -> Store:
    return cast("Store", FakeStore(cells, results, checks, weighings))


def fleet(
    cells: Sequence[StoredCell],
    results: Sequence[StoredResult],
    checks: Sequence[Any] = (),
    weighings: Sequence[WeighingDay] = (),
) -> Fleet:
    return fleet_state(store(cells, results, checks, weighings), NOW)
