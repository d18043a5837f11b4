"""What the formulas of export targets share: the context, and how a file is read."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Context = Mapping[str, Any]
Data = tuple[Array, Array, Context]
"""R_base_flange, wrench and context of `evaluate`."""

R_TOOL0_FLANGE = Rotation.from_euler("xyz", [np.pi / 2, 0, np.pi / 2]).as_matrix().T
"""ur_description/urdf/ur_macro.xacro, joint `flange-tool0`: rpy = (pi/2, 0, pi/2)."""


def mounting(context: Context) -> tuple[Array, Array]:
    """Rotation and position of the sensor in the flange."""
    R, p = (np.asarray(context[key], dtype=np.float64) for key in ("R_flange_sensor", "p_flange_sensor_m"))
    return R, p


def context_bias(context: Context) -> Array:
    """(6,) force, torque."""
    return np.concatenate([context["force_bias_N"], context["torque_bias_Nm"]], dtype=np.float64)


def gravity_base(context: Context) -> Array:
    """(3,) in base, m/s2, pointing down."""
    return np.asarray(context.get("gravity_m_s2", [0.0, 0.0, -context["g_m_s2"]]), dtype=np.float64)


def in_sensor_axes(base: Array, R_base_flange: Array, context: Context) -> Array:
    """(n, 3) from (3,) in base."""
    return np.asarray(base @ (R_base_flange @ mounting(context)[0]))


def force_at(point: Array, force: Array) -> Array:
    """(n, 6) wrench about the origin of the forces (n, 3) at a point (3,)."""
    return np.hstack([force, np.cross(point, force)], dtype=np.float64)


def world_from_base(world_frame: str) -> Array:
    """(3, 3) `base_link` is UR's base turned by 180 deg about z; any other name is UR's base.

    ur_description/urdf/ur_macro.xacro, joint base_link-base_fixed_joint; names may have a prefix.
    """
    return np.diag([-1.0, -1.0, 1.0]) if world_frame.endswith("base_link") else np.eye(3)


def tool0_from(flange_frame: str) -> Array:
    """(3, 3) `flange` is ROS-Industrial's, x out of the flange; any other name is tool0. Names may have a prefix."""
    return R_TOOL0_FLANGE if flange_frame.endswith("flange") else np.eye(3)


def mapping(node: Any) -> Mapping[str, Any]:
    if not isinstance(node, Mapping):
        raise ValueError(f"expected a mapping, got {node!r}")  # noqa: TRY004 - what evaluate promises
    return node


def numbers(values: Any, count: int) -> Array:
    """As Python reads them: YAML 1.1 makes a string of 1e-05."""
    if len(values) != count or not all(type(value) in {int, float} for value in values):
        raise ValueError(f"expected {count} numbers, got {values!r}")
    return np.array(values, dtype=np.float64)


def doubles(values: Any, count: int) -> Array:
    """As rcl reads parameters of type double: no integers, but exponents without a point."""
    if len(values) != count or any(type(value) is int for value in values):
        raise ValueError(f"expected {count} doubles, got {values!r}")
    return np.array([float(value) for value in values])


def xyz(vector: Any) -> Array:
    return numbers([vector[axis] for axis in "xyz"], 3)


def six(parts: Mapping[str, Any], default: float) -> Array:
    """(6,) of `force: {x, y, z}`, `torque: {x, y, z}`."""
    return doubles([parts.get(part, {}).get(axis, default) for part in ("force", "torque") for axis in "xyz"], 6)


def mass_kg(value: Any) -> float:
    mass = float(numbers([value], 1)[0])
    if mass < 0:
        raise ValueError(f"the target rejects the mass {mass}")
    return mass


def split(values: str) -> Array:
    """Numbers between commas."""
    return np.array([float(value) for value in values.split(",") if value.strip()])


def transform_arguments(words: Sequence[str]) -> tuple[str, Array, Rotation]:
    """Return parent frame, position and rotation."""
    o = {key.removeprefix("--"): value for key, value in zip(words[::2], words[1::2], strict=True)}
    rotation = _unit([float(o[name]) for name in ("qx", "qy", "qz", "qw")])
    return o["frame-id"], np.array([float(o[axis]) for axis in "xyz"]), rotation


def _unit(xyzw: Sequence[float]) -> Rotation:
    if abs(np.linalg.norm(xyzw) - 1) > 1e-6:
        raise ValueError(f"the quaternion {xyzw} is not of unit length")
    return Rotation.from_quat(xyzw)
