"""A new tool from four poses and an earlier result, against 12 poses alone.

    uv run python -m tests.benchmarks.new_tool [--runs 200]

The earlier result has 24 poses of another tool. The four poses are those that `calibrate --from` plans, averaged twice
as long as the 12. Shown: squared error over the stated variance (1 expected), the error of compensation over all
orientations against that of 12 poses alone, and what is found when the sensor has turned by 1 degree since. Exit code:
1 if a target is missed.
"""

import argparse
import sys
from dataclasses import replace

import click
import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import solve
from ftcalib.errors import NotObservable
from ftcalib.extras.new_tool import new_tool
from ftcalib.model import Array, predict
from ftcalib.published.yu import SPECIAL_R_flange_base
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_tool
from tests.unit.calib.extras.test_new_tool import OTHER, poses
from tests.unit.ftdrive.live.simulated import TRUTH, calibrated

TOUR = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
EVERYWHERE = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix()
LONGER = 2.0
"""Of an average of `calibrate --from`, in that of a tour."""


def planned() -> Array:
    """Return the poses of `calibrate --from` on a UR5e, (4, 3, 3)."""
    certifier = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene((BASE_PLANE,)))
    plan = plan_tool(certifier, USUAL_POSTURE_RAD, speeds=Speeds(), guess=guess_of(certifier))
    return np.array([step.R_base_flange for step in plan.steps])


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    options = parser.parse_args()
    four_poses = planned()
    z2, worst, rms = list[float](), 0.0, {name: list[float]() for name in ("four", "short", "random", "tour")}
    named = refused = 0
    for seed in range(options.runs):
        rng = np.random.default_rng([seed, 3])
        earlier = calibrated(24, seed % 40)
        try:
            four = new_tool(earlier, poses(OTHER, four_poses, seed, LONGER))
        except NotObservable:
            refused += 1
            continue
        drawn = Rotation.random(12, rng=rng).as_matrix()
        others = {
            "short": new_tool(earlier, poses(OTHER, four_poses, seed)),
            "random": solve(poses(OTHER, drawn, seed)),
            "tour": solve(poses(OTHER, rng.permutation(TOUR)[:12], seed)),
        }
        e = four.parameters.difference(OTHER)
        z2.append(float(e @ np.linalg.solve(four.covariance, e)) / 15)
        worst = max(worst, float(np.max(np.abs(e) / np.sqrt(np.diag(four.covariance)))))
        for name, result in {"four": four, **others}.items():
            off = predict(result.parameters, EVERYWHERE) - predict(OTHER, EVERYWHERE)
            rms[name].append(float(np.mean(np.sum(off[:, :3] ** 2, axis=1))))
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis), degrees=True).as_matrix()
        turned = replace(OTHER, R_flange_sensor=turn @ TRUTH.R_flange_sensor)
        try:
            new_tool(earlier, poses(turned, four_poses, seed, LONGER))
        except NotObservable as error:
            named += "mounted otherwise" in str(error)
    size = {name: float(np.sqrt(np.mean(values))) for name, values in rms.items()}
    click.echo(
        f"{options.runs} runs: mean squared error / variance {np.mean(z2):.2f}, worst component {worst:.1f} sigma, "
        f"refused {refused}; sensor turned by 1 degree: named {named}"
    )
    for name, words in (("four", f"averaged {LONGER:g} times as long"), ("short", "averaged as long")):
        random, tour = size[name] / size["random"], size[name] / size["tour"]
        click.echo(f"force error of four poses, {words} / 12 alone: {random:.2f} (random poses), {tour:.2f} (tour)")
    good = 0.8 <= np.mean(z2) <= 1.25 and named == options.runs and refused <= 1
    good &= size["four"] <= 1.3 * size["random"]
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
