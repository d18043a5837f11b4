"""Planner of sweeps: the most informative wrist curve within the limits that is proven clear.

Candidates have random frequencies and phases, and the largest amplitudes that the limits of speed, acceleration and tip
speed allow. Their information about the load comes from the model of the estimate. Planning is deterministic.

The proof is that of a tour through points of the curve, with additional distance. Between two points the curve leaves
the straight move by at most ``acceleration step²/8``. A controller that follows with a lag T deviates by about
``acceleration T²/2``, as a first-order lag does. A stop that brakes for a time S follows the tangent and deviates by at
most ``acceleration S²/8``.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.motion.model import DELAY, HEIGHT, INERTIA, MovingLoad, motion_jacobian
from ftcalib.motion.problem import DELAY_S, GYRATION_M, HEIGHT_M
from ftcalib.motion.samples import Motion
from ftcalib.poses.information import Guess
from ftcalib.sensor_matrix import Calibrated
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.geometry.arm_model import ArmModel
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import checked_joints
from ftdrive.planning.motion import Speeds, tips
from ftdrive.planning.plan import PROOF_S, Plan, PlanStep, ball_of, describe_plan, fingerprints
from ftdrive.planning.search.nodes import constant_tour, with_room
from ftdrivers.sweep import WRISTS, Sweep
from ftdrivers.ur.kinematics import Array

# Shortest and longest duration of a sweep, s. Beyond 20 s, white noise limits the accuracy of any estimator.
SECONDS = (10.0, 120.0)
RAMP_S = 3.0
# Time between two steps that the plan of a sweep lists, s.
STEP_S = 0.2
# Time, s, by which the controller lags behind the curve: the `lookahead_time` of its command `servoj`.
SMOOTHED_S = 0.1
# Number of random curves that are tried, and number of variations of the best curve so far.
RANDOM, CHANGED = 40, 200
# Step sizes of the search: the fractions of a new random curve that are mixed into the best curve so far.
STEPS = (0.03, 0.1, 0.3)
# At each of `POSTURES` postures, a proof is tried for this many of the best curves, each in all `SIZES` of amplitude.
PROVEN = 6
SIZES = (1.0, 0.9, 0.8, 0.6)
POSTURES = 6
# Frequencies of the two sines of each joint: the slow one covers a large angle, the quick one determines the inertia.
# At 0.3 to 0.9 Hz acceleration needs little speed; ISO 10218-1 allows 250 mm/s near people.
SLOW_HZ, QUICK_HZ = (0.06, 0.16), (0.3, 0.9)
MOST_RAD = 1.5
_MODEL_STEP_S = 0.01
# A quick collision check before the proof uses every fifth point of the proof only.
_COARSE = 5
# Penalty on the score of a curve that seems to collide: it is tried last, as smaller amplitudes may make it clear.
_TOUCHING = 10.0
_ROW_S = 0.12
# Weight of log(sigma of the moments of inertia) relative to log(compensation error) in the score of a curve.
_INERTIA_WORTH = 0.5


def plan_sweep(
    certifier: Certifier,
    q_rad: ArrayLike,
    seconds: float,
    *,
    speeds: Speeds,
    stop_rad_s2: float,
    guess: Guess,
) -> Plan:
    """Plan a sweep around the current posture, or around one with more room.

    The sweep takes `seconds` at the planned speed. Raises `ConfigError` if `seconds` is out of range, and `PlanRefused`
    if no sweep is proven clear.
    """
    if not SECONDS[0] <= seconds <= SECONDS[1]:
        raise ConfigError(f"a sweep of {seconds:g} s is not possible: give {SECONDS[0]:g} to {SECONDS[1]:g} s")
    q_now = checked_joints(q_rad)
    tried = 0
    for centre in _centres(certifier, q_now):
        if not certifier.free(centre)[0]:
            continue
        tried += 1
        best = _scored_sweeps(certifier, centre, seconds, speeds=speeds, stop_rad_s2=stop_rad_s2, guess=guess)[:PROVEN]
        for sweep in (curve.smaller(size) for size in SIZES for _, curve in best):
            off_m = certifier.reach_m(_off_curve(sweep, stop_rad_s2))
            path = sweep.at(_times(sweep, PROOF_S))
            if _seems_free(certifier, sweep, stop_rad_s2) and certifier.keeping(off_m).clear_around(path):
                return _plan(certifier, sweep, off_m, q_now, speeds, guess)
        if tried == POSTURES:
            break
    raise PlanRefused(
        "no sweep of the wrist is proven clear: describe the tool more closely, clear the surroundings, or jog the arm "
        "to a posture with more room"
    )


def _centres(certifier: Certifier, q_now: Array) -> Iterator[Array]:
    """Yield postures for the centre of a sweep: the current one, other wrist angles, then other angles 1 to 3 too."""
    yield q_now
    for turn in (np.pi / 2, -np.pi / 2):
        yield np.concatenate([q_now[:4], [turn], q_now[5:]])
    near = constant_tour(q_now, certifier.arm.kinematics)
    yield from near[np.argsort(np.abs(near - q_now).max(axis=1), kind="stable")[:6]]
    for tour in with_room(certifier, q_now):
        yield tour[int(np.abs(tour - q_now).max(axis=1).argmin())]


def _scored_sweeps(
    certifier: Certifier, centre: Array, seconds: float, *, speeds: Speeds, stop_rad_s2: float, guess: Guess
) -> list[tuple[float, Sweep]]:
    """Return random curves, and variations of the best that seems clear, with their scores; smallest score first."""
    arm = certifier.arm
    rng, scored = np.random.default_rng(0), list[tuple[float, Sweep]]()
    best, least = _random_shape(rng), np.inf
    for k in range(RANDOM + CHANGED):
        tried = _random_shape(rng)
        if k >= RANDOM:
            share = rng.choice(STEPS)
            tried = (1 - share) * best + share * tried
        sweep = _within(arm, _curve(tried, centre, seconds), speeds)
        if sweep is None:
            continue
        score = _score(arm, sweep, guess)
        seems_free = score < least and _seems_free(certifier, sweep, stop_rad_s2)
        if k < RANDOM or seems_free:
            scored.append((score if seems_free else score + _TOUCHING, sweep))
        if seems_free:
            least, best = score, tried
    return sorted(scored, key=lambda one: one[0])


def _seems_free(certifier: Certifier, sweep: Sweep, stop_rad_s2: float) -> bool:
    """Return whether the arm keeps the margins at a few points of the curve, as a quick check before the proof."""
    keeping = certifier.keeping(certifier.reach_m(_off_curve(sweep, stop_rad_s2)))
    return bool(keeping.free(sweep.at(_times(sweep, _COARSE * PROOF_S))).all())


def _random_shape(rng: np.random.Generator) -> Array:
    """Return random numbers (3, 6), 0 to 1, that define a curve: 2 frequencies, share, size, 2 phases per joint."""
    return rng.uniform(size=(len(WRISTS), 6))


def _curve(drawn: Array, centre: Array, seconds: float) -> Sweep:
    hertz = np.stack([low + (high - low) * drawn[:, k] for k, (low, high) in enumerate((SLOW_HZ, QUICK_HZ))], axis=1)
    quick = 0.1 + 0.8 * drawn[:, 2]  # the quick sine's share of the acceleration
    strength = np.stack([1 - quick, quick], axis=1) / (2 * np.pi * hertz) ** 2
    size = (0.2 + 0.8 * drawn[:, 3]) * MOST_RAD
    amplitude = size[:, None] * strength / strength.sum(axis=1, keepdims=True)
    return Sweep(centre.tolist(), amplitude, 2 * np.pi * hertz, 2 * np.pi * drawn[:, 4:], seconds, RAMP_S)


def _within(arm: ArmModel, sweep: Sweep, speeds: Speeds) -> Sweep | None:
    """Return the sweep with amplitudes reduced so that it keeps all limits; None if that is not possible."""
    limits = MOST_RAD, speeds.joint_rad_s, speeds.joint_rad_s2
    most = np.stack([sweep.largest(k) for k in range(3)])[:, list(WRISTS)]
    most[0] = np.abs(sweep.at(_times(sweep, 0.05)) - sweep.centre_rad)[:, list(WRISTS)].max(axis=0)
    sweep = sweep.smaller(np.minimum(1.0, 0.99 * (np.array(limits)[:, None] / most).min(axis=0)))
    for share in ((1, 1, 0), (1, 1, 0), (1, 1, 1), (1, 1, 1), (1, 1, 1)):
        if speeds.tip_m_s is None:
            break
        excess = _tip_speed_m_s(arm, sweep) / speeds.tip_m_s
        if excess <= 1:
            break
        sweep = sweep.smaller(np.where(share, 0.98 / excess, 1.0))
    else:
        return None
    low, high = (np.array(sweep.centre_rad) + side * MOST_RAD for side in (-1, 1))
    return sweep if max(-low.min(), high.max()) <= 2 * np.pi else None


def _tip_speed_m_s(arm: ArmModel, sweep: Sweep) -> float:
    step_s = 0.05
    path = tips(arm, sweep.at(_times(sweep, step_s)))
    return float(np.linalg.norm(np.diff(path, axis=0), axis=2).max()) / step_s


def _times(sweep: Sweep, step_s: float) -> Array:
    return np.arange(0.0, sweep.duration_s, step_s)


def _off_curve(sweep: Sweep, stop_rad_s2: float) -> Array:
    """Return a bound (6,) on the deviation of each joint from the straight moves between the points, rad."""
    stop_s = float(sweep.largest(1).max()) / stop_rad_s2
    return np.asarray(sweep.largest(2) * (PROOF_S**2 / 8 + SMOOTHED_S**2 / 2 + stop_s**2 / 8))


def _score(arm: ArmModel, sweep: Sweep, guess: Guess) -> float:
    force_N, torque_Nm, inertia = predicted(arm, sweep, guess)
    return float(np.log(force_N) + np.log(torque_Nm) + _INERTIA_WORTH * np.log(inertia))


def predicted(arm: ArmModel, sweep: Sweep, guess: Guess) -> tuple[float, float, float]:
    """Return the predicted compensation error, N and N·m, and the largest sigma of a moment of inertia, kg·m².

    The mean over 0.12 s of motion is assumed to have the noise that the guess gives for a pose.
    """
    load = MovingLoad(guess.parameters, guess.g_m_s2, inertia=np.r_[np.full(3, 1e-3), np.zeros(3)])
    motion, rate = _flange_motion(arm, sweep)
    J = (motion_jacobian(load, motion, rate) / guess.wrench_sigma[:, None])[:, :, :23].reshape(-1, 23)
    prior = np.zeros(23)
    prior[INERTIA], prior[HEIGHT], prior[DELAY] = guess.mass_kg * GYRATION_M**2, HEIGHT_M, DELAY_S
    weight = np.divide(1.0, prior**2, out=np.zeros(23), where=prior > 0)
    # A weak prior keeps the sigma finite in directions that the motion does not determine.
    weight[:15] = 1e-6 / guess.scale**2
    covariance = np.linalg.inv(J.T @ J + np.diag(weight))
    force_N, torque_Nm = Calibrated(guess.parameters, covariance[:15, :15]).predicted_error()
    return force_N, torque_Nm, float(np.sqrt(np.diag(covariance)[INERTIA].max()))


def _flange_motion(arm: ArmModel, sweep: Sweep) -> tuple[Motion, Motion]:
    """Return the motion of the flange in a sweep every 0.12 s, and its time derivative, by finite differences."""
    t, h = _times(sweep, _ROW_S), _MODEL_STEP_S
    places = [arm.frames(sweep.at(t + k * h)) for k in range(-2, 3)]
    columns = []
    for k in (1, 2, 3):
        R = places[k].R_base_flange
        before, after = places[k - 1], places[k + 1]
        Rdd = (before.R_base_flange - 2 * R + after.R_base_flange) / h**2
        a = (before.flange_m - 2 * places[k].flange_m + after.flange_m) / h**2
        columns.append(Motion(R, np.einsum("nji,nj->ni", R, a), np.swapaxes(R, 1, 2) @ Rdd).columns())
    return Motion.of_columns(columns[1]), Motion.of_columns((columns[2] - columns[0]) / (2 * h))


def _plan(certifier: Certifier, sweep: Sweep, off_curve_m: float, q_now: Array, speeds: Speeds, guess: Guess) -> Plan:
    arm, q = certifier.arm, sweep.at(_times(sweep, STEP_S))
    following = np.roll(q, -1, axis=0)
    certificate = certifier.keeping(off_curve_m).certify(q, following)
    R, turn = arm.frames(q).R_base_flange, np.abs(following - q).max(axis=1)
    steps = tuple(
        PlanStep(
            i + 1,
            tuple(q[i].tolist()),
            tuple(tuple(row) for row in R[i].tolist()),
            float(turn[i]),
            float(turn[i]) / STEP_S,
            STEP_S,
            bool(certificate.clear[i]),
            float(certificate.clearance_m[i]) - off_curve_m,
            certificate.limited_by[i],
        )
        for i in range(len(q))
    )
    force_N, torque_Nm, inertia = predicted(arm, sweep, guess)
    centre_m, ball_m = ball_of(certifier, q, following)
    why = ["A sweep of the wrist: the most informative curve within the limits that is proven clear."]
    if not np.allclose(q_now, sweep.centre_rad):
        first = np.degrees(sweep.centre_rad).round().astype(int).tolist()
        why.append(f"Its centre at joint angles {first} degrees has more room; the plan does not include the approach.")
    why.append(f"Predicted error of force compensation: {force_N:.3f} N.")
    return Plan(
        "sweep",
        tuple(why),
        fingerprints(certifier),
        steps,
        float(sweep.largest(2).max()),
        ball_m,
        tuple(centre_m.tolist()),
        {"force_rms_N": force_N, "torque_rms_Nm": torque_Nm, "inertia_kg_m2": inertia},
        describe_plan(certifier, speeds, guess),
        sweep,
        off_curve_m,
    )
