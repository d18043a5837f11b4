"""Reproduce the figures of Carlson (2019) and the effect of a bias on his methods, against target numbers.

Run `python tests/benchmarks/carlson_figures.py [--quick]`: prints tables with pass or fail and exits with 1 if one
fails. With matplotlib installed, `--png FILE` draws figures 1 and 2.
"""

import argparse
import sys
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.model import Array, nearest_rotation, skew
from ftcalib.published import carlson, carlson_known
from tests import carlson_references

FIG_1_SIGMA_N = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
FIG_1_CURVES = ("relaxation", "Cayley total", "Cayley ordinary", "Cayley total, 4 turns")
FIG_2_STEPS = (1, 2, 3, 4, 5, 6)


class Report:
    """Prints lines and counts failures."""

    def __init__(self) -> None:
        self.failures = 0

    def line(self, text: str = "") -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def check(self, what: str, value: float, low: float, high: float) -> None:
        ok = low <= value <= high
        self.failures += not ok
        self.line(f"  {'pass' if ok else 'FAIL'}  {what}: {value:.3g}  (target {low:.3g} to {high:.3g})")


def apart_deg(R: Array, S: Array) -> float:
    return float(np.degrees(2 * np.arcsin(min(np.linalg.norm(R - S) / np.sqrt(8), 1))))


def forces(X: Array, R: Array, gravity: Array, bias: Array, sigma_N: float, rng: np.random.Generator) -> Array:
    return np.asarray(gravity @ R @ X + bias + sigma_N * rng.normal(size=(len(R), 3)))


def direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def tilted(rng: np.random.Generator, n: int, angle_deg: float, *, spin: bool) -> Array:
    """Orientations within an angle of straight down: tool axis with free wrist (cone), or the whole rotation (ball)."""
    down = Rotation.from_rotvec([np.pi, 0, 0])
    limit = np.radians(angle_deg)
    if not spin:
        turn = np.array([direction(rng) for _ in range(n)]) * (limit * rng.uniform(size=n) ** (1 / 3))[:, None]
        return (Rotation.from_rotvec(turn) * down).as_matrix()
    heading, wrist = rng.uniform(0, 2 * np.pi, size=(2, n))
    tilt = np.arccos(rng.uniform(np.cos(limit), 1, size=n))
    axis = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(n)])
    return (
        Rotation.from_rotvec(tilt[:, None] * axis) * down * Rotation.from_rotvec(np.outer(wrist, [0, 0, 1]))
    ).as_matrix()


def figure_1(trials: int, mass_factor: float, rng: np.random.Generator) -> Array:
    """(sigma, curve) medians of |R_error|_F^2 with 100 poses and 1 kg; Cayley transforms get another weight.

    The published code draws the sensor's rotation vector from a normal distribution, which favours the Cayley
    transform; a uniform rotation makes its plateau 4 times as high.
    """
    errors = np.empty((len(FIG_1_SIGMA_N), trials, len(FIG_1_CURVES)))
    gravity = np.array([0, 0, -9.82])
    for i, sigma_N in enumerate(FIG_1_SIGMA_N):
        for trial in range(trials):
            X = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
            R = Rotation.random(100, rng=rng).as_matrix()
            force_N = forces(X, R, gravity, np.zeros(3), sigma_N, rng)
            a = mass_factor * gravity @ R
            fits = (
                carlson_known.relaxation(R, force_N, mass_factor * gravity, bias=False).R_flange_sensor,
                carlson_known.cayley_rotation(force_N, a, total=True).T,
                carlson_known.cayley_rotation(force_N, a, total=False).T,
                carlson_known.cayley(R, force_N, mass_factor * gravity, bias=False).R_flange_sensor,
            )
            errors[i, trial] = [np.sum((fit - X) ** 2) for fit in fits]
    return np.median(errors, axis=1)


def report_figure_1(report: Report, quick: bool) -> tuple[Array, Array]:
    trials, margin = (150, 1.5) if quick else (2000, 1.3)
    rng = np.random.default_rng(1)
    exact, wrong = figure_1(trials, 1.0, rng), figure_1(trials, 1.1, rng)
    for title, table in (
        ("left: weight exact for the Cayley transform", exact),
        ("right: 10 % too much weight", wrong),
    ):
        report.line(f"Figure 1 {title}; median |R_error|_F^2 of {trials} runs")
        report.line("  sigma N   " + "".join(f"{name:>24}" for name in FIG_1_CURVES))
        for sigma_N, row in zip(FIG_1_SIGMA_N, table, strict=True):
            report.line(f"  {sigma_N:<10.0e}" + "".join(f"{value:24.2g}" for value in row))

    def near(what: str, value: float, target: float) -> None:
        report.check(what, value, target / margin, target * margin)

    for i, sigma_N in enumerate(FIG_1_SIGMA_N):
        near(f"left, relaxation, sigma {sigma_N:.0e}", exact[i, 0], 7.4e-12 * (sigma_N / 1e-4) ** 2)
    for i, target in ((0, 8.5e-12), (2, 8.5e-8), (4, 9e-4), (5, 0.38)):
        near(f"left, Cayley total, sigma {FIG_1_SIGMA_N[i]:.0e}", exact[i, 1], target)
    near("left, Cayley ordinary, sigma 1", exact[4, 2], 1.4e-3)
    near("right, Cayley total, plateau", wrong[0, 1], 1.5e-5)
    near("right, relaxation, sigma 1e-4", wrong[0, 0], 7.4e-12)
    return exact, wrong


def figure_2(runs: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """(run, step) errors of R in degrees and of gravity as a share; the last column is after convergence."""
    R_error, gravity_error = np.empty((2, runs, len(FIG_2_STEPS) + 1))
    for run in range(runs):
        X = Rotation.random(rng=rng).as_matrix()
        R = Rotation.random(100, rng=rng).as_matrix()
        gravity, start = 100 * rng.normal(size=3), rng.normal(size=3)
        force_N = forces(X, R, gravity, np.zeros(3), 1.0, rng)
        for column, steps in enumerate((*FIG_2_STEPS, 20_000)):
            fit = carlson.iterative(R, force_N, bias=False, gravity_start_base=start, max_iterations=steps)
            R_error[run, column] = apart_deg(fit.R_flange_sensor, X)
            gravity_error[run, column] = np.linalg.norm(fit.gravity_force_base_N - gravity) / np.linalg.norm(gravity)
    return R_error, gravity_error


def report_figure_2(report: Report, quick: bool) -> tuple[Array, Array]:
    runs = 200 if quick else 1000
    R_error, gravity_error = figure_2(runs, np.random.default_rng(2))
    report.line(f"Figure 2: algorithm 1 with the flip, random start; {runs} runs")
    report.line("  step            " + "".join(f"{step!s:>10}" for step in (*FIG_2_STEPS, "end")))
    for name, table, factor in (("R deg", R_error, 1), ("gravity %", gravity_error, 100)):
        for quantile in (50, 95):
            row = factor * np.percentile(table, quantile, axis=0)
            report.line(f"  {name:<10}{quantile:>3} % " + "".join(f"{value:10.3g}" for value in row))
    report.check("R median, deg", float(np.median(R_error[:, -1])), 0, 0.075)
    report.check("relative gravity, 95 %, in %", 100 * float(np.percentile(gravity_error[:, -1], 95)), 0, 0.32)
    report.check("runs that end at the truth (R within 20 deg), %", 100 * float(np.mean(R_error[:, -1] < 20)), 100, 100)
    return R_error, gravity_error


def algorithm_1_as_printed(R: Array, force_N: Array, gravity: Array | None) -> Array:
    """X after 200 steps without the change of sign; without gravity it starts at R = I, as appendix B does."""
    A = R.transpose(0, 2, 1)
    X = np.eye(3)
    for _ in range(200):
        if gravity is not None:
            X = nearest_rotation(np.asarray(np.linalg.lstsq(force_N, A @ gravity)[0].T, dtype=np.float64))
        gravity = np.mean(R @ (force_N @ X.T)[:, :, None], axis=0)[:, 0]
    return X


def report_missing_flip(report: Report, quick: bool) -> None:
    runs = 150 if quick else 1000
    rng = np.random.default_rng(3)
    right = np.zeros(2)
    for _ in range(runs):
        X, R, gravity = (
            Rotation.random(rng=rng).as_matrix(),
            Rotation.random(100, rng=rng).as_matrix(),
            20 * direction(rng),
        )
        force_N = forces(X, R, gravity, np.zeros(3), 0.2, rng)
        right += [apart_deg(algorithm_1_as_printed(R, force_N, start), X) < 5 for start in (None, rng.normal(size=3))]
    at_identity, at_random = 100 * right / runs
    spread = 400 * np.sqrt(0.25 / runs)
    report.line(f"Algorithm 1 as printed, without the flip; {runs} runs")
    report.check("ends at the truth from R = I, %", at_identity, 39 - spread, 39 + spread)
    report.check("ends at the truth from a random gravity, %", at_random, 52 - spread, 52 + spread)


def report_bias(report: Report, quick: bool) -> None:
    runs = 100 if quick else 600
    report.line(f"A bias that the model lacks: rms R error in deg, 20 N, 24 random poses, noise 0.05 N; {runs} runs")
    bias_N = (0.0, 0.1, 1.0, 5.0, 20.0)
    report.line(f"  {'bias N':<28}" + "".join(f"{value:10g}" for value in bias_N))
    table: dict[str, list[float]] = {}
    for value in bias_N:
        rng = np.random.default_rng(4)
        squares: dict[str, list[float]] = {}
        for _ in range(runs):
            X, R = Rotation.random(rng=rng).as_matrix(), Rotation.random(24, rng=rng).as_matrix()
            gravity = 20 * direction(rng)
            force_N = forces(X, R, gravity, value * direction(rng), 0.05, rng)
            fits = {
                "eigendecomposition": carlson.eigen(R, force_N, bias=False),
                "nullspace": carlson.nullspace(R, force_N, bias=False),
                "iterative": carlson.iterative(R, force_N, bias=False),
                "relaxation": carlson_known.relaxation(R, force_N, gravity, bias=False),
                "Cayley": carlson_known.cayley(R, force_N, gravity, bias=False),
                "similarity": carlson_references.similarity(R, force_N, gravity, bias=False),
                "eigendecomposition, with bias": carlson.eigen(R, force_N, bias=True),
                "nullspace, with bias": carlson.nullspace(R, force_N, bias=True),
                "similarity, with bias": carlson_references.similarity(R, force_N, gravity, bias=True),
            }
            for name, fit in fits.items():
                squares.setdefault(name, []).append(apart_deg(fit.R_flange_sensor, X) ** 2)
        for name, values in squares.items():
            table.setdefault(name, []).append(float(np.sqrt(np.mean(values))))
    for name, row in table.items():
        report.line(f"  {name:<28}" + "".join(f"{value:10.2f}" for value in row))
    for value, target, got in zip(bias_N[:4], (0.07, 0.1, 0.76, 4.0), table["eigendecomposition"], strict=False):
        report.check(f"eigendecomposition, bias {value:g} N", got, target / 1.25, target * 1.25)


def total_least_squares(R: Array, force_N: Array, down: Array) -> Array:
    """X from the published code's known-direction method: total least squares on `[f^T (x) I, -I] = 0.3 kg A g`.

    What it minimises, and so its error, depends on the assumed mass and on the size of the bias.
    """
    n = len(R)
    columns = np.hstack(
        [carlson.kron_identity(force_N), np.tile(-np.eye(3), (n, 1)), (0.3 * 9.82 * down @ R).reshape(-1, 1)]
    )
    null = np.linalg.svd(columns, full_matrices=False)[2][-1]
    return nearest_rotation((-null[:9] / null[12]).reshape(3, 3).T)


def report_known_direction(report: Report, quick: bool) -> None:
    runs = 200 if quick else 1000
    report.line(f"Known direction, 20 N of weight, 5 N of bias, 24 poses: mean square R error / bound; {runs} runs")
    report.line("  poses   SNR  similarity  relaxation  total least squares")
    for name, spin in (("cone40", True), ("ball40", False)):
        for snr in (100, 10):
            rng = np.random.default_rng(5)
            squares, bound = np.zeros(3), 0.0
            for _ in range(runs):
                X, R, down = (
                    Rotation.random(rng=rng).as_matrix(),
                    tilted(rng, 24, 40, spin=spin),
                    np.array([0, 0, -1.0]),
                )
                force_N = forces(X, R, 20 * down, 5 * direction(rng), 20 / snr, rng)
                a = 20 * down @ R - np.mean(20 * down @ R, axis=0)
                J = np.concatenate([skew(a), a[:, :, None]], axis=2).reshape(-1, 4)
                bound += np.trace(np.linalg.inv(J.T @ J)[:3, :3]) * (20 / snr) ** 2
                fits = (
                    carlson_references.similarity(R, force_N, down, bias=True).R_flange_sensor,
                    carlson_known.relaxation(R, force_N, down, bias=True).R_flange_sensor,
                    total_least_squares(R, force_N, down),
                )
                squares += [np.radians(apart_deg(fit, X)) ** 2 for fit in fits]
            similarity, relaxation, total = squares / bound
            report.line(f"  {name}{snr:6}{similarity:12.2f}{relaxation:12.2f}{total:14.1f}")
            report.check(f"similarity, {name}, SNR {snr}", similarity, 0.8, 1.2)


def report_pairs(report: Report) -> None:
    rng = np.random.default_rng(6)
    X, R = Rotation.random(rng=rng).as_matrix(), Rotation.random(100, rng=rng).as_matrix()
    force_N = forces(X, R, np.array([0, 0, -20.0]), np.ones(3), 0.2, rng)
    seconds, rotation = {}, {}
    for method in (carlson.nullspace, carlson_references.nullspace_all_pairs):
        start = time.perf_counter()
        for _ in range(5):
            rotation[method] = method(R, force_N, bias=False).R_flange_sensor
        seconds[method] = (time.perf_counter() - start) / 5
    slow, fast = seconds[carlson_references.nullspace_all_pairs], seconds[carlson.nullspace]
    report.line(f"Nullspace, 100 poses: all pairs {1e3 * slow:.1f} ms, O(n) {1e3 * fast:.2f} ms")
    apart = apart_deg(rotation[carlson.nullspace], rotation[carlson_references.nullspace_all_pairs])
    report.check("difference, deg", apart, 0, 1e-9)


def draw(path: Path, figure_1_tables: tuple[Array, Array], R_error: Array, gravity_error: Array) -> None:
    plt = import_module("matplotlib.pyplot")
    figure, axes = plt.subplots(1, 4, figsize=(16, 4), layout="constrained")
    for axis, table, title in zip(
        axes, figure_1_tables, ("Fig. 1: weight exact", "Fig. 1: weight 10 % off"), strict=False
    ):
        axis.loglog(FIG_1_SIGMA_N, table, label=FIG_1_CURVES)
        axis.set(title=title, xlabel="noise in N", ylabel="|R_error|_F^2")
        axis.legend()
    for axis, table, label in (
        (axes[2], R_error, "R error in deg"),
        (axes[3], gravity_error, "relative gravity error"),
    ):
        axis.semilogy(FIG_2_STEPS, table[:, : len(FIG_2_STEPS)].T, color="black", alpha=0.1)
        axis.set(title="Fig. 2", xlabel="step", ylabel=label)
    figure.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(description="The figures of Carlson (2019) against target numbers.")
    parser.add_argument("--quick", action="store_true", help="fewer runs, wider targets")
    parser.add_argument("--png", type=Path, metavar="FILE", help="draw figures 1 and 2 (needs matplotlib)")
    options = parser.parse_args()
    report = Report()
    figure_1_tables = report_figure_1(report, options.quick)
    R_error, gravity_error = report_figure_2(report, options.quick)
    report_missing_flip(report, options.quick)
    report_bias(report, options.quick)
    report_known_direction(report, options.quick)
    report_pairs(report)
    if options.png and find_spec("matplotlib"):
        draw(options.png, figure_1_tables, R_error, gravity_error)
    elif options.png:
        report.line(f"{options.png} not drawn: matplotlib is not installed")
    report.line(f"{report.failures} targets missed" if report.failures else "all targets met")
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
