"""What a session takes its poses for: a calibration, or a verification (`verifying.py`)."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftcalib.published.methods import SPECIAL
from ftcalib.result import Method
from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.cell_plan import plan_for, sweep_for
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import down_of
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import NUMBERS
from ftdrive.planning.search.nodes import constant_tour
from ftdrive.runs.run import Run
from ftdrive.session.forecast import predict_accuracy
from ftdrive.session.live_fit import Judge, RunningFit
from ftdrive.session.open_cell import OpenCell
from ftdrive.session.options import SessionOptions
from ftdrive.session.sweep import FreeTool

# The load of a sweep where [tool] mass_kg is not set.
_HEAVIEST_KG: Final = 5.0


class Task(Protocol):
    """Which poses are taken, and how they are judged."""

    @property
    def command(self) -> str:
        """The command line of the task; the run folder names it."""

    @property
    def cell(self) -> CellConfig:
        """The cell of the session."""

    @property
    def calibration(self) -> CalibrationResult | None:
        """The calibration that the poses are compared with: arm, sensor and mounting must be its own."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the operator should know before a pose is taken."""

    @property
    def goal(self) -> str:
        """When the poses suffice that the operator moves the arm to."""

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Plan the poses from joint angles (6,). Raises `PlanRefused`."""

    def judge(self, *, by_hand: bool) -> Judge:
        """Return who judges the poses; `by_hand` says that no plan chooses them."""

    def learner(self) -> FreeTool | None:
        """Return what learns the wrench of a free tool in motion; None where the poses show it."""

    def forecast(self, plan: Plan, certifier: Certifier, sigma: Array, /) -> str:
        """Describe what averages with one standard deviation `sigma` (6,) can show; empty if that is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """An open cell, and what its poses are taken for."""

    cell: OpenCell
    task: Task
    options: SessionOptions
    resumed: Run | None
    """The run that is continued."""
    plan: Plan | None
    """The plan on disk that is followed; None where it is made when the posture of the arm is known."""
    new_run: Callable[[], Run]
    """Creates the folder of a new run."""


def from_usual_wrist(certifier: Certifier, q_rad: Array) -> Array:
    """Return joint angles (6,) with joints 4 and 5 as the constant tour begins, from which most tours are found.

    Joint 6 keeps its turn, which shows how the cable is wound.
    """
    q = q_rad.copy()
    # The planner reports it, with what to do.
    with suppress(ConfigError):
        q[3:5] = constant_tour(q, certifier.arm.kinematics)[0, 3:5]
    return q


@dataclass(frozen=True, eq=False)
class Calibrating:
    """A calibration."""

    command: ClassVar[str] = "calibrate"
    goal: ClassVar[str] = "the coverage is green"
    calibration: ClassVar[None] = None
    warnings: ClassVar[tuple[str, ...]] = ()
    cell: CellConfig
    real: bool = True
    """Whether a real arm moves."""
    sets: str | None = None
    """Sets of Yu's Fig. 6 instead of a number of poses."""
    method: Method = "ml"
    """Method that will solve the poses."""
    sweep_s: float | None = None
    """Duration of a sweep at the planned speed; None for poses."""

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Return a sweep or a tour. Raises `PlanRefused` if it lacks orientations that the method needs."""
        if self.sweep_s is not None:
            return sweep_for(self.cell, certifier, q_rad, self.sweep_s)
        q_rad = from_usual_wrist(certifier, q_rad)
        plan = plan_for(self.cell, certifier, q_rad, poses, sets=self.sets)
        special = sum(step.number in NUMBERS[24] for step in plan.steps)
        if self.method in SPECIAL and special < 24:
            raise PlanRefused(
                f"{self.method} needs the 24 special orientations, and the tour has {special} of them: plan all 24, "
                "jog the arm to a posture with more room, or choose --method lrom"
            )
        if self.method == "srom" and len(plan.steps) > 24:
            raise PlanRefused(
                f"srom needs the 24 special orientations alone, and the tour has {len(plan.steps) - 24} other poses: "
                "choose --method mixed"
            )
        return plan

    def judge(self, *, by_hand: bool) -> Judge:
        """Return the running fit."""
        down_base = down_of(self.cell.workcell.mounting)
        return RunningFit(g_m_s2=self.cell.site.g_m_s2, down_base=down_base, advise=by_hand)

    def learner(self) -> FreeTool | None:
        """Return the guard that learns the weight of the tool in a sweep."""
        if self.sweep_s is None:
            return None
        return FreeTool(down_of(self.cell.workcell.mounting), self.cell.tool.mass_kg or _HEAVIEST_KG)

    def forecast(self, plan: Plan, certifier: Certifier, sigma: Array, /) -> str:
        """Describe the sigmas of the result; those of a new tool depend on the earlier result too."""
        if plan.kind == "tool":
            return ""
        mass_kg = self.cell.tool.mass_kg
        return predict_accuracy(plan, certifier, sigma, mass_kg, assumed=self.real and not mass_kg)
