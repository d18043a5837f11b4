"""A verification: a session with new poses, each of which is compared with the prediction of a calibration."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final, Literal, Self

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftcalib.model import Array, angle_between
from ftcalib.rounding import to_place_of
from ftcalib.routine import PoseRecord
from ftdrive.cell.config import CellConfig
from ftdrive.errors import BadPlan, ConfigError, Declined, PlanRefused
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_verification, speeds_of
from ftdrive.planning.search.nodes import WRIST_6_RAD, from_usual_wrist
from ftdrive.runs.calibration import read_calibration
from ftdrive.runs.run import Run
from ftdrive.runs.verification import NO_LIMITS, Limits, Verified, fitted_dataset, save_update, verify_run
from ftdrive.session.events import Compared, Operator, Question
from ftdrive.session.live_fit import free_wrench
from ftdrive.session.open_session import Judge, SessionOptions
from ftdrive.session.session import take_poses

Answer = Literal["ask", "no", "yes"]

POSES: Final = 6
QUICK_POSES: Final = 2
# A pose closer than this to an orientation of the calibration does not count as new.
FRESH_RAD: Final = float(np.radians(10))
# The contact guard uses the calibration after `HOLDS_POSES` poses, if all residuals are within the other two limits.
HOLDS_N, HOLDS_NM = 2.0, 0.2
HOLDS_POSES: Final = 3


@dataclass(frozen=True, eq=False)
class Verifying:
    """The task of a session that verifies a calibration."""

    command: ClassVar[str] = "verify"
    load: ClassVar[None] = None
    cell: CellConfig
    calibration: CalibrationResult
    path: Path
    """The calibration file."""
    poses: int
    """Number of new poses to take."""
    runs: Path
    """Folder of runs, from which the plan of an earlier verification is reused if it still fits the cell."""

    @staticmethod
    def chosen(
        options: SessionOptions, path: Path | None, poses: int | None, limits: Limits
    ) -> tuple[Path | None, Limits, SessionOptions]:
        """Return calibration, limits and options as given, or of the resumed run; `ConfigError` if they conflict."""
        quick, resume = options.fast, options.resume
        if quick and poses is not None:
            raise ConfigError("--quick and --poses are mutually exclusive: leave one of them out")
        if resume is None:
            return path, limits, replace(options, poses=poses or (QUICK_POSES if quick else POSES))
        limited = limits != NO_LIMITS
        given = {"--calibration": path, "--quick": quick, "--poses": poses, "--max-force or --max-torque": limited}
        if wrong := [option for option, value in given.items() if value]:
            raise ConfigError(f"--resume continues with the options of its run: leave out {' and '.join(wrong)}")
        run = Run(resume)
        if run.command != "verify":
            raise ConfigError(f"{resume} is not a verification: continue it with {run.resume_command}")
        begun = run.header()["verification"]
        options = replace(options, poses=begun["poses"], fast=begun["quick"])
        return Path(begun["path"]), (begun["limits"]["force_N"], begun["limits"]["torque_Nm"]), options

    @classmethod
    def of(cls, cell: CellConfig, path: Path, options: SessionOptions) -> Self:
        """Return the task for a calibration file or a run folder. Raises the errors of `read_calibration`."""
        calibration = read_calibration(path)
        path = Run(path).calibration_path if path.is_dir() else path
        # Recording the sensor's noise for 12 s would take longer than the few poses of a quick verification.
        if options.fast:
            cell = replace(cell, sampling=replace(cell.sampling, noise_record_s=0.0))
        return cls(cell, calibration, path, options.poses, options.runs)

    def take(self, operator: Operator, limits: Limits, options: SessionOptions) -> Verified:
        """Guide the operator through the poses; return the result of the verification. Raises as `take_poses` does."""
        # The run records the calibration and the options, so that --resume continues with them.
        kept = {"path": str(self.path.absolute()), "poses": options.poses, "quick": options.fast}
        about = {**kept, "limits": dict(zip(("force_N", "torque_Nm"), limits, strict=True)), "id": self.calibration.id}
        run = take_poses(self, operator, replace(options, description={"verification": about, **options.description}))
        if run is None:
            raise RuntimeError("a verification is never a dry run")
        return verify_run(run, self.calibration, self.path, limits)

    @property
    def goal(self) -> str:
        """Condition under which hand-guided poses suffice; see `Task.goal`."""
        return f"{self.poses} poses differ by {np.degrees(FRESH_RAD):.0f}° or more from those of the calibration"

    @cached_property
    def R_fitted(self) -> Array:
        """Orientations R_base_flange (k, 3, 3) of the calibration poses; (0, 3, 3) if they are unknown."""
        dataset = fitted_dataset(self.calibration, self.path)
        return np.zeros((0, 3, 3)) if dataset is None else dataset.R_base_flange

    @property
    def warnings(self) -> tuple[str, ...]:
        """One warning if the calibration poses are unknown, otherwise none."""
        if len(self.R_fitted):
            return ()
        lost = f"the poses of the calibration are unknown, because its dataset.json is not next to {self.path}"
        return (f"{lost}; the verification may repeat them",)

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Return the plan of the newest suitable verification, or a new plan from joint angles (6,)."""
        q_rad = from_usual_wrist(certifier, q_rad)
        earlier = self._earlier(certifier, q_rad, poses)
        if earlier is not None:
            return earlier
        guess = guess_of(certifier, self.cell)
        plan = plan_verification(certifier, q_rad, poses, self.R_fitted, speeds=speeds_of(self.cell), guess=guess)
        return plan.marked(measured=self.cell.workcell.measured, emulated=self.cell.is_emulated)

    def judge(self, *, by_hand: bool) -> Judge:
        """Return a new object that compares each pose with the calibration."""
        return RunningComparison(self.calibration, self.R_fitted if by_hand else np.zeros((0, 3, 3)), self.poses)

    def forecast(self, _plan: Plan, _certifier: Certifier, _sigma: Array, /) -> str:
        """Describe the error of the calibration to expect if the cell has not changed."""
        error_N, error_Nm = self.calibration.likely_error()
        return f"error of the calibration: {error_N:.2g} N, {to_place_of(error_Nm, error_Nm)} N·m"

    def _earlier(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan | None:
        """Return the plan of an earlier verification, which may run fast because it was driven; None if none fits."""
        for path in sorted(self.runs.glob("*/plan.json"), reverse=True):
            with suppress(BadPlan, BadDataset, PlanRefused, OSError, KeyError, TypeError):
                plan = Plan.load(path)
                turns = np.array([step.q_rad[5] for step in plan.steps]) - q_rad[5]
                near = (
                    turns.min() <= 0 <= turns.max() or np.abs(turns).max() <= WRIST_6_RAD
                )  # a larger turn of wrist 3 would wind up the cable
                if plan.kind == "verification" and len(plan.steps) == poses and near and self._is_mine(path.parent):
                    plan.require(certifier)
                    return plan
        return None

    def _is_mine(self, folder: Path) -> bool:
        found = Run(folder).header().get("verification", {})
        return bool(found.get("id") == self.calibration.id)


class RunningComparison:
    """Compares each pose with the prediction of a calibration.

    The poses suffice when `wanted` of them are far from `R_fitted` (k, 3, 3), the orientations of the calibration.
    """

    weighed_kg: float | None = None
    """Always None, because the payload was compared when the cell was calibrated."""

    def __init__(self, calibration: CalibrationResult, R_fitted: Array, wanted: int) -> None:
        self._calibration, self._R_fitted, self._wanted = calibration, R_fitted, wanted
        self._compared: dict[int, Compared] = {}
        self._fresh: set[int] = set()

    def add(self, record: PoseRecord) -> Compared:
        """Add a pose, which replaces one with the same `stop`; return its comparison with the calibration."""
        self.remove(record.stop)
        R_base_flange = record.before.R_base_flange
        if angle_between(self._R_fitted, R_base_flange).min(initial=np.inf) >= FRESH_RAD:
            self._fresh.add(record.stop)
        enough = len(self._fresh) >= self._wanted
        hint = "" if record.stop in self._fresh else "too near to a pose of the calibration: turn the tool further"
        compared = Compared(
            stop=record.stop,
            number=record.pose.number,
            residual=self._calibration.compensate(record.mean.mean, R_base_flange),
            sigma=np.sqrt(np.diag(record.mean.covariance + self._calibration.wrench_covariance(R_base_flange))),
            poses=len(self._compared) + 1,
            light="green" if enough else "amber",
            hint=hint,
        )
        self._compared[record.stop] = compared
        return compared

    def remove(self, stop: int) -> None:
        """Remove the pose at a stop before it is taken again."""
        self._compared.pop(stop, None)
        self._fresh.discard(stop)

    def predict(self, R_base_flange: Array) -> Array | None:
        """Return a free tool's wrench (6,); None until some poses confirm the calibration. Callable from any thread."""
        seen = [compared.residual for compared in list(self._compared.values())]
        norms = ((np.linalg.norm(residual[:3]), np.linalg.norm(residual[3:])) for residual in seen)
        if len(seen) < HOLDS_POSES or any(force_N > HOLDS_N or torque_Nm > HOLDS_NM for force_N, torque_Nm in norms):
            return None
        return free_wrench(self._calibration, R_base_flange)


def save_wanted_update(verified: Verified, update: Answer, ask: Callable[[Question], str]) -> Path | None:
    """Save the update of a verification as a new calibration if the operator wants it; return its path or None."""
    if verified.passed or verified.update is None or update == "no":
        return None
    question = Question(f"An update of {verified.updated} is sufficient. Save it as a new calibration?")
    try:
        return save_update(verified) if update == "yes" or ask(question) == "yes" else None
    except Declined:
        return None
