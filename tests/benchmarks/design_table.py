"""Print the information of pose sets; with --optimise, search the stored sets of 6 and 8 again (a minute).

Run: python tests/benchmarks/design_table.py [--optimise]
"""

import argparse
import sys
import time
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.poses.information import (
    SUBSET_6,
    T12,
    Guess,
    TOOL_DOWN_R_base_flange,
    predicted_sigma,
    prediction_weights,
    second_basin,
    special,
    whitened_jacobian,
)
from ftcalib.poses.selection import choose, cone_candidates, next_pose, order
from tests.pose_sets import AMBIGUOUS_6, SUBSET_8, SUBSET_12, efficiency, optimised

GUESS = Guess(mass_kg=20 / 9.80665, sigma_force_N=0.2, sigma_torque_Nm=0.005)  # weight / sigma 100, lever 25 mm
FORCES_ONLY = Guess(1.0, 0.05, 0.003, p_sensor_com_m=(0, 0, 0), tilt_alpha_rad=np.deg2rad(3))
_GOLDEN = (1 + np.sqrt(5)) / 2
COM_DIRECTIONS = np.array(
    [[0, 1, _GOLDEN], [0, -1, _GOLDEN], [1, _GOLDEN, 0], [-1, _GOLDEN, 0], [_GOLDEN, 0, 1], [_GOLDEN, 0, -1]]
) / np.hypot(1, _GOLDEN)  # axes of the icosahedron: information is even in the centre of mass


def efficiencies(R_base_flange: Array) -> Array:
    """D, A, I_F, I_T (6, 4) for centres of mass 80 mm from the sensor in all directions."""
    return np.array([efficiency(R_base_flange, replace(GUESS, p_sensor_com_m=0.08 * d)) for d in COM_DIRECTIONS])


def optimise(n: int, starts: int = 5) -> Array:
    """Rotation vectors (n, 3) of the best set found: least mean of the inverse efficiencies, tool down first."""

    def cost(x: Array) -> float:
        return float((1 / efficiencies(Rotation.from_rotvec(x.reshape(n, 3)).as_matrix())).mean())

    rng = np.random.default_rng(7)
    ends = [minimize(cost, Rotation.random(n, rng=rng).as_rotvec().ravel(), method="BFGS") for _ in range(starts)]
    R = Rotation.from_rotvec(min(ends, key=lambda end: float(end.fun)).x.reshape(n, 3)).as_matrix()
    return Rotation.from_matrix(R @ R[0].T @ TOOL_DOWN_R_base_flange).as_rotvec()


def ball(half_angle_rad: float, m: int, rng: np.random.Generator) -> Array:
    """Orientations (m, 3, 3) uniformly within an angle of the tool straight down."""
    turns = Rotation.random(200 * m, rng=rng)
    return np.asarray(turns[turns.magnitude() <= half_angle_rad][:m].as_matrix() @ TOOL_DOWN_R_base_flange)


def force_rms_N(R_base_flange: Array, R_workspace: Array) -> float:
    """Predicted error of force compensation in a workspace."""
    J = whitened_jacobian(R_base_flange, GUESS).reshape(-1, 15)
    variance = np.sum(prediction_weights(R_workspace, GUESS)[0] * np.linalg.inv(J.T @ J))
    return GUESS.sigma_force_N * float(np.sqrt(variance))


def random_sets(R_candidates: Array, n: int, rng: np.random.Generator) -> list[Array]:
    """Choose 200 times at random."""
    return [R_candidates[rng.choice(len(R_candidates), n, replace=False)] for _ in range(200)]


def say(text: str) -> None:
    """Print a line."""
    sys.stdout.write(text + "\n")


def fixed_sets() -> None:
    """Efficiencies and gaps of the stored sets."""
    say("set          n   D    A    I_F  I_T   mean over directions of the centre of mass | lowest | gap")
    sets = {
        "special 24": special(range(1, 25)), "T12": special(T12), "SUBSET_12": special(SUBSET_12),
        "optimised 8": optimised(8), "optimised 6": optimised(6), "SUBSET_8": special(SUBSET_8),
        "SUBSET_6": special(SUBSET_6), "AMBIGUOUS_6": special(AMBIGUOUS_6),
    }  # fmt: skip
    for name, R in sets.items():
        e = efficiencies(R)
        mean, low = (" ".join(f"{x:.3f}" for x in row) for row in (e.mean(axis=0), e.min(axis=0)))
        say(f"{name:12s} {len(R):2d} {mean} | {low} | {second_basin(R, GUESS)[0]:.3f}")


def cones() -> None:
    """Predicted sigma of 24 poses chosen in cones."""
    say("\n24 poses of ~1300, forces only: cone9 cond[u,1]  R deg  tilt deg  mg N    F0 N   CoM mm  gap   time s")
    for degrees in (180, 120, 90, 60, 45, 30, 15):
        candidates = cone_candidates(np.deg2rad(degrees))
        start = time.perf_counter()
        chosen = choose(candidates, 24, FORCES_ONLY, least_gap=0.02)
        elapsed = time.perf_counter() - start
        p = predicted_sigma(candidates[chosen], FORCES_ONLY)
        R, F0, com = (np.linalg.norm(p.sigma[name]) for name in ("R_flange_sensor", "force_bias_N", "p_sensor_com_m"))
        tilt = np.hypot(p.sigma["tilt_alpha_rad"], p.sigma["tilt_beta_rad"])
        say(
            f"cone {degrees:3d}                        {p.cond9:5.2f} {p.cond_u1:6.2f}     {np.rad2deg(R):.3f}  "
            f"{np.rad2deg(tilt):.3f}    {p.sigma['weight_N']:.4f}  {F0:.4f} {1e3 * com:.3f}   "
            f"{p.second_basin_gap:.4f} {elapsed:.2f}"
        )


def against_random() -> None:
    """Sets chosen at once, and greedily, against random ones; I_F and rms in the workspace."""
    rng = np.random.default_rng(0)
    workspace = ball(np.deg2rad(40), 400, rng)
    places = {
        "everywhere": (Rotation.random(600, rng=rng).as_matrix(), special(range(1, 25))),
        "ball 40": (ball(np.deg2rad(40), 600, rng), workspace),
        "cone 40": (cone_candidates(np.deg2rad(40), directions=75), cone_candidates(np.deg2rad(40), directions=30)),
    }
    say("\nchosen in one go, per pose, against the median random set of 24")
    for name, (candidates, R_workspace) in places.items():
        sets = random_sets(candidates, 24, rng)
        A = np.median([efficiency(R, GUESS).A for R in sets])
        mse = 24 * np.median([force_rms_N(R, R_workspace) ** 2 for R in sets])
        for n in (6, 12):
            for least_gap in (0.0, 0.02):
                start = time.perf_counter()
                chosen = choose(
                    candidates, n, GUESS, criterion="prediction", R_workspace=R_workspace, least_gap=least_gap
                )
                elapsed = time.perf_counter() - start
                R = candidates[chosen]
                say(
                    f"{name:10s} n {n:2d}  gap >= {least_gap:.2f}: A x{efficiency(R, GUESS).A / A:.2f}  "
                    f"I_F x{mse / (n * force_rms_N(R, R_workspace) ** 2):.2f}  gap {second_basin(R, GUESS)[0]:.3f}  "
                    f"{elapsed:.2f} s"
                )
    say("\ngreedy next-best against random (median): force rms, N")
    for name, (candidates, R_workspace) in places.items():
        R, times = np.zeros((0, 3, 3)), []
        for n in range(1, 25):
            start = time.perf_counter()
            ranked, rms = next_pose(R, candidates, GUESS, R_workspace=R_workspace, least_gap=0.02)
            times.append(time.perf_counter() - start)
            R = np.concatenate([R, candidates[ranked[:1]]])
            if n in (8, 24):
                median = np.median([force_rms_N(R, R_workspace) for R in random_sets(candidates, n, rng)])
                say(f"{name:10s} n {n:2d}: greedy {rms[0]:.4f}  random {median:.4f}  ({1e3 * np.median(times):.1f} ms)")


def orders() -> None:
    """Order of the 24 special poses with a random walk of the bias."""
    guess = Guess(20 / 9.80665, 0.02, 0.0005, walk_force_N=0.07, walk_torque_Nm=0.00175)
    R = special(range(1, 25))
    start = time.perf_counter()
    best = order(R, guess)
    elapsed = time.perf_counter() - start
    sweep = np.lexsort(np.round(R[:, 2], 6).T)
    say("\norder of the special 24, bias wandering 0.07 N a pose at 0.02 N noise: R deg, F_b N (norms)")
    shuffled = [np.random.default_rng(k).permutation(24) for k in range(50)]
    for name, arrangements in (("sweep", [sweep]), ("paper", [np.arange(24)]), ("random", shuffled), ("best", [best])):
        sigmas = [predicted_sigma(R[a], guess).sigma for a in arrangements]
        turn, force = (
            np.median([np.linalg.norm(s[key]) for s in sigmas]) for key in ("R_flange_sensor", "gravity_force_base_N")
        )
        say(f"{name:7s} {np.rad2deg(turn):.4f} {force:.4f}")
    say(f"search {elapsed:.2f} s")


def main() -> None:
    """Print the tables or search the stored sets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--optimise", action="store_true")
    if parser.parse_args().optimise:
        for n in (6, 8):
            say(f"    {n}: (")
            for row in optimise(n):
                say("        (" + ", ".join(f"{x:.6f}" for x in row) + "),")
            say("    ),")
        return
    fixed_sets()
    cones()
    against_random()
    orders()


if __name__ == "__main__":
    main()
