"""`UrArm` with every generation of controllers: CB3, and PolyScope 5 from the oldest that ur_rtde controls."""

import threading
from collections.abc import Callable
from math import radians
from typing import Any, Protocol

import numpy as np
import pytest

from drivers.errors import ConnectError, DeviceFault
from drivers.ur.arm import UrArm
from drivers.ur.kinematics import MODELS, forward

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")


class Station(Protocol):
    """What the tests use of the emulator's process."""

    host: str

    def do(self, verb: str, /, **how: object) -> dict[str, Any]: ...

    def close(self) -> None: ...


def no_guard() -> None:
    pass


@pytest.mark.parametrize(
    ("polyscope", "model"),
    [
        ("3.15.8", "UR5"),
        ("5.4.0", "UR3e"),
        ("5.9.4", "UR5e"),
        ("5.10.2", "UR10e"),
        ("5.15.0", "UR16e"),
        ("5.23.0", "UR20"),
        ("5.26.0", "UR30"),
    ],
)
def test_open_state_move_stop_limits_close(start_station: Callable[..., Station], polyscope: str, model: str) -> None:
    tcp = "0.1,-0.02,0.25,0.3,-1.2,0.7"
    station = start_station(
        "--time-scale", "4", "--polyscope", polyscope, "--model", model, "--tcp", tcp, "--joint-limit-deg", "170"
    )
    old = polyscope == "5.4.0"
    if old:
        with pytest.raises(ConnectError, match=r"could not understand.*name the model"):
            UrArm(station.host).open()
    arm = UrArm(station.host, model=model if old else None, speed_rad_s=radians(30), acceleration_rad_s2=radians(100))
    arm.open(control=True)
    assert arm.identify().model == model
    assert arm.identify().firmware.startswith(polyscope)

    status = arm.status()
    assert (status.robot_mode, status.safety_mode, status.program, status.fault) == (
        "running",
        "normal",
        "playing",
        None,
    )
    assert status.tcp_offset == pytest.approx([float(value) for value in tcp.split(",")])
    assert (status.payload_kg is None) == (status.p_flange_payload_m is None) == old
    assert arm.in_remote_control() is (None if old or polyscope.startswith("3") else True)

    q = arm.state().q_rad
    q[5] += -0.5 if q[5] > 0.5 else 0.5
    assert arm.within_safety_limits(q.tolist())
    assert not arm.within_safety_limits([*q[:5], radians(175)])
    arm.move_to(q.tolist(), timeout_s=10, guard=no_guard)
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    state = arm.state()
    assert np.allclose(state.q_rad, q, atol=1e-4)
    nominal = forward(MODELS[model], q)
    assert np.allclose(state.R_base_flange, nominal.R, atol=1e-4)
    assert np.allclose(state.p_base_flange_m, nominal.p_m, atol=1e-4)

    q[5] += 1.5 if q[5] < 0.5 else -1.5

    def stop_on_the_way() -> None:
        if not stopping.is_alive() and abs(arm.state().q_rad[5] - q[5]) < 1.3:
            stopping.start()

    stopping = threading.Thread(target=arm.stop)
    with pytest.raises(DeviceFault, match="told to stop"):
        arm.move_to(q.tolist(), timeout_s=10, guard=stop_on_the_way)
    stopping.join()
    assert not station.do("state")["moving"]
    assert abs(arm.state().q_rad[5] - q[5]) > 0.3
    arm.close()
    left = station.do("state")
    assert left["runtime_state"] == "STOPPED"
    assert left["bad_inputs"] == []
    station.close()


@pytest.mark.parametrize(
    ("polyscope", "control", "says"),
    [
        ("5.3.0", True, r"PolyScope 5\.3, which ur_rtde cannot control; update it to 5\.4"),
        ("10.7.0", False, "runs PolyScope X .*PolyScope 5 or the CB3 generation is needed"),
    ],
)
def test_versions_that_cannot_be_used(
    start_station: Callable[..., Station], polyscope: str, control: bool, says: str
) -> None:
    station = start_station("--polyscope", polyscope)
    with pytest.raises(ConnectError, match=says):
        UrArm(station.host, model="UR5e").open(control=control)
    assert station.do("state")["runtime_state"] == "STOPPED"
    station.close()
