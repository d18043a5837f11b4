"""From the poses of a verification on disk to its outcome, and to an updated calibration.

verification.json   ftdrive.verification/1, in the run folder of the poses: calibration, limits, poses, outcome
calibration.json    in the same folder, if the operator accepted an update: its provenance names the parent
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.after.state import Update, apply_update
from ftcalib.after.verification import Verification, verify
from ftcalib.data.dataset import pooled_covariance
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import JSON, write_object
from ftcalib.model import Array
from ftcalib.routine import DriftCheck, PoseRecord, dataset_from, drift_check, is_return
from ftdrive.runs.run import Run, made_now
from ftdrive.runs.verification_record import FORMAT, fitted_dataset, marks_of

# Share of verifications of an unchanged cell that fail.
FALSE_ALARMS: Final = 0.01
# Parts of a calibration's provenance that an update keeps.
_COPIED: Final = ("devices", "station", "setup", "edited")


@dataclass(frozen=True, slots=True)
class AcceptanceLimits:
    """Largest differences that pass. If either is given, it decides instead of the predicted uncertainty."""

    force_N: float | None = None
    torque_Nm: float | None = None

    @property
    def given(self) -> bool:
        """Whether either limit is given."""
        return self.force_N is not None or self.torque_Nm is not None


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A verification run, compared with the calibration."""

    run: Run
    calibration: CalibrationResult
    calibration_path: Path
    limits: AcceptanceLimits
    dataset: CalibrationDataset
    records: tuple[PoseRecord, ...]
    """One for each row of the dataset."""
    verification: Verification
    drift: DriftCheck | None
    path: Path
    """verification.json"""

    @property
    def force_N(self) -> Array:
        """(n,) norm of the difference at each pose."""
        return np.asarray(np.linalg.norm(self.verification.residual[:, :3], axis=1))

    @property
    def torque_Nm(self) -> Array:
        """(n,) norm of the difference at each pose."""
        return np.asarray(np.linalg.norm(self.verification.residual[:, 3:], axis=1))

    @property
    def passed(self) -> bool:
        """Whether the calibration holds, by the limits given or by its predicted uncertainty."""
        if not self.limits.given:
            return bool(self.verification.passed)
        return not self.exceeded

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Limits that a pose exceeds, in words with the values."""
        pairs = (
            (self.force_N, self.limits.force_N, "--max-force", "N"),
            (self.torque_Nm, self.limits.torque_Nm, "--max-torque", "N·m"),
        )
        return tuple(
            f"{found.max():.3g} {unit} is above {option} {limit:g} {unit}"
            for found, limit, option, unit in pairs
            if limit is not None and found.max() > limit
        )

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of the calibration, and that of a verification in an emulated cell."""
        return marks_of(self.calibration, emulated=self.run.header().get("station") is not None)

    @property
    def update(self) -> Update | None:
        """The smallest sufficient update; None if the calibration holds, or if only a new calibration helps."""
        return self.verification.update

    @property
    def update_name(self) -> str | None:
        """What the update estimates, such as "bias", "payload" or "all"."""
        return None if self.update is None else self.update.kind

    def to_dict(self) -> dict[str, JSON]:
        """Return the content of verification.json."""
        found, header = self.verification, self.run.header()
        return {
            "format": FORMAT,
            "schema_version": 1,
            **made_now(),
            "run": self.run.folder.name,
            "marks": list(self.marks),
            "calibration": {
                "id": self.calibration.id,
                "path": str(self.calibration_path.absolute()),
                "created_utc": self.calibration.provenance.get("created_utc"),
            },
            "devices": header.get("devices", {}),
            "temperature_C": self.run.temperature_C(),
            "passed": self.passed,
            "change": found.change,
            "alternatives": list(found.alternatives),
            "reason": found.reason,
            "update": self.update_name,
            "limits": {
                "force_N": self.limits.force_N,
                "torque_Nm": self.limits.torque_Nm,
                "false_alarms": None if self.limits.given else FALSE_ALARMS,
            },
            "force_max_N": float(self.force_N.max()),
            "torque_max_Nm": float(self.torque_Nm.max()),
            "chi2": found.chi2,
            "dof": found.dof,
            "p_value": found.p_value,
            "bias_change": found.bias_change.to_dict(),
            "poses": [self._pose(row) for row in range(len(self.records))],
            "drift_check": None if self.drift is None else self.drift.to_dict(),
            "dataset_sha256": self.dataset.sha256(),
        }

    def _pose(self, row: int) -> dict[str, JSON]:
        record, measured = self.records[row], self.dataset.wrench[row]
        residual = self.verification.residual[row]
        return {
            "stop": record.stop,
            "number": record.pose.number,
            "q_rad": np.asarray(record.before.q_rad).tolist(),
            "R_base_flange": self.dataset.R_base_flange[row].tolist(),
            "measured": measured.tolist(),
            "predicted": (measured - residual).tolist(),
            "residual": residual.tolist(),
            "sigma": self.verification.predicted_sigma[row].tolist(),
            "steady": record.steady,
        }


def verify_run(run: Run, calibration: CalibrationResult, path: Path, limits: AcceptanceLimits) -> Verified:
    """Compare the poses of a run, read from its files, with a calibration; write dataset.json and verification.json.

    Parameters
    ----------
    path : Path
        File of the calibration.
    """
    records = run.records()
    dataset = dataset_from(records, {"run": run.folder.name, "devices": run.header().get("devices", {})})
    if dataset.wrench_cov is None:
        raise BadDataset(f"{run.folder} has no noise of its poses: repeat the verification")
    wrench_cov = pooled_covariance(dataset.wrench_cov, dataset.n_samples)
    fitted = fitted_dataset(calibration, path)
    found = verify(
        calibration, dataset.R_base_flange, dataset.wrench, wrench_cov, fitted=fitted, false_alarms=FALSE_ALARMS
    )
    kept = tuple(record for record in records if not is_return(record, records))
    file = run.new_path("verification")
    verified = Verified(run, calibration, path, limits, dataset, kept, found, drift_check(records), file)
    dataset.save(run.new_path("dataset"))
    write_object(file, verified.to_dict())
    return verified


def save_update(verified: Verified) -> Path:
    """Save the update as a new calibration in the run folder of the verification; its provenance names the parent.

    Raises
    ------
    NotObservable
        The verification has no update.
    """
    if verified.update is None:
        raise NotObservable("no update makes up for the change: calibrate again")
    old, run = verified.calibration, verified.run
    provenance = {
        **made_now(),
        **{key: old.provenance[key] for key in _COPIED if key in old.provenance},
        "run": run.folder.name,
        "temperature_C": run.temperature_C(),
        "dataset_sha256": verified.dataset.sha256(),
        "verification": verified.path.name,
        "parent": {"path": str(verified.calibration_path.absolute())},
    }
    path = run.new_path("calibration")
    apply_update(old, verified.update, provenance).save(path)
    return path
