"""Records in the store: results, verifications and weighings from run folders, and configured cells."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ftcalib.errors import DataError
from ftcalib.files import JSON
from ftdrive.runs import run_folders
from ftdrive.runs.calibration import EMULATED, at, marks_of, number_at, numbers_at, text_at, time_at
from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import FILES, FOLDER, WeighingDay

# Only for type checkers: listing results must not import numpy, which takes long.
if TYPE_CHECKING:
    from ftcalib.model import Array, Parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredResult:
    """What the store keeps of a calibration; None for values that are not in its file or run."""

    id: str
    """Id of the result, see `CalibrationResult.id`."""
    path: str
    """Path of the calibration file."""
    run: str
    """Name of the run folder that contains the calibration."""
    created_utc: str | None
    """Time of the calibration, UTC, ISO 8601 with microseconds, which sorts as text."""
    tool: str | None
    arm_serial: str | None
    arm_model: str | None
    sensor_serial: str | None
    sensor_model: str | None
    robot_host: str | None
    """Address of the robot controller in the configuration of the run."""
    mount: str | None
    verdict: str
    n_poses: int
    mass_kg: float
    g_m_s2: float
    numbers: dict[str, JSON]
    """The estimates and their covariance: the fields of `Parameters`, and `covariance`, as in calibration.json."""
    dataset_sha256: str | None
    parent: str | None
    """Id of the calibration that this one updates."""
    update: str | None
    """Kind of the update, such as "bias"; None for a full calibration."""
    temperature_C: float | None
    """Temperature of the sensor, °C; None if the sensor reports none."""
    payload_kg: float | None
    """Payload set in the robot controller during the calibration, kg, as the controller reported it."""
    payload_com_m: list[float] | None
    """(3,) centre of mass, m, of the payload that the controller reported, flange axes."""
    emulated: bool = False
    """Whether the calibration was made in an emulated cell."""

    @property
    def parameters(self) -> "Parameters":
        """Estimates as `Parameters`, so that the record has the interface `ftcalib.after.series.Estimated`."""
        import numpy as np

        from ftcalib.model import Parameters

        return Parameters(**{item.name: np.array(self.numbers[item.name]) for item in fields(Parameters)})

    @property
    def covariance(self) -> "Array":
        """(15, 15) covariance of the estimates, in the error coordinates `ftcalib.model.PARAMETER_NAMES`."""
        import numpy as np

        return np.array(self.numbers["covariance"], dtype=np.float64)

    @property
    def mass_sigma_kg(self) -> float:
        """Standard deviation of the mass, kg, without the sensor's gain error, which all its results have in common."""
        return self.parameters.weight_sigma_N(self.covariance) / self.g_m_s2

    def to_dict(self, age_days: float | None, check: VerificationRecord | None) -> dict[str, Any]:
        """Return the record as JSON, with its age and last verification `check`, each of which may be None."""
        import numpy as np

        from ftcalib.model import BIASES

        columns = {name: value for name, value in asdict(self).items() if name != "numbers"}
        bias = {name: self.numbers[name] for name in ("force_bias_N", "torque_bias_Nm", "p_sensor_com_m")}
        sigma = np.sqrt(np.diag(self.covariance))[BIASES].tolist()
        return {
            **columns,
            "age_days": age_days,
            "mass_sigma_kg": self.mass_sigma_kg,
            **bias,
            "bias_sigma": {"force_N": sigma[:3], "torque_Nm": sigma[3:]},
            "last_verification": None if check is None else check.to_dict(STORED),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredCell:
    """A cell of a fleet in the store. A rebuild of the store keeps the cells, because run folders do not have them."""

    name: str
    config: str
    """Absolute path of the configuration file of the cell."""
    verify_every_days: float
    arm_serial: str | None
    robot_host: str | None
    sensor_url: str | None
    tool: str | None


Record = StoredResult | VerificationRecord | WeighingDay
# Fields of a `VerificationRecord` that are stored, and printed with the list of results.
STORED: Final = (
    *("id", "path", "run", "calibration_id", "created_utc", "passed", "change", "reason", "temperature_C"),
    *("bias_change", "bias_change_sigma", "calibration_sigma"),
)


def record_paths(folders: Iterable[Path]) -> list[Path]:
    """Return the files of results, verifications and weighings in run folders, or in folders that contain these."""
    folders = [folder.resolve() for folder in folders]
    weighings = (path for folder in folders for path in (folder, folder / FOLDER) if path.name == FOLDER)
    names = ("calibration*.json", "verification*.json", FILES)
    runs = sorted({*run_folders(folders), *weighings})
    return [path for run in runs for name in names for path in sorted(run.glob(name))]


def read_records(paths: Iterable[Path]) -> tuple[list[Record], tuple[str, ...]]:
    """Read the record in each file; also return a text with path and error for each file that could not be read."""
    records, unreadable = list[Record](), list[str]()
    for path in paths:
        try:
            records.append(_read_record_file(path))
        except (DataError, OSError) as error:
            unreadable.append(f"{path}: {error}")
    return records, tuple(unreadable)


def _read_record_file(path: Path) -> Record:
    """Read a result, a verification or a day of weighings, by the name of the file, ignoring unknown fields.

    Raises `BadCalibration` or `BadDataset` for a damaged file or another format, and `OSError` if reading fails.
    """
    if path.match(FILES):
        return WeighingDay.load(path)
    return VerificationRecord.load(path) if path.name.startswith("verification") else _result(path)


def _result(path: Path) -> StoredResult:
    from ftcalib import CalibrationResult
    from ftdrive.runs.run import Run

    result = CalibrationResult.load(path)
    try:
        header = Run(path.parent).header()
    except (DataError, OSError):  # such as a calibration without its run
        header = {}
    provenance, setup = result.provenance, at(result.provenance, "setup")
    named = provenance if at(provenance, "devices") else header
    return StoredResult(
        id=result.id,
        path=str(path),
        run=path.parent.name,
        created_utc=time_at(provenance if provenance.get("created_utc") else header, "created_utc"),
        tool=text_at(provenance, "setup", "tool") or text_at(header, "config", "tool", "name"),
        arm_serial=text_at(named, "devices", "arm", "serial"),
        arm_model=text_at(named, "devices", "arm", "model"),
        sensor_serial=text_at(named, "devices", "sensor", "serial"),
        sensor_model=text_at(named, "devices", "sensor", "model"),
        robot_host=text_at(header, "config", "robot", "host"),
        mount=(
            text_at(provenance, "setup", "mount")
            if isinstance(setup, Mapping) and "mount" in setup
            else text_at(header, "config", "sensor", "mount")
        ),
        verdict=result.verdict,
        n_poses=result.n_poses,
        mass_kg=result.mass_kg,
        g_m_s2=result.g_m_s2,
        numbers={
            **{item.name: getattr(result.parameters, item.name).tolist() for item in fields(result.parameters)},
            "covariance": result.covariance.tolist(),
        },
        dataset_sha256=text_at(provenance, "dataset_sha256"),
        parent=text_at(provenance, "parent", "id") or text_at(provenance, "parent"),
        update=text_at(provenance, "update"),
        temperature_C=number_at(provenance, "temperature_C"),
        payload_kg=number_at(provenance, "setup", "payload_kg"),
        payload_com_m=numbers_at(provenance, 3, "setup", "p_flange_payload_m"),
        emulated=EMULATED in marks_of(result),
    )
