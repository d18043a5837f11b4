"""Datasets, calibrations and recorded runs from any place that commands accept: run folders and single files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from shlex import quote
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult, Known, Setup, solve
from ftcalib.after.new_tool import new_tool
from ftcalib.data.dataset import Orientation
from ftcalib.errors import BadCalibration, BadDataset, NotObservable
from ftcalib.likelihood.session import Drift
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array, Parameters
from ftcalib.routine import ArmReading, DriftCheck, PoseRecord, WrenchSamples, dataset_from, drift_check
from ftdrive.cell.config import NOMINAL_ORIENTATION_DEG, orientation_accuracy_deg
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.scene import down_of
from ftdrive.runs.load import Load
from ftdrive.runs.motion import solve_motion_file
from ftdrive.runs.run import Run, is_run, made_now, versions
from ftdrive.runs.sensor_file import with_sensor
from ftdrive.tables.table import Table, TableOptions


class RecordedRun:
    """Arm and sensor in one, as `ftcalib.routine` wants them; neither moves nor waits."""

    def __init__(self, records: Sequence[PoseRecord]) -> None:
        self._records = list(records)
        self._stop = -1
        self._collected = False

    def go_on_to(self, q_rad: Array) -> None:
        """Go on to the next recorded stop, which must be at these joint angles (6,)."""
        self._stop += 1
        if not np.array_equal(q_rad, self._records[self._stop].pose.q_rad):
            raise ValueError(f"stop {self._stop + 1} of the recording went elsewhere than the routine now asks")

    def wait_until_still(self, **_: object) -> None:
        """Begin a look at the pose."""
        self._collected = False

    def state(self) -> ArmReading:
        """Return the state before or after the samples."""
        record = self._records[self._stop]
        return record.after if self._collected else record.before

    def collect(self, _duration_s: float, /) -> WrenchSamples:
        """Give the samples of this stop."""
        self._collected = True
        return self._records[self._stop].samples

    def check(self) -> None:
        """Do nothing: a recording cannot fail."""


_UNDESCRIBED: Final = Setup()


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """Options of `ftdrive solve` and `ftdrive report`: what is known of the data, and how they are solved."""

    method: str = "ml"
    """A `ftcalib.result.Method`; "all" compares them."""
    orientation: Orientation = "R_base_flange"
    """Of the rotations in a CSV file."""
    drift: Drift = "auto"
    known: Known | None = None
    """A known direction of gravity means a base that is level with respect to the mounting."""
    up_in_base: Sequence[float] | None = None
    """(3,) declared up direction, instead of that of a run's mounting."""
    as_published: bool = False
    earlier: CalibrationResult | None = None
    """The result that gives a new tool its mounting, base and gain."""
    pair: tuple[Path, Path] | None = None
    """Files of wrench and orientation of a recording in motion."""
    point_mass: bool = False
    topics: tuple[str | None, str | None] = (None, None)
    """Topics of a bag: wrench and pose."""
    table: TableOptions | None = None
    """What is known of a table of another program; None if nothing is."""
    words: tuple[str, ...] = ()
    """The same as typed, quoted for a shell."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedData:
    """What a place holds."""

    dataset: CalibrationDataset
    provenance: dict[str, Any]
    g_m_s2: float = STANDARD_GRAVITY_M_S2
    setup: Setup = _UNDESCRIBED
    """The described cell."""
    known: Known | None = None
    records: Sequence[PoseRecord] = ()
    """Only of a run."""
    earlier: CalibrationResult | None = None
    """The result that gives a new tool its mounting, base and gain."""

    @property
    def circumstances(self) -> dict[str, Any]:
        """What `ftcalib.solve` takes beside dataset and provenance."""
        return {"g_m_s2": self.g_m_s2, "setup": self.setup, "known": self.known}

    @property
    def p_flange_sensor_m(self) -> Array:
        """(3,) sensor origin from the flange face, where its height is described; else there."""
        return np.array([0.0, 0.0, self.setup.sensor_height_m or 0.0])

    @property
    def truth(self) -> Parameters | None:
        """What a perfect calibration finds, of an emulated cell that is described in the run."""
        truth = (self.provenance.get("station") or {}).get("truth")
        return None if truth is None else Parameters(*(np.array(truth[one.name]) for one in fields(Parameters)))


def read_source(source: Path, options: SolveOptions) -> RecordedData:
    """Read poses at rest from a run folder, a dataset.json or a table.

    Raises `BadDataset`, `ConfigError` or `OSError`.
    """
    known = options.known
    if source.is_dir():
        run = Run(source)
        if run.in_motion:
            raise BadDataset(f"{source} is a recording in motion and has no poses: solve it with {run.solve_command}")
        records = run.records()
        dataset, of_run = _dataset_of(run, records)
        found = RecordedData(dataset, of_run.provenance(), of_run.g_m_s2, of_run.setup, None, records, _earlier_of(run))
    elif source.suffix == ".json":
        found = RecordedData(CalibrationDataset.load(source), {"source": source.name, "versions": versions()})
    else:
        table = Table(source, options.table)
        dataset = table.dataset(options.orientation)
        recognised = {"table": table.words} if table.words else {}
        found = RecordedData(dataset, {"source": source.name, **recognised, "versions": versions()})
        if table.has_nominal_kinematics:
            found = replace(found, setup=replace(found.setup, orientation_accuracy_deg=NOMINAL_ORIENTATION_DEG))
        if table.gravity_is_measured:  # its direction is that of the base by definition
            known = replace(known or Known(), gravity_direction_base=-UP_IN_BASE)
    if options.table is not None and (source.is_dir() or source.suffix == ".json"):
        raise ConfigError(f"{source.name} is no table: leave out the options that describe one, such as --columns")
    up_in_base = options.up_in_base
    if up_in_base is not None:
        provenance = {**found.provenance, "up_in_base": list(up_in_base)}
        found = replace(found, setup=replace(found.setup, up_in_base=up_in_base), provenance=provenance)
    if known is not None and known.gravity_direction_base is not None:
        known = replace(known, gravity_direction_base=-found.setup.up)
    return replace(found, known=known)


_TAKEN: Final = "give a path, a DataFrame, arrays by name, or a pair (R_base_flange, wrench)"


def as_source(source: Any) -> Any:
    """Return a dataset, a recording, or a Path, DataFrame or mapping that may be either.

    Parameters
    ----------
    source : str, Path, Run, DataFrame, mapping, Recording, CalibrationDataset or pair of arrays
        A pair is R_base_flange (n, 3, 3), or n Rotations, and the wrenches (n, 6), N and N·m.

    Raises
    ------
    BadDataset
        The arrays of a pair have other shapes, or are none of rotations and wrenches.
    TypeError
        Anything else; the message names the call that helps.
    """
    if isinstance(source, str):
        return Path(source)
    if isinstance(source, Run):
        return source.folder
    if isinstance(source, CalibrationResult):
        raise TypeError("this is a result, which is solved already: print it, or solve the data that it was made of")
    if isinstance(source, tuple | list) and len(source) == 2 and not any(isinstance(one, Mapping) for one in source):
        try:
            return CalibrationDataset.of(*source)
        except (BadDataset, ValueError) as error:
            raise BadDataset(f"{error} Give (R_base_flange, wrench), of shapes (n, 3, 3) and (n, 6)") from error
    is_table = isinstance(source, Mapping) or hasattr(source, "columns")
    if is_table or isinstance(source, Path | CalibrationDataset) or hasattr(source, "pieces"):
        return source
    found = f"an array of shape {source.shape}" if isinstance(source, np.ndarray) else type(source).__name__
    raise TypeError(f"{found} has no names of columns: {_TAKEN}")


def read_dataset(
    source: Any, orientation: Orientation = "R_base_flange", table: TableOptions | None = None
) -> CalibrationDataset:
    """Read the poses of a calibration; `CalibrationDataset.save` writes them.

    Parameters
    ----------
    source : str, Path, Run, DataFrame, mapping or pair of arrays
        A run folder, a dataset.json, a table of any program (text, DataFrame of pandas or Polars, arrays by name), or
        R_base_flange (n, 3, 3) and the wrenches (n, 6).
    orientation : {"R_base_flange", "R_flange_base"}
        Of the rotations in a table: flange to base coordinates, like a robot pose, or the inverse.
    table : TableOptions, optional
        What the table does not say: names of columns, units, order of angles, TCP.

    Raises
    ------
    DataError
        The message names the file, and the row or the field.
    OSError
        It cannot be read.
    TypeError
        The source is nothing of this; the message names the call that helps.

    Examples
    --------
    >>> import ftdrive
    >>> dataset = ftdrive.read_dataset("poses.csv")
    >>> dataset.wrench.shape
    (24, 6)
    """
    source = as_source(source)
    if isinstance(source, CalibrationDataset):
        return source
    if hasattr(source, "pieces"):
        raise TypeError("this is a recording in motion, which has no poses at rest: ftdrive.solve(recording) solves it")
    if not isinstance(source, Path):
        return Table(source, table).dataset(orientation)
    return read_source(source, SolveOptions(orientation=orientation, table=table)).dataset


def read_calibration(path: str | Path, *, accept_edited: bool = False) -> CalibrationResult:
    """Read a calibration; `CalibrationResult.save` writes it.

    If the present folder has a `sensor.json` of its sensor, the result decodes contacts with that.

    Parameters
    ----------
    path : str or Path
        A calibration.json, or a run folder: its newest calibration.
    accept_edited : bool
        Accept a file that was edited by hand; the result is then `is_edited`.

    Raises
    ------
    DataError
        The file is not a calibration that this version can read, is damaged or was edited, or a load was on the tool.
    OSError
        It cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.solve(ftdrive.read_dataset("poses.csv")).save("calibration.json")
    >>> ftdrive.read_calibration("calibration.json").verdict
    'good'
    """
    path = Path(path)
    file = Run(path).calibration_path if path.is_dir() else path
    if is_run(path) and not file.exists():
        folder = quote(str(path))
        raise FileNotFoundError(
            f"{path} has no calibration, because its run was interrupted or its result rejected. Solve its poses:\n"
            f"ftdrive solve {folder} --output {folder}/calibration.json"
        )
    result = CalibrationResult.load(file, accept_edited=accept_edited)
    if (load := Load.of_header(result.provenance)) is not None:
        raise BadCalibration(f"{path} was made with {load}: use it with `ftdrive loads solve`, not as that of the tool")
    return with_sensor(result)


def require_same_cell(earlier: CalibrationResult, provenance: Mapping[str, Any]) -> None:
    """Raise `ConfigError` if a rejected result, or one of another sensor, arm or mount, is to serve a new tool.

    What a file does not name is not compared.
    """
    if earlier.verdict == "rejected":
        raise ConfigError(f"--from: result {earlier.id} is rejected: take an accepted one")
    before, now = earlier.provenance, provenance
    for device in ("sensor", "arm"):
        serials = [_of(one, "devices", device, "serial") for one in (before, now)]
        if all(serials) and serials[0] != serials[1]:
            raise ConfigError(
                f"--from: result {earlier.id} is of {device} {serials[0]}, the new data of {serials[1]}: take one of "
                f"the same {device}"
            )
    mounts = [_of(one, "setup", "mount") for one in (before, now)]
    if all(mounts) and mounts[0] != mounts[1]:
        raise ConfigError(f"--from: result {earlier.id} is of mount {mounts[0]}, the new data of {mounts[1]}")


def _of(document: Any, *keys: str) -> Any:
    for key in keys:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What is known of the data of a run beside them."""

    g_m_s2: float
    setup: Setup
    """The described cell."""
    origin: dict[str, Any]
    """Devices, run, cell and temperature."""

    def provenance(self) -> dict[str, Any]:
        """Return the provenance of a result that is made now."""
        return {**made_now(), **self.origin}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A solved run."""

    run: Run
    dataset: CalibrationDataset | None
    """None of a run in motion."""
    result: CalibrationResult
    drift: DriftCheck | None


def solve_and_save(run: Run) -> Outcome:
    """Solve a run from its files, so that the files suffice to repeat it. Raises `OSError` if they cannot be saved."""
    # Solved from its files and not from memory, so a replay agrees to the last digit.
    outcome = Outcome(run, None, solve_in_motion(run), None) if run.in_motion else solve_records(run, run.records())
    try:
        if outcome.dataset is not None:
            outcome.dataset.save(run.new_path("dataset"))
        if outcome.result.verdict != "rejected":
            outcome.result.save(run.new_path("calibration"))
    except OSError as error:
        kept = "all poses are" if outcome.dataset is not None else "the recording is"
        raise OSError(
            f"{error.strerror or error}: the result is not saved, but {kept}. Make room in {run.folder}, then "
            f"{run.solve_command} --output FILE"
        ) from error
    return outcome


def solve_in_motion(
    run: Run, known: Known | None = None, *, earlier: CalibrationResult | None = None, point_mass: bool = False
) -> CalibrationResult:
    """Solve the recording of a run in motion; with the earlier result of a new tool that is given, or its own."""
    found = circumstances_of(run)
    earlier = earlier or _earlier_of(run)
    if earlier is not None:
        require_same_cell(earlier, found.origin)
    return solve_motion_file(
        run.motion_path,
        height_m=found.setup.sensor_height_m,
        known=known,
        earlier=earlier,
        point_mass=point_mass,
        guarded=run.mode == "sweep",
        provenance=found.provenance(),
        g_m_s2=found.g_m_s2,
        setup=found.setup,
    )


def solve_records(run: Run, records: Sequence[PoseRecord]) -> Outcome:
    """Solve records of a run, as they are on disk or as a replay gives them."""
    dataset, found = _dataset_of(run, records)
    earlier, provenance = _earlier_of(run), found.provenance()
    if earlier is None:
        result = solve(dataset, run.method, g_m_s2=found.g_m_s2, setup=found.setup, provenance=provenance)
    else:
        require_same_cell(earlier, provenance)
        result = new_tool(earlier, dataset, provenance)
    return Outcome(run, dataset, result, drift_check(records))


def _earlier_of(run: Run) -> CalibrationResult | None:
    """Return the result from which a run of a new tool takes mounting, base and gain; None for any other run."""
    document = run.header().get("earlier")
    return None if document is None else CalibrationResult.from_dict(document)


def _dataset_of(run: Run, records: Sequence[PoseRecord]) -> tuple[CalibrationDataset, Circumstances]:
    if not records:
        raise NotObservable(f"{run.folder} has no data to solve: {run.how_to_go_on}")
    found = circumstances_of(run)
    marks = {"emulated": True} if found.origin["station"] is not None else {}
    if "load" in found.origin:
        marks["load"] = found.origin["load"]
    return dataset_from(records, {"run": run.folder.name, "devices": found.origin["devices"], **marks}), found


def circumstances_of(run: Run) -> Circumstances:
    """Return what `solve` takes beside the data of a run, without reading them."""
    header = run.header()
    config = header["config"]
    setup, robot = _described(run, config, Load.of_header(header)), config.get("robot", {})
    mounting, height_mm = setup["mounting"], setup["height_mm"]
    origin = {
        "devices": header.get("devices", {}),
        "run": run.folder.name,
        "station": header.get("station"),
        "setup": setup,
        "temperature_C": run.temperature_C(),
        **({"load": dict(header["load"])} if "load" in header else {}),
    }
    return Circumstances(
        float(config["site"]["g_m_s2"]),
        Setup(
            up_in_base=None if mounting is None else (-down_of(mounting)).tolist(),
            tool_mass_kg=setup["tool_mass_kg"],
            tool_mass_sigma_kg=setup["tool_mass_sigma_kg"],
            cylinders_m=[[value / 1e3 for value in row] for row in setup["cylinders_mm"]],
            sensor_height_m=None if height_mm is None else height_mm / 1e3,
            sensor_mass_kg=setup["sensor_mass_kg"],
            payload_kg=setup["payload_kg"],
            sensor_accuracy_percent=setup["accuracy_percent"],
            sensor_range=setup["range"],
            orientation_accuracy_deg=orientation_accuracy_deg(robot.get("host"), robot.get("orientation_accuracy_deg")),
            sensor_has_arbitrary_zero="zero" in (_of(origin, "devices", "sensor", "facts") or ()),
        ),
        origin,
    )


def _described(run: Run, config: Mapping[str, Any], load: Load | None) -> dict[str, Any]:
    """Return what a result is bound to or compared with: payload last reported, tool, mount label and mounting.

    A tool with a load is another tool, with another name, so that its result serves no session of the tool alone.
    """
    payload_kg = p_flange_payload_m = None
    for event in run.events():
        if event.get("event") == "weighed":
            payload_kg, p_flange_payload_m = event["payload_kg"], event.get("p_flange_payload_m")
    sensor, tool, workcell = (config.get(section, {}) for section in ("sensor", "tool", "workcell"))
    tool_kg, measured = tool.get("mass_kg"), workcell.get("measured")
    return {
        "payload_kg": payload_kg,
        "p_flange_payload_m": p_flange_payload_m,
        "sensor_mass_kg": sensor.get("mass_kg"),
        "accuracy_percent": sensor.get("accuracy_percent"),
        "range": [sensor["range_N"], sensor["range_Nm"]] if sensor.get("range_N") and sensor.get("range_Nm") else None,
        "mounting": workcell.get("mounting"),
        "height_mm": sensor.get("height_mm"),
        "tool_mass_kg": tool_kg + load.mass_kg if load and tool_kg else tool_kg,
        "tool_mass_sigma_kg": None if load else tool.get("mass_sigma_kg"),
        # The centre of mass of a tool with a load may be anywhere between the two.
        "cylinders_mm": [list(row) for row in tool.get("cylinders_mm", ())] if measured and not load else [],
        "tool": f"{tool.get('name')} with {load}" if load else tool.get("name"),
        "mount": sensor.get("mount"),
    }
