"""The functions of `import ftdrive` that combine several packages: solve, open devices and streams, plan a tour."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult, Known, Setup
from ftcalib import solve as solve_dataset
from ftcalib.after.weighing import drift_since
from ftcalib.errors import FtdriveError
from ftcalib.likelihood.session import Drift
from ftcalib.loads.check import LoadCheck, check_hung_load
from ftcalib.loads.model import LoadRun
from ftcalib.loads.solve import LoadSolution, solve_loads
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.result import Method
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, cell_of, read_recorded, recorded_cell, settings
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import EMULATED, Station, emulated_cell
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.files import load_recording as read_ours
from ftdrive.recording.foreign import TablePair, is_recording, moving_source, tables_of
from ftdrive.recording.recording import ROW, Recording, to_records
from ftdrive.recording.replay import is_run_folder
from ftdrive.recording.solve import solve_recording
from ftdrive.runs.calibration import identity_mismatch, read_calibration, sensor_files, sensor_identity
from ftdrive.runs.load import Load, mass_of
from ftdrive.runs.run import Run
from ftdrive.runs.source import RecordedData, SolveOptions, as_source, read_dataset, read_source
from ftdrive.session.rehearsal import NoOperator, short_calibration, station_of
from ftdrive.stream.contact import Contact
from ftdrive.stream.processing import SENSOR_FRAME
from ftdrive.stream.samples import Stages, Tracking, WrenchFrame
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Stream, pump
from ftdrive.stream.weighing import WEIGH_S, CannotWeigh, Scale
from ftdrive.tables.table import TableOptions
from ftdrivers.interfaces import ForceTorqueSensor, RobotArm


def solve(
    source: Any,
    method: Method = "ml",
    *,
    table: TableOptions | None = None,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup | None = None,
    provenance: Mapping[str, Any] | None = None,
    as_published: bool = False,
) -> CalibrationResult:
    """Calibrate from poses at rest, or from a recording in motion.

    Parameters
    ----------
    source : str, Path, Run, DataFrame, mapping, pair of arrays, CalibrationDataset or Recording
        A source or result of `read_dataset`, such as a pair (R_base_flange, wrench) of shapes (n, 3, 3) and (n, 6). A
        table with closely spaced rows, a ROS bag, a file of `ftdrive record` and a result of `read_recording` are
        recordings in motion.
    method : Method
        "ml": maximum likelihood, which needs at least 4 poses; or one of the published methods, for comparison.
    table : TableOptions, optional
        What the table itself does not contain.
    drift, known, g_m_s2, setup, provenance, as_published
        As for `ftcalib.solver.solve`. For a recording in motion, only `known` and the up direction of `setup` are used.

    Raises
    ------
    DataError
        The source cannot be read.
    NotObservable
        The poses do not determine the parameters; the message names what is missing and what to add.
    ValueError
        The method is unknown, cannot use the known values, or does not support `as_published`.
    TypeError
        The type of the source is not supported; the message names the right call.

    Examples
    --------
    >>> import ftdrive
    >>> result = ftdrive.solve("poses.csv")
    >>> result.verdict, result.n_poses
    ('good', 24)
    >>> dataset = ftdrive.read_dataset("poses.csv")
    >>> result.compensate(dataset.wrench, dataset.R_base_flange).shape
    (24, 6)
    """
    setup = setup or Setup()
    source = as_source(source)
    if not isinstance(source, CalibrationDataset):
        moving = source if isinstance(source, Recording) else moving_source(source, SolveOptions(table=table))
        if moving is not None:
            if method != "ml":
                raise ValueError(f"method {method} is for poses at rest: leave it out for a recording")
            return solve_recording(moving, known=known, point_mass=False, up_in_base=setup.up_in_base)
        source = read_dataset(source, table=table)
    return solve_dataset(
        source,
        method,
        drift=drift,
        known=known,
        g_m_s2=g_m_s2,
        setup=setup,
        provenance=provenance,
        as_published=as_published,
    )


def read_recording(
    source: Any,
    columns: Collection[str] = ROW.names or (),
    *,
    calibration: CalibrationResult | None = None,
    table: TableOptions | None = None,
) -> Recording:
    """Read a recording into memory, or the `.partial` file of an interrupted recording.

    Parameters
    ----------
    source : str, Path, DataFrame or mapping
        A file of `ftdrive record`, with the format given by its suffix: .mcap, .csv or .parquet; or of another program:
        a ROS bag, or a table with wrench and orientation as text, DataFrame or arrays by name.
    columns : collection of str
        Required fields of `Recording.rows`. Others may be left out, which makes reading faster.
    calibration : CalibrationResult, optional
        Calibration to store with another program's recording. It is not applied: rows have `raw`, and 0 as `wrench`.
    table : TableOptions, optional
        What the table itself does not contain.

    Raises
    ------
    ConfigError
        The suffix is unknown, a package is missing, or a recording of another program has no calibration.
    BadRecording, BadDataset
        The file is damaged, empty or of an unknown format. A truncated file is read to its end; `cut` gives the reason.
    OSError
        The file does not exist or cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> recording = ftdrive.read_recording("peg.csv")
    >>> table = recording.table  # a DataFrame: recording.to_frame()
    >>> table["fz"].shape, table["raw_fz"].shape
    ((3000,), (3000,))
    """
    source = Path(source) if isinstance(source, str) else source
    if not isinstance(source, Path) or not (is_recording(source) or (calibration is None and table is None)):
        return _of_tables(source, calibration, table)
    return read_ours(source, columns)


def _of_tables(source: Any, calibration: CalibrationResult | None, table: TableOptions | None) -> Recording:
    if calibration is None:
        raise ConfigError("a recording of another program has no calibration: give one as calibration=")
    tables = tables_of(source, table)
    if tables is None:
        raise ConfigError(f"{source} is a recording of ftdrive: leave out table=")
    pair = TablePair(*tables, calibration, "", None)
    return Recording(pair.header, np.concatenate([to_records(block.samples) for block in pair.blocks()]), [])


_NOT_CONFIGURED = CellConfig(RobotConfig(""), SensorConfig(""))


def open_sensor(url: str, *, sign: int = 1) -> ForceTorqueSensor:
    """Open and return a sensor; `with` or `close` ends its stream.

    Parameters
    ----------
    url : str
        Address such as "ati-can://can0?bitrate=250000"; "emulated://" is an emulated ATI sensor on CAN.
    sign : {1, -1}
        -1 for a sensor that reports the reaction.

    Raises
    ------
    UsageError
        The address cannot be used.
    DeviceError
        The sensor does not answer, or reports a fault.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_sensor("emulated://") as sensor:
    ...     samples = sensor.collect(0.5)
    >>> samples.wrench.shape == (len(samples), 6)
    True
    """
    sensor = build_sensor(CellConfig(RobotConfig(""), SensorConfig(url, sign=sign)))
    sensor.open()
    return sensor


def open_arm(host: str, *, model: str | None = None, driver: str = "ur") -> RobotArm:
    """Open and return an arm for reading; `with` or `close` ends the connection. The arm is not moved.

    Parameters
    ----------
    host : str
        Name or address of the controller; "emulated://" is an emulated UR5e.
    model : str, optional
        Model such as "ur5e", for a controller that does not report it.
    driver : str
        "ur", or the entry point of a driver in another package.

    Raises
    ------
    UsageError
        The driver does not exist.
    DeviceError
        The arm does not answer.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_arm("emulated://") as arm:
    ...     print(arm.identify().model, arm.state().R_base_flange.shape)
    UR5e (3, 3)
    """
    if host.startswith(EMULATED):
        arm = build_arm(emulated_cell(host))
    else:
        arm = build_arm(CellConfig(RobotConfig(host, model, driver=driver), SensorConfig("")))
    arm.open()
    return arm


def open_stream(
    config: str | Path | CellConfig | Station | None = None,
    calibration: str | Path | CalibrationResult | None = None,
    *,
    name: str = "",
    tool: str | None = None,
    simulate: bool = False,
    sensor: ForceTorqueSensor | None = None,
    arm: RobotArm | None = None,
    frame: WrenchFrame = SENSOR_FRAME,
    stages: Stages | None = None,
    on_contact: Callable[[Contact], object] | None = None,
    force: bool = False,
    track: Tracking = "off",
) -> Stream:
    """Return the stream of compensated samples of a cell, for use in a `with` block. The arm is only read.

    Parameters
    ----------
    config : str, Path, CellConfig or Station, optional
        A configuration file instead of ./ftdrive.toml, or the cell itself; the stream starts an emulated cell.
    calibration : str, Path or CalibrationResult
        A calibration.json or its run folder.
    name : str
        Name of a `CalibrationResult` in recordings and on screens; default for a file: its path.
    tool : str
        Use the newest accepted calibration of this tool for the devices and mount of the cell, from the store and the
        run folders in ./runs, instead of `calibration`. `Stream.use_tool` switches to another tool.
    simulate : bool
        Use an emulated cell instead of `config`: that of `calibration`, or the one described by ./ftdrive.toml,
        calibrated first with six poses in about 10 s. `Stream.station` controls it.
    sensor, arm : ForceTorqueSensor, RobotArm, optional
        Devices to use instead of those in the configuration. With both, no configuration is read.
    frame : WrenchFrame
        Axes and reference point of the wrench.
    stages : Stages
        Processing steps between raw and compensated wrench.
    on_contact : callable
        Called by the reading thread with each `Contact` 40 to 60 ms after its start, and again at its end
        (`contact.over`). `Stream.on_contact` may be set at any time.
    force : bool
        Apply a calibration of another arm, sensor or mount, with a warning in `Stream.warnings`, or one that
        was edited by hand, with a mark in `StreamInfo.marks`.
    track : "off", "show" or "apply"
        Track bias and held part while the arm works: `stream.status().tracked`. Only `apply` corrects the wrench.

    Raises
    ------
    UsageError
        The configuration cannot be used, or not exactly one of calibration and tool is given.
    DataError, OSError
        The calibration cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_stream(simulate=True, frame=ftdrive.WrenchFrame("base")) as stream:
    ...     sample = next(iter(stream))
    >>> sample.force_N.shape, str(sample.frame)
    ((3,), 'base axes, about the sensor origin')
    """
    given: CalibrationResult | None
    if isinstance(calibration, str | Path):
        name, given = str(calibration), read_calibration(calibration, accept_edited=force)
    else:
        given = calibration
    cell: CellConfig | Station
    chosen: CalibrationResult | str
    if simulate:
        if any(one is not None for one in (config, tool, sensor, arm)):
            raise ConfigError("simulate=True opens an emulated cell: leave config, tool, sensor and arm out")
        given = short_calibration(nullcontext(NoOperator())) if given is None else given
        cell, chosen = station_of(given), given
    else:
        chosen = _only_one(given, tool)
        cell = config if isinstance(config, Station) else _cell_config(config, sensor, arm)
    source = CellSource(cell, chosen, name=name, force=force, devices=(sensor, arm))
    return Stream(source, frame=frame, stages=stages, track=track, on_contact=on_contact)


def _only_one(calibration: CalibrationResult | None, tool: str | None) -> CalibrationResult | str:
    if calibration is not None and tool is None:
        return calibration
    if tool is not None and calibration is None:
        return tool
    found = "no calibration" if tool is None else "both a calibration and a tool"
    raise ConfigError(
        f"{found}: give the path of a calibration.json or of its run folder, the name of a tool, or simulate=True"
    )


def _cell_config(
    config: str | Path | CellConfig | None, sensor: ForceTorqueSensor | None, arm: RobotArm | None
) -> CellConfig:
    if isinstance(config, CellConfig):
        return config
    if config is None and sensor is not None and arm is not None:
        return _NOT_CONFIGURED
    found, devices = settings(None if config is None else Path(config)), sensor is None and arm is None
    if devices and (simulated := found["robot.simulate"]).value:
        raise ConfigError(f"{simulated.origin} describes an emulated cell: open it with simulate=True")
    return cell_of(found, devices=devices)


def plan_tour(
    model: str,
    tool_mm: Sequence[Sequence[float]],
    poses: int = 24,
    *,
    mounting: str = "floor",
    planes_mm: Sequence[Sequence[float]] = (),
    boxes_mm: Sequence[Sequence[float]] = (),
    mass_kg: float | None = None,
    posture_deg: Sequence[float] = tuple(np.degrees(USUAL_POSTURE_RAD[:3])),
) -> Plan:
    """Plan a tour that is proven clear of collisions with the arm, the tool, planes and boxes. No robot is needed.

    Parameters
    ----------
    model : str
        Model of the arm, such as "ur5e".
    tool_mm : sequence of rows (from, to, diameter) or (from, to, diameter, x, y)
        Cylinders of tool and sensor, mm from the flange face; x, y is the offset of the axis.
    poses : {24, 12, 6}
    mounting : str
        "floor", "wall", "ceiling", or the tilt of the base towards its -x in degrees.
    planes_mm : sequence of rows (nx, ny, nz, d)
        Walls: the arm stays where n·p >= d, base axes. The mounting surface is always included.
    boxes_mm : sequence of rows (x, y, z, x, y, z)
        Blocks given by two opposite corners, base axes.
    mass_kg : float, optional
        Mass of the tool for the predicted accuracy; default 1.
    posture_deg : sequence of 3 floats
        Current angles of the first three joints.

    Raises
    ------
    UsageError
        A shape is impossible, or the model is unknown.
    AcceptanceError
        No tour could be proven clear of collisions.

    Examples
    --------
    >>> import ftdrive
    >>> plan = ftdrive.plan_tour("ur5e", [(0, 200, 100)], 6)
    >>> len(plan.steps), plan.certified, plan.R_base_flange.shape
    (6, True, (6, 3, 3))
    """
    options = {
        "robot.model": ("model", model),
        "tool.cylinders_mm": ("tool_mm", _float_rows(tool_mm)),
        "tool.mass_kg": ("mass_kg", mass_kg),
        "workcell.mounting": ("mounting", mounting),
        "workcell.planes_mm": ("planes_mm", _float_rows(planes_mm)),
        "workcell.boxes_mm": ("boxes_mm", _float_rows(boxes_mm)),
        "workcell.measured": ("measured", True),
    }
    cell = cell_of(settings(flags=options, cell=_NOT_CONFIGURED), devices=False)
    if len(posture_deg) != 3:
        raise ConfigError(f"posture_deg has {len(posture_deg)} angles: give those of the first three joints")
    q_rad = np.array([*np.radians(posture_deg), *USUAL_POSTURE_RAD[3:]])
    return plan_for(cell, certifier_for(cell, cell.robot.model), q_rad, poses)


def certifier_of(stream: Stream, replayed: Path | None, say: Callable[[str], object]) -> Certifier | None:
    """Return the certifier for the arm and the tool of a stream's cell, or of the replayed run or recording.

    None for a table of another program, and if the cell has no description of arm and tool; `say` receives the reason.
    """
    try:
        if replayed is None:
            cell = stream.cell
        elif is_run_folder(replayed):
            cell = recorded_cell(Run(replayed).header()["config"])
        else:
            cell = recorded_cell(read_recorded(RecordingReader(replayed).header.configuration))
    except (FtdriveError, KeyError, TypeError):
        return None
    try:
        return certifier_for(cell, stream.info.arm.model)
    except ConfigError as error:
        say(f" The page shows no arm: {error}")
        return None


def _float_rows(rows: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in rows)


# A reading of at least this fraction of the known load's mass means that the load hangs from the tool.
_SHOWS = 0.5


def check_known_load(
    stream: Stream, load: Load, poses: int, wait_s: float, *, replayed: bool
) -> tuple[LoadCheck, int, float]:
    """Average the load at rest until enough poses are combined or a recording ends, and compare it with the known load.

    A recording is tared at the last rest of the free tool before the load. Return the check, the number of poses, and
    the time since the tare, s.
    """
    scale, refusal, best, due_ns = Scale(stream), CannotWeigh("samples"), None, 0
    end_s = stream.clock.now_s() + wait_s
    for rows in pump(stream, until=None if replayed else lambda: stream.clock.now_s() > end_s, patience_s=0.0):
        if not rows or rows.t_host_ns[-1] < due_ns:
            continue
        due_ns = rows.t_host_ns[-1] + round(1e9 * WEIGH_S / 5)
        try:
            weight = scale.weigh(more=best is not None)
            if weight.mass_kg > _SHOWS * load.mass_kg:
                best = (scale.poses, *stream.processor.monitor.reference())
                if not replayed and weight.poses >= poses:
                    break
            elif not replayed:
                refusal = CannotWeigh("samples")
            elif best is None and stream.processor.monitor.reference()[1] > WEIGH_S:
                scale.zero()
        except CannotWeigh as error:
            refusal = error
    if best is None and refusal.code == "samples":
        raise ConfigError(f"no load of about {load.mass_kg:g} kg hangs at rest: hang the load, or check MASS (kg)")
    if best is None:
        raise refusal
    measured, reference, tare_age_s = best
    drift, p_m = drift_since(tare_age_s), stream.info.p_flange_sensor_m
    found = check_hung_load(stream.info.calibration, reference, load, measured, drift=drift, p_flange_sensor_m=p_m)
    return found, len(measured[0]), tare_age_s


def solve_load_runs(
    paths: Sequence[Path], tool_mass: str | None, say: Callable[[str], object]
) -> tuple[LoadSolution, SensorMatrix]:
    """Fit the matrix of a sensor to runs with the tool alone and with loads; return the solution and the prior matrix.

    `tool_mass` is the weighed mass, such as "1.300±0.002"; by default, the one in the configuration of the cells. `say`
    receives the source of the prior. Raises `ConfigError` if the sensors differ, and whatever `read_source` raises.
    """
    read = [_run_of(path) for path in paths]
    identity, data = read[0][1:]
    if other := next((one for _, one, _ in read if one != identity), None):
        name, ours = next((name, value) for name, value in identity.items() if other[name] != value)
        raise ConfigError(f"the runs are of different sensors ({name} {ours} and {other[name]}): give runs of one")
    of_cells = (one.setup.weighed_kg for _, _, one in read if one.setup.weighed_kg is not None)
    weighed = next(of_cells, None) if tool_mass is None else mass_of(tool_mass)
    prior = _prior_matrix(data, identity, [path.name for path in paths], say)
    solution = solve_loads(
        [run for run, _, _ in read],
        prior,
        p_flange_sensor_m=data.p_flange_sensor_m,
        g_m_s2=data.g_m_s2,
        setup=data.setup,
        tool_mass_kg=weighed,
        provenance={
            "serial": identity["serial"],
            "sensor": identity,
            "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    )
    return solution, prior


def _run_of(path: Path) -> tuple[LoadRun, dict[str, Any], RecordedData]:
    data = read_source(path, SolveOptions())
    origin = data.provenance if "devices" in data.provenance else data.dataset.meta
    return LoadRun(path.name, data.dataset, Load.of_header(data.dataset.meta)), sensor_identity(origin), data


def _prior_matrix(
    data: RecordedData, identity: dict[str, Any], names: list[str], say: Callable[[str], object]
) -> SensorMatrix:
    """Return the sensor matrix before the fit, as prior: from earlier loads, the data sheet, or typical errors."""
    for path in reversed(sensor_files()):
        known = SensorMatrix.load(path)
        if not identity_mismatch(known, identity) and not {*known.provenance.get("runs", ())} & {*names}:
            say(f"Starting from {path.name} of {str(known.provenance.get('created_utc'))[:10]}.")
            return known
    return SensorMatrix.declared(data.setup)
