"""Print the figures of the constant tour, and sample random certified plans at half a degree.

Run: python tests/benchmarks/planning.py [--plans 1000]
"""

import argparse
import sys
import time

import numpy as np

from calib.tour import wrist_tour
from ftdrive.errors import PlanRefused
from ftdrive.planning.arm_model import ArmModel, Cylinder
from ftdrive.planning.certify import Certifier
from ftdrive.planning.motion import Speeds
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_tour
from ftdrive.planning.scene import Scene

MODELS = ("UR3e", "UR5e", "UR10e", "UR16e", "UR20", "UR30")
TOOLS = {
    "150 x 100": (Cylinder(0, 0.15, 0.1),),
    "200 x 100": (Cylinder(0, 0.2, 0.1),),
    "250 x 100": (Cylinder(0, 0.25, 0.1),),
    "150 from 50": (Cylinder(0, 0.05, 0.08), Cylinder(0.05, 0.2, 0.15)),
}


def show(line: str) -> None:
    """Write a line."""
    sys.stdout.write(line + "\n")


def constant_tour() -> None:
    """Every model with every tool at the usual posture."""
    show("model  tool          certified  largest  60 deg/s  <= 250 mm/s  clearance   ball     check")
    for model in MODELS:
        for name, tool in TOOLS.items():
            certifier = Certifier(ArmModel(model, tool), Scene())
            q = np.array([pose.q_rad for pose in wrist_tour(USUAL_POSTURE_RAD)])
            checks = []
            for _ in range(5):
                start = time.perf_counter()
                clear = certifier.certify(q, np.roll(q, -1, axis=0), tight=False).clear
                checks.append(1e3 * (time.perf_counter() - start))
            fast, slow = (
                plan_tour(certifier, speeds=Speeds(tip_m_s=limit), guess=guess_of(certifier)).to_dict()
                for limit in (None, 0.25)
            )
            times = f"{fast['motion_time_s']:5.1f}        {slow['motion_time_s']:5.1f}"
            show(
                f"{model:6s} {name:12s}  {clear.sum():2d} of 24   {fast['max_move_deg']:5.1f}    {times}     "
                f"{slow['min_clearance_mm']:5.1f} mm   {slow['ball_m']:.2f} m  {np.median(checks):4.0f} ms"
            )


def random_plans(wanted: int) -> None:
    """Plans at random postures; every move sampled at 0.5 degrees."""
    rng = np.random.default_rng(0)
    made, refused, below, lowest = 0, 0, 0, np.inf
    while made < wanted:
        certifier = Certifier(ArmModel(MODELS[made % 6], list(TOOLS.values())[rng.integers(4)]), Scene())
        q = USUAL_POSTURE_RAD + np.concatenate([rng.uniform(-0.6, 0.6, 3), np.zeros(3)])
        try:
            plan = plan_tour(certifier, q, int(rng.choice([24, 12, 6])), speeds=Speeds(), guess=guess_of(certifier))
        except PlanRefused:
            refused += 1
            continue
        poses = np.array([pose.q_rad for pose in plan.tour])
        following = np.roll(poses, -1, axis=0)
        samples = int(np.ceil(np.degrees(np.abs(following - poses).max()) / 0.5)) + 1
        share = np.linspace(0, 1, samples)[:, None, None]
        below += not certifier.free(((1 - share) * poses + share * following).reshape(-1, 6)).all()
        lowest = min(lowest, *(step.clearance_m for step in plan.steps))
        made += 1
    show(f"{made} plans sampled, {refused} refused, {below} below a margin")
    show(f"smallest stated clearance {1e3 * lowest:.2f} mm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    arguments = parser.parse_args()
    constant_tour()
    random_plans(arguments.plans)
