"""The sets of orientations A to H of Yu, Shi, Lou 2021 (Fig. 6), by which the cases of Table III are named.

The figure gives kinds and counts, no numbers. A is the paper's own; the others are drawn here, always alike. The
limited workspace of E is that of a tool that points forwards and down: its axis (flange z) within 60° of the
direction halfway between straight down and forwards. F is on the opposite side, backwards and down.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.poses.information import special

COUNTS: Mapping[str, int] = {"A": 24, "B": 12, "C": 12, "D": 150, "E": 24, "F": 24, "G": 48, "H": 12}
"""Orientations of each set. H is the first half of E."""
EVERY_SET = "A+B+C+D+E+F+G"
"""What Table III needs."""
_HALF_ANGLE_RAD = np.pi / 3
_SIDES = {"E": 1.0, "F": -1.0, "G": 1.0, "H": 1.0}


def paper_set(name: str, *, spare: int = 0, down_base: ArrayLike = (0.0, 0.0, -1.0)) -> Array:
    """Return the orientations of one set.

    Parameters
    ----------
    name : str
        A to H.
    spare : int
        More orientations of the same kind, for an arm that cannot reach each of them; A has none.
    down_base : array_like, shape (3,)
        Direction of gravity in base, a unit vector: forwards is base x, or base z where gravity is along x.

    Returns
    -------
    array, shape (n, 3, 3)
        R_base_flange.

    Raises
    ------
    ValueError
        There is no such set.

    Examples
    --------
    >>> from ftcalib.poses.paper_sets import paper_set
    >>> paper_set("E").shape
    (24, 3, 3)
    """
    if name not in COUNTS:
        raise ValueError(f"there is no set {name}: choose {', '.join(COUNTS)}")
    if name == "A":
        return special(range(1, 25))
    count, rng = COUNTS[name] + spare, np.random.default_rng(ord("E" if name == "H" else name))
    if name not in _SIDES:
        return np.asarray(Rotation.random(count, rng=rng).as_matrix())
    down = np.asarray(down_base, dtype=np.float64)
    forwards = np.eye(3)[0 if abs(down[0]) < 0.9 else 2]
    forwards -= forwards @ down * down
    axis = down + _SIDES[name] * forwards / np.linalg.norm(forwards)
    drawn = Rotation.random(8 * count + 100, rng=rng).as_matrix()  # a quarter of all directions is inside
    inside = drawn[:, :, 2] @ axis / np.linalg.norm(axis) >= np.cos(_HALF_ANGLE_RAD)
    return np.asarray(drawn[inside][:count])


def names_of(sets: str) -> Sequence[str]:
    """Split the names in "A+E". Raises `ValueError` for an unknown set, a repeated one, or E and its half H."""
    names = sets.split("+")
    if unknown := [name for name in names if name not in COUNTS]:
        raise ValueError(f"there is no set '{unknown[0]}': choose {', '.join(COUNTS)}, or several as A+E")
    if len(set(names)) < len(names) or {"E", "H"} <= set(names):
        raise ValueError(f"{sets} contains a set twice (H is the half of E): leave one of them out")
    return names


def numbers_of(name: str) -> NDArray[np.intp]:
    """Return the numbers of the poses of one set: those of the paper for A, 1001 to 1012 for B, from 2001 on for C."""
    return np.arange(1, COUNTS[name] + 1) + 1000 * "ABCDEFG".index("E" if name == "H" else name)
