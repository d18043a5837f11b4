"""The figures of a report as SVG in the colours of the page, which differ in light and dark mode.

Matplotlib writes fixed colours, so each colour used here stands for a CSS variable that replaces it afterwards.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ftcalib.model import Array
from ftdrive.planning.plan import JOINTS
from ftdrive.report.facts import label_of
from ftdrive.report.sections import LIMIT_SIGMAS, SUSPICIOUS_SIGMAS, Facts, shown_poses
from ftdrivers.sweep import WRISTS, Sweep

INK, PAPER, GRID, BAD = "#010101", "#020202", "#030303", "#040404"
SERIES = ("#050505", "#060606", "#070707")
# CSS variable of the page that replaces each colour.
VARIABLES = {
    INK: "currentColor",
    PAPER: "var(--paper)",
    GRID: "var(--grid)",
    BAD: "var(--bad)",
    **{colour: f"var(--series-{k})" for k, colour in enumerate(SERIES)},
}
# Width of a figure, inches: text stays readable on a phone, and two figures fit side by side on a desktop screen.
WIDTH_IN = 5.0
# Time axes of runs longer than this, s, are in minutes.
LONG_S = 200
# Largest number of dots in a figure, because each one enlarges the file. Of more dots, only every n-th is drawn.
MOST_DOTS = 400
# Correlations with an absolute value below this are not drawn.
INVISIBLE = 0.02
_STYLE: Mapping[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "ftdrive",
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "hatch.color": PAPER,
    "legend.frameon": False,
}


def draw_figure(name: str, facts: Facts) -> str:
    """Return the figure of this name as an SVG element without links, scripts or fixed text colours."""
    height, (left, right, bottom, top), fill = _FIGURES[name]
    height_in = height(facts) if callable(height) else height
    with mpl.rc_context(dict(_STYLE)):
        # The margins are fixed, because an automatic layout would take as long as the drawing itself.
        figure = Figure(figsize=(WIDTH_IN, height_in))
        figure.subplots_adjust(left / WIDTH_IN, bottom / height_in, 1 - right / WIDTH_IN, 1 - top / height_in)
        fill(figure, facts)
        written = StringIO()
        figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _inline_svg(written.getvalue(), name)


def _inline_svg(svg: str, name: str) -> str:
    """Convert the SVG file of matplotlib to an element for a page: unique ids, CSS colours, no prologue, no size."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'xlink:href="#|href="#', f'href="#{name}-', svg).replace("url(#", f"url(#{name}-")
    svg = re.sub(r"font: ([\d.]+)px [^;\"]+", r"font-size: \1px", svg)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, variable)
    return re.sub(r"\n\s*", "\n", svg)


def _map(figure: Any, facts: Facts, kind: str, unit: str) -> None:
    found = facts["error_map"]
    elevation, azimuth = (np.radians(found[name]) for name in ("elevation_deg", "azimuth_deg"))
    axes = figure.add_subplot()
    error = 1e3 * np.array(found[kind]["map"])
    x, y = _hammer_map(*np.meshgrid(elevation, azimuth, indexing="ij"))
    levels = MaxNLocator(12).tick_values(0, error.max() or 1.0)
    filled = axes.contourf(x, y, error, levels=levels, cmap="viridis", antialiased=False)
    filled.set_edgecolor("face")
    with _globe(axes):
        if facts["coverage"] is not None:
            _dots(axes, facts["coverage"]["tool_in_base"], color="white", edgecolor="black", s=16)
        _dots(axes, [found[kind]["worst_direction"]], color="white", edgecolor="black", marker="X", s=90)
    bar = figure.colorbar(filled, ax=axes, orientation="horizontal", shrink=0.8, aspect=30, format="{x:.3g}")
    bar.outline.set_visible(False)
    bar.set_ticks(levels[::2])
    bar.set_label(f"predicted {kind.partition('_')[0]} error, {unit}, 1 sigma")


def _draw_coverage(figure: Any, facts: Facts) -> None:
    axes, found = figure.add_subplot(), facts["coverage"]
    with _globe(axes):
        _dots(axes, found["gravity_in_flange"], color=SERIES[0], edgecolor=PAPER, s=36)
        towards, radius = np.array(found["gap_towards"]), found["largest_gap_rad"]
        across = np.linalg.svd(towards[None])[2][1:]
        turn = np.linspace(0, 2 * np.pi, 181)
        circle = np.cos(radius) * towards + np.sin(radius) * np.outer(np.cos(turn), across[0])
        circle += np.sin(radius) * np.outer(np.sin(turn), across[1])
        x, y = _on_map(circle)
        jumps = np.flatnonzero(np.hypot(np.diff(x), np.diff(y)) > 0.7) + 1  # where the circle crosses the map's edge
        axes.plot(np.insert(x, jumps, np.nan), np.insert(y, jumps, np.nan), "--", color=SERIES[1], linewidth=1.5)


@contextmanager
def _globe(axes: Any) -> Iterator[None]:
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set(xlim=(-2.95, 2.95), ylim=(-1.75, 1.75))
    quarter, half = np.linspace(-np.pi / 2, np.pi / 2, 61), np.linspace(-np.pi, np.pi, 121)
    for azimuth in np.radians([-180, -90, 0, 90, 180]):
        axes.plot(*_hammer_map(quarter, np.full_like(quarter, azimuth)), color=INK, linewidth=0.5, alpha=0.6)
    for elevation in np.radians([-45, 0, 45]):
        axes.plot(*_hammer_map(np.full_like(half, elevation), half), color=INK, linewidth=0.5, alpha=0.6)
    yield
    box = {"boxstyle": "round,pad=0.15", "facecolor": PAPER, "edgecolor": "none"}
    for name, elevation, azimuth in (("+x", 0, 0), ("+y", 0, 90), ("-y", 0, -90), ("-x", 0, 180), ("-x", 0, -180)):
        x, y = _hammer_map(*np.radians([elevation, azimuth]))
        axes.text(x, y - 0.2, name, ha="center", va="center", fontsize=8, bbox=box)  # below a dot on this axis
    axes.text(0, np.sqrt(2) + 0.08, "+z", ha="center", va="bottom", fontsize=8)
    axes.text(0, -np.sqrt(2) - 0.08, "-z", ha="center", va="top", fontsize=8)


def _hammer_map(elevation: Any, azimuth: Any) -> tuple[Array, Array]:
    """Map angles on the sphere, rad, to the plane with equal areas (Hammer 1892); +x in the middle, +z at the top."""
    length = np.sqrt(1 + np.cos(elevation) * np.cos(azimuth / 2))
    x = 2 * np.sqrt(2) * np.cos(elevation) * np.sin(azimuth / 2) / length
    return np.asarray(x), np.asarray(np.sqrt(2) * np.sin(elevation) / length)


def _on_map(directions: Any) -> tuple[Array, Array]:
    x, y, z = np.array(directions).T
    return _hammer_map(np.arcsin(np.clip(z, -1, 1)), np.arctan2(y, x))


def _dots(axes: Any, directions: Any, **style: Any) -> None:
    step = -(-len(directions) // MOST_DOTS)
    axes.scatter(*_on_map(directions[::step]), linewidth=0.8, zorder=3, clip_on=False, **style)


def _sweep(figure: Any, facts: Facts) -> None:
    axes, sweep = figure.add_subplot(), Sweep.from_dict(facts["motion"]["sweep"])
    t_s = np.linspace(0.0, sweep.duration_s, 400)
    q_deg = np.degrees(sweep.at(t_s))
    for joint, colour in zip(WRISTS, SERIES, strict=True):
        axes.plot(t_s, q_deg[:, joint], color=colour, linewidth=1.5, label=JOINTS[joint])
    axes.set(xlabel="time, s", ylabel="joint, °", xlim=(0, sweep.duration_s))
    axes.legend(loc="upper right", fontsize=8, ncols=3)


def _draw_correlation(figure: Any, facts: Facts) -> None:
    axes = figure.add_subplot()
    matrix = np.abs(np.array(facts["correlation"]["matrix"]))
    n = len(matrix)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    seen = np.argwhere(matrix > INVISIBLE)
    corners = seen[:, None, ::-1] + [[0, 0], [1, 0], [1, 1], [0, 1]]
    colours = [to_rgba(SERIES[0], matrix[i, j]) for i, j in seen]  # opacity is strength
    axes.add_collection(PolyCollection(list(corners), facecolors=colours, linewidth=0), autolim=False)
    for edge in range(0, n + 1, 3):
        axes.plot([0, n], [edge, edge], color=GRID, linewidth=0.8)
        axes.plot([edge, edge], [0, n], color=GRID, linewidth=0.8)
    names = [label_of(name) for name in facts["correlation"]["names"]]
    axes.set_yticks(np.arange(n) + 0.5, names, fontsize=8)
    axes.set_xticks(np.arange(n) + 0.5, names, fontsize=8, rotation=90)
    axes.tick_params(length=0)
    axes.set(xlim=(0, n), ylim=(n, 0))
    axes.set_aspect("equal")


def _methods(figure: Any, facts: Facts) -> None:
    methods = [one for one in facts["cross_validation"]["methods"] if one.get("cross_validated", {}).get("force_rms_N")]
    own = facts["result"]["method"]
    force, torque = figure.subplots(1, 2, sharey=True)
    for axes, key, scale, label in ((force, "force_rms_N", 1.0, "N rms"), (torque, "torque_rms_Nm", 1e3, "mN·m rms")):
        values = [scale * one["cross_validated"][key] for one in methods]
        colours = [SERIES[1] if one["method"] == own else SERIES[0] for one in methods]
        axes.barh([one["method"] for one in methods], values, color=colours, height=0.6)
        axes.set_xscale("log")
        least, most = min(values), max(values)
        axes.set_xlim(10 ** math.floor(math.log10(least) - 0.2), 10 ** math.ceil(math.log10(most) + 0.05))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(label)
        axes.minorticks_off()
    force.invert_yaxis()


def _draw_contact(figure: Any, facts: Facts) -> None:
    axes, found = figure.add_subplot(), facts["contact"]
    if found["without_loads_N"] is not None:
        axes.plot(found["force_N"], found["without_loads_N"], "--", color=SERIES[1], label="without known loads")
    axes.plot(found["force_N"], found["sigma_N"], color=SERIES[0], label=f"now ({found['source']})")
    axes.set_xlim(0, found["force_N"][-1])
    axes.set_ylim(bottom=0)
    axes.set_xlabel("force at the tip, N")
    axes.set_ylabel("sigma, N")
    axes.legend(loc="upper left")


def _pose_residuals(figure: Any, facts: Facts) -> None:
    poses, axes = shown_poses(facts["poses"]), figure.add_subplot()
    sizes = [pose["sigmas"] for pose in poses]
    hatches = [None if pose["used"] else "///" for pose in poses]
    axes.bar(range(len(poses)), sizes, color=[SERIES[0] if pose["used"] else BAD for pose in poses], hatch=hatches)
    axes.axhline(1, color=INK, linewidth=1)
    axes.axhline(SUSPICIOUS_SIGMAS, color=INK, linewidth=1, linestyle="--")
    axes.set_ylabel("residual, sigma")
    _name_poses(axes, poses)


def _time_residuals(figure: Any, facts: Facts) -> None:
    poses = shown_poses(facts["poses"])
    timed = all(pose["t_s"] is not None for pose in poses)
    at = np.array([pose["t_s"] if timed else pose["row"] for pose in poses], dtype=float)
    long = timed and np.ptp(at) > LONG_S
    at = at / 60 if long else at
    order = np.argsort(at, kind="stable")
    residual = np.array([pose["residual"] for pose in poses])[order]
    both = figure.subplots(2, 1, sharex=True)
    for k, (axes, scale, label) in enumerate(zip(both, (1, 1e3), ("N", "mN·m"), strict=True)):
        axes.axhline(0, color=INK, linewidth=1)
        axes.set_prop_cycle(color=SERIES, marker=list("osD"))
        names = [f"{'FT'[k]}{axis}" for axis in "xyz"]
        axes.plot(at[order], scale * residual[:, 3 * k : 3 * k + 3], markersize=3.5, linewidth=0.9, label=names)
        axes.set_ylabel(label)
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), borderaxespad=0.1)
    unit = "min" if long else "s"
    if not timed:
        axes.xaxis.get_major_locator().set_params(integer=True)
    words = "part of the motion, in the order of time" if facts["motion"] else "pose, in the order of the rows"
    axes.set_xlabel(f"time since the first pose, {unit}" if timed else words)


def _draw_noise(figure: Any, facts: Facts) -> None:
    rows = [pose["row"] - 1 for pose in shown_poses(facts["poses"])]
    both = figure.subplots(2, 1, sharex=True)
    for axes, key, label in zip(both, ("force_N", "torque_Nm"), ("mN", "mN·m"), strict=True):
        values = 1e3 * np.array(facts["noise"][key])[rows]
        axes.bar(np.arange(len(rows)), values, color=SERIES[0])
        axes.axhline(float(np.median(values)), color=INK, linewidth=1, linestyle="--")
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(label)
    _name_poses(axes, [facts["poses"][row] for row in rows])


def _name_poses(axes: Any, poses: Sequence[Facts]) -> None:
    step = max(1, -(-len(poses) // 24))
    axes.grid(visible=False, axis="x")
    axes.set_xticks(np.arange(len(poses))[::step], [pose["name"] for pose in poses][::step], fontsize=8, rotation=90)
    axes.set_xlabel("pose")


def _draw_comparison(figure: Any, facts: Facts) -> None:
    axes, found = figure.add_subplot(), facts["comparison"]["parameters"]
    values = [one["sigmas"] or 0.0 for one in found]
    axes.barh([label_of(one["name"]) for one in found], values, color=SERIES[0], height=0.6)
    axes.axvline(0, color=INK, linewidth=1)
    for limit in (-LIMIT_SIGMAS, LIMIT_SIGMAS):
        axes.axvline(limit, color=INK, linewidth=1, linestyle="--")
    most = max(10.0, 1.2 * max(map(abs, values)))
    axes.set_xscale("symlog", linthresh=LIMIT_SIGMAS)
    axes.set_xlim(-most, most)
    ticks = LIMIT_SIGMAS * 10.0 ** np.arange(0, math.log10(most / LIMIT_SIGMAS), max(1, math.log10(most) // 2))
    axes.set_xticks([*-ticks, 0, *ticks])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("difference, sigma")


_Margins = tuple[float, float, float, float]
# For each figure of the report: height and margins (left, right, bottom, top), inches, and the drawing function.
_FIGURES: Mapping[str, tuple[float | Callable[[Facts], float], _Margins, Callable[[Any, Facts], None]]] = {
    "force_map": (3.4, (0.1, 0.1, 0.45, 0.1), lambda figure, facts: _map(figure, facts, "force_N", "mN")),
    "torque_map": (3.4, (0.1, 0.1, 0.45, 0.1), lambda figure, facts: _map(figure, facts, "torque_Nm", "mN·m")),
    "contact": (2.6, (0.65, 0.2, 0.5, 0.1), _draw_contact),
    "correlation": (4.6, (1.05, 0.1, 1.05, 0.1), _draw_correlation),
    "methods": (lambda facts: 1.0 + 0.25 * len(facts["cross_validation"]["methods"]), (1.35, 0.2, 0.5, 0.1), _methods),
    "pose_residuals": (2.8, (0.55, 0.1, 0.65, 0.1), _pose_residuals),
    "time_residuals": (3.8, (0.65, 0.1, 0.5, 0.35), _time_residuals),
    "noise": (3.6, (0.65, 0.1, 0.65, 0.1), _draw_noise),
    "coverage": (2.7, (0.1, 0.1, 0.1, 0.1), _draw_coverage),
    "sweep": (2.6, (0.65, 0.2, 0.5, 0.1), _sweep),
    "comparison": (3.8, (1.2, 0.2, 0.5, 0.1), _draw_comparison),
}
