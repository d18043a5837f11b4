"""The course of a session from the cell to the result, the task of a calibration, and the table of modes."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Final, cast, get_args

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftcalib.poses.information import predicted_sigma
from ftcalib.published.methods import SPECIAL
from ftcalib.result import Method
from ftcalib.rounding import to_place_of
from ftdrive.cell.config import CellConfig, SensorConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.checks.check import compare_devices
from ftdrive.errors import ConfigError, Declined, PlanRefused
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import down_of
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import NUMBERS, guess_of, plan_for
from ftdrive.planning.search.nodes import from_usual_wrist
from ftdrive.runs.load import Load
from ftdrive.runs.run import Mode, Run
from ftdrive.runs.source import Outcome, solve_and_save
from ftdrive.session import preflight
from ftdrive.session.events import Operator, State, StateChanged, rms_sigma
from ftdrive.session.guards import Limits
from ftdrive.session.hand_guided import take_by_hand
from ftdrive.session.live_fit import RunningFit
from ftdrive.session.open_session import Journal, Judge, OpenCell, OpenSession, SessionOptions, Task
from ftdrive.session.passive import take_passively
from ftdrive.session.sweep import on_script_path, take_sweep
from ftdrive.session.tour import take_tour
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo
from ftdrivers.registry import Options, split_url

# Options in the address of a sensor that select one of its factory calibrations, with their defaults.
_CHOOSES_CALIBRATION: Final = {"slot": 0, "calibration": 1}
# Properties that a sensor reports and that depend on its scale or its factory calibration.
_OF_NUMBERS: Final = ("counts_per_N", "counts_per_Nm", "range", "software_bias")


def _require_devices(
    connected: Mapping[str, DeviceInfo], config: SensorConfig, *, calibration: CalibrationResult | None, run: Run | None
) -> tuple[str, ...]:
    """Check that these are the devices of a calibration or resumed run; return warnings about what was not compared.

    Raises `ConfigError` if arm, sensor or mounting differ from the calibration, `PlanRefused` if not those of the run.
    """
    belongs = None if calibration is None else compare_devices(calibration, connected, config.mount)
    if belongs is not None and belongs.others:
        raise ConfigError(f"{belongs.others[0]}: calibrate this cell")
    if run is not None:
        _require_same_devices(run, config, connected)
    return () if belongs is None else belongs.unknown


def _require_same_devices(run: Run, config: SensorConfig, connected: Mapping[str, DeviceInfo]) -> None:
    """Raise `PlanRefused` if the devices, or the scaling of the sensor, differ from those of the run.

    Devices without a serial number are compared by their model, if the run has no serial number either.
    """
    header = run.header()
    devices = header["devices"]
    for name, info in connected.items():
        model, serial = devices[name]["model"], devices[name]["serial"]
        if (model, serial) == (info.model, info.serial):
            continue
        fix = f"connect the {name} of the run"
        if name == "sensor" and NOT_REPORTED in {serial, info.serial}:
            fix += ", or set serial=… in its address as in the run"
        raise PlanRefused(
            f"the run was made with the {name} {model}, serial {serial}, but {info.model}, serial {info.serial} is "
            f"connected: {fix}, or start a new run"
        )
    then = _meaning(header["config"]["sensor"], devices["sensor"].get("facts", {}))
    now = _meaning(asdict(config), asdict(connected["sensor"])["facts"])
    if other := [name for name in then if name in now and not np.array_equal(then[name], now[name])]:
        changes = " and ".join(f"{name} was {then[name]} and is {now[name]}" for name in other)
        raise PlanRefused(
            f"the sensor is configured differently from the run, {changes}: restore that setting, or start a new run"
        )


def _meaning(config: Mapping[str, Any], facts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the properties that define the scaling of a sensor: sign, factory calibration, scale and range."""
    options = Options(config["url"], split_url(config["url"]).query)
    chosen = {f"option {name}": options.integer(name, usual, 0, 255) for name, usual in _CHOOSES_CALIBRATION.items()}
    scale = {name: fact["value"] for name, fact in facts.items() if name in _OF_NUMBERS}
    return {"[sensor] sign": config.get("sign", 1), **chosen, **scale}


@dataclass(frozen=True, eq=False)
class Calibrating:
    """The task of a session that calibrates."""

    command: ClassVar[str] = "calibrate"
    goal: ClassVar[str] = "the coverage is green"
    calibration: ClassVar[None] = None
    warnings: ClassVar[tuple[str, ...]] = ()
    cell: CellConfig
    options: SessionOptions
    load: Load | None = None

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Return a tour. Raises `PlanRefused` if it lacks orientations that the method of calibration needs."""
        options = self.options
        # A wrist that is a full turn away is brought back by the approach, but not with a hanging load.
        q_rad = q_rad if certifier.arm.hung else from_usual_wrist(certifier, q_rad)
        plan = plan_for(self.cell, certifier, q_rad, poses, sets=options.sets)
        special = sum(step.number in NUMBERS[24] for step in plan.steps)
        if options.method in SPECIAL and special < 24:
            raise PlanRefused(
                f"{options.method} needs the 24 special orientations, but the tour has {special} of them: plan all "
                "24, jog the arm to a posture with more room, or choose --method lrom"
            )
        if options.method == "srom" and len(plan.steps) > 24:
            raise PlanRefused(
                f"srom needs the 24 special orientations alone, but the tour has {len(plan.steps) - 24} other poses: "
                "choose --method mixed"
            )
        return plan

    def judge(self, *, by_hand: bool) -> Judge:
        """Return a new running fit, which judges the poses of a calibration."""
        down_base = down_of(self.cell.workcell.mounting)
        return RunningFit(g_m_s2=self.cell.site.g_m_s2, down_base=down_base, advise=by_hand, load=self.load)

    def forecast(self, plan: Plan, certifier: Certifier, sigma: Array, /) -> str:
        """Describe the predicted sigmas of the result; empty for a new tool on a calibrated sensor, or with a load."""
        if plan.kind == "tool" or self.load is not None:
            return ""
        force_N, torque_Nm = rms_sigma(sigma)
        guess = replace(guess_of(certifier, self.cell), sigma_force_N=force_N, sigma_torque_Nm=torque_Nm)
        found = predicted_sigma(np.array([step.R_base_flange for step in plan.steps]), guess)
        assumed = " (assumed: [tool] mass_kg is not set)" if self.options.real and not self.cell.tool.mass_kg else ""
        return (
            f"predicted for {guess.mass_kg:g} kg{assumed}, a sensor gain error of {100 * guess.gain_sigma:.2g} %; one "
            f"sigma: mass {1e3 * found.sigma['mass_kg']:.2g} g, force bias {np.max(found.sigma['force_bias_N']):.2g} "
            f"N, compensation {found.force_rms_N:.2g} N, {to_place_of(found.torque_rms_Nm, found.torque_rms_Nm)} N·m"
        )


def run_calibration(
    cell: CellConfig, operator: Operator, options: SessionOptions, load: Load | None = None
) -> Outcome | None:
    """Guide the operator through a calibration; return its outcome, or None after a dry run. Raises as `take_poses`.

    `load` is a known load on the tool. A resumed run has the load with which it began.
    """
    if options.resume is not None:
        load = Load.of_header(Run(options.resume).header())
    if load is not None:
        # The run records the cell as configured; checks and guards treat the load as part of the tool.
        options = replace(
            options, description={**options.description, "config": cell.to_dict(), "load": load.to_dict()}
        )
        if cell.tool.mass_kg is not None:
            cell = replace(cell, tool=replace(cell.tool, mass_kg=cell.tool.mass_kg + load.mass_kg))
    cell = on_script_path(cell) if options.mode == "sweep" else cell
    run = take_poses(Calibrating(cell, options, load), operator, options)
    return None if run is None else solve_and_save(run)


def take_poses(task: Task, operator: Operator, options: SessionOptions) -> Run | None:
    """Guide the operator through the poses of a task; return the run, or None after a dry run.

    Raises `Declined` if the operator ended the session, and `NotAccepted`, `PlanRefused` or `ConfigError` if the
    session refuses to start. After `DeviceError`, `OSError` or `SupervisorGone` the run has all poses taken so far and
    can be resumed.
    """
    config = task.cell
    journal = Journal(operator, yes=options.yes)
    journal.show(StateChanged(state=State.IDLE))
    options = options.with_recorded_mode()
    resumed = None if options.resume is None else Run(options.resume, config.clock)
    if resumed is not None and resumed.command != task.command:
        raise ConfigError(f"{resumed.folder} was not made by {task.command}: continue it with {resumed.resume_command}")
    # A plan that lacks a pose is refused before a device is opened.
    plan = None if options.by_hand else _plan_on_disk(options, resumed)
    device, driver = build_sensor(config), build_arm(config)
    with (
        ExitStack() as locked,
        device as sensor,
        closing(driver) as arm,
        preflight.awake() as kept_awake,
        journal.recording_absence(),
    ):
        if resumed is not None:
            journal.keep_in(locked.enter_context(resumed))
        cell = OpenCell(arm, sensor, config.clock, journal, Limits.of(config.clock))
        arm.open()
        journal.show(StateChanged(state=State.PREFLIGHT))
        if not options.by_hand:
            # A session never stops the program of another client.
            preflight.require_no_program(arm, cell.clock, cell.limits)
            if options.real and not options.dry_run:
                cell.note(kept_awake)
        connected = {"arm": arm.identify(), "sensor": sensor.identify()}
        uncertain = _require_devices(connected, config.sensor, calibration=task.calibration, run=resumed)
        for words in (*uncertain, *task.warnings):
            cell.note(words, warning=True)

        def new_run() -> Run:
            description = describe_run(task, options, connected)
            return locked.enter_context(Run.create(options.runs, options.name, description, config.clock))

        run = _take(OpenSession(cell, task, options, resumed, plan, new_run))
    if run is None:
        return None
    if not (run.stops() or run.in_motion):
        raise Declined(f"the session ended before the first pose: {run.folder} has no pose to solve")
    journal.show(StateChanged(state=State.REPORT))
    return run


def _plan_on_disk(options: SessionOptions, run: Run | None) -> Plan | None:
    """Load the plan of the resumed run, or the plan of `--plan`; None if there is none.

    Raises `ConfigError` if the plan lacks a pose of `redo`, or is a sweep, which needs the guards of the mode "sweep".
    """
    if run is None:
        given = None if options.plan is None else Plan.load(options.plan)
        if given is not None and given.sweep is not None:
            raise ConfigError(
                f"{options.plan} is the plan of a sweep: leave out --plan and give --sweep, which plans a new one"
            )
        return given
    plan = Plan.load(run.plan_path)
    stops = len(plan.steps) + 1
    if wrong := sorted(stop for stop in options.redo if not 1 <= stop <= stops):
        raise ConfigError(f"pose {wrong[0]} cannot be taken again: the run has poses 1 to {stops}")
    return plan


def _take(session: OpenSession) -> Run | None:
    """Take the poses or the recording in the mode of the session; return the run, or None after a dry run."""
    by_mode: Mapping[Mode, Callable[[OpenSession], Run | None]] = {
        "auto": take_tour,
        "step": take_tour,
        "sweep": take_sweep,
        "manual": take_by_hand,
        "listen": take_by_hand,
        "passive": take_passively,
    }
    return by_mode[session.options.mode](session)


def describe_run(task: Task, options: SessionOptions, connected: Mapping[str, DeviceInfo]) -> dict[str, Any]:
    """Return the entries of run.json that describe task, cell, devices and mode of a session."""
    return {
        "command": task.command,
        "config": task.cell.to_dict(),
        "devices": {role: asdict(info) for role, info in connected.items()},
        "mode": options.mode,
        **({} if options.method == "ml" else {"method": options.method}),
        **({"station": {}} if task.cell.is_emulated else {}),  # another process: true values unknown
        **options.description,
    }


def method_of_poses(name: str) -> Method:
    """Return the method of this name. Raises `ConfigError` if there is none, or if it needs more than the poses."""
    if name not in get_args(Method):
        raise ConfigError(f"there is no method '{name}': choose one of {', '.join(get_args(Method))}")
    if name == "carlson-cayley":
        raise ConfigError(
            "carlson-cayley needs the mass on the sensor: take the poses without --method, then "
            "`ftdrive solve RUN --method carlson-cayley --mass-kg KG`"
        )
    return cast(Method, name)
