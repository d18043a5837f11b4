"""Draw the papers' figures and ours from simulation.

uv run python tests/benchmarks/figures.py --out DIR [--quick]
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from ftcalib.likelihood import fit as likelihood
from tests.benchmarks import accuracy, carlson_figures
from tests.benchmarks import scenarios as sim
from tests.benchmarks.accuracy import Lab

SROM_COLOR, ML_COLOR, OTHER_COLOR = "tab:orange", "tab:blue", "tab:gray"
CHANNELS = ("x", "y", "z")


def yu_9(lab: Lab) -> Figure:
    table = accuracy.figure_9(lab)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    styles = (("ours", ML_COLOR, "o-"), ("yaw only", SROM_COLOR, "s--"), ("known rotation", OTHER_COLOR, "^:"))
    yaw = {cell[0]: row for cell, row in table.items() if cell[1] == 0.0 and cell[0] != accuracy.FIG_9_YAW_DEG}
    roll = {cell[1]: row for cell, row in table.items() if cell[0] == accuracy.FIG_9_YAW_DEG}
    for axis, rows, label in (
        (axes[0], yaw, "yaw of the sensor, deg (no roll)"),
        (axes[1], roll, f"roll of the sensor, deg (yaw {accuracy.FIG_9_YAW_DEG:.0f}°)"),
    ):
        for k, (name, color, style) in enumerate(styles):
            axis.plot(list(rows), [row[k] for row in rows.values()], style, color=color, label=name)
        axis.set(xlabel=label, yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("rms error of predicted force, N")
    axes[0].legend(loc="center right")
    figure.suptitle("Yu Fig. 9 in simulation: 20 N, 24 poses within 60° of straight down, noise 0.2 N")
    return figure


def yu_14(lab: Lab) -> Figure:
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    n2 = np.array([0.0, 0.01, 0.02, 0.03, 0.04, 0.06])
    for axis, channels, name in ((axes[0], slice(0, 3), "force"), (axes[1], slice(3, 6), "torque")):
        axis.set(title=name, xlabel="n2: amplitude of the orientation noise, rad")
        axis.grid(alpha=0.3)
        for n1, alpha in ((0.1, 0.5), (0.2, 1.0)):
            slopes = np.array([accuracy.coefficients(lab, n1, value)[:, channels].mean(axis=1) for value in n2])
            for k, (method, color, style) in enumerate((("SROM", SROM_COLOR, "s--"), ("ours", ML_COLOR, "o-"))):
                axis.plot(n2, slopes[:, k], style, color=color, alpha=alpha, label=f"{method}, n1 = {n1:g} N")
        axis.axhline(0.03, color="black", lw=0.8, ls=":", label="the paper's 3 %")
    axes[0].set_ylabel("largest error / range (slope)")
    axes[0].legend()
    figure.suptitle("Yu Fig. 14 in simulation: the coefficient is set by the orientation noise of the test poses")
    return figure


def yu_15(lab: Lab) -> Figure:
    centres = ((0.0, 0.0, 0.1), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.1, 0.1, 0.1), (0.0, 0.0, 0.3))
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    at, width = np.arange(len(centres)), 0.26
    slopes = np.array([accuracy.coefficients(lab, 0.2, 0.04, centre)[1] for centre in centres])
    lever = np.array([np.linalg.norm(centre) for centre in centres])
    for axis, rows, label in (
        (axes[0], slopes[:, :3], "force: largest error / (2 |F_b|)"),
        (axes[1], slopes[:, 3:] * lever[:, None], "torque: largest error / (2 |F_b|), m"),
    ):
        for k, channel in enumerate(CHANNELS):
            axis.bar(at + (k - 1) * width, rows[:, k], width, label=channel)
        axis.set_xticks(at, ["[" + ", ".join(f"{x:g}" for x in centre) + "]" for centre in centres], fontsize=8)
        axis.set(xlabel="centre of mass, m", ylabel=label)
        axis.grid(alpha=0.3, axis="y")
    axes[0].set_ylim(0, 1.3 * slopes[:, :3].max())
    axes[0].legend(title="channel", ncols=3, loc="upper right")
    figure.suptitle("Yu Fig. 15 in simulation: n1 = 0.2, n2 = 0.04; the centre of mass changes the torques only")
    return figure


def carlson_1(lab: Lab) -> Figure:
    trials = lab.count(400, 40)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    for axis, factor, title in ((axes[0], 1.0, "correct weight"), (axes[1], 1.1, "weight 10 % too large")):
        table = carlson_figures.figure_1(trials, factor, np.random.default_rng(1))
        for curve, name, style in zip(table.T, carlson_figures.FIG_1_CURVES, ("o-", "s--", "^:", "v-."), strict=True):
            axis.loglog(carlson_figures.FIG_1_SIGMA_N, curve, style, label=name, alpha=0.8)
        axis.set(title=title, xlabel="noise, N")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("median squared error of R (Frobenius)")
    axes[0].legend()
    figure.suptitle("Carlson Fig. 1: gravity known, 100 poses, 1 kg")
    return figure


def carlson_2(lab: Lab) -> Figure:
    R_error, gravity_error = carlson_figures.figure_2(lab.count(300, 40), np.random.default_rng(2))
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    steps = carlson_figures.FIG_2_STEPS
    for axis, table, label in (
        (axes[0], R_error, "error of R, deg"),
        (axes[1], 100 * gravity_error, "error of gravity, %"),
    ):
        axis.semilogy(steps, table[:, : len(steps)].T, color="black", alpha=0.06)
        axis.semilogy(steps, np.median(table[:, : len(steps)], axis=0), "o-", color=ML_COLOR, label="median")
        axis.set(xlabel="step", ylabel=label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.suptitle("Carlson Fig. 2: algorithm 1 with the change of sign, 100 poses, noise 1 N")
    return figure


def odds(lab: Lab) -> Figure:
    table = accuracy.odds_table(accuracy.odds(lab))
    figure, axis = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
    gap = np.linspace(0, 16, 200)
    axis.semilogy(gap, 1 / (1 + np.exp(gap / 2)), color="black", lw=1, label="stated: 1 / (1 + exp(gap / 2))")
    for factor in (1 / 1.5, 1.5):
        axis.semilogy(gap, factor / (1 + np.exp(gap / 2)), color="black", lw=0.6, ls=":")
    seen = (
        [(min(high, 16.0) + low) / 2 for low, high, *_ in table],
        [row[3] for row in table],
        [row[2] for row in table],
    )
    middle, share, n = (np.array(x) for x in seen)
    shown = share > 0
    spread = 1.96 * np.sqrt(share * (1 - share) / np.maximum(n, 1))
    lower = np.minimum(spread, 0.9 * share)
    axis.errorbar(
        middle[shown], share[shown], [lower[shown], spread[shown]], fmt="o", color=ML_COLOR, label="observed, 95 %"
    )
    axis.set(
        xlabel="chi-square of the second solution above the first", ylabel="share of wrong answers", ylim=(2e-4, 1)
    )
    axis.set_title(f"Odds of a wrong basin, {n.sum()} noisy calibrations")
    axis.grid(alpha=0.3)
    axis.legend()
    return figure


def drift(lab: Lab) -> Figure:
    rng = np.random.default_rng(4)
    n, q_N, s = 60, 0.07, sim.sigma(1000)
    truth, R = sim.tool(rng), sim.poses(f"haar{n}", rng)
    path, _ = sim.walk(n, q_N, rng)
    y = sim.readings(truth, R) + path + s * rng.normal(size=(n, 6))
    fit = likelihood.fit(R, y, np.diag(s**2))
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    bias = np.zeros((n, 6)) if fit.drift is None else fit.drift.bias
    for k, (channel, color) in enumerate(zip(CHANNELS, ("tab:red", "tab:green", "tab:blue"), strict=True)):
        axes[0].plot(path[:, k], color=color, lw=3, alpha=0.35)
        axes[0].plot(bias[:, k], color=color, lw=1, label=f"force {channel}")
    axes[0].set(xlabel="pose", ylabel="bias less its mean, N", title="one session: true (wide) and found (thin)")
    axes[0].legend()
    runs = lab.count(150, 20)
    walks = (0.0, 0.02, 0.04, 0.07, 0.1)
    records = [lab.simulate(partial(accuracy.drift_run, q_N=value), runs) for value in walks]
    for key, color, style, name in (
        ("auto", ML_COLOR, "o-", "drift found"),
        ("none", OTHER_COLOR, "^:", "no drift model"),
    ):
        rms = [np.rad2deg(np.sqrt(record[key][:, 0].mean())) for record in records]
        axes[1].plot(walks, rms, style, color=color, label=name)
    axes[1].set(xlabel="random walk of the bias, N a pose", ylabel="rms error of R, deg", title=f"{runs} sessions each")
    axes[1].set_ylim(bottom=0)
    axes[1].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.suptitle("Drift: 60 random poses, 20 N, noise 0.02 N")
    return figure


FIGURES: dict[str, Callable[[Lab], Figure]] = {
    "yu_9": yu_9,
    "yu_14": yu_14,
    "yu_15": yu_15,
    "carlson_1": carlson_1,
    "carlson_2": carlson_2,
    "second_basin": odds,
    "drift": drift,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the papers' figures from simulation.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the pictures go")
    parser.add_argument("--quick", action="store_true", help="few runs")
    parser.add_argument("--only", choices=FIGURES, action="append", help="one picture; may be repeated")
    options = parser.parse_args()
    mpl.use("Agg")
    options.out.mkdir(parents=True, exist_ok=True)
    pool, lab = accuracy.laboratory(quick=options.quick)
    with pool:
        for name in options.only or FIGURES:
            path = options.out / f"{name}.png"
            figure = FIGURES[name](lab)
            figure.savefig(path, dpi=130)
            plt.close(figure)
            sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()
