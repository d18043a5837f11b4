"""Presentation of a calibration: its estimates as numbers, table rows, a DataFrame and plots."""

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from io import BytesIO
from typing import Any, Final, NamedTuple

import numpy as np
import scipy  # submodules are imported at their first use
from numpy.typing import ArrayLike, NDArray

from ftcalib.display import Row
from ftcalib.errors import UsageError
from ftcalib.model import Array
from ftcalib.rounding import to_place_of, with_sigma

# The first four fields of each `ShownEstimate`: label, conversion factor, unit, name in a calibration file.
_QUANTITIES: Final[Sequence[tuple[str, float, str, str]]] = (
    ("mass", 1.0, "kg", "mass_kg"),
    ("centre of mass", 1e3, "mm", "p_sensor_com_m"),
    ("force bias", 1.0, "N", "force_bias_N"),
    ("torque bias", 1.0, "N·m", "torque_bias_Nm"),
    ("flange to sensor", 180 / np.pi, "deg", "R_flange_sensor"),
    ("gravity in base", 1.0, "N", "gravity_force_base_N"),
    ("base tilt alpha", 180 / np.pi, "deg", "tilt_alpha_rad"),
    ("base tilt beta", 180 / np.pi, "deg", "tilt_beta_rad"),
)
_IN_MOTION: Final[Sequence[tuple[str, float, str, str]]] = (
    ("inertia", 1e3, "g·m²", "inertia_kg_m2"),
    ("delay of wrench", 1e3, "ms", "delay_s"),
    ("sensor above flange", 1e3, "mm", "height_m"),
)
# A standard deviation below this share of the largest one is a rounding error: the value was exactly known.
_KNOWN_BELOW: Final = 1e-9


class ShownEstimate(NamedTuple):
    """Estimated quantity for display: a number, a vector, a symmetric tensor, or the rotation vector of a mounting."""

    label: str
    factor: float
    """Conversion factor from SI to the displayed unit."""
    unit: str
    """Unit in which the quantity is displayed."""
    key: str
    """Name of the quantity in a calibration file, such as "mass_kg"."""
    values: Array
    """(k,) values in SI units."""
    sigma: Array
    """(k,) standard deviations in SI units."""
    is_known: NDArray[np.bool_]
    """(k,) whether a value was exactly known. Its sigma is then only a rounding error."""

    @property
    def axes(self) -> Sequence[str]:
        """(k,) axis names of the values."""
        return {1: ("",), 3: tuple("xyz"), 6: ("xx", "yy", "zz", "xy", "xz", "yz")}[len(self.values)]


def shown_estimates(document: Mapping[str, Any]) -> list[ShownEstimate]:
    """Return the estimates contained in the document of a calibration file."""
    known_below = _KNOWN_BELOW * float(np.sqrt(np.diag(document["covariance"]).max()))
    estimates = []
    for label, factor, unit, key in (*_QUANTITIES, *(_IN_MOTION if "inertia_kg_m2" in document else ())):
        values, sigma = (values_of(source[key], key) for source in (document, document["sigma"]))
        estimates.append(ShownEstimate(label, factor, unit, key, values, sigma, sigma <= known_below))
    return estimates


def values_of(value: Any, key: str) -> Array:
    """Return a quantity, or its sigma, as an array (k,); a mounting as its rotation vector, rad."""
    values = np.asarray(value, dtype=np.float64)
    if key == "R_flange_sensor" and values.ndim == 2:
        values = scipy.spatial.transform.Rotation.from_matrix(values).as_rotvec()
    if key == "inertia_kg_m2":
        values = values[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return np.atleast_1d(values)


def summary_rows(estimates: Iterable[ShownEstimate]) -> list[Row]:
    """Return the rows of a summary. The gravity force is left out, because it follows from mass and tilt."""
    rows = list[Row]()
    for label, factor, unit, key, values, sigmas, known in estimates:
        if key == "gravity_force_base_N":
            continue
        cells = [
            f"{to_place_of(factor * value, 0.0)} fixed" if is_known else with_sigma(factor * value, factor * sigma)
            for value, sigma, is_known in zip(values, sigmas, known, strict=True)
        ]
        if key == "tilt_beta_rad":  # beta is shown in the row of alpha
            rows[-1] = Row("base tilt alpha, beta", [*rows[-1].cells, *cells], unit)
        elif key == "inertia_kg_m2":
            rows += [
                Row("inertia xx, yy, zz", cells[:3], unit),
                Row("inertia xy, xz, yz", cells[3:], unit),
            ]
        else:
            rows.append(Row(f"{label} x, y, z" if len(cells) == 3 else label, cells, unit))
    return rows


def data_frame(columns: Mapping[str, ArrayLike]) -> Any:
    """Return named columns as a pandas DataFrame, or as a Polars one if pandas is not installed.

    Raises
    ------
    UsageError
        Neither pandas nor Polars is installed.
    """
    for name in ("pandas", "polars"):
        try:
            return import_module(name).DataFrame(dict(columns))
        except ModuleNotFoundError as error:
            if error.name != name:  # re-raised: the package is installed, but a dependency is missing
                raise
    raise UsageError("a DataFrame needs pandas or Polars, but neither is installed: run pip install pandas")


def wrench_figure(
    x: Array,
    wrench: Array,
    *,
    label: str,
    title: str,
    sigma: Array | None = None,
    marked: Array | None = None,
    points: bool = False,
) -> Any:
    """Return a matplotlib Figure of forces above torques, which a notebook shows and `savefig` writes.

    Parameters
    ----------
    x : array, shape (n,)
    wrench : array, shape (n, 6)
        N and N·m.
    label, title : str
        Label of the x axis, and title of the figure.
    sigma : array, shape (6,) or (n, 6), optional
        One standard deviation, drawn as a band: around the lines, or around zero if points are drawn.
    marked : array of bool, shape (n,), optional
        Points to mark as rejected.
    points : bool
        Whether to draw points instead of lines.

    Raises
    ------
    UsageError
        matplotlib is not installed.
    """
    try:
        base = import_module("matplotlib.figure").Figure
    except ImportError:
        raise UsageError("a figure needs matplotlib, which is not installed: run pip install matplotlib") from None

    class Shown(base):  # type: ignore[misc, valid-type]  # the base class is imported above
        """Figure that a notebook displays without pyplot, which would display it twice."""

        def _repr_png_(self) -> bytes:
            self.savefig(written := BytesIO(), format="png")
            return written.getvalue()

    figure = Shown(figsize=(7.5, 4.5), layout="constrained")
    both = figure.subplots(2, 1, sharex=True)
    bands = np.zeros_like(wrench) if sigma is None else np.broadcast_to(sigma, wrench.shape)
    for k, (axes, scale, unit) in enumerate(zip(both, (1.0, 1e3), ("force, N", "torque, mN·m"), strict=True)):
        for j in range(3):
            values, band = scale * wrench[:, 3 * k + j], scale * bands[:, 3 * k + j]
            (line,) = axes.plot(x, values, "osD"[j] if points else "-", markersize=4, linewidth=1, label="xyz"[j])
            if sigma is not None:
                middle = 0.0 if points else values
                axes.fill_between(x, middle - band, middle + band, color=line.get_color(), alpha=0.15, linewidth=0)
            if marked is not None and marked.any():
                axes.plot(x[marked], values[marked], "x", color="red", markersize=9, label="rejected" * (j == 2))
        axes.axhline(0, color="gray", linewidth=0.8)
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
    both[0].legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    both[0].set_title(title, loc="left", fontsize="medium")
    both[1].set_xlabel(label)
    return figure
