"""A wrench in three dimensions: the frames of the arm and two arrows, as Foxglove messages."""

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    FrameTransform,
    FrameTransforms,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from ftdrive.live import ros2
from ftdrive.live.frames import frames_in_flange
from ftdrive.live.quaternions import quaternions
from ftdrive.live.samples import Block, StreamInfo
from ftdrivers.interfaces import Array

FORCE_M_N, TORQUE_M_NM = 0.01, 0.1
"""Lengths of the arrows: 10 N and 1 N·m are 100 mm."""
_ORANGE, _BLUE = Color(r=1.0, g=0.5, b=0.0, a=1.0), Color(r=0.1, g=0.4, b=1.0, a=1.0)
_HEAD_M = 0.02


def stamp(t_utc_ns: int) -> Timestamp:
    """Convert nanoseconds since 1970."""
    return Timestamp(*divmod(t_utc_ns, 1_000_000_000))


def transforms(block: Block, info: StreamInfo, t_utc_ns: int) -> FrameTransforms:
    """Return the frames of the last sample of a block: flange in base; sensor, tcp and the wrench's frame in flange."""
    R_base_flange = block.R_base_flange[-1]
    frames = frames_in_flange(block.frame, info, R_base_flange)
    return FrameTransforms(
        transforms=[
            _transform("base", "flange", R_base_flange, block.p_base_flange_m[-1], t_utc_ns),
            *(_transform("flange", name, R, p, t_utc_ns) for name, (R, p) in frames.items()),
        ]
    )


def _transform(parent: str, child: str, R: Array, p_m: Array, t_utc_ns: int) -> FrameTransform:
    x, y, z = np.nan_to_num(p_m).tolist()
    return FrameTransform(
        timestamp=stamp(t_utc_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(**dict(zip("xyzw", quaternions(R[None])[0].tolist(), strict=True))),
    )


def arrows(block: Block, t_utc_ns: int) -> SceneUpdate:
    """Return force (orange) and torque (blue) of the last sample, in the frame of the wrench, from its point."""
    force_N, torque_Nm = block.wrench[-1, :3], block.wrench[-1, 3:]
    entity = SceneEntity(
        timestamp=stamp(t_utc_ns),
        frame_id=ros2.frame_id(block.frame),
        id="wrench",
        frame_locked=True,
        arrows=[_arrow(FORCE_M_N * force_N, _ORANGE), _arrow(TORQUE_M_NM * torque_Nm, _BLUE)],
    )
    return SceneUpdate(entities=[entity])


def _arrow(vector_m: Array, color: Color) -> ArrowPrimitive:
    length_m = float(np.linalg.norm(vector_m))
    # An arrow points along x. Half a turn about the bisector of x and a direction swaps the two.
    bisector = np.array([1.0, 0.0, 0.0]) + (vector_m / length_m if length_m > 0 else 0.0)
    half_turn = bisector / norm if (norm := np.linalg.norm(bisector)) > 1e-9 else np.array([0.0, 0.0, 1.0])
    orientation = Quaternion(**dict(zip("xyz", half_turn.tolist(), strict=True)), w=0.0)
    head_m = min(_HEAD_M, length_m / 2)
    return ArrowPrimitive(
        pose=Pose(position=Vector3(), orientation=orientation),
        shaft_length=length_m - head_m,
        shaft_diameter=0.4 * _HEAD_M,
        head_length=head_m,
        head_diameter=0.8 * _HEAD_M,
        color=color,
    )
