"""Forward kinematics of the chain between two links of a URDF. Ref: wiki.ros.org/urdf/XML/joint."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.errors import BadUrl
from ftdrivers.interfaces import Array

_MOVES: Final = ("revolute", "continuous", "prismatic")


class _Joint(NamedTuple):
    name: str
    kind: str
    parent: str
    R: Array
    p: Array
    axis: Array


class Chain:
    """The joints from a base to a flange.

    Parameters
    ----------
    path : Path
        A URDF, with xacro already evaluated.
    base, flange : str
        Links; an empty base is the root.

    Raises
    ------
    BadUrl
        The file is no URDF, a link does not exist, or the flange is not below the base.
    """

    def __init__(self, path: Path, base: str, flange: str) -> None:
        try:
            root = ET.fromstring(path.read_text(encoding="utf-8"))  # of the user's own disk
        except (OSError, UnicodeDecodeError, ET.ParseError) as error:
            raise BadUrl(f"{path} is not a URDF ({error}): give the file with xacro evaluated") from error
        joints = {}
        try:
            for element in root.iter("joint"):
                if (child := element.find("child")) is not None:
                    joints[child.attrib["link"]] = _joint(element)
        except (KeyError, ValueError, TypeError) as error:
            raise BadUrl(f"{path}: a joint cannot be read ({error!r}): correct the URDF") from error
        links = [link.attrib.get("name", "") for link in root.iter("link")]
        for link in (flange, *([base] if base else [])):
            if link not in links:
                near = get_close_matches(link, links, 1)
                hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(links[:20])}"
                raise BadUrl(f"{path} has no link {link!r}: {hint}")
        self._joints: list[_Joint] = []
        link = flange
        while link != base and link in joints and len(self._joints) <= len(joints):
            self._joints.insert(0, joints[link])
            link = joints[link].parent
        if base and link != base:
            raise BadUrl(f"{path}: {flange} is not below {base}: exchange base and flange, or give another base")
        self.names = [joint.name for joint in self._joints if joint.kind in _MOVES]
        if not self.names:
            raise BadUrl(f"{path}: no joint moves between {base or link} and {flange}: give other links")

    def poses(self, positions: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return orientations (n, 3, 3) and origins (n, 3) of the flange in the base.

        `positions` has the joint positions (n,) by name, rad or m.
        """
        n = len(positions[self.names[0]])
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for joint in self._joints:
            p = p + R @ joint.p
            R = R @ joint.R
            if joint.kind == "prismatic":
                p = p + np.einsum("nij,nj->ni", R, np.outer(positions[joint.name], joint.axis))
            elif joint.kind in _MOVES:
                R = R @ Rotation.from_rotvec(np.outer(positions[joint.name], joint.axis)).as_matrix()
        return R, p


def _joint(element: ET.Element) -> _Joint:
    origin, axis, parent = element.find("origin"), element.find("axis"), element.find("parent")
    place = {} if origin is None else origin.attrib
    kind = element.attrib["type"]
    if kind not in (*_MOVES, "fixed"):
        raise ValueError(f"joint {element.attrib['name']} is {kind}")
    direction = _numbers("1 0 0" if axis is None else axis.attrib["xyz"])
    if parent is None:
        raise ValueError(f"joint {element.attrib['name']} has no parent")
    return _Joint(
        element.attrib["name"],
        kind,
        parent.attrib["link"],
        Rotation.from_euler("xyz", _numbers(place.get("rpy", "0 0 0"))).as_matrix(),
        _numbers(place.get("xyz", "0 0 0")),
        direction / np.linalg.norm(direction),
    )


def _numbers(text: str) -> Array:
    found = np.array([float(word) for word in text.split()])
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{text!r} is not three numbers")
    return found
