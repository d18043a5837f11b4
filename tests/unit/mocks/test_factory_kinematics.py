"""Arms as factories make them: spread, conversion to Denavit-Hartenberg parameters, and what uses them."""

import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from ftmocks.factory_kinematics import read
from ftmocks.kinematics import inverse
from ftmocks.station import kinematics_from
from ftmocks.ur import primary
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.world import Truth, World
from tests.real_arms import RealArm, real_arms
from tests.unit.mocks.ur.primary_decoder import decoded
from tests.unit.mocks.ur.urscript_robot import HOME

ARMS = real_arms()
a_real_arm = pytest.mark.parametrize(
    "arm",
    ARMS or [pytest.param(None, marks=pytest.mark.skip(reason="FTDRIVE_REAL_DATA is not set"))],
    ids=[f"{arm.number}-{arm.model}" for arm in ARMS] or ["none"],
)


@a_real_arm
def test_an_emulated_arm_has_the_kinematics_of_a_real_one(arm: RealArm, tmp_path: Path) -> None:
    path = arm.save(tmp_path)
    dh = kinematics_from(Namespace(kinematics=str(path), model=None, polyscope=(5, 15, 0), seed=0))
    robot = Robot(World(Truth.drawn(0), dh, HOME, 0), RobotSettings(model=dh.model))
    np.testing.assert_allclose(robot.tcp_pose("target")[:3], arm.flange(np.array(HOME))[:3, 3], atol=1e-9)
    reported = decoded(primary.state_package(robot, complete=True))["kinematics"]
    given = json.loads(path.read_text(encoding="utf-8"))
    assert {name: reported[name] for name in arm.dh()} == {name: given[name] for name in arm.dh()}
    near = [0.01 + v for v in HOME]
    assert inverse(dh, arm.flange(np.array(HOME)), near) == pytest.approx(HOME, abs=1e-8)


def test_a_file_of_another_model_than_the_option_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "arm.json"
    path.write_text(json.dumps({"model": "UR3e", **dict.fromkeys(("theta", "a", "d", "alpha"), [0.1] * 6)}))
    with pytest.raises(ValueError, match="UR3e"):
        kinematics_from(Namespace(kinematics=str(path), model="UR5e", polyscope=(5, 15, 0), seed=0))
    path.write_text('{"model": "UR3e", "theta": [1]}')
    with pytest.raises(ValueError, match="cannot read kinematics"):
        read(path)
