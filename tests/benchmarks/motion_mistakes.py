"""Random mistakes in random recordings in motion: what is named first, and what of it ends good.

    uv run python -m tests.benchmarks.motion_mistakes                  # 2,000 with mistakes, 500 right: half an hour
    uv run python -m tests.benchmarks.motion_mistakes --runs 200       # a tenth of both
    uv run python -m tests.benchmarks.motion_mistakes --only zeroed    # one mistake alone

Recording k has the seed k: load, mounting, motion, noise and contacts are drawn, then one mistake or up to three. The
simulator (tests/moving_load.py) shares no formula with the estimator. The exit code is the number of failed rows.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.pool import Pool

import click
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ftcalib import Setup
from ftcalib.errors import BadDataset, FtdriveError
from ftcalib.findings import Finding
from ftcalib.motion.model import HEIGHT, INERTIA, SECOND_MOMENTS
from ftcalib.motion.solve import solve_motion
from ftcalib.result import CalibrationResult
from tests.benchmarks.common import Array, Row, show, show_rows, two_workers
from tests.moving_load import Recorded, Truth, means_of, programme, record, sweep

# Findings that name a cause.
CAUSES = frozenset(
    (
        *("zeroed", "positions_unit", "clock_rate", "reversed_in_motion", "poses_of_tcp", "torques_about_tcp"),
        *("inertia_impossible", "height_impossible", "other_recording", "wrench_compensated", "torques_reversed"),
        *("forces_reversed", "weight_upwards", "axes_disagree", "wrench_in_base", "orientations_inverted", "drift"),
        *("quaternion_order", "euler_angles", "columns_swapped", "pairing_or_rotations", "bias_stepped"),
    )
)
Generator = np.random.Generator


@dataclass(frozen=True)
class Drawn:
    """A right recording, and the times at which its arm rests."""

    truth: Truth
    recorded: Recorded
    rests_s: Sequence[float]
    setup: Setup
    """With the declared mounting."""


def draw(seed: int) -> Drawn:
    """Draw load, sensor, motion and noise."""
    rng = np.random.default_rng([seed, 31])
    mass_kg = float(np.exp(rng.uniform(np.log(0.4), np.log(6.0))))
    points = rng.standard_normal((8, 3)) * rng.uniform(0.015, 0.06, 3)
    points -= points.mean(axis=0)
    J = mass_kg * np.mean([p @ p * np.eye(3) - np.outer(p, p) for p in points], axis=0)
    mounting = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * Rotation.from_rotvec(0.05 * rng.standard_normal(3))
    down = np.array([0.0, 0, -1]) if rng.random() < 0.9 else np.array([0, 1.0, 0])
    truth = Truth(
        mass_kg=mass_kg,
        inertia_kg_m2=J,
        p_sensor_com_m=np.r_[rng.uniform(-0.02, 0.02, 2), rng.uniform(0.03, 0.12)],
        mounting_rotvec=mounting.as_rotvec(),
        height_m=rng.uniform(0.0, 0.08),
        bias=np.r_[rng.uniform(-15, 15, 3), rng.uniform(-0.5, 0.5, 3)],
        gravity_m_s2=9.80665 * Rotation.from_rotvec(0.02 * rng.standard_normal(3)).apply(down),
        delay_s=rng.uniform(-0.01, 0.03),
        vibration=(rng.uniform(0, 0.6), rng.uniform(0, 0.03)),
        vibrates_at_rest=False,
        posture_error_rad=np.radians(rng.uniform(0, 0.03)),
        drift_N_per_s=rng.uniform(0, 0.02),
    )
    if rng.random() < 0.4:
        phase, wide = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.6, 1.2)
        joints, seconds = sweep(18.0, (wide, wide, wide), phase=(phase[0], phase[1], phase[2])), 18.0
        return Drawn(truth, record(truth, joints, seconds, seed), (5.0, 11.0), Setup(up_in_base=(-down).tolist()))
    seconds = float(rng.uniform(18, 30))
    joints, stops = programme(seed, seconds)
    touched = {}
    if rng.random() < 0.3:
        for start, end in stops[2::3]:
            force = rng.uniform(-12, 12, 3)
            touched[start + 0.1, end] = np.r_[force, np.cross(rng.uniform(-0.05, 0.15, 3), force)]
    rests_s = [start + 0.3 for start, _ in stops[1::3] if start < seconds - 3]
    return Drawn(
        truth, record(truth, joints, seconds, seed, contacts=touched), rests_s, Setup(up_in_base=(-down).tolist())
    )


# -- mistakes ----------------------------------------------------------------------------------------------------------


def _tcp(one: Drawn, rng: Generator) -> Recorded:
    turn = (np.zeros(3), np.r_[0, 0, rng.uniform(-3, 3)], rng.uniform(-2, 2, 3))[rng.integers(3)]
    tilt = rng.uniform(-0.7, 0.7, 2) * (rng.random() < 0.5)
    offset_m = rng.uniform(0.1, 0.3) * np.r_[tilt, 1.0] / np.sqrt(1 + tilt @ tilt)
    R = one.recorded.R_base_flange
    position = one.recorded.p_base_flange_m + R @ offset_m
    return replace(one.recorded, R_base_flange=R @ Rotation.from_rotvec(turn).as_matrix(), p_base_flange_m=position)


def _torques_about_tcp(one: Drawn, rng: Generator) -> Recorded:
    # Beyond the centre of mass: a nearer point shows only in a height that is known.
    point_m = np.r_[rng.uniform(-0.03, 0.03, 2), one.truth.p_sensor_com_m[2] + rng.uniform(0.07, 0.2)]
    wrench = one.recorded.wrench.copy()
    wrench[:, 3:] -= np.cross(point_m, wrench[:, :3])
    return replace(one.recorded, wrench=wrench)


def _zeroed(one: Drawn, rng: Generator) -> Recorded:
    wrench = one.recorded.wrench.copy()
    for first in np.searchsorted(one.recorded.t_s, one.rests_s[: int(rng.integers(1, 4))]):
        wrench[first:] -= wrench[first - 25 : first].mean(axis=0)
    return replace(one.recorded, wrench=wrench)


def _times(one: Recorded, factor: float) -> Recorded:
    return replace(one, t_s=factor * one.t_s, t_pose_s=factor * one.t_pose_s)


def _rate(one: Drawn, rng: Generator) -> Recorded:
    return _times(one.recorded, float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(1.06), np.log(2.0)))))


def _time_unit(one: Drawn, rng: Generator) -> Recorded:
    return _times(one.recorded, float(rng.choice([1e3, 1e6, 1e9])))


def _reversed(one: Drawn, rng: Generator) -> Recorded:
    signs = ((-1, -1), (-1, 1), (1, -1))[rng.integers(3)]
    return replace(one.recorded, wrench=one.recorded.wrench * np.repeat(signs, 3))


def _axes(one: Drawn, rng: Generator) -> Recorded:
    order = ([1, 2, 0], [1, 0, 2], [0, 2, 1], [2, 1, 0])[rng.integers(4)]
    columns = np.r_[0:3, 3 + np.array(order)] if rng.random() < 0.5 else np.r_[order, 3:6]
    return replace(one.recorded, wrench=one.recorded.wrench[:, columns])


def _delay(one: Drawn, rng: Generator) -> Recorded:
    return replace(one.recorded, t_pose_s=one.recorded.t_pose_s + rng.choice([-1, 1]) * rng.uniform(0.2, 1.2))


def _mm(one: Drawn, _: Generator) -> Recorded:
    return replace(one.recorded, p_base_flange_m=1e3 * one.recorded.p_base_flange_m)


def _pounds(one: Drawn, rng: Generator) -> Recorded:
    torque = 1.0 if rng.random() < 0.5 else 0.11298483
    return replace(one.recorded, wrench=one.recorded.wrench / np.repeat([4.4482216, torque], 3))


def _kgf(one: Drawn, rng: Generator) -> Recorded:
    torque = 1.0 if rng.random() < 0.5 else 9.80665
    return replace(one.recorded, wrench=one.recorded.wrench / np.repeat([9.80665, torque], 3))


def _compensated(one: Drawn, rng: Generator) -> Recorded:
    """Take 40 to 80 % of the weight from the wrench, as a controller does whose payload is too small."""
    recorded, truth = one.recorded, one.truth
    R = Slerp(recorded.t_pose_s, Rotation.from_matrix(recorded.R_base_flange))(
        np.clip(recorded.t_s - truth.delay_s, *recorded.t_pose_s[[0, -1]])
    ) * Rotation.from_rotvec(truth.mounting_rotvec)
    force = rng.uniform(0.4, 0.8) * truth.mass_kg * R.inv().apply(truth.gravity_m_s2)
    return replace(recorded, wrench=recorded.wrench - np.hstack([force, np.cross(truth.p_sensor_com_m, force)]))


def _held(one: Drawn, rng: Generator) -> Recorded:
    """Lay a hand on the tool for 60 % of the time: it pulls by 3 to 15 N, slowly changing."""
    t_s, wrench = one.recorded.t_s, one.recorded.wrench.copy()
    start = rng.uniform(0, 0.4)
    held = (t_s > t_s[0] + start * np.ptp(t_s)) & (t_s < t_s[0] + (start + 0.6) * np.ptp(t_s))
    phase, hz = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.1, 0.4, 3)
    force = rng.uniform(3, 15) * np.sin(2 * np.pi * np.outer(t_s[held], hz) + phase)
    wrench[held] += np.hstack([force, np.cross([0.0, 0.02, 0.12], force)])
    return replace(one.recorded, wrench=wrench)


def _zeroed_moving(one: Drawn, rng: Generator) -> Recorded:
    """Zero the sensor once while the arm moves or rests."""
    wrench = one.recorded.wrench.copy()
    first = int(rng.uniform(0.25, 0.75) * len(wrench))
    wrench[first:] -= wrench[first - 25 : first].mean(axis=0)
    return replace(one.recorded, wrench=wrench)


# The mistake, and the codes that name it; those of the clock last, because others know when the arm rests.
MISTAKES: Mapping[str, tuple[Callable[[Drawn, Generator], Recorded], frozenset[str]]] = {
    "zeroed": (_zeroed, frozenset(["zeroed"])),
    "zeroed in motion": (_zeroed_moving, frozenset(["zeroed"])),
    "compensated in part": (_compensated, frozenset(["wrench_compensated"])),
    "hand on the tool": (_held, frozenset(["mostly_contact", "other_recording", "force_error", "torque_error"])),
    "poses of a TCP": (_tcp, frozenset(["poses_of_tcp"])),
    "torques about a TCP": (_torques_about_tcp, frozenset(["torques_about_tcp"])),
    "positions in mm": (_mm, frozenset(["positions_unit"])),
    "reversed": (_reversed, frozenset(["reversed_in_motion"])),
    "axes": (_axes, frozenset(["axes_disagree", "reversed_in_motion"])),
    "pounds": (_pounds, frozenset(["com_too_far", "com_too_near", "weight_implausible"])),
    "kgf": (_kgf, frozenset(["com_too_far", "com_too_near", "weight_implausible"])),
    "delay": (_delay, frozenset(["clock_offset"])),
    # Times that are too long look like a weight that a controller compensates in part.
    "rate": (_rate, frozenset(["clock_rate", "wrench_compensated"])),
    "time unit": (_time_unit, frozenset(["BadDataset"])),
}  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """What became of one recording."""

    verdict: str
    codes: Sequence[str]
    impossible: bool


def judged(recorded: Recorded, setup: Setup) -> Judged:
    """Solve; a recording that is refused counts by the name of the error."""
    try:
        result = solve_motion(*means_of(recorded), setup=setup)
    except BadDataset:
        return Judged("refused", ["BadDataset"], False)
    except FtdriveError as error:
        return Judged("refused", [type(error).__name__], False)
    return Judged(result.verdict, _named(result.findings), _is_impossible(result))


def _named(findings: Sequence[Finding]) -> list[str]:
    return [one.code for one in findings if one.severity != "note"]


def _is_impossible(result: CalibrationResult) -> bool:
    """Whether no body has the inertia, or no sensor the height, by more than 3 sigma and 10 mm."""
    assert result.motion is not None
    covariance, J = result.motion.covariance, result.motion.inertia_kg_m2
    inertia = J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    moments, axes = np.linalg.eigh(np.tensordot(inertia, SECOND_MOMENTS, 1))
    along: Array = np.einsum("i,kij,j->k", axes[:, 0], SECOND_MOMENTS, axes[:, 0])
    sigma = float(np.sqrt(along @ covariance[INERTIA, INERTIA] @ along))
    least_m = result.motion.height_m + 3 * float(np.sqrt(covariance[HEIGHT, HEIGHT]))
    return bool(moments[0] < -3 * sigma - result.mass_kg * 1e-4 or not -0.01 < least_m < 0.6)


def _right_one(seed: int) -> Judged:
    one = draw(seed)
    return judged(one.recorded, one.setup)


def _alone_one(name: str, seed: int) -> Judged:
    one = draw(seed)
    return judged(MISTAKES[name][0](one, np.random.default_rng([seed, 32])), one.setup)


def _together_one(seed: int) -> tuple[Sequence[str], Judged]:
    """Solve a recording with up to three mistakes; also return their names."""
    rng, one = np.random.default_rng([seed, 33]), draw(seed)
    some = rng.choice(list(MISTAKES), rng.integers(1, 4), replace=False)
    names = [name for name in MISTAKES if name in some]
    for name in names:
        one = replace(one, recorded=MISTAKES[name][0](one, rng))
    return names, judged(one.recorded, one.setup)


def _right(pool: Pool, runs: int) -> Iterator[Row]:
    verdicts, false = Counter[str](), Counter[str]()
    for seed, found in enumerate(pool.imap(_right_one, range(runs))):
        verdicts[found.verdict] += 1
        named = CAUSES.intersection(found.codes)
        false.update(named)
        if named:
            show(f"right, seed {seed}: {found.verdict}, {', '.join(found.codes)}")
    yield Row("right: verdicts", _counts(verdicts), "", True, runs)
    yield Row("right: false causes", _counts(false) or "0", "0", not false, runs)


def _alone(pool: Pool, name: str, runs: int) -> Iterator[Row]:
    expected = MISTAKES[name][1]
    first, good = 0, 0
    for seed, found in enumerate(pool.imap(partial(_alone_one, name), range(runs))):
        hit = bool(found.codes) and found.codes[0] in expected
        first, good = first + hit, good + (found.verdict == "good")
        if not hit:
            show(f"{name}, seed {seed}: {found.verdict}, {', '.join(found.codes)}")
    hidden = name in ("pounds", "kgf")  # which motion does not show in every recording
    passed = hidden or (first >= 0.95 * runs and not good)
    target = "" if hidden else "95 %, 0 good"
    yield Row(f"{name}: named first; good", f"{100 * first / runs:.0f} %; {good}", target, passed, runs)


def _together(pool: Pool, runs: int) -> Iterator[Row]:
    """Subsets of up to three mistakes."""
    verdicts, impossible, silent = Counter[str](), 0, Counter[str]()
    for seed, (names, found) in enumerate(pool.imap(_together_one, range(runs))):
        verdicts[found.verdict] += 1
        if found.verdict == "good":
            silent[" + ".join(sorted(names))] += 1
            impossible += found.impossible
            show(f"together, seed {seed}: good with {', '.join(names)}")
    yield Row("together: verdicts", _counts(verdicts), "", True, runs)
    yield Row("together: good", _counts(silent) or "0", "", True, runs)
    yield Row("together: good beside a body that cannot exist", str(impossible), "0", impossible == 0, runs)


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counter.most_common())


@click.command()
@click.option("--runs", type=int, default=2000, show_default=True, help="With mistakes; a quarter are right ones.")
@click.option("--only", type=click.Choice(["right", "together", *MISTAKES]), multiple=True)
def main(runs: int, only: Sequence[str]) -> None:
    """Print the rows."""
    failed = 0
    with two_workers() as pool:
        for name in only or ("right", *MISTAKES, "together"):
            if name == "right":
                failed += show_rows(_right(pool, max(runs // 4, 1)))
            elif name == "together":
                failed += show_rows(_together(pool, runs))
            else:
                failed += show_rows(_alone(pool, name, max(runs // 100, 5)))
    sys.exit(failed)


if __name__ == "__main__":
    main()
