"""What the store keeps: of a run folder, read from its files, and of a cell, as it was configured."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from ftcalib.errors import BadDataset, DataError
from ftcalib.files import JSON, check_format, read_file, read_object
from ftcalib.rounding import counted, with_sigma
from ftdrive.runs.calibration import EMULATED, marks_of
from ftdrive.runs.verification import FORMAT, VerificationRecord
from ftdrive.runs.weighings import FILES, FOLDER, WeighingsFile, is_weighings

# A list of results needs no numpy.
if TYPE_CHECKING:
    from ftcalib.model import Array, Parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredResult:
    """One calibration; what its file does not say is None."""

    id: str
    """`CalibrationResult.id`."""
    path: str
    """The calibration file."""
    run: str
    """Name of its run folder."""
    created_utc: str | None
    """As ISO 8601 with microseconds, so that texts sort as times."""
    tool: str | None
    arm_serial: str | None
    arm_model: str | None
    sensor_serial: str | None
    sensor_model: str | None
    robot_host: str | None
    """Address of the controller in the configuration of the run."""
    mount: str | None
    verdict: str
    n_poses: int
    mass_kg: float
    g_m_s2: float
    numbers: dict[str, JSON]
    """The fields of `Parameters` and `covariance`, as in the file."""
    dataset_sha256: str | None
    parent: str | None
    """Id of the calibration that this one updates."""
    update: str | None
    """What was updated, such as "bias"."""
    temperature_C: float | None
    """Temperature of the sensor, where a device reports it."""
    payload_kg: float | None
    """That the controller reported during the calibration."""
    payload_com_m: list[float] | None
    """(3,) centre of mass of that payload, flange axes."""
    emulated: bool = False
    """Whether the cell was emulated."""

    @property
    def tool_in_words(self) -> str:
        """Name of the tool, and whether the cell was emulated."""
        return tool_in_words(self.tool, emulated=self.emulated)

    @property
    def parameters(self) -> "Parameters":
        """Estimates; with `covariance` they make a `ftcalib.after.series.Estimated`."""
        import numpy as np

        from ftcalib.model import Parameters

        return Parameters(**{one.name: np.array(self.numbers[one.name]) for one in fields(Parameters)})

    @property
    def covariance(self) -> "Array":
        """(15, 15) of the error coordinates `ftcalib.model.PARAMETER_NAMES`."""
        import numpy as np

        return np.array(self.numbers["covariance"], dtype=np.float64)

    @property
    def mass_sigma_kg(self) -> float:
        """One standard deviation of the mass, without the sensor's gain, which all results of a sensor share."""
        return self.parameters.weight_sigma_N(self.covariance) / self.g_m_s2

    def to_dict(self, age_days: float | None, check: VerificationRecord | None) -> dict[str, Any]:
        """Return it with its age and last verification as JSON."""
        import numpy as np

        from ftcalib.model import BIASES

        kept = {name: value for name, value in asdict(self).items() if name != "numbers"}
        bias = {name: self.numbers[name] for name in ("force_bias_N", "torque_bias_Nm", "p_sensor_com_m")}
        sigma = np.sqrt(np.diag(self.covariance))[BIASES].tolist()
        return {
            **kept,
            "age_days": age_days,
            "mass_sigma_kg": self.mass_sigma_kg,
            **bias,
            "bias_sigma": {"force_N": sigma[:3], "torque_Nm": sigma[3:]},
            "last_verification": None if check is None else check.to_store_dict(),
        }


class BriefVerification(NamedTuple):
    """What a fleet needs of a verification: a tuple, because it reads 20,000 of them a minute."""

    calibration_id: str
    created_utc: str
    passed: bool
    change: str | None
    temperature_C: float | None
    bias: tuple[float | None, ...]
    """(18,) `bias_change`, `bias_change_sigma` and `calibration_sigma` of `VerificationRecord`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredCell:
    """One cell of a fleet. No run folder contains it, so a rebuild of the store keeps it."""

    name: str
    config: str
    """Absolute path of its configuration file."""
    verify_every_days: float
    arm_serial: str | None
    robot_host: str | None
    sensor_url: str | None
    tool: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredWeighings:
    """The weighings of one day (UTC) with one calibration on one arm: a file, or the sum of several."""

    id: str
    """Name of the file without its ending."""
    path: str
    day: str
    """As ISO 8601."""
    tool: str | None
    arm_serial: str | None
    sensor_serial: str | None
    robot_host: str | None
    calibration_id: str | None
    emulated: bool
    size: int
    """Bytes that were read; a file that has more is read again."""
    weighings: int
    """Number of weighings of a part: an empty gripper does not count."""
    refusals: dict[str, int]
    """By the codes of `ftdrive.runs.weighings.REFUSALS`."""
    last_utc: str | None
    """When the last part was weighed."""
    mass_kg: float | None
    mass_sigma_kg: float | None

    @classmethod
    def of(cls, file: WeighingsFile) -> Self:
        """Return what was read of a file of weighings."""
        header, last = file.header, file.last
        return cls(
            id=file.path.stem,
            path=str(file.path),
            day=_text(header.get("day")) or "",
            tool=_text(header.get("tool")),
            arm_serial=_text(header.get("arm_serial")),
            sensor_serial=_text(header.get("sensor_serial")),
            robot_host=_text(header.get("robot_host")),
            calibration_id=_text(header.get("calibration_id")),
            emulated=header.get("emulated") is True,
            size=file.size,
            weighings=file.weighings,
            refusals=dict(file.refusals),
            last_utc=_utc(last.get("t_utc")),
            mass_kg=_number(last.get("mass_kg")),
            mass_sigma_kg=_number(last.get("mass_sigma_kg")),
        )

    @property
    def tool_in_words(self) -> str:
        """Name of the tool, and whether the cell was emulated."""
        return tool_in_words(self.tool, emulated=self.emulated)

    @property
    def mass_in_words(self) -> str:
        """Mass of the last part; a dash without one."""
        if self.mass_kg is None or self.mass_sigma_kg is None:
            return "-"
        return f"{with_sigma(self.mass_kg, self.mass_sigma_kg)} kg"

    @property
    def in_words(self) -> str:
        """Tool, time and mass of the last part, and how many there were."""
        refused = sum(self.refusals.values())
        counts = f"{counted(self.weighings, 'part')}, {refused} refused on this day"
        time = self.day if self.last_utc is None else self.last_utc[:16].replace("T", " ")
        return f"{self.tool_in_words}, {time}: {self.mass_in_words}; {counts}"


Record = StoredResult | VerificationRecord | StoredWeighings


def sum_up(days: Iterable[StoredWeighings]) -> list[StoredWeighings]:
    """Sum up the files of each tool and arm, and keep the last weighing; the oldest first.

    A tool has several files on a day if it was calibrated meanwhile.
    """
    found = dict[tuple[object, ...], StoredWeighings]()
    for one in sorted(days, key=lambda one: (one.day, one.last_utc or "", one.id)):
        key = (one.tool, one.arm_serial, one.robot_host, one.emulated)
        before = found.pop(key, None)
        found[key] = one if before is None or before.day != one.day else _with_counts(one, before)
    return [*found.values()]


def _with_counts(one: StoredWeighings, before: StoredWeighings) -> StoredWeighings:
    refusals = {code: number + before.refusals[code] for code, number in one.refusals.items()}
    return replace(one, weighings=one.weighings + before.weighings, refusals=refusals)


def tool_in_words(tool: str | None, *, emulated: bool) -> str:
    """Return the name of a tool, which is EMULATED in an emulated cell whose tool has no other name."""
    if not emulated:
        return tool or "-"
    return EMULATED if tool in (None, "emulated") else f"{tool} {EMULATED}"


def shows_bias(check: VerificationRecord | BriefVerification) -> bool:
    """Whether the change of the bias that a verification has estimated counts.

    It passed, or found that the bias has changed: another change, or a hand on the tool, spoils the estimate.
    """
    return check.passed or check.change == "bias"


def record_paths(folders: Iterable[Path]) -> list[Path]:
    """Return the files that become records, of runs or of the runs in folders, each once and by name.

    A folder of weighings counts as a run.
    """
    runs = set[Path]()
    for folder in (one.resolve() for one in folders):
        if _is_run(folder):
            runs.add(folder)
        elif folder.is_dir():
            runs.update(filter(_is_run, folder.iterdir()))
    names = ("calibration*.json", "verification*.json", FILES)
    return [path for run in sorted(runs) for name in names for path in sorted(run.glob(name))]


def read_records(paths: Iterable[Path]) -> tuple[list[Record], tuple[str, ...]]:
    """Read files; the second list names those that were left out, each with the reason."""
    records, unreadable = list[Record](), list[str]()
    for path in paths:
        try:
            records.append(_read_record(path))
        except (DataError, OSError) as error:
            unreadable.append(f"{path}: {error}")
    return records, tuple(unreadable)


def _is_run(folder: Path) -> bool:
    try:
        return (folder / "run.json").is_file() or (folder.name == FOLDER and folder.is_dir())
    except OSError:  # a folder of another user
        return False


def _read_record(path: Path) -> Record:
    """Read one file of a run folder or of weighings; fields that this version does not know are ignored.

    Raises `BadCalibration` or `BadDataset` for a damaged file or another format, or `OSError`.
    """
    if is_weighings(path):
        file = WeighingsFile(path)
        file.read()
        return StoredWeighings.of(file)
    return _verification(path) if path.name.startswith("verification") else _result(path)


def _result(path: Path) -> StoredResult:
    from ftcalib import CalibrationResult

    result = CalibrationResult.load(path)
    header = _header(path.parent)
    config = header.get("config", {})
    provenance, run_devices = result.provenance, header.get("devices", {})
    setup, devices = _object(provenance.get("setup")), _object(provenance.get("devices")) or run_devices
    arm, sensor = (_object(devices.get(role)) for role in ("arm", "sensor"))
    parent = provenance.get("parent")
    return StoredResult(
        id=result.id,
        path=str(path),
        run=path.parent.name,
        created_utc=_utc(provenance.get("created_utc") or header.get("created_utc")),
        tool=_text(setup.get("tool")) or _text(_object(config.get("tool")).get("name")),
        arm_serial=_text(arm.get("serial")),
        arm_model=_text(arm.get("model")),
        sensor_serial=_text(sensor.get("serial")),
        sensor_model=_text(sensor.get("model")),
        robot_host=_text(_object(config.get("robot")).get("host")),
        mount=_text(setup["mount"] if "mount" in setup else _object(config.get("sensor")).get("mount")),
        verdict=result.verdict,
        n_poses=result.n_poses,
        mass_kg=result.mass_kg,
        g_m_s2=result.g_m_s2,
        numbers={
            **{one.name: getattr(result.parameters, one.name).tolist() for one in fields(result.parameters)},
            "covariance": result.covariance.tolist(),
        },
        dataset_sha256=_text(provenance.get("dataset_sha256")),
        parent=_text(_object(parent).get("id")) or _text(parent),
        update=_text(provenance.get("update")),
        temperature_C=_number(provenance.get("temperature_C")),
        payload_kg=_number(setup.get("payload_kg")),
        payload_com_m=_numbers(setup.get("p_flange_payload_m"), 3),
        emulated=EMULATED in marks_of(result),
    )


def _verification(path: Path) -> VerificationRecord:
    document = read_object(path, BadDataset)
    check_format(document, FORMAT, BadDataset)
    calibration_id, passed = _text(_object(document.get("calibration")).get("id")), document.get("passed")
    if calibration_id is None or not isinstance(passed, bool):
        raise BadDataset(f"{path.name} lacks the id of its calibration or the outcome: the file is damaged")
    bias_change = _object(document.get("bias_change"))
    created = _utc(document.get("created_utc"))
    return VerificationRecord(
        id=hashlib.sha256(read_file(path)).hexdigest()[:12],
        path=path,
        calibration_id=calibration_id,
        created_utc=None if created is None else datetime.fromisoformat(created),
        passed=passed,
        change=_text(document.get("change")),
        reason=_text(document.get("reason")),
        temperature_C=_number(document.get("temperature_C")),
        bias_change=_numbers(bias_change.get("value"), 6),
        bias_change_sigma=_numbers(bias_change.get("sigma"), 6),
        calibration_sigma=_numbers(bias_change.get("calibration_sigma"), 6),
    )


def _header(run: Path) -> Mapping[str, Any]:
    """Return run.json, or nothing if it is damaged: the calibration file alone suffices."""
    from ftdrive.runs.run import Run

    try:
        return dict(Run(run).header())
    except (DataError, OSError):
        return {}


def _object(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _text(value: Any) -> str | None:
    """Return a text that every database takes: without zero characters and halves of a surrogate pair."""
    return value.encode(errors="replace").decode().replace("\0", "\ufffd") if isinstance(value, str) and value else None


def _number(value: Any) -> float | None:
    usable = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    return float(value) if usable else None


def _numbers(value: Any, n: int) -> list[float] | None:
    """Return a list of n finite numbers, or None if it is not one."""
    found = [_number(one) for one in value] if isinstance(value, list) else []
    known = [one for one in found if one is not None]
    return known if len(known) == len(found) == n else None


def _utc(value: Any) -> str | None:
    try:
        return datetime.fromisoformat(value).astimezone(UTC).isoformat(timespec="microseconds")
    except (TypeError, ValueError):
        return None
