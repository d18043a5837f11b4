"""`ftdrive loads`: known loads show whether a sensor reads a contact right, and correct its matrix."""

from contextlib import ExitStack
from datetime import UTC, datetime
from itertools import repeat
from math import degrees, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftcalib.rounding import with_sigma
from ftdrive.commands.common import JSON, SOURCE, Number, Source, stop_unless, write_json
from ftdrive.errors import ConfigError
from ftdrive.terminal.text import Group, echo, visible

if TYPE_CHECKING:
    from ftcalib.loads.check import LoadCheck
    from ftcalib.loads.model import KnownLoad, LoadRun
    from ftcalib.loads.solve import LoadSolution
    from ftcalib.sensor_matrix import SensorMatrix
    from ftdrive.live.weighing import Scale

# So much of the load as known must show, for the reading to be that of it.
_SHOWS = 0.5


@click.group(cls=Group)
def loads() -> None:
    """Check a sensor by a known weight, and correct its matrix by several: so that 10 N are 10 N."""


@loads.command()
@click.argument("mass", metavar="MASS")
@click.option("--at", metavar="NAME=X,Y,Z", help="Where it hangs, mm from the flange face along the flange axes.")
@SOURCE
@click.option("--replay", type=click.Path(exists=True, path_type=Path), help="Check a recording instead of a cell.")
@click.option("--zero", is_flag=True, help="First tare the free tool: then drift since the calibration is no error.")
@click.option("--poses", type=click.IntRange(1, 24), default=1, show_default=True, help="Rests to join.")
@click.option("--wait", "wait_s", type=Number(1, 600), default=60.0, show_default=True, help="Longest wait, seconds.")
@JSON
def check(
    mass: str,
    at: str | None,
    source: Source,
    replay: Path | None,
    zero: bool,
    poses: int,
    wait_s: float,
    as_json: bool,
) -> None:
    """Hang one known MASS (kg, such as 1.000) on a string, and compare what the sensor reads.

    The arm is only read. Let the load hang still; with --poses another program or your hand turns the arm between the
    rests. The answer has scale and line of action with one sigma of each, and whether the error is within what the
    sensor promises. The exit code is 7 if it is not.
    """
    from ftcalib.after.weighing import drift_since
    from ftcalib.loads.check import check_load
    from ftdrive.cell.emulated import TOOL_MM
    from ftdrive.live.weighing import Scale
    from ftdrive.runs.load import Load, mass_of

    load = Load("load", *mass_of(mass)) if at is None else Load.of(mass, at, gripped=False)
    with ExitStack() as stack:
        stream = _opened(source, replay, stack)
        if zero and replay is None:
            _zero(Scale(stream), stream, wait_s)
        if source.simulate and replay is None:
            x, y, z = hook_mm = load.p_flange_mm or (0.0, 0.0, TOOL_MM[1])
            stream.station.control(do="hang", mass_kg=load.mass_kg, at_mm=hook_mm, string_mm=250, swing_deg=0)
            echo(f"{load.mass_kg:g} kg hangs on the emulated tool, {x:g}, {y:g}, {z:g} mm from the flange.", err=True)
        measured, reference, tare_age_s = _weighed(stream, load.mass_kg, poses, wait_s, replayed=replay is not None)
    found = check_load(
        stream.info.calibration,
        reference,
        load,
        measured,
        drift=drift_since(tare_age_s),
        p_flange_sensor_m=stream.info.p_flange_sensor_m,
    )
    if as_json:
        values = {key: value if isfinite(value) else None for key, value in found._asdict().items()}
        head = {"schema_version": 1, "calibration_id": stream.info.calibration.id, "given_kg": load.mass_kg}
        more = {"is_within": found.is_within, "poses": len(measured[0]), "tared": isfinite(tare_age_s)}
        write_json({**head, **values, **more})
    else:
        _print_check(found, load)
    if not isfinite(tare_age_s):
        drifted = f"No tare: {100 * found.scale_sigma:.1f} % (1 sigma) has the drift since the calibration."
        free = "Record the free tool at rest for a second, and then hang the load."
        echo(f"{drifted} {'Use --zero.' if replay is None else free}", err=True)
    stop_unless(found.is_within, "the load reads otherwise than the sensor promises")


def _opened(source: Source, replay: Path | None, stack: ExitStack) -> Any:
    from ftdrive.commands.live import replayed
    from ftdrive.commands.live_source import open_source
    from ftdrive.live.processing import SENSOR_FRAME

    if replay is not None:
        return replayed(replay, source.path, SENSOR_FRAME, speed=float("inf"), force=source.force)
    return open_source(source, SENSOR_FRAME, stack)


def _zero(scale: "Scale", stream: Any, wait_s: float) -> None:
    """Tare the free tool. Raises `CannotWeigh`."""
    from ftdrive.live.weighing import CannotWeigh

    refusal = CannotWeigh("samples")
    for _ in stream.clock.looks(wait_s):
        stream.read()
        try:
            scale.zero()
        except CannotWeigh as error:
            refusal = error
        else:
            echo("Tared. Hang the load, and let it hang still.", err=True)
            return
    raise refusal


def _weighed(stream: Any, mass_kg: float, poses: int, wait_s: float, *, replayed: bool) -> Any:
    """Average what hangs at rest until enough poses are joined, or until a recording ends.

    A recording is tared by the last rest of the free tool before the load. Return the poses, the empty tool, and how
    many seconds before the poses it was tared.
    """
    from ftdrive.live.weighing import WEIGH_S, CannotWeigh, Scale

    scale, refusal, best, due_ns = Scale(stream), CannotWeigh("samples"), None, 0
    for _ in repeat(None) if replayed else stream.clock.looks(wait_s):
        rows = stream.read()
        if replayed and not len(rows):
            break
        if rows.t_host_ns[-1] < due_ns:
            continue
        due_ns = rows.t_host_ns[-1] + round(1e9 * WEIGH_S / 5)
        try:
            weight = scale.weigh(more=best is not None)
            if weight.mass_kg > _SHOWS * mass_kg:
                best = (scale.poses, *stream.reference())
                if not replayed and weight.poses >= poses:
                    break
            elif not replayed:
                refusal = CannotWeigh("samples")
            elif best is None and stream.reference()[1] > WEIGH_S:
                scale.zero()
        except CannotWeigh as error:
            refusal = error
    if best is not None:
        return best
    if refusal.code == "samples":
        raise ConfigError(f"no load of about {mass_kg:g} kg hangs at rest: hang it, or check MASS (kg)")
    raise refusal


def _print_check(found: "LoadCheck", load: "KnownLoad") -> None:
    off = with_sigma(100 * found.scale_error, 100 * found.scale_sigma, "+")
    echo(f"reads {found.read_N:.3f} N, expected {found.expected_N:.3f} N: {off} %")
    line = ""
    if load.p_flange_m is not None:
        line = f"; line of action {with_sigma(1e3 * found.off_m, 1e3 * found.off_sigma_m)} mm from {load.name}"
    echo(f"{degrees(found.off_vertical_rad):.1f}° off the vertical{line}")
    promised = f"{100 * found.promised_sigma:.1f} % (1 sigma) that the sensor promises"
    if not found.is_within:
        echo(f"OUTSIDE the {promised}: calibrate with known loads, or check the mass.")
    elif found.is_significant:
        echo(f"Within the {promised}; known loads correct it: ftdrive calibrate --load, ftdrive loads solve")
    else:
        echo(f"Right within the check, and within the {promised}.")


@loads.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--tool-mass",
    metavar="KG",
    help="Mass of the tool as weighed, such as 1.300 or 1.300±0.002; else that of [tool] mass_sigma_kg.",
)
@click.option("--accept", is_flag=True, help="Save a matrix that differs much from the one known before.")
@JSON
def solve(runs: tuple[Path, ...], tool_mass: str | None, accept: bool, as_json: bool) -> None:
    """Fit the matrix of the sensor to RUNS: the tool alone, and runs of `calibrate --load`.

    It is saved as sensor.json in this folder, only if the runs agree. Every command here then decodes contacts of this
    sensor with it, whatever the tool. Later loads narrow it.
    """
    from ftdrive.runs.load import mass_of
    from ftdrive.runs.sensor_file import next_sensor_file

    read = [_run_of(path) for path in runs]
    identity = read[0][1]
    if other := next((one for _, one, _ in read if one != identity), None):
        name, ours = next((name, value) for name, value in identity.items() if other[name] != value)
        raise ConfigError(f"the runs are of different sensors ({name} {ours} and {other[name]}): give those of one")
    data = read[0][2]
    of_cells = (one.setup.weighed_kg for _, _, one in read if one.setup.weighed_kg is not None)
    weighed = next(of_cells, None) if tool_mass is None else mass_of(tool_mass)
    prior = _prior(data, identity, [path.name for path in runs])
    from ftcalib.loads.solve import solve_loads

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
    hindering = [one for one in solution.findings if one.severity == "reject"]
    saved = None
    if not hindering or (accept and {one.code for one in hindering} == {"matrix_changed"}):
        saved = next_sensor_file()
        solution.sensor.save(saved)
    if as_json:
        write_json(_solution_json(solution, saved))
    else:
        _print_solution(solution, prior, saved)
    stop_unless(saved is not None, "the runs do not agree on a matrix")


def _run_of(path: Path) -> tuple["LoadRun", dict[str, Any], Any]:
    """Read one run with its load, the identity of its sensor, and what is known of its cell."""
    from ftcalib.loads.model import LoadRun
    from ftdrive.runs.load import Load
    from ftdrive.runs.sensor_file import sensor_identity
    from ftdrive.runs.source import SolveOptions, read_source

    data = read_source(path, SolveOptions())
    origin = data.provenance if "devices" in data.provenance else data.dataset.meta
    return LoadRun(path.name, data.dataset, Load.of_header(data.dataset.meta)), sensor_identity(origin), data


def _prior(data: Any, identity: dict[str, Any], names: list[str]) -> "SensorMatrix":
    """Return what is known of the sensor before these runs: by earlier loads, its data sheet, or as usual."""
    from ftcalib.sensor_matrix import SensorMatrix
    from ftdrive.runs.sensor_file import difference, sensor_files

    for path in reversed(sensor_files()):
        known = SensorMatrix.load(path)
        if not difference(known, identity) and not {*known.provenance.get("runs", ())} & {*names}:
            echo(f"Begins with {path.name} of {str(known.provenance.get('created_utc'))[:10]}.", err=True)
            return known
    return SensorMatrix.declared(data.setup)


def _contact_sigma(sensor: "SensorMatrix", tip_m: float) -> tuple[float, float]:
    """Return one sigma of force and torque of 100 N at the tip: of the length of the vector, mean over directions."""
    import numpy as np

    from ftcalib.model import Parameters

    nothing = Parameters(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    force, torque = sensor.after(nothing, None).sigma_at(np.array([0, 0, tip_m]))
    return 100 * force, 100 * torque


def _solution_json(solution: "LoadSolution", saved: Path | None) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "verdict": solution.verdict,
        "findings": [one.to_dict() for one in solution.findings],
        "loads": [dict(one) for one in solution.loads],
        "sizes": dict(solution.sizes),
        "remaining": list(solution.remaining),
        "tool_mass_kg": solution.tool_mass_kg,
        "tool_mass_sigma_kg": solution.tool_mass_sigma_kg,
        "sensor": solution.sensor.to_dict(),
        "saved": None if saved is None else str(saved),
    }


def _print_solution(solution: "LoadSolution", prior: "SensorMatrix", saved: Path | None) -> None:
    echo(f"{'load':14}{'mass, kg':>22}{'place from the flange, mm':>44}")
    for one in solution.loads:
        place = ", ".join(
            with_sigma(1e3 * p, 1e3 * s) for p, s in zip(one["p_flange_m"], one["p_sigma_m"], strict=True)
        )
        echo(f"{one['name']:14}{with_sigma(one['mass_kg'], one['mass_sigma_kg']):>22}{place:>44}")
    echo(f"{'tool':14}{with_sigma(solution.tool_mass_kg, solution.tool_mass_sigma_kg):>22}")
    _print_matrix(solution.sensor)
    tip_m = max((abs(one["p_flange_m"][2]) for one in solution.loads), default=0.2)
    (before, _), (after, torque) = _contact_sigma(prior, tip_m), _contact_sigma(solution.sensor, tip_m)
    echo(f"100 N at {1e3 * tip_m:.0f} mm: ± {after:.2g} N, ± {torque:.2g} N·m (of the sensor before: ± {before:.2g} N)")
    for finding in solution.findings:
        echo(f"{finding.severity.upper()}  {finding.words}")
    if saved is not None:
        echo(f"The runs agree. Saved {saved}: commands in this folder decode contacts with it.")


def _print_matrix(sensor: "SensorMatrix") -> None:
    from ftcalib.loads.solve import AXES

    diagonal = zip(AXES, sensor.error.diagonal(), sensor.sigma.diagonal(), strict=True)
    echo("diagonal, %: " + ", ".join(f"{axis} {with_sigma(100 * e, 100 * s, '+')}" for axis, e, s in diagonal))


@loads.command()
@JSON
def show(as_json: bool) -> None:
    """Show the matrix of the sensor in this folder: sensor.json, or the newest sensor-N.json."""
    from ftcalib.sensor_matrix import SensorMatrix

    path = _newest()
    sensor = SensorMatrix.load(path)
    if as_json:
        write_json({"schema_version": 1, "file": str(path), **sensor.to_dict()})
        return
    known = sensor.provenance
    echo(f"{path.name}: sensor {known.get('serial') or 'without serial number'}, {known.get('created_utc')}")
    echo(f"runs: {', '.join(map(str, known.get('runs', ())))}")
    _print_matrix(sensor)
    force, torque = _contact_sigma(sensor, 0.2)
    echo(f"100 N at 200 mm: ± {force:.2g} N, ± {torque:.2g} N·m; not linear by {100 * sensor.floor:.2g} % of the load")


@loads.command()
@click.option("--yes", is_flag=True, help="Do not ask.")
def drop(yes: bool) -> None:
    """Delete the newest file of the sensor's matrix in this folder, so that the one before it, or none, counts."""
    path = _newest()
    if yes or click.confirm(visible(f"Delete {path.name}?"), err=True):
        path.unlink()
        echo(f"Deleted {path.name}.")


def _newest() -> Path:
    from ftdrive.runs.sensor_file import sensor_files

    if not (files := sensor_files()):
        raise ConfigError("this folder has no sensor.json: `ftdrive loads solve RUN RUN …` makes one")
    return files[-1]
