"""A DataFrame and a figure of numbers, with packages that only these need: pandas or Polars, and matplotlib."""

from collections.abc import Mapping
from importlib import import_module
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.errors import UsageError
from ftcalib.model import Array


def frame_of(columns: Mapping[str, ArrayLike]) -> Any:
    """Return columns by name as a DataFrame of pandas, else of Polars.

    Raises
    ------
    UsageError
        Neither of the two is installed.
    """
    for name in ("pandas", "polars"):
        try:
            return import_module(name).DataFrame(dict(columns))
        except ModuleNotFoundError as error:
            if error.name != name:  # it is there, but what it needs is not
                raise
    raise UsageError("a DataFrame needs pandas or Polars, and neither is installed: pip install pandas")


def figure_of(
    x: Array,
    wrench: Array,
    *,
    label: str,
    title: str,
    sigma: Array | None = None,
    marked: Array | None = None,
    points: bool = False,
) -> Any:
    """Draw forces above torques, and return the Figure, which a notebook shows and `savefig` writes.

    Parameters
    ----------
    x : array, shape (n,)
    wrench : array, shape (n, 6)
        N and N·m.
    label, title : str
        Of `x`, and of the figure.
    sigma : array, shape (6,) or (n, 6), optional
        One standard deviation: of a line a band around it, of points a band around zero.
    marked : array of bool, shape (n,), optional
        Points to mark as rejected.
    points : bool
        Draw points instead of lines.

    Raises
    ------
    UsageError
        matplotlib is not installed.
    """
    try:
        base = import_module("matplotlib.figure").Figure
    except ImportError:
        raise UsageError("a figure needs matplotlib, which is not installed: pip install matplotlib") from None

    class Shown(base):  # type: ignore[misc, valid-type]  # known only here
        """A figure that a notebook shows without pyplot, which would show it twice."""

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
