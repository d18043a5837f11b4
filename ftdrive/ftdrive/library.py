"""The functions of `import ftdrive` that join several rooms: solve, open devices and streams, plan a tour."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult, Known, Setup
from ftcalib import solve as solve_dataset
from ftcalib.likelihood.session import Drift
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.result import Method
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, cell_of, settings
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import EMULATED, Station, emulated_cell
from ftdrive.errors import ConfigError
from ftdrive.live.contact import Contact
from ftdrive.live.processing import SENSOR_FRAME
from ftdrive.live.samples import Stages, Tracking, WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for
from ftdrive.recording.files import is_recording
from ftdrive.recording.files import read_recording as read_ours
from ftdrive.recording.foreign import moving_source, tables_of
from ftdrive.recording.recording import ROW, Recording, rows_of
from ftdrive.runs.source import SolveOptions, as_source, read_calibration, read_dataset
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
        What `read_dataset` takes and gives, such as a pair (R_base_flange, wrench) of shapes (n, 3, 3) and (n, 6). A
        table whose rows follow one another quickly, a bag, a file of `ftdrive record` and what `read_recording` gives
        are recordings in motion.
    method : Method
        "ml": maximum likelihood, from 4 poses on; or one of the published methods, for comparison.
    table : TableOptions, optional
        What a table does not say.
    drift, known, g_m_s2, setup, provenance, as_published
        As for `ftcalib.solver.solve`. A recording in motion takes `known` and the up direction of `setup`.

    Raises
    ------
    DataError
        The source cannot be read.
    NotObservable
        The poses do not determine the parameters; the message names what is missing and what to add.
    ValueError
        An unknown method, known values that the method cannot use, or `as_published` for another method.
    TypeError
        The source is nothing of this; the message names the call that helps.

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
            from ftdrive.recording.in_motion import solve_recording

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
    """Read a recording into memory, also the `.partial` of one that was interrupted.

    Parameters
    ----------
    source : str, Path, DataFrame or mapping
        A file of `ftdrive record`, whose ending names the format: .mcap, .csv or .parquet. Or another program's: a bag,
        or a table with wrench and orientation, as text, as a DataFrame of pandas or Polars, or as arrays by name.
    columns : collection of str
        Fields of `Recording.rows` that are needed. Others may be missing, which makes reading faster.
    calibration : CalibrationResult, optional
        Of another program's recording, which has none; `raw` is the wrench as measured, `wrench` is 0.
    table : TableOptions, optional
        What another program's table does not say.

    Raises
    ------
    ConfigError
        Another ending, a missing package, or no calibration for another program's recording.
    BadRecording, BadDataset
        Damaged, without a sample, or of no known form. A file that was cut is read up to there; `cut` says so.
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
    """Read another program's recording. Raises `ConfigError` without a calibration, or `BadDataset`."""
    if calibration is None:
        raise ConfigError("the recording is another program's and has no calibration: give one as calibration=")
    from ftdrive.recording.table_pair import TablePair  # with the filters of a stream

    tables = tables_of(source, SolveOptions(table=table))
    if tables is None:
        raise ConfigError(f"{source} is a recording of ftdrive: leave out table=")
    pair = TablePair(*tables, calibration, "", None)
    return Recording(pair.header, np.concatenate([rows_of(block.samples) for block in pair.blocks()]), [])


_NOT_CONFIGURED = CellConfig(RobotConfig(""), SensorConfig(""))


def open_sensor(url: str, *, sign: int = 1) -> ForceTorqueSensor:
    """Open a sensor; `with` or `close` ends its stream.

    Parameters
    ----------
    url : str
        Such as "ati-can://can0?bitrate=250000"; "emulated://" is an emulated ATI sensor on CAN.
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
    """Open an arm for reading; `with` or `close` ends the connection. It is not moved.

    Parameters
    ----------
    host : str
        Name or address of the controller; "emulated://" is an emulated UR5e.
    model : str, optional
        Such as "ur5e", for a controller that does not report it.
    driver : str
        "ur", or the entry point of an arm of another package.

    Raises
    ------
    UsageError
        There is no such driver.
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
    config: str | Path | CellConfig | None = None,
    calibration: str | Path | CalibrationResult | None = None,
    *,
    tool: str | None = None,
    simulate: bool = False,
    sensor: ForceTorqueSensor | None = None,
    arm: RobotArm | None = None,
    frame: WrenchFrame = SENSOR_FRAME,
    stages: Stages | None = None,
    on_contact: Callable[[Contact], object] | None = None,
    force: bool = False,
    track: Tracking = "off",
) -> CompensatedStream:
    """Return the stream of compensated samples of a cell, for use with `with`. The arm is only read.

    Parameters
    ----------
    config : str, Path or CellConfig, optional
        A configuration file instead of ./ftdrive.toml, or the cell itself.
    calibration : str, Path or CalibrationResult
        A calibration.json or its run folder.
    tool : str
        Instead of `calibration`: the newest accepted one of this tool on the devices and mount of the cell, from the
        store and from the run folders in ./runs. `CompensatedStream.use_tool` switches to another one.
    simulate : bool
        An emulated cell instead of `config`: that of `calibration`, or the one that ./ftdrive.toml describes, which is
        calibrated with six poses first, in about 10 s. `CompensatedStream.station` controls it.
    sensor, arm : ForceTorqueSensor, RobotArm, optional
        Devices of your own, used in place of those in the configuration. With both no configuration is read.
    frame : WrenchFrame
        Axes and reference point of the wrench.
    stages : Stages
        What is done to the raw wrench.
    on_contact : callable
        Called with each `Contact` when it has lasted 40 to 60 ms, and again when it is over (`contact.over`), by the
        thread that reads. `CompensatedStream.on_contact` may be set at any time.
    force : bool
        Apply a calibration of another arm, sensor or mount, with a warning in `CompensatedStream.warnings`, or one that
        was edited by hand, with a mark in `StreamInfo.marks`.
    track : "off", "show" or "apply"
        Follow bias and held part while the arm works: `stream.status().tracked`. Only `apply` corrects the wrench.

    Raises
    ------
    UsageError
        The configuration cannot be used, or there is not one of calibration and tool.
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
        name, given = "", calibration
    cell: CellConfig | Station
    chosen: CalibrationResult | str
    if simulate:
        from ftdrive.session.rehearsal import NoOperator, short_calibration, station_of

        if any(one is not None for one in (config, tool, sensor, arm)):
            raise ConfigError("simulate=True opens an emulated cell: leave config, tool, sensor and arm out")
        given = short_calibration(NoOperator()) if given is None else given
        cell, chosen = station_of(given), given
    else:
        chosen = _only_one(given, tool)
        cell = _cell(config, sensor, arm)
    stream = CompensatedStream(cell, chosen, name=name, frame=frame, stages=stages, force=force, devices=(sensor, arm))
    stream.track = track
    stream.on_contact = on_contact
    return stream


def _only_one(calibration: CalibrationResult | None, tool: str | None) -> CalibrationResult | str:
    if calibration is not None and tool is None:
        return calibration
    if tool is not None and calibration is None:
        return tool
    found = "no calibration" if tool is None else "both a calibration and a tool"
    raise ConfigError(
        f"{found}: give the path of a calibration.json or of its run folder, the name of a tool, or simulate=True"
    )


def _cell(config: str | Path | CellConfig | None, sensor: ForceTorqueSensor | None, arm: RobotArm | None) -> CellConfig:
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
    """Plan a tour that is proven clear of the arm itself, the tool, planes and boxes. No robot is needed.

    Parameters
    ----------
    model : str
        Such as "ur5e".
    tool_mm : sequence of rows (from, to, diameter) or (from, to, diameter, x, y)
        Cylinders of tool and sensor, mm from the flange face; x, y is the offset of the axis.
    poses : {24, 12, 6}
    mounting : str
        "floor", "wall", "ceiling", or the degrees by which the base leans towards its -x.
    planes_mm : sequence of rows (nx, ny, nz, d)
        Walls: the arm stays where n·p >= d, base axes. The mounting surface is always included.
    boxes_mm : sequence of rows (x, y, z, x, y, z)
        Blocks, two corners each, base axes.
    mass_kg : float, optional
        Of the tool, for the predicted accuracy; default 1.
    posture_deg : sequence of 3 floats
        Present angles of the first three joints.

    Raises
    ------
    UsageError
        A shape is impossible, or there is no such model.
    AcceptanceError
        No tour is proven clear.

    Examples
    --------
    >>> import ftdrive
    >>> plan = ftdrive.plan_tour("ur5e", [(0, 200, 100)], 6)
    >>> len(plan.steps), plan.certified, plan.R_base_flange.shape
    (6, True, (6, 3, 3))
    """
    options = {
        "robot.model": ("model", model),
        "tool.cylinders_mm": ("tool_mm", _rows(tool_mm)),
        "tool.mass_kg": ("mass_kg", mass_kg),
        "workcell.mounting": ("mounting", mounting),
        "workcell.planes_mm": ("planes_mm", _rows(planes_mm)),
        "workcell.boxes_mm": ("boxes_mm", _rows(boxes_mm)),
        "workcell.measured": ("measured", True),
    }
    cell = cell_of(settings(flags=options, cell=_NOT_CONFIGURED), devices=False)
    if len(posture_deg) != 3:
        raise ConfigError(f"posture_deg has {len(posture_deg)} angles: give those of the first three joints")
    q_rad = np.array([*np.radians(posture_deg), *USUAL_POSTURE_RAD[3:]])
    return plan_for(cell, certifier_for(cell, cell.robot.model), q_rad, poses)


def _rows(rows: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in rows)
