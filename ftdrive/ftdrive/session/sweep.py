"""A sweep: recording of the free tool along a smooth curve, and the prediction of its wrench for the contact guard."""

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from ftcalib.model import STANDARD_GRAVITY_M_S2, Array
from ftcalib.sampling import Sampling
from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.planning.planner import sweep_for
from ftdrive.runs.motion import MotionRecording
from ftdrive.runs.run import Run
from ftdrive.session.along_plan import AlongPlan
from ftdrive.session.drive import APPROACH_RAD_S, SLOW, STOPS, Drive
from ftdrive.session.events import MotionRecorded, State
from ftdrive.session.guards import Guard, Seen
from ftdrive.session.open_session import OpenSession
from ftdrive.session.preflight import Before
from ftdrivers.sweep import Sweep

# Duration of the rest that is recorded before and after the sweep, s.
REST_S: Final = 2.0
# Time step, s, of the points of the curve with which the guards compare the arm.
CURVE_S: Final = 0.01
_READ_S: Final = 1.0
# Fraction of the planned speed at which a plan is run for the first time.
FIRST_SHARE: Final = 0.5
# Lowest position of the speed slider, 0 to 1, at which a sweep is useful.
LEAST_SLIDER: Final = 0.5
# The contact guard uses the noise of the resting sensor within averages of this length, s.
_QUIET_S: Final = 1.0
# Assumed upper bound on the mass of the tool if [tool] mass_kg is not set.
_HEAVIEST_KG: Final = 5.0
# Duration of motion along the curve, s, before the wrench of the free tool is predicted.
KNOWN_S: Final = 3.0
# The fit excludes the readings of the last seconds, this many, so that a growing contact is not taken for weight.
BEHIND_S: Final = 1.0
# Standard deviation of one force reading in motion, including vibration and inertial force.
_NOISE_N: Final = 2.0
# A predicted force whose sigma exceeds this is not used.
_UNSURE_N: Final = 2.5


def take_sweep(session: OpenSession) -> Run | None:
    """Record the free tool along a wrist curve about the current posture; return the run, or None after a dry run."""
    task, options = session.task, session.options
    along = AlongPlan(session, lambda certifier, q_rad: sweep_for(task.cell, certifier, q_rad, options.seconds))
    driven, sweep = _choose_speed(along.before, slow=options.real and not along.before.known)
    if options.dry_run:
        along.end_dry_run()
        return None
    # There are no poses, so the motion itself must show the weight of the tool.
    tool = FreeToolPrediction(driven.certifier.scene.down_base, task.cell.tool.mass_kg or _HEAVIEST_KG)
    with along.guarding(driven, driven.quiet_std(_QUIET_S), tool.predict, tool) as (guarded, book):
        drive = Drive(guarded, driven, options, [None], lambda _: "")
        _repeat_until_recorded(drive, sweep, driven.config.sampling, book.run)
    along.judge_completed()
    return book.run


def _repeat_until_recorded(drive: Drive, sweep: Sweep, sampling: Sampling, run: Run) -> None:
    """Move the arm to the centre and along the curve, again after a stop, until recorded. Raises as `Tour.run` does."""
    now = drive.now
    now.todo = [1]
    drive.watcher.begin()
    while now.todo:
        try:
            now.under_way = None
            drive.obey_keys()
            now.under_way = 1
            if now.at is None:
                if drive.approach(0, 1):
                    drive.confirm(_begin_words(sweep))
                now.arrive(0)
            drive.obey_keys()
            _record_sweep(drive, sweep, sampling, run)
            now.todo.clear()
        except STOPS as error:
            drive.hold(error, _choices)
    drive.guarded.show_new()
    drive.show_state(State.CLOSE)


def _record_sweep(drive: Drive, sweep: Sweep, sampling: Sampling, run: Run) -> None:
    """Follow the curve from the centre, where the arm stands, and save the recording."""
    (centre,), clock = drive.nodes_rad, drive.watcher.clock
    curve = sweep.at(np.arange(0.0, sweep.duration_s + CURVE_S, CURVE_S))
    with drive.sensor.follow() as wrench, drive.arm.follow() as poses:
        _rest(drive, sampling.still_timeout_s)
        if not drive.now.confirmed:
            drive.confirm(_begin_words(sweep))
        drive.require_at(centre)
        drive.show_state(State.SWEEP, 1, f"{sweep.duration_s:.0f} s along the curve of the plan")
        drive.now.standing = False
        began_s = clock.now_s()
        with drive.watcher.watching(centre, centre, moving=True, curve_rad=curve):
            drive.arm.sweep(sweep, guard=drive.between_looks)
        duration_s = clock.now_s() - began_s
        drive.now.standing = True
        _rest(drive, sampling.still_timeout_s)
        rate_Hz = drive.sensor.health().nominal_rate_Hz
        recording = MotionRecording(wrench.read(_READ_S), poses.read(_READ_S), rate_Hz)
    drive.guarded.load.judge(recording.samples.wrench)
    path = run.new_path("motion", ".npz")
    recording.save(path)
    drive.guarded.show_new()
    drive.journal.show(
        MotionRecorded(
            file=path.name,
            duration_s=duration_s,
            samples=len(recording.samples),
            states=len(recording.states),
            temperature_C=drive.sensor.temperature_C(),
        ),
        sync=True,
    )


def _rest(drive: Drive, still_timeout_s: float) -> None:
    (centre,), clock = drive.nodes_rad, drive.watcher.clock
    drive.arm.wait_until_still(timeout_s=still_timeout_s, guard=drive.between_looks)
    with drive.watcher.watching(centre, centre, moving=False):
        for _ in clock.looks(REST_S):
            drive.between_looks()
            clock.sleep(0.02)


def _begin_words(sweep: Sweep) -> str:
    return f"The arm is at the start of the sweep, which takes {sweep.duration_s:.0f} s. Begin?"


def _choices(_: int | None, fixed: str) -> tuple[str, dict[str, str]]:
    """Return a sentence about the data, and the answers in a hold with their effects; see `Drive.hold`."""
    ways = {"resume": f"sweep again from the start{fixed}", "quit": "stop; the next session starts again"}
    return "The stopped sweep is not saved.", ways


@dataclass
class FreeToolPrediction(Guard):
    """Recursive least-squares fit of the wrench as a linear function of the gravity direction in flange axes.

    Force and torque of a free tool are linear in this direction for every mounting, weight, centre of mass and bias.
    The class is a guard that never trips: it updates the fit with each sample, and predicts for the contact guard.
    """

    down_base: Array
    """(3,) unit vector down, base axes."""
    heaviest_kg: float
    """Mass of the heaviest possible tool, which sets the prior standard deviation."""
    _moving_s: float = field(default=0.0, init=False)
    _sample: int = field(default=-1, init=False)
    _waiting: deque[tuple[float, Array, Array]] = field(default_factory=deque, init=False)
    _covariance: Array = field(default_factory=lambda: np.zeros((4, 4)), init=False)
    _coefficients: Array = field(default_factory=lambda: np.zeros((4, 6)), init=False)

    def begin(self, _: Seen) -> None:
        """Discard the fit, because the tool and the sensor's zero may differ after a stop."""
        unknown = (self.heaviest_kg * STANDARD_GRAVITY_M_S2 / _NOISE_N) ** 2
        self._covariance = np.diag([unknown, unknown, unknown, 1e6])
        self._coefficients = np.zeros((4, 6))
        self._waiting.clear()
        self._moving_s = 0.0

    def look(self, seen: Seen) -> None:
        """Add the readings older than `BEHIND_S` to the fit."""
        # A contact force that grows over several seconds still enters the fit in part.
        if seen.motion.curve_rad is not None:
            self._moving_s += seen.dt_s
        if seen.sample == self._sample:
            return
        self._sample = seen.sample
        self._waiting.append((seen.t_s, self._features(seen.state.R_base_flange), seen.wrench))
        while self._waiting[0][0] < seen.t_s - BEHIND_S:
            _, x, wrench = self._waiting.popleft()
            Px = self._covariance @ x
            gain = Px / (1.0 + x @ Px)
            self._coefficients = self._coefficients + np.outer(gain, wrench - x @ self._coefficients)
            self._covariance = self._covariance - np.outer(gain, Px)

    def predict(self, R_base_flange: Array) -> Array | None:
        """Return the wrench (6,) of a free tool at this orientation (3, 3); None while it is uncertain."""
        # The recursive fit is used, because the full fit takes longer than a guard may wait.
        if self._moving_s < KNOWN_S:
            return None
        x = self._features(R_base_flange)
        if float(x @ self._covariance @ x) > (_UNSURE_N / _NOISE_N) ** 2:
            return None
        return np.asarray(x @ self._coefficients)

    def _features(self, R_base_flange: Array) -> Array:
        return np.append(self.down_base @ R_base_flange, 1.0)


def on_script_path(cell: CellConfig) -> CellConfig:
    """Return the cell with control path "script", which a sweep needs; raises `ConfigError` if "ur-rtde" is set."""
    # Only the program of ftdrive evaluates the curve and stops when its heartbeat is lost.
    if cell.robot.control == "ur-rtde":
        raise ConfigError(
            "a sweep needs the control path script, whose program evaluates the curve on the controller: give "
            "--control script, or set [robot] control"
        )
    return replace(cell, robot=replace(cell.robot, control="script"))


def _choose_speed(before: Before, *, slow: bool) -> tuple[Before, Sweep]:
    """Return plan and sweep, slowed to the speed slider and on a first run. `NotAccepted` if the slider is too low."""
    cell, slider = before.cell, before.cell.arm.status().speed_slider
    if slider < LEAST_SLIDER:
        raise NotAccepted(
            f"the speed slider is at {100 * slider:.0f} %, too slow for a useful sweep: set it to "
            f"{100 * LEAST_SLIDER:.0f} % or more"
        )
    share = min(slider, 1.0) * (FIRST_SHARE if slow else 1.0)
    plan = before.plan.at_share(share)
    if plan.sweep is None:
        raise NotAccepted("the plan has no sweep: make a plan with --sweep")
    why = "the first run of a plan is slow" if slow else f"speed slider {100 * slider:.0f} %"
    total_s = plan.sweep.duration_s + 2 * REST_S + before.approach.duration_s(APPROACH_RAD_S, SLOW.joint_rad_s2)
    cell.note(
        f"sweep of {plan.sweep.duration_s:.0f} s at {100 * share:.0f} % of the planned speed ({why}), at most "
        f"{np.degrees(plan.top_speed_rad_s):.0f} °/s: about {total_s:.0f} s of motion"
    )
    return replace(before, plan=plan), plan.sweep
