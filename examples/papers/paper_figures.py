"""Draw the figures of both papers from simulation, and print their numbers beside ours.

Yu, Shi, Lou 2021 ("yu-...") and Carlson 2019 ("carlson-..."). One figure: `paper_figures.py yu-fig14`.
"""

import argparse
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import ftcalib
from ftcalib.model import Array, nearest_rotation, skew
from ftcalib.poses.selection import paper_set
from ftcalib.published.methods import Estimator, published

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
except ImportError:
    raise SystemExit("error: the figures need matplotlib: run with `uv run --extra viz python`") from None

Row = tuple[str, str, str]
"""A quantity, the text of the paper, ours."""
Drawing = tuple[Figure, list[Row]]

DOWN = np.array([0.0, 0.0, -1.0])
SENSOR_NOISE = np.repeat([0.2, 0.01], 3)
"""Noise amplitude, N and N m. With it and `ORIENTATION_NOISE_RAD`, the errors are as large as those of Table III."""
ORIENTATION_NOISE_RAD = 0.04
HARDWARE = ftcalib.Parameters(  # Yu, Table II, with the weight and the centre of Table III
    R_flange_sensor=Rotation.from_matrix(
        [[-0.4433, -0.8963, -0.0017], [0.8963, -0.4433, -0.0056], [0.0043, -0.0040, 0.9999]]
    ).as_matrix().T,
    gravity_force_base_N=19.75 * np.array([0.072, 0.092, -20.047]) / 20.0473,
    force_bias_N=np.array([2.992, -5.916, -1.021]),
    p_sensor_com_m=np.array([0.0, 0.0, 0.08]),
    torque_bias_Nm=np.array([-0.071, -0.046, 0.017]),
)  # fmt: skip


# --- simulation ---


def tool(
    weight_N: float = 19.75, com_m: Sequence[float] = (0, 0, 0.08), R: Array = HARDWARE.R_flange_sensor
) -> ftcalib.Parameters:
    """Another tool, or another mounting, on the cell of Yu's experiments."""
    direction = HARDWARE.gravity_force_base_N / np.linalg.norm(HARDWARE.gravity_force_base_N)
    return ftcalib.Parameters(R, weight_N * direction, HARDWARE.force_bias_N, np.array(com_m), HARDWARE.torque_bias_Nm)


def zyx(degrees: Sequence[float]) -> Array:
    """Return s_eR = R_Z R_Y R_X transposed, which is R_flange_sensor."""
    return Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix().T


def turned(R_base_flange: Array, amplitude_rad: float, rng: np.random.Generator) -> Array:
    """Return the true orientations, whose three angles of e_bR are off by uniform noise (Yu, caption of Fig. 14)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the special orientations at 90 deg, where one angle is free
        angles = Rotation.from_matrix(R_base_flange).inv().as_euler("ZYX")
    angles += rng.uniform(-amplitude_rad, amplitude_rad, angles.shape)
    return Rotation.from_euler("ZYX", angles).inv().as_matrix()


def measured(
    truth: ftcalib.Parameters,
    R_base_flange: Array,
    rng: np.random.Generator,
    sensor: Array | float = SENSOR_NOISE,
    orientation_rad: float = ORIENTATION_NOISE_RAD,
) -> Array:
    """Return wrenches (n, 6) with uniform noise, at orientations that are not exactly those reported."""
    wrench = ftcalib.predict(truth, turned(R_base_flange, orientation_rad, rng))
    return wrench + rng.uniform(-1, 1, wrench.shape) * sensor


def method(name: str, R_base_flange: Array, **known: Any) -> Estimator:
    """Prepare a method by name."""
    return published(name, R_base_flange, gravity_direction_base=DOWN, **known)


def worst(estimate: ftcalib.Parameters, R_base_flange: Array, wrench: Array) -> Array:
    """Return the largest compensation errors: Fx, Fy, Fz, |F|, Tx, Ty, Tz, |T|."""
    error = wrench - ftcalib.predict(estimate, R_base_flange)
    force, torque = error[:, :3], error[:, 3:]
    norms = np.linalg.norm(force, axis=1, keepdims=True), np.linalg.norm(torque, axis=1, keepdims=True)
    return np.asarray(np.abs(np.hstack([force, norms[0], torque, norms[1]])).max(axis=0))


def slope(x: Array, y: Array) -> Array:
    """Return the linear coefficients (k,) of y (n, k) on x (n,)."""
    return np.asarray(np.polyfit(x, y, 1)[0], dtype=np.float64)


def length(vector: Array) -> float:
    """Return the 2-norm."""
    return float(np.linalg.norm(vector))


def joined(values: Sequence[float] | Array) -> str:
    """Write numbers with three decimals."""
    return " / ".join(f"{round(float(one), 3) + 0.0:.3f}" for one in values)


# --- Yu ---

SETUPS = (  # Table I: angles of s_eR, F_b, P, F0, T0
    ((0, 7, 3), (0, 0, -10), (0, 0, 2), (0, 0, 0), (0, 0, 0)),
    ((0, 7, 3), (0, 0, 10), (0, 0, 2), (0, 0, 0), (87, 45, 6)),
    ((0, 7, 3), (0, 0, -10), (0, 0, 2), (63, 5, 21), (87, 45, 6)),
    ((0, 7, 3), (0, 0, -10), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
    ((45, 7, 3), (1, 3, -40), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
    ((70, 15, 13), (1, 3, -40), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
)


def yu_fig4(rng: np.random.Generator) -> Drawing:
    """Errors of SROM without noise in the six setups of Table I."""
    special = paper_set("A")
    estimate = method("srom", special)
    errors = []
    for angles, F_b, P, F0, T0 in SETUPS:
        truth = ftcalib.Parameters(zyx(angles), *(np.array(v, dtype=float) for v in (F_b, F0, P, T0)))
        found = estimate(ftcalib.predict(truth, special))
        poses = Rotation.random(200, rng=rng).as_matrix()
        contact = np.repeat([1, 0.5], 3) / np.sqrt(3)  # 1 N and 0.5 N m
        wrench = ftcalib.predict(truth, poses) + contact
        compensation = worst(found, poses, wrench - contact)
        names = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")
        errors.append([length(getattr(found, n) - getattr(truth, n)) for n in names] + list(compensation[[3, 7]]))
    figure, (axes,) = canvas(1)
    labels = ("R", "F_b", "F0", "P", "T0", "force", "torque")
    for k, label in enumerate(labels):
        axes.semilogy(range(1, 7), np.maximum(np.array(errors)[:, k], 1e-17), "osD^v<>"[k], label=label)
    finish(axes, "setup of Table I", "error, SI units", "SROM, no noise")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))

    def below(of: Array) -> str:  # the rounding differs between computers
        return "< 1e-12" if of.max() < 1e-12 else f"{of.max():.1e}"

    found_errors: Array = np.array(errors)
    return figure, [
        ("epsilon_2 of R / F_b / F0 / P / T0", "< 1e-12", " / ".join(map(below, found_errors[:, :5].T))),
        ("epsilon_max of force / torque, 200 poses", "< 1e-12", " / ".join(map(below, found_errors[:, 5:].T))),
    ]


def yu_fig9(rng: np.random.Generator) -> Drawing:
    """Three methods against the yaw of the mounting: estimated on set E, error on set D."""
    E, D = paper_set("E"), paper_set("D")
    yaws = (0, 60, 120, 180, 240, 300)
    without_yaw = HARDWARE.R_flange_sensor @ zyx([-116.32, 0, 0])
    errors = np.zeros((3, len(yaws), 8))
    for k, yaw in enumerate(yaws):
        truth = tool(R=without_yaw @ zyx([yaw, 0, 0]))
        nominal = zyx([yaw + 2, 0, 0])  # Wang knows the mounting "roughly"
        methods = method("wang", E, R_flange_sensor=nominal), method("yang", E), method("lrom", E)
        for _ in range(30):
            wrench, test = measured(truth, E, rng), measured(truth, D, rng)
            errors[:, k] += [worst(estimate(wrench), D, test) / 30 for estimate in methods]
    figure, both = canvas(2)
    for axes, channel, label in zip(both, (3, 2), ("largest |F| error, N", "largest Fz error, N"), strict=True):
        for one, marker, name in zip(errors, "osD", ("Wang", "Yang", "LROM"), strict=True):
            axes.plot(yaws, one[:, channel], marker + "-", label=name)
        axes.set_ylim(bottom=0)
        finish(axes, "yaw of the mounting, deg", label)
    wang, yang, lrom = errors.mean(axis=1)
    return figure, [
        ("|F|: Wang / Yang / LROM, N", "Wang worst", f"{wang[3]:.2f} / {yang[3]:.2f} / {lrom[3]:.2f}"),
        ("Fz: Yang / LROM, N", "LROM better", f"{yang[2]:.2f} / {lrom[2]:.2f}"),
    ]


def against_tool(truths: Sequence[ftcalib.Parameters], rng: np.random.Generator, runs: int = 20) -> tuple[Array, Array]:
    """Return the mean of `worst` on D (k, 8), and the errors of weight and centre (k, 2), of LROM on A and E."""
    poses, D = np.concatenate([paper_set("A"), paper_set("E")]), paper_set("D")
    estimate = method("lrom", poses)
    compensation, estimation = np.zeros((len(truths), 8)), np.zeros((len(truths), 2))
    for k, truth in enumerate(truths):
        for _ in range(runs):
            found = estimate(measured(truth, poses, rng))
            compensation[k] += worst(found, D, measured(truth, D, rng)) / runs
            weights = [length(one.gravity_force_base_N) for one in (found, truth)]
            estimation[k] += (
                np.abs([weights[0] - weights[1], length(found.p_sensor_com_m - truth.p_sensor_com_m)]) / runs
            )
    return compensation, estimation


def draw_against_tool(force_range: Array, torque_range: Array, compensation: Array, title: str) -> Figure:
    """Draw the errors over the ranges of force and torque."""
    figure, (left, right) = canvas(2)
    for axes, x, first, unit in ((left, force_range, 0, "N"), (right, torque_range, 4, "N m")):
        for k, label in enumerate(("x", "y", "z", "norm")):
            axes.plot(x, compensation[:, first + k], "osD^"[k] + "-", label=label)
        finish(axes, f"range of the {'torque' if first else 'force'}, {unit}", f"largest error, {unit}", title)
    return figure


def yu_fig11(rng: np.random.Generator) -> Drawing:
    """Compensation error against the mass of the tool."""
    weights = 9.80665 * np.array([0.25, 0.5, 1, 1.5, 2, 2.5])
    compensation, estimation = against_tool([tool(weight_N=w) for w in weights], rng)
    force_range, torque_range = 2 * weights, 2 * weights * 0.08
    figure = draw_against_tool(force_range, torque_range, compensation, "mass varies")
    return figure, [
        ("coefficient of force / torque", "0.03 / 0.03", f"{slope(force_range, compensation)[3]:.3f} / "
         f"{slope(torque_range, compensation)[7]:.3f}"),
        ("error of mass, lightest / heaviest, N", "grows", f"{estimation[0, 0]:.2f} / {estimation[-1, 0]:.2f}"),
        ("error of centre, lightest / heaviest, mm", "no relation",
         f"{1e3 * estimation[0, 1]:.1f} / {1e3 * estimation[-1, 1]:.1f}"),
    ]  # fmt: skip


def yu_fig12(rng: np.random.Generator) -> Drawing:
    """Compensation error against the centre of mass [0; 0; x] of a tool of 1 kg."""
    centres = np.array([0.04, 0.08, 0.12, 0.16, 0.2])
    compensation, estimation = against_tool([tool(9.80665, (0, 0, x)) for x in centres], rng)
    torque_range = 2 * 9.80665 * centres
    figure = draw_against_tool(centres, torque_range, compensation, "centre varies")
    figure.axes[0].set_xlabel("centre x, m")
    return figure, [
        ("coefficient of torque", "0.03", f"{slope(torque_range, compensation)[7]:.3f}"),
        ("|F| error, nearest / farthest, N", "no relation", f"{compensation[0, 3]:.2f} / {compensation[-1, 3]:.2f}"),
        ("error of mass, nearest / farthest, N", "grows", f"{estimation[0, 0]:.3f} / {estimation[-1, 0]:.3f}"),
        ("error of centre, nearest / farthest, mm", "grows",
         f"{1e3 * estimation[0, 1]:.1f} / {1e3 * estimation[-1, 1]:.1f}"),
    ]  # fmt: skip


def yu_fig13(rng: np.random.Generator) -> Drawing:
    """Error of Fz over the weight: case 8 of Table III against Yang, who ignores the tilt of the mounting."""
    special, E, D = (paper_set(one) for one in "AED")
    poses = np.concatenate([special, E])
    case_8, yang = method("mixed", poses), method("yang", E)
    weights, runs, rows = 9.80665 * np.array([0.5, 1, 1.5, 2, 2.5]), 30, list[Row]()
    figure, both = canvas(2)
    for axes, tilt_deg in zip(both, (0, 1.2), strict=True):
        errors = np.zeros((2, len(weights)))
        for k, weight_N in enumerate(weights):
            truth = tool(weight_N, R=HARDWARE.R_flange_sensor @ zyx([0, 0, tilt_deg]))
            for _ in range(runs):
                wrench, test = measured(truth, poses, rng), measured(truth, D, rng)
                found = case_8(wrench), yang(wrench[len(special) :])
                errors[:, k] += [worst(one, D, test)[2] / runs for one in found]
        for error, marker, name in zip(errors, "oD", ("case 8", "Yang"), strict=True):
            axes.plot(weights, error, marker + "-", label=name)
        label = f"tilt {0.34 + tilt_deg:.1f} deg"
        finish(axes, "weight, N", "largest Fz error, N", label)
        ours, theirs = slope(weights, errors.T)
        gain = f"{theirs - ours:.1%} / {(theirs - ours) / theirs:.1%}"
        rows += [
            (f"{label}: Fz error over weight, Yang / case 8", "4.6 % / 3.6 %", f"{theirs:.1%} / {ours:.1%}"),
            (f"{label}: gain, of the weight / relative", "1.0 % / 21.7 %", gain),
        ]
    return figure, rows


def coefficients(
    sensor: float, orientation_rad: float, com_m: Array, rng: np.random.Generator, test_rad: float | None = None
) -> Array:
    """Return the slopes (8,) of `worst`, of forces over 2 |F_b| and torques over 2 |F_b| |P| (Yu, Fig. 14)."""
    special, runs = paper_set("A"), 3
    estimate = method("srom", special)
    F_b, shares = np.array([1.0, 3.0, -40.0]), np.linspace(0.1, 1, 8)
    errors = np.zeros((len(shares), 8))
    for k, share in enumerate(np.tile(shares, runs)):
        truth = ftcalib.Parameters(
            zyx([45, 7, 3]), share * F_b, np.array([63.0, 5, 21]), com_m, np.array([87.0, 45, 6])
        )
        found = estimate(measured(truth, special, rng, sensor, orientation_rad))
        test = Rotation.random(500, rng=rng).as_matrix()
        wrench = measured(truth, test, rng, sensor, orientation_rad if test_rad is None else test_rad)
        errors[k % len(shares)] += worst(found, test, wrench) / runs
    slopes: Array = slope(2 * length(F_b) * shares, errors) / np.repeat([1, length(com_m)], 4)
    return slopes


def yu_fig14(rng: np.random.Generator) -> Drawing:
    """Linear coefficients against the noise of the sensor, n1, and of the orientations, n2."""
    n1, n2 = np.array([0, 0.2, 0.4, 0.6]), np.array([0, 0.02, 0.04, 0.06])
    found = np.array([[coefficients(a, b, np.full(3, 0.1), rng) for a in n1] for b in n2])
    figure, both = canvas(2)
    for axes, channel, label in zip(both, (3, 7), ("force", "torque"), strict=True):
        for k, one in enumerate(found):
            axes.plot(n1, one[:, channel], "osD^"[k] + "-", label=f"n2 = {n2[k]:.2f} rad")
        finish(axes, "n1, N and N m", f"coefficient of {label}")
    per_axis = found[2, 1, :3].max(), found[2, 1, 4:7].max()
    exact = coefficients(0.2, 0.04, np.full(3, 0.1), rng, test_rad=0)[:3].max()
    return figure, [
        ("force / torque, an axis, n1 .2, n2 .04", "about 0.03", joined(per_axis)),
        ("force, the same, but exact orientations in the test", "-", f"{exact:.3f}"),
        ("|F|, n2 = 0 / .02 / .04 / .06 (n1 = .2)", "grows", joined(found[:, 1, 3])),
        ("|F|, n1 = 0 / .2 / .4 / .6 (n2 = .04)", "falls", joined(found[2, :, 3])),
    ]


def yu_fig15(rng: np.random.Generator) -> Drawing:
    """Linear coefficients of the torque axes, over the range of the force, against the centre of mass."""
    z = np.array([0.02, 0.05, 0.1, 0.15, 0.2])
    figure, both = canvas(2)
    found = list[Array]()
    for axes, across in zip(both, (0.0, 0.1), strict=True):
        centres = np.column_stack([np.full((len(z), 2), across), z])
        torque = np.array([coefficients(0.2, 0.04, one, rng)[4:7] * length(one) for one in centres])
        found.append(torque)
        for k, name in enumerate("xyz"):
            axes.plot(z, torque[:, k], "osD"[k] + "-", label=f"T{name}")
        finish(axes, "z, m", "coefficient of torque, m", f"centre [{across}; {across}; z]")
    x, y, last = found[0][2]
    return figure, [("Tx, Ty / Tz at [0;0;0.1], m", "overt / less", f"{x:.4f}, {y:.4f} / {last:.4f}")]


CASES = (  # Table III: method, data, test, |F| N, |T| N m
    ("srom", "A", "D", 1.780, 0.108),
    ("lrom", "A", "D", 1.854, 0.109),
    ("lrom", "B", "D", 5.167, 0.444),
    ("lrom", "BC", "D", 1.882, 0.126),
    ("lrom", "H", "D", 2.263, 0.172),
    ("lrom", "E", "D", 1.612, 0.108),
    ("lrom", "EF", "D", 1.566, 0.106),
    ("mixed", "AE", "D", 1.507, 0.090),
    ("lrom", "AE", "D", 1.640, 0.099),
    ("lrom", "ABCDEFG", "D", 1.682, 0.099),
    ("lrom", "E", "G", 1.242, 0.079),
)


def yu_table3(rng: np.random.Generator) -> Drawing:
    """The eleven cases of Table III."""
    rows, errors = list[Row](), list[Array]()
    for name, sets, tested, force, torque in CASES:
        poses, test = np.concatenate([paper_set(one) for one in sets]), paper_set(tested)
        estimate = method(name, poses)
        runs = [worst(estimate(measured(HARDWARE, poses, rng)), test, measured(HARDWARE, test, rng)) for _ in range(40)]
        errors.append(np.median(runs, axis=0)[[3, 7]])
        what = f"case {len(rows) + 1}, {name} {'+'.join(sets) if len(sets) < 7 else 'all'}, {tested}: |F| N / |T| N m"
        rows.append((what, f"{force:.2f} / {torque:.3f}", f"{errors[-1][0]:.2f} / {errors[-1][1]:.3f}"))
    figure, both = canvas(2)
    for axes, k, label in zip(both, (0, 1), ("|F|, N", "|T|, N m"), strict=True):
        axes.plot(range(1, 12), [case[3 + k] for case in CASES], "o", label="paper")
        axes.plot(range(1, 12), np.array(errors)[:, k], "D", label="simulated")
        axes.set_ylim(bottom=0)
        finish(axes, "case of Table III", f"largest error of {label}")
    return figure, rows


# --- Carlson ---


def cayley_least_squares(f: Array, a: Array) -> Array:
    """Return R_TF^S of one Cayley transform by ordinary least squares (eq. 11), which the paper advises against."""
    s = np.asarray(np.linalg.lstsq(skew(f + a).reshape(-1, 3), (f - a).ravel())[0], dtype=np.float64)
    return np.asarray(np.linalg.inv(np.eye(3) + skew(s)) @ (np.eye(3) - skew(s))).T


def carlson_fig1(rng: np.random.Generator) -> Drawing:
    """Error of the rotation by relaxation and by the Cayley transform, right and wrong weight."""
    sigmas, runs = 10.0 ** np.arange(-4, 2), 60
    error = np.zeros((4, len(sigmas), runs))
    for run in range(runs):
        poses = Rotation.random(100, rng=rng).as_matrix()
        truth = ftcalib.Parameters(Rotation.random(rng=rng).as_matrix(), 9.80665 * DOWN, *np.zeros((3, 3)))
        one = {"as_published": True}
        methods = [
            method("carlson-relaxation", poses, **one),
            *(method("carlson-cayley", poses, weight_N=9.80665 * factor, **one) for factor in (1, 1.1)),
        ]
        noise = rng.normal(size=(100, 6)) * np.repeat([1, 0], 3)
        for k, sigma in enumerate(sigmas):
            wrench = ftcalib.predict(truth, poses) + sigma * noise
            found = [m(wrench).R_flange_sensor for m in methods]
            found.append(cayley_least_squares(wrench[:, :3], 9.80665 * DOWN @ poses))
            error[:, k, run] = [length(R - truth.R_flange_sensor) ** 2 for R in found]
    relaxation, right, wrong, ordinary = np.median(error, axis=2)
    figure, both = canvas(2)
    for axes, cayley, title in zip(both, (right, wrong), ("weight of Cayley right", "weight 1.1 times"), strict=True):
        axes.loglog(sigmas, relaxation, "o-", label="relaxation")
        axes.loglog(sigmas, cayley, "s-", label="Cayley, total least squares")
        if cayley is right:
            axes.loglog(sigmas, ordinary, "D-", label="Cayley, ordinary least squares")
        finish(axes, "sigma of the force, N", "squared error of R", title)
    return figure, [
        ("relaxation / Cayley, sigma .01", "on par", f"{relaxation[2]:.1e} / {right[2]:.1e}"),
        ("relaxation / Cayley, sigma 10", "on par", f"{relaxation[5]:.1e} / {right[5]:.1e}"),
        ("Cayley by ordinary / total least squares, sigma 1", "very sensitive", f"{ordinary[4]:.1e} / {right[4]:.1e}"),
        (
            "weight 1.1 times: Cayley, sigma 1e-4 / 1e-2 / 1",
            "plateau",
            " / ".join(f"{wrong[k]:.1e}" for k in (0, 2, 4)),
        ),
    ]


def pairwise_nullspace(A: Array, f: Array, *, successive: bool) -> Array:
    """Return R_TF^S from differences of all pairs of poses, or of successive ones (eqs. 22 to 26)."""
    first, second = np.triu_indices(len(f), 1)
    if successive:
        first, second = np.arange(len(f) - 1), np.arange(1, len(f))
    rows = np.einsum("nji,nk->nikj", A, f).reshape(-1, 3, 9)  # A_i^T (f_i^T (x) I): the gravity force in base axes
    r = np.linalg.svd((rows[first] - rows[second]).reshape(-1, 9), full_matrices=False)[2][-1]
    X = r.reshape(3, 3).T
    return nearest_rotation(X * np.sign(np.linalg.det(X)))


def carlson_pairs(rng: np.random.Generator) -> Drawing:
    """Error of the nullspace method with the differences of all pairs, and of successive poses only."""
    sizes, runs = (6, 12, 24, 48), 60
    error = np.zeros((2, len(sizes), runs))
    for k, n in enumerate(sizes):
        for run in range(runs):
            R, A = Rotation.random(rng=rng).as_matrix(), Rotation.random(n, rng=rng).as_matrix()
            f = 9.80665 * DOWN @ A.swapaxes(1, 2) @ R + rng.normal(0, 0.1, (n, 3))
            for one, successive in enumerate((False, True)):
                cosine = (np.sum(R * pairwise_nullspace(A, f, successive=successive)) - 1) / 2
                error[one, k, run] = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    every, successive = np.sqrt(np.mean(error**2, axis=2))
    figure, (axes,) = canvas(1)
    axes.loglog(sizes, every, "o-", label="all pairs")
    axes.loglog(sizes, successive, "s-", label="successive poses")
    finish(axes, "poses", "rms angle of R, deg", "9.8 N, noise 0.1 N")
    return figure, [
        (f"angle of R, deg, {n} poses: all / successive pairs", "-", f"{every[k]:.2f} / {successive[k]:.2f}")
        for k, n in enumerate(sizes)
        if n in (12, 48)
    ]


def algorithm_1(A: Array, f: Array, g: Array, steps: int, *, negate: bool) -> tuple[Array, Array]:
    """Iterate from g (r, 3) for all runs at once; return R_TF^S (steps, r, 3, 3) and g (steps, r, 3).

    `negate` is not printed: a matrix of negative determinant, from a g that points the wrong way, is negated.
    """
    inverse = np.linalg.inv(np.einsum("rni,rnj->rij", f, f))
    sums = np.einsum("rnij,rnk->rijk", A, f)
    rotations, gravities = list[Array](), list[Array]()
    for _ in range(steps):
        X = np.einsum("rijk,rj->rik", sums, g) @ inverse
        if negate:
            X *= np.sign(np.linalg.det(X))[:, None, None]
        U, _, Vt = np.linalg.svd(X)
        U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
        rotations.append(U @ Vt)
        g = np.einsum("rjik,rjk->ri", sums, rotations[-1]) / A.shape[1]
        gravities.append(g)
    return np.array(rotations), np.array(gravities)


def carlson_fig2(rng: np.random.Generator) -> Drawing:
    """Errors in each iteration of Algorithm 1, from a random start."""
    runs, n, steps = 200, 100, 15
    R = Rotation.random(runs, rng=rng).as_matrix()
    A = Rotation.random(runs * n, rng=rng).as_matrix().reshape(runs, n, 3, 3)
    g, start = rng.normal(0, 100, (runs, 3)), rng.normal(size=(runs, 3))
    f = np.einsum("rij,rnjk,rk->rni", R, A, g) + rng.normal(size=(runs, n, 3))

    def turn(rotations: Array) -> Array:
        cosine = (np.einsum("rij,srji->sr", R, rotations) - 1) / 2
        return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

    rotations, found = algorithm_1(A, f, start, steps, negate=True)
    size = np.linalg.norm(g, axis=1)
    relative = np.linalg.norm(found - g, axis=2) / size
    cosine = np.sum(found * g, axis=2) / np.linalg.norm(found, axis=2) / size
    errors = turn(rotations), relative, np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    as_printed = turn(algorithm_1(A, f, start, 100, negate=False)[0])[-1]
    # Appendix B starts with the rotation, R = I: its first gravity is the mean of the forces in base axes.
    identity = np.einsum("rnji,rnj->ri", A, f) / n
    appendix = {negate: turn(algorithm_1(A, f, identity, 100, negate=negate)[0])[-1] for negate in (True, False)}
    figure, three = canvas(3)
    labels = "angle of R, deg", "relative error of g", "angle of g, deg"
    for axes, one, label in zip(three, errors, labels, strict=True):
        for share, style in ((5, ":"), (50, "-"), (95, "--")):
            axes.semilogy(range(1, steps + 1), np.percentile(one, share, axis=1), style, color="C0", label=f"{share} %")
        finish(axes, "iteration", label)
    angle = errors[0]
    return figure, [
        ("runs that converge to R within 10 deg", "all", f"{np.mean(angle[-1] < 10):.1%}"),
        ("the same without negation, as printed", "all", f"{np.mean(as_printed < 10):.1%}"),
        ("from R = I, as in appendix B", "all", f"{np.mean(appendix[True] < 10):.1%}"),
        ("from R = I without negation, as printed", "all", f"{np.mean(appendix[False] < 10):.1%}"),
        (
            "runs within 1 deg in 3 / 4 / 5 iterations",
            "-",
            " / ".join(f"{np.mean(angle[k] < 1):.1%}" for k in (2, 3, 4)),
        ),
        ("runs with relative error of g below 1 %", "typically", f"{np.mean(relative[-1] < 0.01):.1%}"),
        ("angle of R, deg, median / 95 %", "-", "{:.3f} / {:.3f}".format(*np.percentile(angle[-1], [50, 95]))),
    ]


# --- drawing and command line ---


def canvas(columns: int) -> tuple[Figure, Any]:
    """Return a figure and its axes."""
    figure = Figure(figsize=(3.4 * columns, 2.6), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def finish(axes: Any, x: str, y: str, title: str = "") -> None:
    """Label the axes."""
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.grid(alpha=0.3)
    axes.minorticks_off()
    axes.legend(fontsize=7, framealpha=0.5)


FIGURES: Mapping[str, Callable[[np.random.Generator], Drawing]] = {
    "yu-fig4": yu_fig4,
    "yu-fig9": yu_fig9,
    "yu-fig11": yu_fig11,
    "yu-fig12": yu_fig12,
    "yu-fig13": yu_fig13,
    "yu-fig14": yu_fig14,
    "yu-fig15": yu_fig15,
    "yu-table3": yu_table3,
    "carlson-fig1": carlson_fig1,
    "carlson-pairs": carlson_pairs,
    "carlson-fig2": carlson_fig2,
}


def main() -> None:
    """Draw and print the figures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "figures", nargs="*", metavar="FIGURE", help=f"one or more of {', '.join(FIGURES)}; default: all"
    )
    parser.add_argument("--output", type=Path, default=Path("paper-figures"), help="folder of the pictures")
    options = parser.parse_args()
    unknown = set(options.figures) - set(FIGURES)
    if unknown:
        parser.error(f"unknown figure {', '.join(sorted(unknown))}: choose from {', '.join(FIGURES)}")
    try:
        draw(options.figures or list(FIGURES), options.output)
    except OSError as error:
        parser.error(f"the pictures cannot be written ({error}): choose another folder with --output")


def draw(names: Sequence[str], output: Path) -> None:
    """Save the figures in a folder, and print their numbers."""
    output.mkdir(parents=True, exist_ok=True)
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "ftdrive", "font.size": 8})
    print(f"{'':52} {'paper':>16}  ours")
    for name in names:
        figure, rows = FIGURES[name](np.random.default_rng(1))
        figure.savefig(output / f"{name}.svg", metadata={"Date": None})
        print(name)
        for what, paper, ours in rows:
            print(f"  {what:50} {paper:>16}  {ours}")


if __name__ == "__main__":
    main()
