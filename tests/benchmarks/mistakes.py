"""Mistakes at rest: is the cause named first, is no wrong result good, and does its advice lead to the truth?

    uv run python -m tests.benchmarks.accuracy --only mistakes            # 16 seeds of each kind, 300 right sessions
    SHOW_MISTAKES=1 uv run python -m tests.benchmarks.accuracy --only mistakes          # what is named otherwise

Run k of a kind has the seed k: poses, tool, mounting, bias and noise are drawn, and whether the tool is described and
the noise is given. "Hidden" kinds fit as well as right poses without another value that is known: a good result is
then no defect. `docs/explanation/methods.md` lists them.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Finding, NotObservable, Setup, solve
from ftcalib.files import JSON
from ftcalib.known import NOTHING, Known
from ftcalib.model import Array
from tests import structured_cell as cell
from tests.benchmarks import scenarios as sim
from tests.benchmarks.common import Lab, Row, band, most
from tests.benchmarks.structured_errors import calibrated

FINE: Array = np.repeat([0.01, 4e-4], 3)
ORDERS = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
# Findings that accuse nothing.
ACCUSE_NOTHING = frozenset((
    "noise_unknown", "noise_exceeded", "residuals_alike", "pose_deviates", "poses_rejected", "poses_unchecked",
    "gain_x", "gain_y", "gain_z", "axes_mixed", "cross_talk", "response_small", "cable_spring", "force_error",
    "torque_error", "base_leans", "drift", "second_solution",
))  # fmt: skip

# What cells with such errors truly have.
STRUCTURE = frozenset(("response_not_linear", "cable_acts", "orientations_smoothly_off", "gain_unknown"))


@dataclass(frozen=True)
class Handed:
    """Poses as a user hands them in, and what is true of them."""

    truth: sim.Truth
    R: Array
    wrench: Array
    rng: sim.Rng
    form: dict[str, JSON]
    """Of `CalibrationDataset.meta`: from what the orientations were read."""
    tcp_m: Array
    """(3,) in the flange."""
    known: Known | None = None
    setup: Setup = NOTHING
    counts_N: float = 1.0
    """A unit of the force."""
    given: bool = False
    """Whether the noise of a pose is."""

    def solved(self) -> CalibrationResult | Finding:
        """Solve; the finding if that is refused."""
        n = len(self.R)
        noise = np.broadcast_to(np.diag(FINE**2), (n, 6, 6)) if self.given else None
        samples = np.full(n, 1000 if self.given else 0)
        dataset = CalibrationDataset(self.R, self.wrench, noise, samples, np.arange(float(n)), self.form)
        try:
            return solve(dataset, known=self.known, setup=self.setup)
        except NotObservable as error:
            return error.finding or Finding(str(error), "reject")

    def is_right(self, result: CalibrationResult | Finding) -> bool:
        if isinstance(result, Finding):
            return False
        x = np.linalg.norm(sim.error(self.truth, result.parameters).reshape(5, 3), axis=1)
        return bool(x[0] < np.deg2rad(2.0) and x[1] < 0.02 * np.linalg.norm(self.truth.b) and x[3] < 0.003)


def handed(seed: int, *, exact: bool = False) -> Handed:
    """Draw right poses: in all orientations or within 60° of tool down; exact ones of a simulator in steps of 30°."""
    rng = np.random.default_rng([seed, 47])
    n = int(rng.choice([12, 24]))
    R = sim.poses(("haar", "cone60_")[rng.integers(2)] + str(n), rng)
    along = Rotation.from_rotvec(np.deg2rad(20) * rng.uniform() * np.append(sim.direction(rng)[:2], 0)).apply([0, 0, 1])
    com_m, weight_N = rng.uniform(0.03, 0.15) * along, rng.uniform(0.6, 2.5) * 9.80665
    lean = Rotation.from_rotvec(np.deg2rad(1.0) * np.append(rng.uniform(-1, 1, 2), 0))
    mount = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
    bias = np.repeat([5.0, 0.3], 3) * rng.normal(size=6)
    truth = sim.Truth(mount, lean.apply([0, 0, -weight_N]), bias[:3], mount @ com_m, bias[3:])
    if exact:
        com = np.array([0.0, 0, com_m[2]])
        truth = sim.Truth(np.eye(3), np.array([0, 0, -weight_N]), np.zeros(3), com, np.zeros(3))
        R = Rotation.from_euler("xyz", np.deg2rad([180, 0, 0] + 30 * rng.integers(-2, 3, (n, 3)))).as_matrix()
    tcp_m = np.array([0, 0, com_m[2] * rng.uniform(1.5, 3.0)])
    noise = 0.0 if exact else FINE * rng.normal(size=(n, 6))
    form: dict[str, JSON] = {"form": str(rng.choice(["matrix", "quaternion", "vector", "joints"]))}
    right = Handed(truth, R, sim.readings(truth, R) + noise, rng, form, tcp_m)
    if rng.integers(2):  # the tool and its mass are described
        described = Setup(cylinders_m=[(0.0, 2 * com_m[2], 0.16)], sensor_height_m=0.0, tool_mass_kg=weight_N / 9.8)
        right = replace(right, setup=described)
    return replace(right, given=not exact and bool(rng.integers(2)))


def about_tcp(case: Handed, sign: float = 1.0) -> Handed:
    """Move the point of the torque to the TCP; with sign -1 back."""
    point, force = case.truth.R @ case.tcp_m, case.wrench[:, :3]
    moved = case.wrench[:, 3:] - sign * np.cross(point, force)
    return replace(case, wrench=np.concatenate([force, moved], axis=1))


def negated(case: Handed) -> Handed:
    return replace(case, wrench=-case.wrench)


def torques_negated(case: Handed) -> Handed:
    return replace(case, wrench=case.wrench * np.repeat([1, -1], 3))


def zeroed(case: Handed, times: int) -> Handed:
    """Zero the sensor some times, two poses apart or more: each time it reads 0 in another orientation."""
    spare = len(case.R) - 2 * (times + 1)
    gaps = np.sort(case.rng.integers(0, spare + 1, times)) + 2 * np.arange(1, times + 1)
    wrench = case.wrench.copy()
    for first in gaps:
        at = sim.readings(case.truth, Rotation.random(1, rng=case.rng).as_matrix())[0]
        wrench[first:] = case.wrench[first:] - at
    return replace(case, wrench=wrench)


def zeroed_before_each(case: Handed) -> Handed:
    """Zero it before each move: at the pose before."""
    return replace(case, wrench=np.diff(case.wrench, axis=0), R=case.R[1:])


def in_counts(case: Handed, counts: float, offset: float, *, known: bool = False) -> Handed:
    """Raw counts of force and torque, with an offset that a strain gauge has."""
    offsets = offset * case.rng.uniform(0.3, 1.0, 6) * case.rng.choice([-1, 1], 6)
    mass_kg = float(np.linalg.norm(case.truth.b)) / 9.80665
    spoiled = replace(case, wrench=counts * case.wrench + offsets, counts_N=1 / counts)
    return replace(spoiled, known=Known(mass_kg=mass_kg, mass_tolerance_kg=0.001 * mass_kg)) if known else spoiled


def angles_as(case: Handed, *, form: str) -> Handed:
    """Read three angles, one about each axis, in another order than that in which they were written."""
    written, read = case.rng.choice(ORDERS, 2, replace=False)
    angles = Rotation.from_matrix(case.R).as_euler(written)[:, [written.index(axis) for axis in "xyz"]]
    R = Rotation.from_euler(read, angles[:, ["xyz".index(axis) for axis in read]]).as_matrix()
    return replace(case, R=R, form={"form": "euler", "euler": str(read)} if form == "euler" else {"form": form})


def quaternions_rolled(case: Handed) -> Handed:
    rolled = np.roll(Rotation.from_matrix(case.R).as_quat(), int(case.rng.choice([-1, 1])), axis=1)
    return replace(case, R=Rotation.from_quat(rolled).as_matrix(), form={"form": "quaternion"})


def inverted(case: Handed) -> Handed:
    return replace(case, R=np.swapaxes(case.R, 1, 2), form={"form": "matrix"})


def scaled(case: Handed, force: float, torque: float) -> Handed:
    """Give forces and torques in units of so many N and N·m."""
    return replace(case, wrench=case.wrench / np.repeat([force, torque], 3))


def axes_as(case: Handed, order: Sequence[int], signs: Sequence[float] = (1, 1, 1, 1, 1, 1)) -> Handed:
    """Take the channels from others."""
    return replace(case, wrench=case.wrench[:, order] * signs)


def in_base(case: Handed) -> Handed:
    """Give the wrench in base axes, with the bias of the sensor."""
    return replace(case, wrench=np.einsum("nij,nkj->nki", case.R, case.wrench.reshape(-1, 2, 3)).reshape(-1, 6))


def turned_poses(case: Handed, *, of_tool: Array | None = None, of_base: Array | None = None) -> Handed:
    """Give poses of another frame of the tool, or in another frame of the base."""
    before, after = (np.eye(3) if v is None else Rotation.from_rotvec(v).as_matrix() for v in (of_base, of_tool))
    return replace(case, R=before @ case.R @ after)


def vectors_as(case: Handed, *, read: str) -> Handed:
    """Read rotation vectors as angles about x, y and z, or in degrees as if they were radians."""
    v = Rotation.from_matrix(case.R).as_rotvec()
    R = Rotation.from_euler("xyz", v) if read == "angles" else Rotation.from_rotvec(np.rad2deg(v))
    return replace(case, R=R.as_matrix(), form={"form": "vector"})


def of_other_arm(case: Handed) -> Handed:
    """Compute the poses from joint angles with the model of an arm whose elbow has its zero elsewhere."""
    q = cell.postures(case.rng, len(case.R), "whole")
    right = cell.flange(q)
    other = cell.flange(q + np.pi / 2 * np.array([0, 0, 1, 0, 0, 0]))
    return replace(case, R=other, wrench=at_poses(case, right), form={"form": "joints"})


def at_poses(case: Handed, R: Array) -> Array:
    """Readings (n, 6) in other poses."""
    return sim.readings(case.truth, R) + FINE * case.rng.normal(size=(len(R), 6))


def paired_by(case: Handed, poses: int) -> Handed:
    """Pair each wrench with a later pose."""
    return replace(case, R=case.R[poses:], wrench=case.wrench[:-poses])


def without_row(case: Handed) -> Handed:
    """Lose a wrench in the middle: all later ones belong to the pose before."""
    lost = int(case.rng.integers(len(case.R) // 3, 2 * len(case.R) // 3))
    return replace(case, R=case.R[:-1], wrench=np.delete(case.wrench, lost, axis=0))


def copied(case: Handed, *, wrench_alone: bool) -> Handed:
    """Record a pose twice, or its wrench again in the pose after it."""
    k = int(case.rng.integers(1, len(case.R)))
    R, wrench = case.R.copy(), case.wrench.copy()
    wrench[k] = wrench[k - 1]
    if not wrench_alone:
        R[k] = R[k - 1]
    return replace(case, R=R, wrench=wrench)


def compensated(case: Handed, share: float) -> Handed:
    """Read a wrench from which the controller takes a share of the weight."""
    gravity = sim.readings(case.truth, case.R) - np.r_[case.truth.F0, case.truth.T0]
    return replace(case, wrench=case.wrench - share * gravity)


def touched(case: Handed, share: float, *, along_base: bool = False) -> Handed:
    """Touch something in a share of the poses with 2 to 8 N at the tip, or press against the same thing in all."""
    n = len(case.R)
    count = max(1, round(share * n))
    force = case.rng.normal(size=(n, 3))
    force *= case.rng.uniform(2, 8, (n, 1)) / np.linalg.norm(force, axis=1)[:, None]
    if along_base:
        force = case.R.swapaxes(1, 2) @ force[0] @ case.truth.R.T
    force[case.rng.permutation(n)[count:]] = 0
    return replace(case, wrench=case.wrench + np.hstack([force, np.cross(case.truth.R @ case.tcp_m, force)]))


def changed(case: Handed, change: Callable[[sim.Truth], sim.Truth]) -> Handed:
    """Change the truth from a pose in the middle on."""
    k = int(case.rng.integers(4, len(case.R) - 3))
    wrench = case.wrench.copy()
    wrench[k:] += sim.readings(change(case.truth), case.R[k:]) - sim.readings(case.truth, case.R[k:])
    return replace(case, wrench=wrench)


def slipped(case: Handed) -> Handed:
    turn = Rotation.from_rotvec(np.deg2rad(case.rng.uniform(1, 4)) * sim.direction(case.rng)).as_matrix()
    return changed(case, lambda truth: replace(truth, R=turn @ truth.R))


def shifted(case: Handed) -> Handed:
    off_m = case.rng.uniform(0.005, 0.02) * sim.direction(case.rng)
    return changed(case, lambda truth: replace(truth, P=truth.P + off_m))


def lost_part(case: Handed) -> Handed:
    kept = case.rng.uniform(0.75, 0.95)
    return changed(case, lambda truth: replace(truth, b=kept * truth.b))


def loose(case: Handed) -> Handed:
    """Let the tool turn on loose screws to the side to which its weight pulls, by .2 to .6° either way."""
    axis, most_rad = sim.direction(case.rng), np.deg2rad(case.rng.uniform(0.2, 0.6))
    torque = sim.readings(case.truth, case.R)[:, 3:] - case.truth.T0
    turns = Rotation.from_rotvec(np.outer(most_rad * np.sign(torque @ axis), axis)).as_matrix()
    here = [replace(case.truth, R=turn @ case.truth.R) for turn in turns]
    right = sim.readings(case.truth, case.R)
    read = np.vstack([sim.readings(one, R[None]) for one, R in zip(here, case.R, strict=True)])
    return replace(case, wrench=case.wrench + read - right)


def rocking(case: Handed) -> Handed:
    """Let the base rock by 2° to the side to which the arm reaches."""
    side = case.rng.uniform(0, 2 * np.pi, len(case.R))
    rock = Rotation.from_rotvec(np.deg2rad(2.0) * np.stack([np.cos(side), np.sin(side), 0 * side], axis=1))
    true = rock.as_matrix() @ case.R
    return replace(case, wrench=case.wrench + sim.readings(case.truth, true) - sim.readings(case.truth, case.R))


def pulled(case: Handed, *, half: bool) -> Handed:
    """Let a cable pull in the poses in which it is short, or everywhere like a spring."""
    v = Rotation.from_matrix(case.R[0].T @ case.R).as_rotvec() @ sim.direction(case.rng)
    pull = np.maximum(v - np.median(v), 0.0) if half else v
    force = case.rng.uniform(1, 3) * np.outer(pull, sim.direction(case.rng))
    return replace(case, wrench=case.wrench + np.hstack([force, np.cross(case.truth.R @ case.tcp_m / 2, force)]))


def of_other_sensor(case: Handed, *, torque_alone: bool) -> Handed:
    """Take the torques, or all channels, from a sensor with another tool on another arm."""
    truth = handed(int(case.rng.integers(1000, 2000))).truth
    other = sim.readings(truth, Rotation.random(len(case.R), rng=case.rng).as_matrix())
    other += FINE * case.rng.normal(size=other.shape)
    return replace(case, wrench=np.hstack([case.wrench[:, :3], other[:, 3:]]) if torque_alone else other)


def torques_of_idle(case: Handed) -> Handed:
    """Take the torques from a sensor that carries nothing."""
    torque = case.wrench[0, 3:] + FINE[3:] * case.rng.normal(size=(len(case.R), 3))
    return replace(case, wrench=np.hstack([case.wrench[:, :3], torque]))


def alternating(case: Handed) -> Handed:
    """Read two sensors in turn."""
    turn = Rotation.from_rotvec([0, 0, case.rng.uniform(0.5, 3)]).as_matrix()
    other = replace(case.truth, R=turn @ case.truth.R, P=turn @ case.truth.P, F0=3 * case.rng.normal(size=3))
    wrench = case.wrench.copy()
    wrench[1::2] = at_poses(replace(case, truth=other), case.R[1::2])
    return replace(case, wrench=wrench)


def channel(case: Handed, what: str) -> Handed:
    """Let a channel stick, saturate or read in coarse steps."""
    wrench, k = case.wrench.copy(), int(case.rng.integers(3))
    if what == "stuck":
        wrench[:, k] = wrench[0, k]
    elif what == "saturated":
        wrench[:, k] = np.minimum(wrench[:, k], np.quantile(wrench[:, k], 0.7))
    else:
        wrench = np.round(wrench / np.repeat([1.0, 0.05], 3)) * np.repeat([1.0, 0.05], 3)
    return replace(case, wrench=wrench)


def warming(case: Handed) -> Handed:
    """Let the bias drift by 1 to 3 N and their torque, as a sensor does that has just been switched on."""
    course = (1 - np.exp(-3 * np.linspace(0, 1, len(case.R))))[:, None]
    drift = np.r_[case.rng.uniform(1, 3) * sim.direction(case.rng), 0.05 * sim.direction(case.rng)]
    return replace(case, wrench=case.wrench + course * drift)


@dataclass(frozen=True)
class Mistake:
    """What is wrong, what names it, and what a user does who follows the advice."""

    name: str
    spoil: Callable[[Handed], Handed]
    named: str
    """Codes, and words that the sentence has after "/"."""
    follow: Callable[[Handed], Handed] | None = None
    """None records again without the mistake."""
    exact: bool = False
    hidden: bool = False
    """Whether sessions fit as well as right ones, so that no finding may name it."""


about_sensor = partial(about_tcp, sign=-1.0)
POINT = "torques_reversed torques_about_point/--wrench-frame tcp"
UNITS = "com_too_far com_too_near com_outside_tool tool_mass_mismatch weight_implausible"
OTHER_POSES = "pairing_or_rotations other_recording"
CONTACT = "poses_rejected force_error torque_error weight_insignificant second_solution"
CABLE = "cable_acts cable_spring force_error torque_error noise_exceeded bias_stepped/cable"
CHANGED = "sensor_turned sensor_changed load_changed com_shifted bias_stepped"
MISTAKES: Sequence[Mistake] = (
    # Units
    Mistake("forces in kgf", partial(scaled, force=9.80665, torque=1.0), UNITS),
    Mistake("forces in lbf", partial(scaled, force=4.4482216, torque=1.0), UNITS, hidden=True),
    Mistake("lbf and lbf·in", partial(scaled, force=4.4482216, torque=0.11298483), UNITS),
    Mistake("lbf and lbf·ft", partial(scaled, force=4.4482216, torque=1.3558179), UNITS, hidden=True),
    Mistake("kgf and kgf·m", partial(scaled, force=9.80665, torque=9.80665), UNITS, hidden=True),
    Mistake("torques in N·mm", partial(scaled, force=1.0, torque=1e-3), UNITS),
    Mistake("forces in mN", partial(scaled, force=1e-3, torque=1.0), UNITS),
    Mistake("counts, 1 unit = .82 N", partial(in_counts, counts=1 / 0.82, offset=25_400), "bias_implausible/counts"),
    Mistake(
        "counts, 400 for 1 N",
        partial(in_counts, counts=400.0, offset=25_400),
        "bias_implausible weight_implausible/counts",
    ),
    Mistake(
        "counts, 1 unit = .82 N, known mass",
        partial(in_counts, counts=1 / 0.82, offset=25_400, known=True),
        "known_mass bias_implausible/1 unit = 0.8",
    ),
    # Signs, axes and points of the wrench
    Mistake("torque about the TCP", about_tcp, POINT, about_sensor),
    Mistake("torques reversed", torques_negated, "torques_reversed/reverse", torques_negated),
    Mistake(
        "reaction about the TCP",
        lambda case: negated(about_tcp(case)),
        "forces_reversed/--sign -1 --wrench-frame tcp",
        lambda case: about_sensor(negated(case)),
    ),
    Mistake("reaction", negated, "weight_upwards/--sign -1", negated),
    Mistake("forces reversed", lambda case: torques_negated(negated(case)), "forces_reversed/reverse the forces"),
    Mistake("fx reversed", partial(axes_as, order=range(6), signs=(-1, 1, 1, 1, 1, 1)), "axes_disagree"),
    Mistake("tz reversed", partial(axes_as, order=range(6), signs=(1, 1, 1, 1, 1, -1)), "axes_disagree"),
    Mistake("fx and fy exchanged", partial(axes_as, order=(1, 0, 2, 3, 4, 5)), "axes_disagree"),
    Mistake("axes of torque rolled", partial(axes_as, order=(0, 1, 2, 4, 5, 3)), "axes_disagree"),
    Mistake("axes of both rolled", partial(axes_as, order=(1, 2, 0, 4, 5, 3)), "known_mounting", hidden=True),
    Mistake("forces and torques exchanged", partial(axes_as, order=(3, 4, 5, 0, 1, 2)), "columns_swapped"),
    Mistake("wrench in base axes", in_base, "wrench_in_base constant_force"),
    # Orientations
    Mistake("Euler order", partial(angles_as, form="euler"), "euler_angles/--euler"),
    Mistake("Euler order, in matrices", partial(angles_as, form="matrix"), "euler_angles/Euler"),
    Mistake("quaternion order", quaternions_rolled, "quaternion_order/quaternions"),
    Mistake("inverted matrices", inverted, "orientations_inverted/inverted", inverted),
    Mistake("vectors as angles", partial(vectors_as, read="angles"), OTHER_POSES),
    Mistake("degrees as radians", partial(vectors_as, read="degrees"), OTHER_POSES),
    Mistake("model of another arm", of_other_arm, OTHER_POSES),
    Mistake("poses of a TCP", partial(turned_poses, of_tool=np.array([0.4, 0.3, 1.0])), "known_mounting", hidden=True),
    Mistake("base turned", partial(turned_poses, of_base=np.array([0, 0, np.pi])), "known_mounting", hidden=True),
    Mistake("base of a wall", partial(turned_poses, of_base=np.array([np.pi / 2, 0, 0])), "mounting_undeclared"),
    # Zeroing and compensation
    Mistake("zeroed once", partial(zeroed, times=1), "bias_stepped/zeroed"),
    Mistake("zeroed twice", partial(zeroed, times=2), "bias_stepped/zeroed"),
    Mistake("zeroed three times", partial(zeroed, times=3), "bias_stepped/zeroed"),
    Mistake("zeroed before each move", zeroed_before_each, "zeroed_each_pose/zeroed"),
    Mistake("compensated", partial(compensated, share=1.0), "weight_compensated weight_insignificant"),
    Mistake("compensated by 60 %", partial(compensated, share=0.6), "tool_mass_mismatch/controller", hidden=True),
    # Pairs of wrench and pose
    Mistake("paired with the next pose", partial(paired_by, poses=1), "pairing_shifted"),
    Mistake("paired three poses later", partial(paired_by, poses=3), OTHER_POSES),
    Mistake("a wrench is missing", without_row, f"{OTHER_POSES} pairing_shifted"),
    Mistake("poses in the order of the plan", lambda case: replace(case, R=case.rng.permutation(case.R)), OTHER_POSES),
    Mistake("a pose twice", partial(copied, wrench_alone=False), "repeated_poses"),
    Mistake("a wrench twice", partial(copied, wrench_alone=True), "repeated_wrenches"),
    Mistake("torques of another sensor", partial(of_other_sensor, torque_alone=True), "torques_unrelated"),
    Mistake("torques of a sensor without load", torques_of_idle, "torques_unrelated"),
    Mistake("another recording", partial(of_other_sensor, torque_alone=False), OTHER_POSES),
    # The cell
    Mistake("contact in one pose", partial(touched, share=0.0), CONTACT),
    Mistake("contact in a third", partial(touched, share=0.33), CONTACT),
    Mistake("contact in all", partial(touched, share=1.0), CONTACT),
    Mistake("a hose that pulls one way", partial(touched, share=1.0, along_base=True), CABLE),
    Mistake("tool slipped", slipped, CHANGED),
    Mistake("load shifted", shifted, CHANGED),
    Mistake("lost a part", lost_part, CHANGED),
    Mistake("loose screws", loose, "orientations_smoothly_off orientations_off/fasten", hidden=True),
    Mistake("base rocks by 2°", rocking, "orientations_off/fasten base"),
    Mistake("cable pulls in half of the poses", partial(pulled, half=True), CABLE),
    Mistake("cable pulls like a spring", partial(pulled, half=False), CABLE),
    Mistake("two sensors in turn", alternating, "sensors_alternate"),
    Mistake("warming up", warming, "drift"),
    Mistake("a channel is stuck", partial(channel, what="stuck"), "stuck_channels"),
    Mistake("a channel saturates", partial(channel, what="saturated"), "saturated"),
    Mistake("coarse steps", partial(channel, what="coarse"), "quantised stuck_channels"),
    # A simulator without noise
    Mistake("simulator: quaternion order", quaternions_rolled, "quaternion_order/quaternions", exact=True),
    Mistake("simulator: inverted", inverted, "orientations_inverted/inverted", inverted, exact=True),
    Mistake("simulator: torque about the TCP", about_tcp, POINT, about_sensor, exact=True),
    Mistake("simulator: Euler order", partial(angles_as, form="euler"), "euler_angles/--euler", exact=True),
)


def mistake_run(seed: int, kind: int) -> dict[str, object]:
    mistake = MISTAKES[kind]
    right = handed(seed, exact=mistake.exact)
    spoiled = mistake.spoil(right)
    result = spoiled.solved()
    first = result if isinstance(result, Finding) else (*result.findings, Finding("none", "note"))[0]
    codes, _, word = mistake.named.partition("/")
    named = first.code in codes.split() and word in first.words
    good = not isinstance(result, Finding) and result.verdict == "good"
    if os.environ.get("SHOW_MISTAKES") and not named:
        print(f"{mistake.name} {seed} n={len(right.R)} {first.code}: {first.words}")  # noqa: T201
    wrong = good and not right.is_right(result)
    led = mistake.follow is None or not named or right.is_right(mistake.follow(spoiled).solved())
    return {"named": named, "good": good, "wrong": wrong, "misled": not led}


def right_run(seed: int) -> dict[str, object]:
    """Right poses of the same generators, with an imperfection of real cells or none."""
    case = handed(seed, exact=seed % 6 == 5)
    rng, wrench = case.rng, case.wrench.copy()
    if seed % 6 == 1:  # a gain of 2 %, cross-talk of 1 % of 50 mm
        force = wrench[:, :3] - case.truth.F0
        wrench += np.concatenate(
            [force @ (0.02 * rng.normal(size=(3, 3))), force @ (5e-4 * rng.normal(size=(3, 3)))], 1
        )
    if seed % 6 == 2:
        wrench += np.cumsum(np.repeat([0.02, 6e-4], 3) * rng.normal(size=wrench.shape), axis=0)
    if seed % 6 == 3:
        R = sim.with_inexact_orientations(case.R, np.deg2rad(0.05), rng)
        wrench += sim.readings(case.truth, R) - sim.readings(case.truth, case.R)
    if seed % 6 == 4:  # written with two decimals and three
        wrench = np.round(wrench, 3)
    form: dict[str, JSON] = {"form": "euler", "euler": "xyz"} if rng.integers(3) == 0 else case.form
    result = replace(case, wrench=wrench, form=form).solved()
    # Small errors with a structure are notes.
    found = [result] if isinstance(result, Finding) else [one for one in result.findings if one.severity != "note"]
    found = [one for one in found if one.code not in ACCUSE_NOTHING]
    if os.environ.get("SHOW_MISTAKES") and found:
        print(f"right {seed} {found[0].code}: {found[0].words}")  # noqa: T201
    return {"false": bool(found)}


def structured_run(seed: int) -> dict[str, object]:
    """Right sessions of cells whose errors have a structure."""
    name = list(cell.CELLS)[seed % len(cell.CELLS)]
    n, where = (12, 24)[seed // 2 % 2], ("whole", "wrist")[seed // 4 % 2]
    result = calibrated(seed, name, n, where, given=bool(seed % 2)).result
    found = [one for one in result.findings if one.code not in ACCUSE_NOTHING | STRUCTURE]
    if os.environ.get("SHOW_MISTAKES") and found:
        print(f"{name} {seed} {found[0].code}: {found[0].words}")  # noqa: T201
    return {"false": bool(found)}


def mistakes(lab: Lab) -> Iterator[Row]:
    """Count what is named first; a mistake that left the estimates right may end good."""
    runs, share = lab.count(16, 4), []
    for kind, mistake in enumerate(MISTAKES):
        found = lab.simulate(partial(mistake_run, kind=kind), runs)
        named, good, wrong, misled = (int(found[key].sum()) for key in ("named", "good", "wrong", "misled"))
        figure = f"{named} first, {good} good, {wrong} wrong, {misled} misled"
        passed = misled == 0 and (mistake.hidden or wrong == 0)
        yield Row(f"mistake, {mistake.name}", figure, "" if mistake.hidden else "0 good and wrong", passed, runs)
        share += [] if mistake.hidden else [100 * named / runs]
    yield band("mistakes that data show: named first", float(np.mean(share)), 92, np.inf, runs * len(share), " %")
    runs = lab.count(300, 60)
    for name, worker in (("right poses", right_run), ("errors with a structure", structured_run)):
        false = 100 * float(lab.simulate(worker, runs)["false"].mean())
        yield most(f"mistakes, {name} with a false cause", false, 1, runs, " %")
