"""A sweep: the free tool recorded along a smooth curve, at the speed of the slider; and what it teaches the guards."""

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

# Recorded before the sweep and after it.
REST_S: Final = 2.0
# Between two points of the curve that the guards compare with.
CURVE_S: Final = 0.01
_READ_S: Final = 1.0
# Share of the planned speed in the first run of a plan.
FIRST_SHARE: Final = 0.5
LEAST_SLIDER: Final = 0.5
# Length of the averages of the resting sensor that the guards compare with.
_QUIET_S: Final = 1.0
# The mass of the tool where [tool] mass_kg is not set.
_HEAVIEST_KG: Final = 5.0
# The motion teaches so long before anything is predicted.
KNOWN_S: Final = 3.0
# The newest looks do not teach: a contact that grows must not pass for weight.
BEHIND_S: Final = 1.0
# Noise of one look, vibration and acceleration included.
_NOISE_N: Final = 2.0
# A prediction with a larger sigma is none.
_UNSURE_N: Final = 2.5


def take_sweep(session: OpenSession) -> Run | None:
    """Record the free tool along a smooth curve of the wrist, planned where the arm stands; None after a dry run."""
    task, options = session.task, session.options
    along = AlongPlan(session, lambda certifier, q_rad: sweep_for(task.cell, certifier, q_rad, options.seconds))
    driven, sweep = _choose_speed(along.before, slow=options.real and not along.before.known)
    if options.dry_run:
        along.end_dry_run()
        return None
    # No pose shows what the tool weighs while it moves.
    tool = FreeToolPrediction(driven.certifier.scene.down_base, task.cell.tool.mass_kg or _HEAVIEST_KG)
    with along.guarding(driven, driven.quiet_std(_QUIET_S), tool.predict, tool) as (guarded, book):
        drive = Drive(guarded, driven, options, [None], lambda _: "")
        _repeat_until_recorded(drive, sweep, driven.config.sampling, book.run)
    along.judge_completed()
    return book.run


def _repeat_until_recorded(drive: Drive, sweep: Sweep, sampling: Sampling, run: Run) -> None:
    """Take the arm to the centre of a sweep, along it, and back; start again after a stop. Raises as `Tour.run`."""
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
    """Follow the curve from its centre, where the arm stands, and keep the recording."""
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
    return f"The arm stands where the sweep of {sweep.duration_s:.0f} s begins. Begin?"


def _choices(_: int | None, fixed: str) -> tuple[str, dict[str, str]]:
    """Return what is kept, and the answers in a hold with their effects; see `Drive.hold`."""
    ways = {"resume": f"sweep again from the start{fixed}", "quit": "stop; the next session starts again"}
    return "A sweep that was stopped is not kept.", ways


@dataclass
class FreeToolPrediction(Guard):
    """Recursive least squares of the wrench as a linear function of the direction of gravity in the flange.

    Force and torque are linear in it, whatever mounting, weight, centre of mass and bias are. It looks as a guard, but
    never trips: the contact guard asks it what a free tool weighs.
    """

    down_base: Array
    """(3,) unit vector."""
    heaviest_kg: float
    """Mass of the heaviest possible tool: the size of what is unknown."""
    _moving_s: float = field(default=0.0, init=False)
    _sample: int = field(default=-1, init=False)
    _waiting: deque[tuple[float, Array, Array]] = field(default_factory=deque, init=False)
    _covariance: Array = field(default_factory=lambda: np.zeros((4, 4)), init=False)
    _coefficients: Array = field(default_factory=lambda: np.zeros((4, 6)), init=False)

    def begin(self, _: Seen) -> None:
        """Forget everything."""
        # After a stop the tool may be another, and the sensor may have another zero.
        unknown = (self.heaviest_kg * STANDARD_GRAVITY_M_S2 / _NOISE_N) ** 2
        self._covariance = np.diag([unknown, unknown, unknown, 1e6])
        self._coefficients = np.zeros((4, 6))
        self._waiting.clear()
        self._moving_s = 0.0

    def look(self, seen: Seen) -> None:
        """Learn from what was seen a second ago."""
        # Learns from a second ago and before; a push that grows over several seconds is partly learned.
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
        """Wrench (6,) of a free tool at this orientation (3, 3); None while it is uncertain."""
        # The full fit takes longer than a guard may wait, and knows no contact, so a linear function of gravity
        # predicts.
        if self._moving_s < KNOWN_S:
            return None
        x = self._features(R_base_flange)
        if float(x @ self._covariance @ x) > (_UNSURE_N / _NOISE_N) ** 2:
            return None
        return np.asarray(x @ self._coefficients)

    def _features(self, R_base_flange: Array) -> Array:
        return np.append(self.down_base @ R_base_flange, 1.0)


def on_script_path(cell: CellConfig) -> CellConfig:
    """Return the cell with the control path that follows a curve; raises `ConfigError` if another one is set."""
    # Only our own program evaluates the curve and stops with its heartbeat.
    if cell.robot.control == "ur-rtde":
        raise ConfigError(
            "a sweep needs the control path script, whose program evaluates the curve on the controller and stops "
            "with it: give --control script, or set [robot] control"
        )
    return replace(cell, robot=replace(cell.robot, control="script"))


def _choose_speed(before: Before, *, slow: bool) -> tuple[Before, Sweep]:
    """Return the plan at the speed of the slider, which does not act on a sweep while it runs, and its curve.

    Raises `NotAccepted` if the slider is too low.
    """
    cell, slider = before.cell, before.cell.arm.status().speed_slider
    if slider < LEAST_SLIDER:
        raise NotAccepted(
            f"the speed slider is at {100 * slider:.0f} %, at which a sweep shows too little: set it to "
            f"{100 * LEAST_SLIDER:.0f} % or more"
        )
    share = min(slider, 1.0) * (FIRST_SHARE if slow else 1.0)
    plan = before.plan.at_share(share)
    if plan.sweep is None:
        raise NotAccepted("the plan holds no sweep: make it with --sweep")
    why = "the first run of a plan is slow" if slow else f"speed slider {100 * slider:.0f} %"
    total_s = plan.sweep.duration_s + 2 * REST_S + before.approach.duration_s(APPROACH_RAD_S, SLOW.joint_rad_s2)
    cell.note(
        f"sweep of {plan.sweep.duration_s:.0f} s at {100 * share:.0f} % of the planned speed ({why}), at most "
        f"{np.degrees(plan.top_speed_rad_s):.0f} °/s: about {total_s:.0f} s of motion"
    )
    return replace(before, plan=plan), plan.sweep
