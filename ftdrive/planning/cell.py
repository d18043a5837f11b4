"""From a cell as its configuration describes it, in millimetres, to what judges moves in it."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.planning.arm_model import ArmModel, Cylinder
from ftdrive.planning.certify import Certifier
from ftdrive.planning.scene import BASE_PLANE, Box, Plane, Scene, lean_of


class Tool(Protocol):
    """What the flange carries."""

    @property
    def cylinders_mm(self) -> Sequence[Sequence[float]]:
        """From, to, diameter, and x, y where the axis stands aside."""


class Workcell(Protocol):
    """What stands around the arm."""

    @property
    def mounting(self) -> str:
        """floor, wall, ceiling, or degrees about base y."""

    @property
    def planes_mm(self) -> Sequence[Sequence[float]]:
        """Normal in base axes, and the least offset along it. The mounting surface is known without."""

    @property
    def boxes_mm(self) -> Sequence[Sequence[float]]:
        """Two corners in base axes."""


class Cell(Protocol):
    """The parts of a cell's configuration that a plan depends on."""

    @property
    def tool(self) -> Tool:
        """What the flange carries."""

    @property
    def workcell(self) -> Workcell:
        """What stands around the arm."""


def certifier_for(cell: Cell, model: str) -> Certifier:
    """Describe arm, tool and surroundings of a cell to the certifier.

    Whether somebody has measured them is not asked here.

    Parameters
    ----------
    cell : CellConfig
    model : str
        Of the arm, as the controller or the configuration tells it.

    Raises
    ------
    ConfigError
        The tool is empty, a shape is impossible, or the arm has no measured shape.
    """
    planes = (BASE_PLANE, *map(plane_from_mm, cell.workcell.planes_mm))
    scene = Scene(planes, tuple(map(box_from_mm, cell.workcell.boxes_mm)), lean_of(cell.workcell.mounting))
    return Certifier(ArmModel(model, [cylinder_from_mm(values) for values in cell.tool.cylinders_mm]), scene)


def cylinder_from_mm(values: Sequence[float]) -> Cylinder:
    """Read from, to, diameter, and x, y of an axis that stands aside."""
    return Cylinder(*_metres("a cylinder of the tool", "from, to, diameter, or these and x, y", values, (3, 5)))


def plane_from_mm(values: Sequence[float]) -> Plane:
    """Read a normal of any length, and the least offset along it."""
    *normal, offset_m = _metres("a plane", "its normal and an offset", values, (4,))
    length = float(np.linalg.norm(normal))
    if not length:
        raise ConfigError(f"a plane is {list(values)}: its normal has no direction, give for example -1, 0, 0, -800")
    x, y, z = (value / length for value in normal)
    return Plane((x, y, z), offset_m)


def box_from_mm(values: Sequence[float]) -> Box:
    """Read any two opposite corners."""
    corners = np.array(_metres("a box", "two opposite corners", values, (6,))).reshape(2, 3)
    (x1, y1, z1), (x2, y2, z2) = np.sort(corners, axis=0).tolist()
    return Box((x1, y1, z1), (x2, y2, z2))


def _metres(what: str, content: str, values: Sequence[float], counts: Sequence[int]) -> list[float]:
    if len(values) not in counts or not all(map(np.isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{what} is {list(values)}: give {wanted} numbers, {content}, in mm")
    return [float(value) / 1e3 for value in values]
