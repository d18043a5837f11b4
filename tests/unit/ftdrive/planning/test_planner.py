"""Impossible cells are refused with a reason, and possible ones are not."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.cell.rules import Rows
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import SHAPES, ArmModel, Cylinder, separation_from_box
from ftdrive.planning.geometry.certify import Margins
from ftdrive.planning.planner import box_from_mm, certifier_for, plane_from_mm, require_possible

Row = Sequence[float]
SHOULDER = 1


def cell(planes: Sequence[Row] = (), boxes: Sequence[Row] = (), tool: Rows = ((0, 60, 90),)) -> CellConfig:
    workcell = WorkcellConfig(planes_mm=tuple(map(tuple, planes)), boxes_mm=tuple(map(tuple, boxes)))
    return CellConfig(RobotConfig(""), SensorConfig("", height_mm=33), ToolConfig(cylinders_mm=tool), workcell)


@given(
    st.sampled_from(list(SHAPES)),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda normal: np.linalg.norm(normal) > 0.1),
    st.floats(-400, 400),
    st.tuples(*[st.floats(-400, 400)] * 6).filter(lambda box: all(abs(box[i] - box[i + 3]) > 1 for i in range(3))),
)
def test_refused_is_just_what_the_shoulder_is_never_clear_of(
    model: str, normal: tuple[float, ...], place: float, box: tuple[float, ...]
) -> None:
    """By the bodies and distances that judge moves."""
    arm = ArmModel(model, [Cylinder(0.0, 0.06, 0.09)])
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (40, 6))
    shoulder = arm.bodies(q).at(np.arange(40), np.full(40, SHOULDER))
    plane, block = plane_from_mm((*normal, place)), box_from_mm(box)
    to_plane = shoulder.height_above(np.array(plane.normal), plane.offset_m).max()
    to_box = separation_from_box(shoulder, np.array(block.low_m), np.array(block.high_m), np.full(40, np.inf)).max()
    for described, distance_m in ((cell(planes=[(*normal, place)]), to_plane), (cell(boxes=[box]), to_box)):
        try:
            require_possible(described, model)
        except ConfigError:
            assert distance_m < Margins().scene_m
        else:
            assert distance_m > 0


def test_a_tool_that_ends_before_its_sensor_is_refused() -> None:
    require_possible(cell(tool=((0, 20, 80), (20, 33, 80))), "ur5e")
    with pytest.raises(ConfigError, match=r"20 mm .* 33 mm"):
        certifier_for(cell(tool=((0, 20, 10),)), "ur5e")
