"""`UrArm` with every generation of controllers: CB3, PolyScope 5 from the oldest that ur_rtde controls, PolyScope X."""

import threading
from collections.abc import Callable
from contextlib import closing
from math import radians

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault, ModelUnknown
from ftdrivers.interfaces import NOT_REPORTED
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.kinematics import forward, kinematics_of
from tests.wire.conftest import TIME_SCALE, Station
from tests.wire.moves import no_guard

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("polyscope", "model"),
    [
        ("3.15.8", "UR5"),
        ("5.4.0", "UR3e"),
        ("5.9.4", "UR5e"),
        ("5.26.0", "UR30"),
        ("10.11.0", "UR20"),
        ("10.14.0", "UR5e"),
    ],
)
def test_open_state_move_stop_limits_close(start_station: Callable[..., Station], polyscope: str, model: str) -> None:
    tcp = "0.1,-0.02,0.25,0.3,-1.2,0.7"
    station = start_station(
        "--time-scale",
        str(TIME_SCALE),
        "--polyscope",
        polyscope,
        "--model",
        model,
        "--tcp",
        tcp,
        "--joint-limit-deg",
        "170",
    )
    old = polyscope == "5.4.0"
    if old:
        with pytest.raises(ModelUnknown, match="does not report its model"):
            station.arm().open()
    with closing(station.arm(model=model if old else None)) as arm:
        use(arm, station, polyscope, model, tcp)
    left = station.ask("state")
    assert left["runtime_state"] == "STOPPED"
    assert left["bad_inputs"] == []
    station.kill()


@pytest.mark.parametrize(
    ("options", "model", "refused"),
    [
        (("--kinematics-message", "none"), None, None),
        (("--kinematics-message", "wrong"), None, "kinematics sent by the controller: the two disagree"),
        (("--model", "UR10e", "--polyscope", "5.4.0"), "UR5e", "the arm is another model, probably a UR10e"),
    ],
)
def test_an_arm_without_kinematics_is_read_and_another_one_is_refused(
    start_station: Callable[..., Station], options: tuple[str, ...], model: str | None, refused: str | None
) -> None:
    station = start_station(*options)
    with closing(station.arm(model=model)) as arm:
        if refused is None:
            arm.open()
            assert kinematics_of(arm.identify()) is None
            arm.state()
        else:
            with pytest.raises(ConnectError, match=refused):
                arm.open()
    station.kill()


def use(arm: UrArm, station: Station, polyscope: str, model: str, tcp: str) -> None:
    old = polyscope == "5.4.0"
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
    assert arm.in_remote_control() is (None if old or polyscope in ("3.15.8", "10.11.0") else True)
    assert (arm.identify().serial == NOT_REPORTED) == (polyscope in ("5.4.0", "10.11.0"))

    q = arm.state().q_rad
    q[5] += -0.5 if q[5] > 0.5 else 0.5
    assert arm.within_safety_limits(q.tolist())
    assert not arm.within_safety_limits([*q[:5], radians(175)])
    arm.move_to(q.tolist(), timeout_s=30, guard=no_guard)
    arm.wait_until_still(timeout_s=30, guard=no_guard)
    state = arm.state()
    assert np.allclose(state.q_rad, q, atol=1e-4)
    own = kinematics_of(arm.identify())
    assert own is not None
    flange = forward(own, q)
    assert np.allclose(state.R_base_flange, flange.R, atol=1e-4)
    assert np.allclose(state.p_base_flange_m, flange.p_m, atol=1e-4)

    q[5] += 1.5 if q[5] < 0.5 else -1.5

    def stop_on_the_way() -> None:
        if not stopping.is_alive() and abs(arm.state().q_rad[5] - q[5]) < 1.3:
            stopping.start()

    stopping = threading.Thread(target=arm.stop)
    with pytest.raises(DeviceFault, match="stop was requested"):
        arm.move_to(q.tolist(), timeout_s=30, guard=stop_on_the_way)
    stopping.join()
    assert not station.ask("state")["moving"]
    assert abs(arm.state().q_rad[5] - q[5]) > 0.3
