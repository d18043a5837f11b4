"""A calibration beside a program or a hand that moves the arm: both devices are only read, until the result is good."""

from typing import Final

from ftcalib import Setup
from ftcalib.errors import AcceptanceError, DataError
from ftcalib.motion.solve import solve_motion
from ftcalib.result import CalibrationResult
from ftcalib.rounding import with_sigma
from ftdrive.errors import Declined
from ftdrive.runs.motion import MotionRecording
from ftdrive.runs.run import Run
from ftdrive.session.events import MotionRecorded
from ftdrive.session.open_cell import OpenCell
from ftdrive.session.operator import Key
from ftdrivers.errors import ConnectError, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import ArmStates, FtSamples

FIRST_S: Final = 10.0
"""Until the first fit; each later one has a quarter more."""
LONGER: Final = 1.25
LEAST_S: Final = 5.0
_READ_S: Final = 0.2
_SILENT_S: Final = 10.0
"""A shorter silence of a device is a gap in the recording, not its end."""
GOOD: Final = 2
"""So many good fits in a row end it."""


def record_passively(cell: OpenCell, run: Run, seconds: float, setup: Setup, g_m_s2: float) -> None:
    """Record the free tool in motion until two fits in a row are good, the operator presses q, or the time is over.

    Each fit is shown with its sigmas and with the motion that is missing.

    Raises
    ------
    Declined
        The operator ended it in the first seconds.
    DeviceError
        A device has failed.
    """
    cell.note(f"Recording for {seconds:.0f} s at most; nothing is commanded. Keep the tool free for part of the time.")
    samples, states = list[FtSamples](), list[ArmStates]()
    begin_s, next_s, good = cell.clock.now_s(), FIRST_S, 0
    heard_s = begin_s
    with cell.sensor.follow() as wrench, cell.arm.follow() as poses:
        for _ in cell.clock.looks(seconds):
            try:
                samples.append(wrench.read(_READ_S))
                states.append(poses.read(0.0))
                heard_s = cell.clock.now_s()
            except (DeviceTimeout, StreamBroken, ConnectError):  # a sensor with `recover` reconnects
                if cell.clock.now_s() - heard_s > _SILENT_S:
                    raise
                cell.clock.sleep(_READ_S)
            elapsed_s = cell.clock.now_s() - begin_s
            if cell.journal.pressed() is Key.STOP:
                break
            if elapsed_s >= next_s:
                next_s = LONGER * elapsed_s
                good = good + 1 if _is_good(cell, _joined(cell, samples, states), elapsed_s, setup, g_m_s2) else 0
                if good == GOOD:
                    break
    recording = _joined(cell, samples, states)
    duration_s = cell.clock.now_s() - begin_s
    if duration_s < LEAST_S:
        raise Declined(f"ended after {duration_s:.1f} s: record {FIRST_S:.0f} s or more")
    path = run.new_path("motion", ".npz")
    recording.save(path)
    event = MotionRecorded(
        file=path.name,
        duration_s=duration_s,
        samples=len(recording.samples),
        states=len(recording.states),
        temperature_C=cell.sensor.temperature_C(),
    )
    cell.journal.show(event, sync=True)


def _joined(cell: OpenCell, samples: list[FtSamples], states: list[ArmStates]) -> MotionRecording:
    samples[:], states[:] = [FtSamples.concatenate(samples)], [ArmStates.concatenate(states)]
    return MotionRecording(samples[0], states[0], cell.sensor.health().nominal_rate_Hz)


def _is_good(cell: OpenCell, recording: MotionRecording, elapsed_s: float, setup: Setup, g_m_s2: float) -> bool:
    """Fit what was recorded so far and show it."""
    try:
        wrench, poses = recording.means()
        result = solve_motion(wrench, poses, setup=setup, height_m=setup.sensor_height_m, g_m_s2=g_m_s2)
    except (AcceptanceError, DataError) as error:
        cell.note(f"{elapsed_s:.0f} s: {error}")
        return False
    cell.note(f"{elapsed_s:.0f} s: {in_words(result)}")
    return result.verdict == "good"


def in_words(result: CalibrationResult) -> str:
    """Return what is determined so far, with sigmas, and why it is not good yet."""
    mass = with_sigma(result.mass_kg, float(result.sigma["mass_kg"]))
    force_N, torque_Nm = result.predicted_error()
    used = 0.0 if result.motion is None else 100 * result.motion.used_share
    why = f"; {result.reasons[0]}" if result.verdict != "good" and result.reasons else ""
    return (
        f"{result.verdict}, mass {mass} kg, expected error {force_N:.3f} N and {1e3 * torque_Nm:.1f} mN·m, "
        f"free for {used:.0f} % of the time{why}"
    )
