"""Mistakes of users and faults of sensors: is the cause named first, and is nothing named in honest sessions?

    uv run python -m tests.benchmarks.causes [--runs 20] [--honest 1000] [--only WORD] [--advice] [--show]

One row a kind: how often the cause came first, first with advice that misled, later, or not at all; how often another
cause was named; how often the verdict was good although the result is wrong; and how often that is so, but the data
cannot show it. Sessions come from a model of their own: tools of 0.6 to 2.5 kg, centre of mass at 20 to 200 mm, 0.01 N
and 0.4 mN·m a pose. 24 or 12 poses in all orientations or with the wrist within 60°, noise measured or not, a base on
the floor or on a wall, and a cell that is described or not are drawn by lot.
"""

import argparse
import json
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, Finding, NotObservable, Parameters, Setup, solve
from ftcalib.known import Known
from ftcalib.model import Array

Rng = np.random.Generator
Spoil = Callable[["Case"], "Case"]
Turning = Callable[[Rotation], Rotation]
Score = Literal["first", "misled", "later", "unnamed", "wrong", "good", "hidden", "harmless"]

NOISE = np.repeat([0.01, 4e-4], 3)
G = 9.80665
LBF_N, KGF_N, LBF_IN_NM = 4.4482216, 9.80665, 0.11298483
HEIGHT_M, SENSOR_KG = 0.04, 0.3
STEPS = 3
"""Mistakes that may be named one after the other, such as two units."""
ROTATION_RAD, SHARE = np.deg2rad(1.5), 0.02
"""A result this close is right: mounting; weight, and centre of mass relative to 0.1 m."""
NO_CAUSE = {"noise_unknown", "noise_exceeded", "residuals_alike", "pose_deviates", "poses_rejected", "poses_unchecked",
            "gain_x", "gain_y", "gain_z", "axes_mixed", "cross_talk", "response_small", "cable_spring", "force_error",
            "torque_error", "base_leans", "drift", "few_poses", "second_solution"}  # fmt: skip
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Case:
    """A session as its user hands it in, and what is true."""

    R: Array
    """(n, 3, 3) base to flange."""
    wrench: Array
    rng: Rng
    mass_kg: float
    down: Array
    """(3,) in base."""
    mount: Array
    """(3, 3) R_flange_sensor."""
    com_m: Array
    """(3,) in sensor axes."""
    bias: Array
    """(6,)"""
    measured: bool
    described: bool
    sigma: Array = field(default_factory=lambda: NOISE)
    setup: dict[str, Any] = field(default_factory=dict)
    known: Known | None = None

    def reading(self, rows: Any = slice(None), **different: Any) -> Array:
        """Return what a sensor would read in these poses, with noise of its own."""
        t = replace(self, **different)
        force = np.einsum("ji,nkj,k->ni", t.mount, t.R[rows], t.mass_kg * G * t.down)
        exact = np.concatenate([force, np.cross(t.com_m, force)], axis=1) + t.bias
        return np.asarray(exact + NOISE * self.rng.normal(size=exact.shape))


def unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def session(seed: int, kind: str = "") -> Case:
    """Draw a session without mistakes."""
    rng = np.random.default_rng([seed, *kind.encode()])
    n = int(rng.choice([24, 12]))
    within, measured, on_wall, described = (bool(one) for one in rng.integers(2, size=4))
    up = [X, -X, Y, -Y][rng.integers(4)] if on_wall else Z
    level = Rotation.align_vectors(up, Z)[0]
    if within:  # the tool down, tilted, the last joint turned
        axis, tilt, turn = rng.uniform(-np.pi, np.pi, n), np.deg2rad(60) * np.sqrt(rng.uniform(size=n)), np.deg2rad(60)
        lean = Rotation.from_rotvec(tilt[:, None] * np.stack([np.cos(axis), np.sin(axis), 0 * axis], axis=1))
        spin = Rotation.from_rotvec(np.outer(rng.uniform(-turn, turn, n), Z))
        poses = lean * Rotation.from_rotvec(np.pi * X) * spin
    else:
        poses = Rotation.random(n, rng=rng)
    R = (level * poses).as_matrix()
    lean = Rotation.from_rotvec(np.deg2rad(1.0) * rng.uniform(-1, 1, 3))
    mount = (Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * Z) * lean).as_matrix()
    aside = np.deg2rad(20) * rng.uniform() * unit(np.append(rng.normal(size=2), 0))
    com_flange = rng.uniform(0.02, 0.2) * Rotation.from_rotvec(aside).apply(Z)
    bias = np.repeat([5.0, 0.3], 3) * rng.normal(size=6)
    case = Case(R, np.empty(0), rng, rng.uniform(0.6, 2.5), -lean.apply(up), mount, com_flange @ mount, bias,
                measured, described)  # fmt: skip
    setup: dict[str, Any] = {"up_in_base": tuple(up)} if on_wall or described else {}
    if described:
        length = HEIGHT_M + 2 * com_flange[2]
        setup |= {"tool_mass_kg": case.mass_kg * rng.uniform(0.9, 1.1), "cylinders_m": [(0.0, length, 0.16)],
                  "sensor_height_m": HEIGHT_M, "sensor_mass_kg": SENSOR_KG,
                  "payload_kg": (case.mass_kg + SENSOR_KG) * rng.uniform(0.95, 1.05)}  # fmt: skip
    return replace(case, wrench=case.reading(), setup=setup)


# ------------------------------------------------------------------------------------------------------------ mistakes


def units(case: Case, force: float = 1.0, torque: float = 1.0) -> Case:
    factor = np.repeat([force, torque], 3)
    return replace(case, wrench=case.wrench / factor, sigma=case.sigma / factor)


def axes(case: Case, Q: Array, groups: str = "FT") -> Case:
    force, torque = (part @ Q.T if group in groups else part for group, part in zip("FT", halves(case), strict=True))
    return replace(case, wrench=np.concatenate([force, torque], axis=1))


def halves(case: Case) -> list[Array]:
    return np.hsplit(case.wrench, 2)


def columns(case: Case) -> Case:
    return replace(case, wrench=np.roll(case.wrench, 3, axis=1), sigma=np.roll(case.sigma, 3))


def rotations(case: Case, change: Turning) -> Case:
    return replace(case, R=change(Rotation.from_matrix(case.R)).as_matrix())


def quaternions(R: Rotation, shift: int) -> Rotation:
    return Rotation.from_quat(np.roll(R.as_quat(), shift, axis=1))


def mirrored(case: Case) -> Case:
    S = np.diag([1.0, -1, 1])
    return replace(case, R=S @ case.R @ S)


def in_base(case: Case, *, bias: bool = True) -> Case:
    wrench = case.wrench - (0 if bias else case.bias)
    R = case.R @ case.mount
    return replace(case, wrench=np.concatenate([np.einsum("nij,nj->ni", R, part) for part in np.hsplit(wrench, 2)], 1))


def rows(case: Case, order: Callable[[int], Any]) -> Case:
    return replace(case, wrench=case.wrench[order(len(case.R))])


def shifted(case: Case, by: int) -> Case:
    own, other = (slice(1, None), slice(None, -1)) if by > 0 else (slice(None, -1), slice(1, None))
    return replace(case, R=case.R[own], wrench=case.wrench[other])


def copied(case: Case) -> Case:
    order = np.append(np.arange(len(case.R)), case.rng.choice(len(case.R), 2, replace=False))
    return replace(case, R=case.R[order], wrench=case.wrench[order])


def stale(case: Case) -> Case:
    wrench, first = case.wrench.copy(), case.rng.integers(1, len(case.R) - 3)
    wrench[first : first + 3] = wrench[first]
    return replace(case, wrench=wrench)


def dead(case: Case) -> Case:
    wrench, channel = case.wrench.copy(), case.rng.integers(6)
    wrench[:, channel] = wrench[0, channel]
    return replace(case, wrench=wrench)


def saturated(case: Case) -> Case:
    """One end of an axis is cut off where 20 to 40 % of the poses are."""
    wrench, channel = case.wrench.copy(), case.rng.choice(6, p=[0.3, 0.3, 0.1, 0.1, 0.1, 0.1])
    wrench[:, channel] = np.minimum(wrench[:, channel], np.quantile(wrench[:, channel], case.rng.uniform(0.6, 0.8)))
    return replace(case, wrench=wrench)


def quantised(case: Case) -> Case:
    """Whole newtons, and torques to 0.1 N·m."""
    step = np.repeat([1.0, 0.1], 3)
    return replace(case, wrench=np.round(case.wrench / step) * step)


def from_middle(case: Case, **different: Any) -> Case:
    first = case.rng.integers(len(case.R) // 4, 3 * len(case.R) // 4 + 1)
    after = np.arange(first, len(case.R))
    return replace(case, wrench=np.concatenate([case.wrench[:first], case.reading(after, **different)]))


def zeroed(case: Case) -> Case:
    """Offsets of 0.5 to 5 N and 10 to 200 mN·m, as a tare makes them."""
    size = np.exp(case.rng.uniform(np.log([0.5, 0.01]), np.log([5.0, 0.2])))
    step = np.concatenate([length * unit(case.rng.normal(size=3)) for length in size])
    return from_middle(case, bias=case.bias + step)


def tool_changed(case: Case) -> Case:
    share = np.exp(case.rng.choice([-1, 1]) * case.rng.uniform(0.1, 0.7))
    return from_middle(case, mass_kg=case.mass_kg * share, com_m=case.com_m + 0.03 * unit(case.rng.normal(size=3)))


def loosened(case: Case) -> Case:
    turn = Rotation.from_rotvec(np.deg2rad(case.rng.uniform(3, 20)) * case.rng.choice([-1, 1]) * Z).as_matrix()
    return from_middle(case, mount=case.mount @ turn, com_m=turn.T @ case.com_m)


def sensor_changed(case: Case) -> Case:
    """Another sensor, mounted otherwise, with another bias."""
    turn = Rotation.from_rotvec(case.rng.uniform(-np.pi, np.pi) * Z).as_matrix()
    bias = np.repeat([5.0, 0.3], 3) * case.rng.normal(size=6)
    return from_middle(case, mount=case.mount @ turn, com_m=turn.T @ case.com_m, bias=bias)


def alternating(case: Case) -> Case:
    """Rows of two sensors, with two biases."""
    wrench, bias = case.wrench.copy(), case.bias + np.repeat([5.0, 0.3], 3) * case.rng.normal(size=6)
    wrench[1::2] = case.reading(np.arange(1, len(case.R), 2), bias=bias)
    return replace(case, wrench=wrench)


def cable(case: Case) -> Case:
    """A cable to the base pulls by up to 1 to 4 N at 0.1 m where the tool points away from it."""
    far = np.maximum(0, 1 - case.R[:, :, 2] @ unit(case.rng.normal(size=3)) - 0.7)
    pull_base = case.rng.uniform(1, 4) * far[:, None] * unit(case.rng.normal(size=3))
    force = np.einsum("ji,nkj,nk->ni", case.mount, case.R, pull_base)
    lever = 0.1 * unit(case.rng.normal(size=3))
    return replace(case, wrench=case.wrench + np.concatenate([force, np.cross(lever, force)], axis=1))


def contact(case: Case, share: float = 0.0) -> Case:
    touched = case.rng.choice(len(case.R), max(1, round(share * len(case.R))), replace=False)
    wrench = case.wrench.copy()
    for row in touched:
        force = case.rng.uniform(1, 10) * unit(case.rng.normal(size=3))
        wrench[row] += np.concatenate([force, np.cross(case.com_m * case.rng.uniform(1, 2), force)])
    return replace(case, wrench=wrench)


def tared_each(case: Case) -> Case:
    return replace(case, wrench=NOISE * case.rng.normal(size=case.wrench.shape))


def compensated(case: Case) -> Case:
    """The weight, known to 1 %, was subtracted; the bias not."""
    weight = case.reading(bias=np.zeros(6)) * (1 + 0.01 * case.rng.normal())
    return replace(case, wrench=case.wrench - weight)


def reached_wall(case: Case) -> Case:
    """The robot hangs on a wall, which is not declared, or not in the controller's base frame."""
    if np.allclose(case.setup.get("up_in_base", Z), Z):
        turn = Rotation.from_rotvec(np.pi / 2 * [X, -X, Y, -Y][case.rng.integers(4)])
        case = replace(case, R=turn.as_matrix() @ case.R, down=turn.apply(case.down))
    setup = {key: value for key, value in case.setup.items() if key != "up_in_base"}
    return replace(case, setup=setup)


def in_world(case: Case) -> Case:
    """Orientations in a world frame that is turned by 30 to 180° about a level axis."""
    axis = np.append(unit(case.rng.normal(size=2)), 0)
    turn = Rotation.from_rotvec(np.deg2rad(case.rng.uniform(30, 180)) * axis).as_matrix()
    if "up_in_base" in case.setup and abs(np.asarray(case.setup["up_in_base"]) @ axis) > 0.5:
        turn = Rotation.from_rotvec(np.pi / 2 * np.cross(case.setup["up_in_base"], Z)).as_matrix()
    return replace(case, R=turn @ case.R)


def warming(case: Case) -> Case:
    n = len(case.R)
    curve = 1 - np.exp(-np.arange(n) / (n * case.rng.uniform(0.2, 0.6)))
    size = np.concatenate([case.rng.uniform(1, 3) * unit(case.rng.normal(size=3)), 0.03 * case.rng.normal(size=3)])
    return replace(case, wrench=case.wrench + curve[:, None] * size)


def walking(case: Case) -> Case:
    steps = np.repeat([0.2, 0.006], 3) * case.rng.normal(size=case.wrench.shape)
    return replace(case, wrench=case.wrench + np.cumsum(steps, axis=0))


def known_mass(case: Case) -> Case:
    return replace(case, known=Known(mass_kg=case.mass_kg * case.rng.choice([0.8, 1.2]), mass_tolerance_kg=0.01))


def known_mount(case: Case) -> Case:
    turn = Rotation.from_rotvec(np.deg2rad(case.rng.uniform(5, 90)) * case.rng.choice([-1, 1]) * Z).as_matrix()
    return replace(case, known=Known(R_flange_sensor=turn @ case.mount))


def tilting(case: Case) -> Case:
    """A tool that is not tight: its centre of mass hangs 1 to 4 mm to the side, whichever is down."""
    force = case.reading(bias=np.zeros(6))[:, :3]
    sag = case.rng.uniform(0.001, 0.004) * force / (case.mass_kg * G)
    P = case.com_m + np.sign(force[:, :1]) * case.rng.uniform(0.001, 0.004) * X + 0 * sag
    torque = np.cross(P, force) - np.cross(case.com_m, force)
    return replace(case, wrench=case.wrench + np.concatenate([0 * force, torque], axis=1))


# --------------------------------------------------------------------------------------------------------------- kinds


def always(_: Case) -> bool:
    return True


def if_described(case: Case) -> bool:
    return case.described


def if_far(case: Case, factor: float) -> bool:
    """Whether the description, or an unusual centre of mass, shows a wrong unit."""
    return case.described or bool(np.linalg.norm(case.com_m) * factor > 0.25)


def euler(R: Rotation, read: Literal["xyz", "XYZ"], written: Literal["xyz", "XYZ"]) -> Rotation:
    return Rotation.from_euler(read, R.as_euler(written))


TO_EXTRINSIC: Turning = partial(euler, read="xyz", written="XYZ")
TO_INTRINSIC: Turning = partial(euler, read="XYZ", written="xyz")


SWAP, CYCLE, FLIP = np.eye(3)[[1, 0, 2]], np.eye(3)[[1, 2, 0]], np.diag([1.0, -1, 1])
PAIRING = "pairing_or_rotations|euler_angles"
BUMPED = "poses_rejected|poses_contact|pose_deviates"
DRIFT = "drift|residuals_alike"
KINDS: dict[str, tuple[Spoil, str, Callable[[Case], bool]]] = {
    # units
    "lbf and lbf·in": (partial(units, force=LBF_N, torque=LBF_IN_NM), '"lbf", "lbf·in"', always),
    "lbf, torque in N·m": (partial(units, force=LBF_N), '"lbf"', partial(if_far, factor=LBF_N)),
    "kgf, torque in N·m": (partial(units, force=KGF_N), '"kgf"', partial(if_far, factor=KGF_N)),
    "gf, torque in N·m": (partial(units, force=KGF_N / 1000), '"gf"', always),
    "kN, torque in N·m": (partial(units, force=1e3), '"kN"', always),
    "torque in N·mm": (partial(units, torque=1e-3), '"N·mm"', always),
    "torque in lbf·in": (partial(units, torque=LBF_IN_NM), '"lbf·in"', partial(if_far, factor=1 / LBF_IN_NM)),
    # axes
    "x, y swapped in force": (partial(axes, Q=SWAP, groups="F"), 'axes_disagree.*"y", "x", "z"', always),
    "x, y swapped in torque": (partial(axes, Q=SWAP, groups="T"), 'axes_disagree.*"y", "x", "z"', always),
    "left-handed wrench": (partial(axes, Q=FLIP), "weight_upwards", always),
    "cyclic axes of force": (partial(axes, Q=CYCLE, groups="F"), 'axes_disagree.*"y", "z", "x"', always),
    "cyclic axes of torque": (partial(axes, Q=CYCLE, groups="T"), 'axes_disagree.*"y", "z", "x"', always),
    "y negated in force": (partial(axes, Q=FLIP, groups="F"), 'axes_disagree.*"x", "-y", "z"', always),
    "y negated in torque": (partial(axes, Q=FLIP, groups="T"), 'axes_disagree.*"x", "-y", "z"', always),
    "forces negated": (partial(axes, Q=-np.eye(3), groups="F"), "forces_reversed", always),
    "torques negated": (partial(axes, Q=-np.eye(3), groups="T"), "torques_reversed", always),
    "reaction": (partial(axes, Q=-np.eye(3)), "weight_upwards", always),
    "force, torque columns swapped": (columns, "columns_swapped", always),
    # orientations
    "transposed": (partial(rotations, change=Rotation.inv), "orientations_inverted|also.*inverted", always),
    "wxyz read as xyzw": (
        partial(rotations, change=partial(quaternions, shift=1)), 'order": "w, x, y, z|also.*w, x, y, z', always),
    "xyzw read as wxyz": (
        partial(rotations, change=partial(quaternions, shift=-1)), 'order": "x, y, z, w|also.*x, y, z, w', always),
    "wxyz, other orientation": (
        partial(rotations, change=lambda R: quaternions(R, 1).inv()),
        'mounting_undeclared.*"w, x, y, z"|gravity_off_mounting.*"w, x, y, z"|weight_upwards', always),
    "degrees as radians": (
        partial(rotations, change=lambda R: Rotation.from_rotvec(np.rad2deg(R.as_rotvec()))), PAIRING, always),
    "intrinsic Euler as extrinsic": (partial(rotations, change=TO_EXTRINSIC), PAIRING,
                                     always),
    "extrinsic Euler as intrinsic": (partial(rotations, change=TO_INTRINSIC), PAIRING,
                                     always),
    "Euler angles as rotation vector": (
        partial(rotations, change=lambda R: Rotation.from_rotvec(R.as_euler("xyz"))), PAIRING, always),
    "left-handed orientations": (mirrored, "forces_reversed|torques_reversed", always),
    "wall not declared": (reached_wall, "mounting_undeclared", always),
    "world for base": (in_world, "mounting_undeclared|gravity_off_mounting|gravity_tilted|weight_upwards", always),
    "wrench in base axes": (in_base, "wrench_in_base|constant_force", always),
    # rows
    "rows delayed by one": (partial(shifted, by=1), "pairing_shifted", always),
    "shuffled poses": (
        lambda case: rows(case, case.rng.permutation), "pairing_or_rotations", always),
    "duplicated rows": (copied, "repeated_poses", always),
    "readings not updated": (stale, "repeated_wrenches", always),
    # sensor and tool
    "axis dead": (dead, "stuck_channels", always),
    "axis saturated": (saturated, "saturated", always),
    "quantised to 1 N": (quantised, "quantised", always),
    "zeroed in mid-session": (zeroed, "bias_stepped", always),
    "tool changed in mid-session": (tool_changed, "load_changed|com_shifted", always),
    "sensor loosened in mid-session": (loosened, "sensor_turned", always),
    "sensor changed in mid-session": (sensor_changed, "sensor_changed|bias_stepped", always),
    "two sensors alternating": (alternating, "sensors_alternate", always),
    "cable": (cable, f"cable|{BUMPED}|force_error|torque_error|noise_exceeded", always),
    "contact at one pose": (contact, BUMPED, always),
    "contact at a fifth of the poses": (partial(contact, share=0.2), BUMPED, always),
    "zeroed at every pose": (tared_each, "weight_insignificant|weight_compensated", always),
    "compensated already": (compensated, "weight_insignificant|weight_compensated", always),
    "known mass wrong": (known_mass, "known_mass", always),
    "known mounting wrong": (known_mount, "known_mounting", always),
    "warm-up": (warming, DRIFT, always),
    "random walk of 0.2 N": (walking, DRIFT, always),
}  # fmt: skip


# -------------------------------------------------------------------------------------------------------------- honest


def honest(seed: int) -> str | None:
    """Name the false cause, if any, in an honest session with noise of one kind, or of all."""
    case = session(seed, "honest")
    rng, n = case.rng, len(case.R)
    wrench = case.wrench.copy()
    kind = int(rng.integers(6))
    if kind in (1, 5):  # a gain of 2 %, cross-talk of 1 % of 50 mm
        force = case.wrench[:, :3] - case.bias[:3]
        gain, cross_talk = 0.02 * rng.normal(size=(3, 3)), 5e-4 * rng.normal(size=(3, 3))
        wrench += np.concatenate([force @ gain, force @ cross_talk], axis=1)
    if kind in (2, 5):
        wrench += np.cumsum(np.repeat([0.02, 6e-4], 3) * rng.normal(size=wrench.shape), axis=0)
    if kind in (3, 5):
        turn = Rotation.from_rotvec(np.deg2rad(0.05) * rng.normal(size=(n, 3))).as_matrix()
        wrench += case.reading(R=case.R @ turn) - case.reading()
    if kind in (4, 5):  # hysteresis of 0.2 % of the last swing
        wrench[1:] += 0.002 * np.abs(np.diff(case.wrench, axis=0)) * np.sign(np.diff(case.wrench, axis=0))
    _, findings, _ = answer(replace(case, wrench=wrench))
    found = [one for one in findings if one.code not in NO_CAUSE]
    return f"{['white', 'gain', 'walk', 'orientation', 'hysteresis', 'all'][kind]}: {found[0].words}" if found else None


# ------------------------------------------------------------------------------------------------------------- answers


def answer(case: Case) -> tuple[Parameters | None, Sequence[Finding], bool]:
    """Parameters, findings, and whether the verdict is good."""
    n = len(case.R)
    cov = np.tile(np.diag(case.sigma**2), (n, 1, 1)) if case.measured else None
    dataset = CalibrationDataset(case.R, case.wrench, cov, np.full(n, 1000), np.arange(float(n)))
    try:
        result = solve(dataset, known=case.known, setup=Setup(**case.setup))
    except NotObservable as exc:
        return None, [exc.finding or Finding(f"error: {exc}", "reject")], False
    except np.linalg.LinAlgError as exc:
        return None, [Finding(f"crash: {exc}", "reject")], False
    return result.parameters, result.findings, result.verdict == "good"


def is_right(found: Parameters | None, case: Case) -> bool:
    if found is None:
        return False
    turn = Rotation.from_matrix(found.R_flange_sensor.T @ case.mount).magnitude()
    weight = case.mass_kg * G
    gravity = np.linalg.norm(found.gravity_force_base_N - weight * case.down)
    com = np.linalg.norm(found.p_sensor_com_m - case.com_m)
    return bool(turn < ROTATION_RAD and gravity < SHARE * weight and com < SHARE * 0.1)


UNITS = {"N": 1.0, "lbf": LBF_N, "kgf": KGF_N, "gf": KGF_N / 1000, "mN": 1e-3, "kN": 1e3,
         "N·m": 1.0, "N·mm": 1e-3, "lbf·in": LBF_IN_NM, "lbf·ft": 12 * LBF_IN_NM, "kgf·m": KGF_N,
         "kgf·cm": KGF_N / 100, "kN·m": 1e3}  # fmt: skip


def taken_from(channels: list[str]) -> Array:
    """Matrix that undoes an order of channels, such as ["y", "-x", "z"]."""
    return np.array([(-1 if channel[0] == "-" else 1) * np.eye(3)["xyz".index(channel[-1])] for channel in channels])


def followed(finding: Finding, case: Case, clean: Case) -> list[Case]:
    """Do what a finding says; several cases if it leaves a choice, the clean one if it says what to look for."""
    code, values = finding.code, finding.values
    groups = {"force": "F", "torque": "T", "wrench": "FT"}
    if "units" in values:
        return [units(case, 1 / UNITS[force], 1 / UNITS[torque]) for force, torque in values["units"]]
    if "corrections" in values:
        return [axes(case, taken_from(order), groups[group]) for group, order in values["corrections"]]
    if code == "orientations_inverted":
        return _read_as(case, ["inverted", *values["also"]])
    if code == "quaternion_order":
        return _read_as(case, [values["order"], *values["also"]])
    if code == "euler_angles":
        return [rotations(case, TO_EXTRINSIC if values["order"] == "extrinsic" else TO_INTRINSIC)]
    if code == "pairing_shifted":
        return [shifted(case, by=-1 if values["neighbour"] == "before" else 1)]
    if code == "columns_swapped":
        return [columns(case)]
    if code == "forces_reversed":
        return [axes(case, -np.eye(3), "F"), mirrored(case)]
    if code == "torques_reversed":
        return [axes(case, -np.eye(3), "T"), mirrored(case)]
    if code in ("repeated_poses", "repeated_wrenches"):
        copies = [row - 1 for row in values["poses"]]
        kept = np.delete(np.arange(len(case.R)), copies[1:] if code == "repeated_poses" else copies)
        return [replace(case, R=case.R[kept], wrench=case.wrench[kept])]
    return [clean]


def _read_as(case: Case, forms: list[str]) -> list[Case]:
    """Read orientations in these forms instead."""
    reading: dict[str, Turning] = {
        "w, x, y, z": partial(quaternions, shift=-1),
        "x, y, z, w": partial(quaternions, shift=1),
    }
    found = [change for form in forms for order, change in reading.items() if order in form]
    if any("inverted" in form for form in forms):
        found.append(Rotation.inv)
    return [rotations(case, change) for change in found]


def leads_to_the_truth(finding: Finding, case: Case, clean: Case) -> bool:
    """Follow the first finding, and those that then come first, until a result is right and not rejected."""
    cases = followed(finding, case, clean)
    for _ in range(STEPS):
        following = []
        for one in cases:
            parameters, findings, _ = answer(one)
            if is_right(parameters, clean):
                return True
            following += followed(findings[0], one, clean) if findings else []
        cases = following
    return False


def as_text(finding: Finding) -> str:
    return f"{finding.code} {json.dumps(dict(finding.values), ensure_ascii=False)}"


def judged(name: str, seed: int, *, advice: bool) -> tuple[Score, str]:
    """Score the findings about one spoiled session, and write the first ones; also follow the advice of the first."""
    spoil, says, shows = KINDS[name]
    clean = session(seed, name)
    case = spoil(clean)
    parameters, findings, good = answer(case)
    places = [bool(re.search(says, as_text(one))) for one in findings]
    said = f"{seed}: n={len(case.R)} sigma={case.measured:d} described={case.described:d} " + (
        "; ".join(as_text(one)[:110] for one in findings[:2]) if findings else "nothing")  # fmt: skip
    if places and places[0]:
        return ("first" if not advice or leads_to_the_truth(findings[0], case, clean) else "misled"), said
    if good and not is_right(parameters, clean):
        return ("good" if shows(clean) else "hidden"), said
    if any(places):
        return "later", said
    if not shows(clean):
        return "hidden", said
    if good:
        return "harmless", said
    return ("wrong" if findings and findings[0].code not in NO_CAUSE else "unnamed"), said


SCORES: tuple[Score, ...] = ("first", "misled", "later", "unnamed", "wrong", "good", "hidden", "harmless")


def main() -> int:
    parser = argparse.ArgumentParser(description="Causes and their names.")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--honest", type=int, default=1000)
    parser.add_argument("--only", default="", help="kinds whose name this finds, a regular expression")
    parser.add_argument("--advice", action="store_true", help="follow the first finding to the truth")
    parser.add_argument("--show", action="store_true", help="what was said where the cause did not come first")
    options = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    total, write = Counter[str](), partial(print, flush=True)
    with get_context("spawn").Pool(int(os.environ.get("WORKERS", "2"))) as pool:
        write(f"{'':34}" + "".join(f"{score:>9}" for score in SCORES))
        for name in (name for name in KINDS if re.search(options.only, name)):
            found = pool.map(partial(judged, name, advice=options.advice), range(options.runs), chunksize=5)
            counts = Counter(score for score, _ in found)
            total += counts
            write(f"{name:34}" + "".join(f"{counts[score] or '-':>9}" for score in SCORES))
            if options.show:
                write(*(f"      {score} {said}" for score, said in found if score != "first"), sep="\n")
        write(f"{'all':34}" + "".join(f"{total[score] or '-':>9}" for score in SCORES))
        false = [one for one in pool.map(honest, range(options.honest), chunksize=10) if one]
    write(f"honest sessions with a false cause: {len(false)} of {options.honest}", *false, sep="\n  ")
    shown = total.total() - total["hidden"] - total["harmless"]
    return int(total["first"] < 0.95 * shown or total["good"] > 0 or len(false) > 1e-3 * options.honest)


if __name__ == "__main__":
    sys.exit(main())
