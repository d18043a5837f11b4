"""Calibration of an emulated cell without questions, and changes to its load."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.accuracy import CONTACT_N
from ftcalib.loads.model import KnownLoad, LoadRun
from ftcalib.loads.solve import LoadSolution, solve_loads
from ftdrive.cell.emulated import REAL_PACE, TOOL_MM, Station
from ftdrive.errors import Declined, NotAccepted
from ftdrive.planning.geometry.arm_model import STRING_M
from ftdrive.runs.load import Load
from ftdrive.runs.source import Outcome
from ftdrive.session.events import Event, Key, Operator, Question
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.session import run_calibration


class NoOperator:
    """Stands in for an operator: shows nothing and returns no key; any question raises `Declined`."""

    has_keys = False
    pressed_by = "the operator"

    def show(self, event: Event) -> None:
        """Do nothing."""

    def ask(self, question: Question) -> str:
        """Raise `Declined`."""
        raise Declined(f"no operator can answer: {question.text}")

    def absence(self) -> str | None:
        """Return None, because this session needs no operator."""
        return None

    def pressed(self) -> Key | None:
        """Return None."""
        return None


class _Unkept:
    """Passes events to an operator, except those whose text names a folder that is temporary."""

    def __init__(self, operator: Operator, folder: Path) -> None:
        self._operator, self._folder = operator, str(folder)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._operator, name)

    def show(self, event: Event) -> None:
        if self._folder not in str(event.to_dict()):
            self._operator.show(event)


def rehearse(
    station: Station,
    runs: Path,
    name: str,
    operator: Operator,
    *,
    kept: bool = True,
    **options: Any,
) -> Outcome:
    """Calibrate an emulated cell and return the outcome.

    `kept` means that the folder `runs` is not temporary; the other keywords are those of `SessionOptions`.
    """
    chosen = SessionOptions(runs, name, real=False, questions=False, description=station.description, **options)
    outcome = run_calibration(station.cell, operator if kept else cast("Operator", _Unkept(operator, runs)), chosen)
    if outcome is None:
        raise RuntimeError("a rehearsal is never a dry run")
    return outcome


@contextmanager
def rehearsed_run(
    operator: AbstractContextManager[Operator], sensor: str | None = None, **options: Any
) -> Iterator[Path]:
    """Calibrate an emulated cell with options of `SessionOptions`; yields the run folder, which is deleted afterwards.

    The context `operator` is active only during the calibration; `sensor` is as in `sensor_name`.
    """
    with TemporaryDirectory(prefix="ftdrive-") as runs:
        with Station.of(None, sensor) as station, operator as shown:
            outcome = rehearse(station, Path(runs), "simulated", shown, kept=False, **options)
        yield outcome.run.folder


def short_calibration(operator: AbstractContextManager[Operator], sensor: str | None = None) -> CalibrationResult:
    """Return a calibration of an emulated cell from six poses, in about 10 s; parameters as in `rehearsed_run`.

    Raises `NotAccepted` if the result is rejected.
    """
    with TemporaryDirectory(prefix="ftdrive-") as runs, Station.of(None, sensor) as station, operator as shown:
        result = rehearse(station, Path(runs), "simulated", shown, poses=6, kept=False).result
    if result.verdict == "rejected":
        raise NotAccepted(f"the calibration of the emulated cell was rejected: {result.reasons[0]}")
    return result


def station_of(calibration: CalibrationResult, sensor: str | None = None) -> Station:
    """Return the emulated cell in which a calibration was made, not yet started; `sensor` replaces its sensor."""
    # Runs in real time, because a stream pairs samples and poses by the controller's clock.
    return Station.of(calibration.provenance.get("station"), sensor, REAL_PACE)


def put_on(station: Station, load: Load) -> None:
    """Attach the load to the tool of the emulated cell, and set the payload of its controller to the total mass."""
    truth = station.truth
    mass_kg = truth["mass_kg"] + load.mass_kg
    station.control(do="set-payload", payload_kg=mass_kg + truth["sensor_mass_kg"])
    if load.p_flange_mm is not None:
        place = list(load.p_flange_mm)
        station.control(do="hang", mass_kg=load.mass_kg, at_mm=place, string_mm=1e3 * STRING_M)
    else:
        # About midway between the fingers; the solver is not given this position.
        p_load_m = np.array([0.0, 0.0, TOOL_MM[1] / 1e3 - truth["p_flange_sensor_m"][2]])
        com_m = (truth["mass_kg"] * np.array(truth["p_sensor_com_m"]) + load.mass_kg * p_load_m) / mass_kg
        station.control(do="payload-shift", mass_kg=mass_kg, p_sensor_com_m=com_m.tolist())


_LOAD_KG, _LOAD_SIGMA_KG, _PLACE_SIGMA_MM, _LOAD_POSES = 2.0, 0.002, 0.5, 12
_HOOKS_MM = {"side": (100.0, 0.0, 50.0), "tip": (0.0, 0.0, 200.0)}
_DIRECTIONS = 300


def rehearse_loads(
    station: Station,
    runs: Path,
    tool: Outcome,
    operator: Callable[[], AbstractContextManager[Operator]],
    say: Callable[[str], object],
) -> LoadSolution:
    """Take poses with a load at each of two hooks; return the sensor matrix from these and the poses of `tool`."""
    truth = station.truth
    taken: list[tuple[Outcome, KnownLoad | None]] = [(tool, None)]
    for name, hook_mm in _HOOKS_MM.items():
        say(
            f"A load of {_LOAD_KG:.3f} kg hangs on a string at {name}, {hook_mm} mm from the flange. The load swings, "
            "because this quick tour moves its hook; `calibrate --load` turns the tool about the hook instead."
        )
        station.control(do="hang", mass_kg=_LOAD_KG, at_mm=hook_mm, swing_deg=0)
        whole_kg = truth["payload_kg"] + _LOAD_KG
        moment = truth["payload_kg"] * np.array(truth["payload_cog_m"]) + _LOAD_KG * np.array(hook_mm) / 1e3
        station.control(do="set-payload", payload_kg=whole_kg, payload_cog_m=(moment / whole_kg).tolist())
        with operator() as shown:
            outcome = rehearse(station, runs, f"demo-{name}", shown, poses=_LOAD_POSES)
        x, y, z = (value / 1e3 for value in hook_mm)
        load = KnownLoad(name, _LOAD_KG, _LOAD_SIGMA_KG, (x, y, z), _PLACE_SIGMA_MM / 1e3)
        taken.append((outcome, load))
    station.control(do="unhang")
    sets = [
        LoadRun(calibrated.run.folder.name, calibrated.dataset, load)
        for calibrated, load in taken
        if calibrated.dataset is not None
    ]
    return solve_loads(sets, p_flange_sensor_m=np.array(truth["p_flange_sensor_m"]), g_m_s2=truth["g_m_s2"])


def contact_errors(result: CalibrationResult, truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the RMS force error, N, for contacts of 100 N at the tip: as read, decoded, and as predicted (sigma).

    The mean is over random directions. The readings come from the true parameters, not from the solver's model.
    """
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    force = CONTACT_N * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    torque = np.cross(np.array(_HOOKS_MM["tip"]) / 1e3 - truth["p_flange_sensor_m"], force)
    R_flange_sensor = np.array(truth["R_flange_sensor"])
    exerted = np.concatenate([force @ R_flange_sensor, torque @ R_flange_sensor], axis=1)
    reading = exerted @ (np.eye(6) + truth["sensor_error"]).T
    decoded = result.contact.decode(reading)
    sigma = result.contact_sigma(decoded, np.eye(3))[:, :3]
    errors = {
        "as_read_N": reading[:, :3] @ R_flange_sensor.T - force,
        "decoded_N": decoded[:, :3] @ result.R_flange_sensor.T - force,
        "sigma_N": sigma,
    }
    return {name: float(np.sqrt((error**2).sum(axis=1).mean())) for name, error in errors.items()}
