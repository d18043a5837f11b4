"""Calibrate the kinematics of real arms as emulated arms, on both control paths, and refuse what contradicts them.

    FTDRIVE_REAL_DATA=… python -m tests.benchmarks.real_arms [--arms 01,13] [--paths script] [--perfect]

Each arm of `ur_calibrations/arms.csv` is a station with these kinematics. `doctor`, `plan`, `calibrate` along that
plan, `verify`, and `solve --method srom` have to find it good, as they would with a configuration file and typed
answers. An arm whose shape is not measured (UR3, UR5 and UR10 of the CB3 generation) cannot be planned: `doctor` has to
accept it, `calibrate` to refuse it in a sentence, `calibrate --manual` to take poses by hand. SROM knows no gain and no
cross-talk, so its result is only usable with the errors of the emulated sensor, which `--perfect` leaves out. The exit
code is the number of rows that failed.
"""

import argparse
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ftdrive.cell.emulated import Station
from ftdrive.planning.geometry.arm_model import SHAPES
from ftdrive.planning.plan import Plan
from ftdrivers.ur.control import ControlPath
from tests.benchmarks.common import show
from tests.own_kinematics import of_dh
from tests.real_arms import RealArm, real_arms
from tests.system.command_line import CommandLine

PATHS: tuple[ControlPath, ...] = ("ur-rtde", "script")
TYPED = "yes\nyes\nyes\nMOVE\nyes\n" + "yes\n" * 5
"""Tool free, ball free, emergency stop in reach; the approach; the tour."""
Row = tuple[str, str, bool]
"""Name, figures and whether it passed."""


def connected(ftdrive: CommandLine, station: Station) -> Path:
    """Write the configuration file of a station, with poses as long as those of an emulated cell."""
    config = ftdrive.connect(station)
    text = config.read_text(encoding="utf-8")
    config.write_text(
        re.sub(r"average_s = .*", f"average_s = {station.cell.sampling.average_s}", text), encoding="utf-8"
    )
    return config


PERFECT = ("--gain", "0", "--cross-talk", "0")


def calibrated(arm: RealArm, path: ControlPath, folder: Path, errors: tuple[str, ...]) -> Iterator[Row]:
    """Run the commands on one arm, which may move; `errors` are options for those of its sensor."""
    options = ("--seed", arm.number, "--kinematics", str(arm.save(folder)), *errors)
    with Station("can", options, control_path=path) as station:
        ftdrive = CommandLine(folder)
        config = connected(ftdrive, station)
        name = f"{arm.number} {arm.model:6s} {path:8s}"
        doctor = ftdrive.json("doctor", "--config", config)
        (kinematics,) = (check["found"] for check in doctor["checks"] if check["name"] == "robot.kinematics")
        yield f"{name} doctor", kinematics.removesuffix("; plans use them"), doctor["verdict"] != "failed"
        tour = folder / "tour.json"
        offline = ftdrive.run("plan", "--config", config, "--output", tour)
        outcome = ftdrive.run("calibrate", "--config", config, "--plan", tour, "--json", typed=TYPED)
        if "other kinematics" in outcome.stderr and not list(folder.glob("runs/*")):
            yield (
                f"{name} plan",
                "the nominal plan has no room on this arm: planned on the arm",
                offline.returncode == 0,
            )
            outcome = ftdrive.run("calibrate", "--config", config, "--json", typed=TYPED)
        runs = sorted(folder.glob("runs/*-calibrate"))
        if outcome.returncode or not runs:
            yield f"{name} calibrate", outcome.stderr.splitlines()[-1], False
            return
        plan = Plan.load(runs[-1] / "plan.json")
        is_own = plan.kinematics is not None and np.allclose(
            plan.kinematics.numbers, of_dh(arm.dh()).numbers, atol=1e-9
        )
        least_mm = 1e3 * min(step.clearance_m for step in plan.steps)
        yield f"{name} plan", f"{plan.kind}, {least_mm:.1f} mm clear with its own kinematics", is_own and plan.certified
        verdicts = []
        for method in ("ml", "srom"):
            solved = ftdrive.json("solve", runs[-1], "--method", method)
            verdicts.append(solved["verdict"])
        error_N = solved["predicted_error"]["force_rms_N"]
        passed = verdicts[0] == "good" and verdicts[1] in ("good", *([] if errors else ["usable"]))
        yield f"{name} calibrate", f"{verdicts[0]}, srom {verdicts[1]}, {error_N:.4f} N", passed
        verified = ftdrive.run("verify", "--config", config, "--calibration", runs[-1], "--update", "no", typed=TYPED)
        words = [line.strip() for line in verified.stdout.splitlines() if line.strip()]
        yield f"{name} verify", words[0] if words else verified.stderr.splitlines()[-1], verified.returncode == 0


def read_only(arm: RealArm, folder: Path) -> Iterator[Row]:
    """Run the commands on an arm that cannot be planned."""
    options = ("--polyscope", "3.15.8", "--seed", arm.number, "--kinematics", str(arm.save(folder)))
    with Station("can", options) as station:
        ftdrive = CommandLine(folder)
        config = connected(ftdrive, station)
        name = f"{arm.number} {arm.model:6s} read    "
        doctor = ftdrive.json("doctor", "--config", config)
        (kinematics,) = (check["found"] for check in doctor["checks"] if check["name"] == "robot.kinematics")
        yield f"{name} doctor", kinematics.removesuffix("; plans use them"), doctor["verdict"] != "failed"
        refused = ftdrive.run("calibrate", "--config", config, typed=TYPED)
        why = refused.stderr.splitlines()[-1]
        yield f"{name} calibrate", why[:70], refused.returncode != 0 and "shape" in why
        station.control(do="hand-guide")
        manual = ftdrive.run("calibrate", "--config", config, "--manual", typed=TYPED)
        taken = len(list(folder.glob("runs/*-calibrate/poses/*.npz")))
        yield f"{name} manual", f"{taken} poses, exit code {manual.returncode}", taken >= 6


def rows(arms: list[RealArm], paths: tuple[ControlPath, ...], errors: tuple[str, ...]) -> Iterator[Row]:
    """Run everything that was asked for, each in a folder of its own."""
    for arm in arms:
        for path in paths:
            with tempfile.TemporaryDirectory() as folder:
                if arm.model in SHAPES:
                    yield from calibrated(arm, path, Path(folder), errors)
                elif path == paths[0]:
                    yield from read_only(arm, Path(folder))


def main() -> int:
    """Print one row for each step of each arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", help="numbers, separated by commas")
    parser.add_argument("--paths", default=",".join(PATHS))
    parser.add_argument("--perfect", action="store_true", help="a sensor without errors of gain and cross-talk")
    arguments = parser.parse_args()
    wanted = arguments.arms.split(",") if arguments.arms else [arm.number for arm in real_arms()]
    arms = [arm for arm in real_arms() if arm.number in wanted]
    paths = tuple(path for path in PATHS if path in arguments.paths.split(","))
    failed = 0
    for name, figures, passed in rows(arms, paths, PERFECT if arguments.perfect else ()):
        failed += not passed
        show(f"{name:30s} {figures:76s} {'pass' if passed else 'FAIL'}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
