"""Passive calibration: another program or the operator moves the arm, and ftdrive only reads the arm and the sensor."""

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Final

from ftcalib import Setup
from ftcalib.errors import AcceptanceError, DataError
from ftcalib.motion.solve import solve_motion
from ftcalib.result import CalibrationResult
from ftcalib.rounding import with_sigma
from ftdrive.errors import Declined
from ftdrive.runs.motion import MotionRecording, means_of
from ftdrive.runs.run import Run
from ftdrive.runs.source import circumstances_of
from ftdrive.session.events import Key, MotionRecorded
from ftdrive.session.open_session import OpenCell, OpenSession
from ftdrivers.errors import ConnectError, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import ArmStates, FtSamples

# Duration of the recording at the first fit, s; each later fit follows when the recording is 25 % longer.
FIRST_S: Final = 10.0
LONGER: Final = 1.25
# Shortest useful recording, s.
LEAST_S: Final = 5.0
# Duration of the recording in each file, s; a power failure loses no more than this.
PART_S: Final = 1.0
_READ_S: Final = 0.2
# A device that sends nothing for this time ends the recording, s; after a shorter time there is only a gap.
_SILENT_S: Final = 10.0
# Number of consecutive good fits that end the recording.
GOOD: Final = 2


def take_passively(session: OpenSession) -> Run:
    """Record the free tool in motion (see `record_passively`); return the run."""
    run = session.new_run()
    known = circumstances_of(run)
    record_passively(session.cell, run, session.options.seconds, known.setup, known.g_m_s2)
    return run


def record_passively(
    cell: OpenCell, run: Run, seconds: float, setup: Setup, g_m_s2: float, fits: Executor | None = None
) -> None:
    """Record the free tool in motion until two consecutive fits are good, the operator presses q, or time is up.

    Each second of data is on disk before the next. Each fit is shown with its sigmas and with the missing motion. The
    fits run in a thread of `fits`, so a lost device is noticed during a fit too and raises `DeviceError`; the run has
    the recording so far. Raises `Declined` if the operator ends the recording before it is long enough for a fit.
    """
    # Every sample is kept, not only sums, so that the run can be solved again with a new search for contact.
    cell.note(f"Recording for at most {seconds:.0f} s; nothing is commanded. Keep the tool free for part of the time.")
    cell.journal.keep_in(run)
    executor = fits or ThreadPoolExecutor(1)
    recorder = _Recorder(cell, run)
    try:
        with cell.journal.reporting_early_end(run):
            recorder.record(seconds, lambda at_s: executor.submit(_fitted, run, at_s, setup, g_m_s2))
    finally:
        executor.shutdown(wait=False, cancel_futures=True)
    if recorder.duration_s < LEAST_S:
        raise Declined(f"ended after {recorder.duration_s:.1f} s: record {FIRST_S:.0f} s or more")
    event = MotionRecorded(
        file=run.motion_path.name,
        duration_s=recorder.duration_s,
        samples=recorder.samples,
        states=recorder.states,
        temperature_C=cell.sensor.temperature_C(),
    )
    cell.journal.show(event, sync=True)


class _Recorder:
    def __init__(self, cell: OpenCell, run: Run) -> None:
        self._cell, self._run = cell, run
        self._unsaved: tuple[list[FtSamples], list[ArmStates]] = [], []
        self._parts = self.samples = self.states = 0
        self.duration_s = 0.0

    def record(self, seconds: float, fit: Callable[[float], "Future[tuple[str, bool]]"]) -> None:
        cell, clock = self._cell, self._cell.clock
        (self._run.folder / "motion").mkdir()
        begin_s = heard_s = saved_s = clock.now_s()
        next_s, good, running = FIRST_S, 0, None
        is_silent = False
        with cell.sensor.follow() as wrench, cell.arm.follow() as poses:
            try:
                for _ in clock.looks(seconds):
                    try:
                        samples, states = self._unsaved
                        samples.append(wrench.read(_READ_S))
                        states.append(poses.read(0.0))
                        heard_s, is_silent = clock.now_s(), False
                    except (DeviceTimeout, StreamBroken, ConnectError) as error:  # a sensor with `recover` reconnects
                        if clock.now_s() - heard_s > _SILENT_S:
                            raise
                        if not is_silent:
                            cell.note(f"{error}. Waiting up to {_SILENT_S:.0f} s for new data.", warning=True)
                        is_silent = True
                        clock.sleep(_READ_S)
                    self.duration_s = clock.now_s() - begin_s
                    if clock.now_s() - saved_s >= PART_S:
                        self._save()
                        saved_s = clock.now_s()
                    if cell.journal.pressed() is Key.STOP:
                        cell.note(f"stopped by {cell.journal.pressed_by}")
                        break
                    if running is not None and running.done() and not is_silent:
                        words, is_good = running.result()
                        cell.note(words)
                        running, good = None, good + 1 if is_good else 0
                        if good == GOOD:
                            break
                    if running is None and self.duration_s >= next_s and not is_silent:
                        next_s, running = LONGER * self.duration_s, fit(self.duration_s)
            finally:
                self._save()

    def _save(self) -> None:
        samples, states = self._unsaved
        if samples and states:
            joined = FtSamples.concatenate(samples), ArmStates.concatenate(states)
            self._unsaved = [], []
            if any(map(len, joined)):
                part = MotionRecording(*joined, self._cell.sensor.health().nominal_rate_Hz)
                self._parts += 1
                part.save(self._run.folder / "motion" / f"{self._parts}.npz")
                self.samples, self.states = self.samples + len(joined[0]), self.states + len(joined[1])


def _fitted(run: Run, at_s: float, setup: Setup, g_m_s2: float) -> tuple[str, bool]:
    """Fit the recording on disk; return a description of the fit, and whether the fit is good."""
    try:
        wrench, poses = means_of(run.motion_path)
        result = solve_motion(wrench, poses, setup=setup, height_m=setup.sensor_height_m, g_m_s2=g_m_s2)
    except (AcceptanceError, DataError) as error:
        return f"{at_s:.0f} s: {error}", False
    return f"{at_s:.0f} s: {_describe_fit(result)}", result.verdict == "good"


def _describe_fit(result: CalibrationResult) -> str:
    mass = with_sigma(result.mass_kg, float(result.sigma["mass_kg"]))
    force_N, torque_Nm = result.predicted_error()
    used = 0.0 if result.motion is None else 100 * result.motion.used_share
    why = f"; {result.reasons[0]}" if result.verdict != "good" and result.reasons else ""
    return (
        f"{result.verdict}, mass {mass} kg, expected error {force_N:.3f} N and {1e3 * torque_Nm:.1f} mN·m, "
        f"free for {used:.0f} % of the time{why}"
    )
