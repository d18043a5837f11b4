"""What a session takes its poses for: a calibration, or another task with other poses and another judgement of them."""

from collections.abc import Mapping
from typing import ClassVar

from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.planning.cell_plan import plan_for
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of
from ftdrive.session.forecast import prediction
from ftdrive.session.live_fit import Judge, RunningFit
from ftdrivers.interfaces import DeviceInfo


class Task:
    """A calibration."""

    command: ClassVar[str] = "calibrate"
    """The command line of the task; the run folder names it."""

    @property
    def goal(self) -> str:
        """When the poses suffice that the operator moves the arm to."""
        return "the coverage is green"

    def require(self, devices: Mapping[str, DeviceInfo], mount: str | None) -> tuple[str, ...]:
        """Return what is uncertain about arm, sensor and its mounting; raises `ConfigError` if they do not fit."""
        del devices, mount
        return ()

    def plan(self, cell: CellConfig, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Plan the poses from joint angles (6,). Raises `PlanRefused`."""
        return plan_for(cell, certifier, q_rad, poses)

    def judge(self, cell: CellConfig, down_base: Array, *, by_hand: bool) -> Judge:
        """Return who judges the poses; `by_hand` says that no plan chooses them."""
        return RunningFit(g_m_s2=cell.site.g_m_s2, down_base=down_base, advise=by_hand)

    def forecast(
        self, cell: CellConfig, certifier: Certifier, plan: Plan, average_s: float, sigma: Array, *, real: bool
    ) -> str:
        """Describe what averages with this standard deviation (6,), N and N·m, can show. `real`: so is the arm."""
        mass_kg = cell.tool.mass_kg
        assumed = real and not mass_kg
        return prediction(plan, guess_of(certifier, mass_kg), average_s, sigma, assumed=assumed)
