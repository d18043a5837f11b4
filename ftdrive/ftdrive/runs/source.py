"""Reading and solving of the data that commands accept: run folders, datasets and tables."""

import hashlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Self
from urllib.parse import parse_qsl

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Known, Setup, solve
from ftcalib.after.new_tool import new_tool
from ftcalib.data.dataset import Orientation
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import read_file
from ftcalib.likelihood.session import Drift
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array, Parameters
from ftcalib.motion.solve import solve_motion
from ftcalib.result import Method
from ftcalib.routine import ArmReading, DriftCheck, PoseRecord, WrenchSamples, dataset_from, drift_check
from ftdrive.cell.config import NOMINAL_ORIENTATION_DEG, orientation_accuracy_deg
from ftdrive.cell.units import parse_numbers
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.kinematics import frames
from ftdrive.planning.geometry.scene import down_of
from ftdrive.runs.calibration import at, made_now, read_calibration, versions
from ftdrive.runs.load import Load
from ftdrive.runs.motion import files_of, means_of
from ftdrive.runs.run import Run
from ftdrive.tables.table import Table, TableOptions
from ftdrivers.errors import BadUrl
from ftdrivers.ros2.poses import Chain
from ftdrivers.ur.kinematics import MODELS, model_named


class RecordedRun:
    """Arm and sensor for `ftcalib.routine` that play back the records of a run; nothing moves or waits."""

    def __init__(self, records: Sequence[PoseRecord]) -> None:
        self._records = list(records)
        self._stop = -1
        self._collected = False

    def go_on_to(self, q_rad: Array) -> None:
        """Go to the next recorded stop. Raises `ValueError` unless it has these joint angles (6,)."""
        self._stop += 1
        if not np.array_equal(q_rad, self._records[self._stop].pose.q_rad):
            raise ValueError(f"the joint angles at stop {self._stop + 1} of the recording are not those of the routine")

    def wait_until_still(self, **_: object) -> None:
        """Return at once, because a recorded arm is still; `state` is then again the one before the samples."""
        self._collected = False

    def state(self) -> ArmReading:
        """Return the recorded state of the arm before the samples, or after them once `collect` was called."""
        record = self._records[self._stop]
        return record.after if self._collected else record.before

    def collect(self, _duration_s: float, /) -> WrenchSamples:
        """Return the recorded samples of this stop, whatever duration is requested."""
        self._collected = True
        return self._records[self._stop].samples

    def check(self) -> None:
        """Do nothing, because recorded devices cannot fail."""


_UNDESCRIBED: Final = Setup()


@dataclass(frozen=True, slots=True)
class SolveOptions:
    """Options of `ftdrive solve` and `ftdrive report`: facts about the data, and the solution method."""

    method: str = "ml"
    """Solution method, a `ftcalib.result.Method`, or "all" to compare the methods."""
    orientation: Orientation = "R_base_flange"
    """Direction of the rotations in a table: flange to base coordinates, or the inverse."""
    drift: Drift = "auto"
    known: Known | None = None
    """Values that the user declares known; a known gravity direction here only means a base level to its mounting."""
    up_in_base: Sequence[float] | None = None
    """(3,) up direction in base axes from `--up`, which replaces the direction from the mounting of a run."""
    as_published: bool = False
    earlier: CalibrationResult | None = None
    """Earlier result, from which a new tool takes mounting, gravity direction and gain."""
    pair: tuple[Path, Path] | None = None
    """Files with the wrench and with the orientation, which together are one recording in motion."""
    point_mass: bool = False
    topics: tuple[str | None, str | None] = (None, None)
    """Topics of wrench and pose in a ROS bag; None if the bag has only one of the type."""
    table: TableOptions | None = None
    """Facts that a table of another program lacks; None if no option gives any."""
    words: tuple[str, ...] = ()
    """The options as words of a command line, quoted for a shell."""

    @classmethod
    def of_solve(  # noqa: PLR0913 - the options of the command
        cls,
        sources: Sequence[Path],
        *,
        method: str,
        orientation: Orientation,
        drift: Drift,
        mass_kg: float | None,
        level_deg: float | None,
        mounting_deg: str | None,
        up: str | None,
        as_published: bool,
        earlier: Path | None,
        wrench: Path | None,
        orientation_file: Path | None,
        point_mass: bool,
        wrench_topic: str | None,
        pose_topic: str | None,
        table: TableOptions | None,
        test: Path | None,
        cases: bool,
        joined: bool,
        output: Path | None,
        simulate: bool,
    ) -> Self:
        """Parse the options of `ftdrive solve`. Raises `ConfigError` if they are invalid or contradict each other."""
        if (wrench is None) != (orientation_file is None) or (wrench is not None and sources):
            raise ConfigError("--wrench and --orientation-file are parts of one recording: give both, and no DATASET")
        pair = None if wrench is None or orientation_file is None else (wrench, orientation_file)
        if not (sources or pair or simulate):
            raise ConfigError("no data: give a run folder, a dataset.json or a CSV file, or --simulate")
        others = (earlier, pair, test, mass_kg, level_deg, mounting_deg, up)
        if cases and (method != "ml" or drift != "auto" or joined or any(option is not None for option in others)):
            raise ConfigError(
                "--table-iii defines its methods and test sets: leave out --method, --test, other data, --drift and "
                "known values"
            )
        if test is not None and method != "all":
            raise ConfigError("--test compares methods: add --method all")
        if as_published and method != "all" and not method.startswith("carlson-"):
            raise ConfigError("--as-published applies only to --method carlson-... and all: leave it out")
        if (earlier is not None or joined) and (method != "ml" or (earlier is not None and joined)):
            raise ConfigError("--from and --together need --method ml and are mutually exclusive: leave one out")
        if joined and pair is not None:
            raise ConfigError("--together joins poses at rest: leave out --wrench and --orientation-file")
        if joined and len(sources) < 2:
            raise ConfigError("--together joins two runs or more: name them, the oldest first")
        if output is not None and ((len(sources) > 1 and not joined) or method == "all" or cases):
            raise ConfigError("--output saves one result: give one dataset and one method")
        return cls(
            method,
            orientation,
            drift,
            known_values(mass_kg, level_deg, mounting_deg),
            up_direction(up),
            as_published=as_published,
            earlier=None if earlier is None else read_calibration(earlier),
            pair=pair,
            point_mass=point_mass,
            topics=(wrench_topic, pose_topic),
            table=table,
        )


def known_values(mass_kg: float | None, level_deg: float | None, mounting_deg: str | None) -> Known | None:
    """Return the values that the options declare known; None without such options. Raises `ConfigError` if invalid."""
    if mass_kg is None and level_deg is None and mounting_deg is None:
        return None
    R_flange_sensor = None
    if mounting_deg is not None:
        rotation_vector = parse_numbers("--mounting-deg", mounting_deg, ",", (3,))
        R_flange_sensor = Rotation.from_rotvec(rotation_vector, degrees=True).as_matrix()
    try:
        return Known(
            R_flange_sensor=R_flange_sensor,
            gravity_direction_base=None if level_deg is None else -UP_IN_BASE,
            direction_tolerance_rad=0.0 if level_deg is None else float(np.radians(level_deg)),
            mass_kg=mass_kg,
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error


def up_direction(up: str | None) -> list[float] | None:
    """Return the direction (3,) given by `--up`; None without the option. An invalid one raises `ConfigError`."""
    if up is None:
        return None
    direction = parse_numbers("--up", up, ",", (3,))
    if not any(direction):
        raise ConfigError(f"--up is {up}, which is not a direction: give 0,0,1 for a robot on a floor")
    return direction


_LINKS: Final = ("tool0", "flange")


def table_options(
    columns: str | None,
    rate: float | None,
    euler: str | None,
    tcp: str | None,
    wrench_frame: Any,
    sign: str | None,
    model: str | None,
    urdf: str | None,
) -> TableOptions:
    """Parse the options that describe a table. Raises `ConfigError` if one is invalid, `OSError` for a missing file."""
    offset = [0.0] * 6 if tcp is None else parse_numbers("--tcp", tcp, ",", (3, 6))
    turn = [*offset, 0.0, 0.0, 0.0][3:6]
    named, text = ({}, {}) if columns is None else _named_columns(columns)
    return TableOptions(
        columns=named,
        separator=text.get("separator", ""),
        decimal=text.get("decimal", ""),
        rate_Hz=rate,
        euler=euler or "",
        wrench_axes=wrench_frame,
        R_flange_tcp=Rotation.from_rotvec(turn).as_matrix(),
        p_flange_tcp_m=np.array(offset[:3]),
        sign=-1 if sign == "-1" else 1,
        forward=_forward(model, urdf),
    )


def _named_columns(text: str) -> tuple[Mapping[str, str], Mapping[str, Any]]:
    """Parse `--columns`, a list or a TOML file: return the columns by ftdrive's names, and the file's `[text]`."""
    if text.endswith(".toml"):
        try:
            document = tomllib.loads(read_file(text).decode())
            columns = document["columns"] if "text" not in document else document.get("columns", {})
        except (KeyError, ValueError) as error:
            raise ConfigError(
                f'{text} has no columns ({error}): write [columns] and lines such as fx = "Force X"'
            ) from error
        return {str(name): str(column) for name, column in columns.items()}, document.get("text", {})
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and column.strip() for name, _, column in pairs):
        raise ConfigError(f'--columns {text}: give NAME=COLUMN separated by commas, such as "t=Time,fx=Force X"')
    return {name.strip(): column.strip() for name, _, column in pairs}, {}


def _forward(model: str | None, urdf: str | None) -> Callable[[Array], tuple[Array, Array]] | None:
    """Return the function from joint angles (n, 6) to flange poses of a model or a URDF; None without either."""
    if model is not None and urdf is not None:
        raise ConfigError("--model and --urdf both describe the arm: leave one out")
    if urdf is not None:
        chain = _load_chain(urdf)
        return lambda q_rad: chain.poses(dict(zip(chain.names, q_rad.T, strict=True)))
    if model is None:
        return None
    if (name := model_named(model, 3)) is None:
        raise ConfigError(f"--model {model}: the models are {', '.join(MODELS)}; another arm needs --urdf FILE")

    def forward(q_rad: Array) -> tuple[Array, Array]:
        at_joints = frames(MODELS[name], q_rad)
        return at_joints.R_base_flange, at_joints.flange_m

    return forward


def _load_chain(urdf: str) -> Chain:
    file, _, query = urdf.partition("?")
    links = dict(parse_qsl(query))
    chain = failure = None
    for flange in [links["flange"]] if "flange" in links else _LINKS:
        try:
            chain = Chain(Path(file), links.get("base", ""), flange)
            break
        except BadUrl as error:
            failure = failure or error
    if chain is None:
        raise ConfigError(f"--urdf {urdf}: {failure}") from failure
    if len(chain.names) != 6:
        raise ConfigError(
            f"--urdf {urdf}: the chain has {len(chain.names)} moving joints, not 6: give its end, FILE?flange=LINK"
        )
    return chain


@dataclass(frozen=True, slots=True, eq=False)
class RecordedData:
    """Poses at rest from a run, a dataset or a table, with the other inputs of the solver."""

    dataset: CalibrationDataset
    provenance: dict[str, Any]
    g_m_s2: float = STANDARD_GRAVITY_M_S2
    setup: Setup = _UNDESCRIBED
    """Description of the cell by which the result is judged; empty for a dataset or table."""
    known: Known | None = None
    records: Sequence[PoseRecord] = ()
    """The poses with their samples if they are from a run; empty for other sources."""
    earlier: CalibrationResult | None = None
    """Earlier result, from which a new tool takes mounting, gravity direction and gain."""

    def solve(
        self,
        method: Method,
        *,
        drift: Drift = "auto",
        as_published: bool = False,
        earlier: CalibrationResult | None = None,
    ) -> CalibrationResult:
        """Return the calibration; with an earlier result, given here or in the run, solve only for a new tool."""
        earlier = earlier or self.earlier
        if earlier is not None:
            require_same_cell(earlier, self.provenance)
            return new_tool(earlier, self.dataset, self.provenance)
        return solve(
            self.dataset,
            method,
            drift=drift,
            known=self.known,
            g_m_s2=self.g_m_s2,
            setup=self.setup,
            provenance=self.provenance,
            as_published=as_published,
        )

    @property
    def p_flange_sensor_m(self) -> Array:
        """(3,) sensor origin from the flange face, flange axes; zero if the height is not configured."""
        return np.array([0.0, 0.0, self.setup.sensor_height_m or 0.0])

    @property
    def truth(self) -> Parameters | None:
        """True parameters if the run is from an emulated cell, else None."""
        truth = (self.provenance.get("station") or {}).get("truth")
        return None if truth is None else Parameters(*(np.array(truth[item.name]) for item in fields(Parameters)))


def read_source(source: Path, options: SolveOptions) -> RecordedData:
    """Read poses at rest from a run folder, dataset.json or table. Unusable data raise `BadDataset`."""
    known = options.known
    if source.is_dir():
        run = Run(source)
        if run.in_motion:
            raise BadDataset(f"{source} is a recording in motion and has no poses: solve it with {run.solve_command}")
        data = _recorded_data(run, run.records())
    elif source.suffix == ".json":
        data = RecordedData(CalibrationDataset.load(source), {"source": source.name, "versions": versions()})
    else:
        table = Table(source, options.table)
        dataset = table.dataset(options.orientation)
        recognised = {"table": table.words} if table.words else {}
        data = RecordedData(dataset, {"source": source.name, **recognised, "versions": versions()})
        if table.has_nominal_kinematics:
            data = replace(data, setup=replace(data.setup, orientation_accuracy_deg=NOMINAL_ORIENTATION_DEG))
        if table.gravity_is_measured:  # the base is defined by gravity
            known = replace(known or Known(), gravity_direction_base=-UP_IN_BASE)
    if options.table is not None and (source.is_dir() or source.suffix == ".json"):
        raise ConfigError(f"{source.name} is not a table: leave out options for tables, such as --columns")
    up_in_base = options.up_in_base
    if up_in_base is not None:
        provenance = {**data.provenance, "up_in_base": list(up_in_base)}
        data = replace(data, setup=replace(data.setup, up_in_base=up_in_base), provenance=provenance)
    if known is not None and known.gravity_direction_base is not None:
        known = replace(known, gravity_direction_base=-data.setup.up)
    return replace(data, known=known)


_TAKEN: Final = "give a path, a DataFrame, arrays by name, or a pair (R_base_flange, wrench)"


def as_source(source: Any) -> Any:
    """Convert a user's argument to a dataset, a recording, or a Path, DataFrame or mapping with either.

    A pair of R_base_flange (n, 3, 3), or n Rotations, and wrenches (n, 6), N and N·m, is a dataset. Raises `BadDataset`
    for arrays of other shapes, and for other arguments `TypeError`, whose message names the right call.
    """
    if isinstance(source, str):
        return Path(source)
    if isinstance(source, Run):
        return source.folder
    if isinstance(source, CalibrationResult):
        raise TypeError("this is a result, which is already solved: print it, or solve its data")
    if isinstance(source, tuple | list) and len(source) == 2 and not any(isinstance(part, Mapping) for part in source):
        try:
            return CalibrationDataset.of(*source)
        except (BadDataset, ValueError) as error:
            raise BadDataset(f"{error} Give (R_base_flange, wrench), of shapes (n, 3, 3) and (n, 6)") from error
    is_table = isinstance(source, Mapping) or hasattr(source, "columns")
    if is_table or isinstance(source, Path | CalibrationDataset) or hasattr(source, "pieces"):
        return source
    kind = f"an array of shape {source.shape}" if isinstance(source, np.ndarray) else type(source).__name__
    raise TypeError(f"{kind} has no column names: {_TAKEN}")


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
        Direction of the rotations in a table: flange to base coordinates, as in a robot pose, or the inverse.
    table : TableOptions, optional
        Facts that the table lacks: names of columns, units, order of angles, TCP.

    Raises
    ------
    DataError
        The data are invalid; the message names the file, and the row or the field.
    OSError
        The file cannot be read.
    TypeError
        The type of the source is not supported; the message names the right call.

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
        raise TypeError("this is a recording in motion without poses at rest: solve it with ftdrive.solve(recording)")
    if not isinstance(source, Path):
        return Table(source, table).dataset(orientation)
    return read_source(source, SolveOptions(orientation=orientation, table=table)).dataset


def require_same_cell(earlier: CalibrationResult, provenance: Mapping[str, Any]) -> None:
    """Raise `ConfigError` if an earlier result cannot be used for a new tool: it is rejected or from a different cell.

    Sensor, arm and mount are compared if both `earlier` and `provenance` name them.
    """
    if earlier.verdict == "rejected":
        raise ConfigError(f"--from: result {earlier.id} is rejected: give an accepted one")
    for what, *place, fix in (
        ("sensor", "devices", "sensor", "serial", ": give a result of the same sensor"),
        ("arm", "devices", "arm", "serial", ": give a result of the same arm"),
        ("mount", "setup", "mount", ""),
    ):
        before, now = at(earlier.provenance, *place), at(provenance, *place)
        if before and now and before != now:
            raise ConfigError(
                f"--from: result {earlier.id} is of the {what} {before}, but the new data are of {now}{fix}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What the solver needs besides the data of a run, from its run.json and events."""

    g_m_s2: float
    setup: Setup
    """Description of the cell by which the result is judged."""
    origin: dict[str, Any]
    """Provenance of the data: devices, run, description of the cell, temperature, load."""

    def provenance(self) -> dict[str, Any]:
        """Return the provenance for a result that is solved now, with time, command line and versions."""
        return {**made_now(), **self.origin}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A run with its result."""

    run: Run
    dataset: CalibrationDataset | None
    """Poses at rest; None for a run in motion."""
    result: CalibrationResult
    drift: DriftCheck | None


def solve_and_save(run: Run) -> Outcome:
    """Solve a run, and save its dataset and, unless rejected, the result. Raises `OSError` if that fails."""
    # Read the data from the files even right after a session, so that a replay gives exactly the same result.
    outcome = Outcome(run, None, solve_in_motion(run), None) if run.in_motion else solve_records(run, run.records())
    try:
        if outcome.dataset is not None:
            outcome.dataset.save(run.new_path("dataset"))
        if outcome.result.verdict != "rejected":
            outcome.result.save(run.new_path("calibration"))
    except OSError as error:
        saved = "all poses are" if outcome.dataset is not None else "the recording is"
        raise OSError(
            f"{error.strerror or error}: the result is not saved, but {saved}. Free disk space in {run.folder}, then "
            f"run {run.solve_command} --output FILE"
        ) from error
    return outcome


def solve_in_motion(
    run: Run, known: Known | None = None, *, earlier: CalibrationResult | None = None, point_mass: bool = False
) -> CalibrationResult:
    """Solve a run in motion; with an earlier result, given here or stored in the run, solve only for a new tool."""
    circumstances, earlier = circumstances_of(run), earlier or _earlier_of(run)
    if earlier is not None:
        require_same_cell(earlier, circumstances.origin)
    wrench, poses = means_of(run.motion_path)
    digest = hashlib.sha256()
    for file in files_of(run.motion_path):
        digest.update(read_file(file))
    recording = {"recording": run.motion_path.name, "recording_sha256": digest.hexdigest()}
    return solve_motion(
        wrench,
        poses,
        known=known,
        earlier=earlier,
        point_mass=point_mass,
        guarded=run.mode == "sweep",
        height_m=circumstances.setup.sensor_height_m,
        g_m_s2=circumstances.g_m_s2,
        setup=circumstances.setup,
        provenance={**circumstances.provenance(), **recording},
    )


def solve_records(run: Run, records: Sequence[PoseRecord]) -> Outcome:
    """Solve the poses `records`, which are those stored in the run, or those of a replay of the run."""
    data = _recorded_data(run, records)
    return Outcome(run, data.dataset, data.solve(run.method), drift_check(records))


def _earlier_of(run: Run) -> CalibrationResult | None:
    """Return the earlier result in run.json, from which a run for a new tool takes mounting, base and gain, or None."""
    document = run.header().get("earlier")
    return None if document is None else CalibrationResult.from_dict(document)


def _recorded_data(run: Run, records: Sequence[PoseRecord]) -> RecordedData:
    if not records:
        raise NotObservable(f"{run.folder} has no data to solve: {run.how_to_go_on}")
    circumstances = circumstances_of(run)
    marks = {"emulated": True} if circumstances.origin["station"] is not None else {}
    if "load" in circumstances.origin:
        marks["load"] = circumstances.origin["load"]
    dataset = dataset_from(records, {"run": run.folder.name, "devices": circumstances.origin["devices"], **marks})
    return RecordedData(
        dataset, circumstances.provenance(), circumstances.g_m_s2, circumstances.setup, None, records, _earlier_of(run)
    )


def circumstances_of(run: Run) -> Circumstances:
    """Return what the solver needs besides the data of a run, without reading the data.

    A tool with a load gets a name of its own, so that the result is not used for the tool alone.
    """
    header = run.header()
    config, load = header["config"], Load.of_header(header)
    sensor, tool, workcell, robot = (config.get(name, {}) for name in ("sensor", "tool", "workcell", "robot"))
    payload_kg = p_flange_payload_m = None
    for event in run.events():
        if event.get("event") == "weighed":  # the last one counts
            payload_kg, p_flange_payload_m = event["payload_kg"], event.get("p_flange_payload_m")
    tool_kg, mounting, height_mm = tool.get("mass_kg"), workcell.get("mounting"), sensor.get("height_mm")
    tool_kg = tool_kg + load.mass_kg if load and tool_kg else tool_kg
    tool_sigma_kg = None if load else tool.get("mass_sigma_kg")
    # With a load, the centre of mass may lie outside the tool's cylinders.
    cylinders_mm = [list(row) for row in tool.get("cylinders_mm", ())] if workcell.get("measured") and not load else []
    ranges = [sensor["range_N"], sensor["range_Nm"]] if sensor.get("range_N") and sensor.get("range_Nm") else None
    # Description of the cell in the provenance of a result, for later comparison with other cells and results.
    described = {
        "payload_kg": payload_kg,
        "p_flange_payload_m": p_flange_payload_m,
        "sensor_mass_kg": sensor.get("mass_kg"),
        "accuracy_percent": sensor.get("accuracy_percent"),
        "range": ranges,
        "mounting": mounting,
        "height_mm": height_mm,
        "tool_mass_kg": tool_kg,
        "tool_mass_sigma_kg": tool_sigma_kg,
        "cylinders_mm": cylinders_mm,
        "tool": f"{tool.get('name')} with {load}" if load else tool.get("name"),
        "mount": sensor.get("mount"),
    }
    origin = {
        "devices": header.get("devices", {}),
        "run": run.folder.name,
        "station": header.get("station"),
        "setup": described,
        "temperature_C": run.temperature_C(),
        **({"load": dict(header["load"])} if "load" in header else {}),
    }
    setup = Setup(
        up_in_base=None if mounting is None else (-down_of(mounting)).tolist(),
        tool_mass_kg=tool_kg,
        tool_mass_sigma_kg=tool_sigma_kg,
        cylinders_m=[[value / 1e3 for value in row] for row in cylinders_mm],
        sensor_height_m=None if height_mm is None else height_mm / 1e3,
        sensor_mass_kg=sensor.get("mass_kg"),
        payload_kg=payload_kg,
        sensor_accuracy_percent=sensor.get("accuracy_percent"),
        sensor_range=ranges,
        orientation_accuracy_deg=orientation_accuracy_deg(robot.get("host"), robot.get("orientation_accuracy_deg")),
        sensor_has_arbitrary_zero="zero" in (at(origin, "devices", "sensor", "facts") or ()),
    )
    return Circumstances(float(config["site"]["g_m_s2"]), setup, origin)
