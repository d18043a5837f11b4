"""Verifications: the outcome of a run, its file, and the search for the last verification of a calibration.

verification.json   ftdrive.verification/1, in the run folder of the poses: calibration, limits, poses, outcome
calibration.json    in the same folder, if the operator accepted an update; its provenance names the parent

The id links a verification to its calibration, regardless of paths. `verification_near` searches the run folders
next to that of the calibration, those in `runs` next to the calibration file, and those in `runs` of the current
folder.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import ftcalib
from ftcalib.errors import BadCalibration, BadDataset, NotObservable
from ftcalib.files import JSON, check_format, object_of, read_file, write_object
from ftdrive.runs.calibration import at, made_now, marks_of, number_at, numbers_at, text_at, time_at

# Only for type checkers: listing results must not import numpy, which takes long.
if TYPE_CHECKING:
    from ftcalib import CalibrationDataset, CalibrationResult
    from ftcalib.after.state import Update
    from ftcalib.after.verification import Verification
    from ftcalib.model import Array
    from ftcalib.routine import DriftCheck, PoseRecord
    from ftdrive.runs.run import Run

FORMAT: Final = "ftdrive.verification/1"
# Limits of the differences in force, N, and torque, N·m; None is no limit. If given, they replace the statistical test.
Limits = tuple[float | None, float | None]
NO_LIMITS: Final = None, None
# False-alarm rate: share of the verifications of an unchanged cell that fail.
FALSE_ALARMS: Final = 0.01
# A recording stores this number of fields of a `VerificationRecord`, the first ones.
_RECORDED: Final = 8
# Fields that an update copies from the provenance of the updated calibration.
_COPIED: Final = ("devices", "station", "setup", "edited")


class VerificationRecord(NamedTuple):
    """Outcome of a verification; a tuple for speed, because a fleet's store reads 20,000 of them per minute."""

    path: str
    """Path of verification.json in its run folder."""
    calibration_id: str
    created_utc: str | None
    """Time of the verification, UTC, ISO 8601 with microseconds (sorts as text); None if the file has no time."""
    passed: bool
    change: str | None
    """Change since the calibration that explains the readings, such as "bias"; None if there is none or none fits."""
    reason: str | None
    """Why the verification failed; None if it passed."""
    force_max_N: float | None = None
    torque_max_Nm: float | None = None
    """Largest differences between measured and predicted force and torque; the store does not have them."""
    id: str = ""
    """First 12 hex digits of the SHA-256 of verification.json; a recording stores neither this nor later fields."""
    temperature_C: float | None = None
    bias_change: Sequence[float] | None = None
    """(6,) estimated change of the bias since the calibration, N and N·m, sensor axes; None if not estimated."""
    bias_change_sigma: Sequence[float] | None = None
    """(6,) standard deviation of `bias_change` due to the noise of this verification's readings."""
    calibration_sigma: Sequence[float] | None = None
    """(6,) standard deviation of `bias_change` due to the calibration, common to all verifications of it."""

    @property
    def run(self) -> str:
        """Name of the run folder of the verification."""
        return Path(self.path).parent.name

    @property
    def shows_bias(self) -> bool:
        """Whether `bias_change` is valid, because no other change and no contact was found."""
        return self.passed or self.change == "bias"

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a verification.json, ignoring unknown fields. Raises `BadCalibration` if it is damaged."""
        content = read_file(path)
        document = object_of(content, BadCalibration)
        check_format(document, FORMAT, BadCalibration)
        bias = (numbers_at(document, 6, "bias_change", name) for name in ("value", "sigma", "calibration_sigma"))
        record = cls.from_dict({**document, "path": str(path), "calibration_id": at(document, "calibration", "id")})
        digest, temperature_C = hashlib.sha256(content).hexdigest(), number_at(document, "temperature_C")
        return cls(*record[:_RECORDED], digest[:12], temperature_C, *bias)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Build the record from the fields in a recording. Raises `BadCalibration` if the id or outcome is missing."""
        path, calibration_id = str(document.get("path")), text_at(document, "calibration_id")
        largest = number_at(document, "force_max_N"), number_at(document, "torque_max_Nm")
        passed = document.get("passed")
        if calibration_id is None or not isinstance(passed, bool) or None in largest:
            raise BadCalibration(
                f"{Path(path).name} lacks the calibration id or the outcome, so it is damaged: restore it from a copy"
            )
        made, change = time_at(document, "created_utc"), text_at(document, "change")
        return cls(path, calibration_id, made, passed, change, text_at(document, "reason"), *largest)

    def to_dict(self, names: Sequence[str] = ()) -> dict[str, Any]:
        """Return the named fields as JSON, by default those that recordings store; `run` is also a name."""
        values = {**self._asdict(), "run": self.run}
        return {name: values[name] for name in names or self._fields[:_RECORDED]}

    def in_words(self, now: datetime | None) -> str:
        """Describe the outcome and its age, such as "verified 2 h ago"; the age is taken as 0 if `now` is None."""
        made = self.created_utc
        age = timedelta(0) if now is None or made is None else now - datetime.fromisoformat(made)
        if self.passed:
            return f"verified {age_in_words(age)} ago"
        return f"VERIFICATION FAILED {age_in_words(age)} ago" + (f" ({self.change})" if self.change else "")


def verification_near(place: Path, calibration_id: str) -> VerificationRecord | None:
    """Return a calibration's newest verification, searched near its file or run folder `place`; None if none exists."""
    # Search other run folders by id, because a verification adds no file to the calibration's own run folder.
    folder, records = place.absolute() if place.is_dir() else place.absolute().parent, list[VerificationRecord]()
    for parent in dict.fromkeys((folder.parent, folder / "runs", Path("runs").absolute())):
        for file in sorted(parent.glob("*/verification*.json")):
            with suppress(BadCalibration, OSError):
                records.append(VerificationRecord.load(file))
    return newest(record for record in records if record.calibration_id == calibration_id)


def newest(records: Iterable[VerificationRecord]) -> VerificationRecord | None:
    """Return the newest of some verifications; None if none of them has a time."""
    timed = (record for record in records if record.created_utc is not None)
    return max(timed, key=lambda record: record.created_utc or "", default=None)


def fitted_dataset(calibration: "CalibrationResult", place: Path) -> "CalibrationDataset | None":
    """Return the dataset from which a calibration was solved, from the folder of its file; None if it is not there."""
    for path in sorted((place if place.is_dir() else place.parent).glob("dataset*.json")):
        with suppress(BadDataset, OSError):
            dataset = ftcalib.CalibrationDataset.load(path)
            if dataset.sha256() == calibration.provenance.get("dataset_sha256"):
                return dataset
    return None


def age_in_words(age: timedelta) -> str:
    """Return an age as text in minutes, hours or days, such as "3 h"."""
    hours = max(0.0, age.total_seconds()) / 3600
    return f"{hours * 60:.0f} min" if hours < 1 else f"{hours:.0f} h" if hours < 48 else f"{hours / 24:.0f} d"


def age_and_check(calibration: "CalibrationResult", last: VerificationRecord | None, now: datetime) -> str:
    """Describe the age of a calibration, if its time is known, and its last verification."""
    created = calibration.provenance.get("created_utc")
    age = f"{age_in_words(now - datetime.fromisoformat(created))} old, " if isinstance(created, str) else ""
    return age + ("not verified" if last is None else last.in_words(now))


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A run of `ftdrive verify`, and the comparison of its poses with the calibration."""

    run: "Run"
    calibration: "CalibrationResult"
    calibration_path: Path
    limits: Limits
    dataset: "CalibrationDataset"
    records: "tuple[PoseRecord, ...]"
    """The poses with their samples, one per row of the dataset."""
    verification: "Verification"
    drift: "DriftCheck | None"
    path: Path
    """Path of verification.json."""

    @property
    def force_N(self) -> "Array":
        """(n,) norm of the difference between measured and predicted force at each pose."""
        return self._differences(slice(3))

    @property
    def torque_Nm(self) -> "Array":
        """(n,) norm of the difference between measured and predicted torque at each pose."""
        return self._differences(slice(3, 6))

    def _differences(self, axes: slice) -> "Array":
        import numpy as np

        return np.asarray(np.linalg.norm(self.verification.residual[:, axes], axis=1))

    @property
    def passed(self) -> bool:
        """Whether the calibration is still valid, according to the given limits or else to the statistical test."""
        return bool(self.verification.passed) if self.limits == NO_LIMITS else not self.exceeded

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Texts about the limits on the command line that the largest difference exceeds, with the values."""
        largest = (self.force_N, "--max-force", "N"), (self.torque_Nm, "--max-torque", "N·m")
        return tuple(
            f"{sizes.max():.3g} {unit} is above {option} {limit:g} {unit}"
            for (sizes, option, unit), limit in zip(largest, self.limits, strict=True)
            if limit is not None and sizes.max() > limit
        )

    @property
    def failure(self) -> str:
        """Why the verification failed; empty if it passed."""
        return self.verification.reason if self.limits == NO_LIMITS else "; ".join(self.exceeded)

    @property
    def marks(self) -> tuple[str, ...]:
        """Warning marks of the calibration, see `MARKS`, including that of a run in an emulated cell."""
        return marks_of(self.calibration, emulated=self.run.header().get("station") is not None)

    @property
    def update(self) -> "Update | None":
        """Smallest update of the calibration that explains the poses; None if no update is needed or none suffices."""
        return self.verification.update

    def next_command(self, saved: Path | None, again: str = "") -> str:
        """Return the command to type next; `saved` is the path of a saved update, `again` are options to append."""
        if saved is not None:
            return f"ftdrive live --calibration {quote(str(saved))}{again}"
        if self.passed:
            return "ftdrive history   (age and trends of all calibrations)"
        return f"ftdrive calibrate{again}   (the calibration is no longer valid)"

    @property
    def updated(self) -> str:
        """Text that names the values that the update replaces, such as "the bias"."""
        kind = None if self.update is None else self.update.kind
        return "all values" if kind == "all" else f"the {kind}"

    def to_dict(self) -> dict[str, JSON]:
        """Return the contents of verification.json."""
        outcome, header = self.verification, self.run.header()
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
            "change": outcome.change,
            "alternatives": list(outcome.alternatives),
            "reason": outcome.reason,
            "update": None if self.update is None else self.update.kind,
            "limits": {
                "force_N": self.limits[0],
                "torque_Nm": self.limits[1],
                "false_alarms": FALSE_ALARMS if self.limits == NO_LIMITS else None,
            },
            "force_max_N": float(self.force_N.max()),
            "torque_max_Nm": float(self.torque_Nm.max()),
            "chi2": outcome.chi2,
            "dof": outcome.dof,
            "p_value": outcome.p_value,
            "bias_change": outcome.to_dict()["bias_change"],
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
            "q_rad": record.before.q_rad.tolist(),
            "R_base_flange": self.dataset.R_base_flange[row].tolist(),
            "measured": measured.tolist(),
            "predicted": (measured - residual).tolist(),
            "residual": residual.tolist(),
            "sigma": self.verification.predicted_sigma[row].tolist(),
            "steady": record.steady,
        }


def verify_run(run: "Run", calibration: "CalibrationResult", path: Path, limits: Limits) -> Verified:
    """Compare the poses of a run with a calibration; write dataset.json and verification.json, return the outcome."""
    from ftcalib.after.verification import verify_calibration
    from ftcalib.data.dataset import pooled_covariance
    from ftcalib.routine import dataset_from, drift_check, is_return

    records = run.records()
    dataset = dataset_from(records, {"run": run.folder.name, "devices": run.header().get("devices", {})})
    if dataset.wrench_cov is None:
        raise BadDataset(f"{run.folder} has poses without noise: repeat the verification")
    wrench_cov = pooled_covariance(dataset.wrench_cov, dataset.n_samples)
    fitted = fitted_dataset(calibration, path)
    outcome = verify_calibration(
        calibration, dataset.R_base_flange, dataset.wrench, wrench_cov, fitted=fitted, false_alarms=FALSE_ALARMS
    )
    in_dataset = tuple(record for record in records if not is_return(record, records))
    file = run.new_path("verification")
    verified = Verified(run, calibration, path, limits, dataset, in_dataset, outcome, drift_check(records), file)
    dataset.save(run.new_path("dataset"))
    write_object(file, verified.to_dict())
    return verified


def save_update(verified: Verified) -> Path:
    """Save the updated calibration in the run folder of the verification, and return its path.

    Its provenance names the old calibration as parent. Raises `NotObservable` if the verification has no update.
    """
    from ftcalib.after.state import apply_update

    if verified.update is None:
        raise NotObservable("no update compensates the change: calibrate again")
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
