"""Payload and gravity of the controller: what is sent, what is refused before it is sent, and what is read."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import ControllerSettings
from ftdrivers.ur import controller_settings
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.controller_settings import read_controller_settings
from ftdrivers.ur.kinematics import MODELS, forward
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import HOST, Controller

INERTIA = (0.01, 0.02, 0.03, 0.0, -0.001, 0.0)


@pytest.fixture
def arm(controller: Controller) -> UrArm:
    arm = UrArm(HOST, clock=controller.clock)
    arm.open(control=True)
    controller.did.clear()
    return arm


# ------------------------------------------------------------------------------------------------------------- sending


def test_a_centre_in_the_flange_is_sent_so_that_it_counts(arm: UrArm, controller: Controller) -> None:
    arm.set_payload(0.5, (0.0, 0.0, 0.0))
    assert controller.did == ["payload 0.5 [1e-09, 0.0, 0.0] [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"]


@pytest.mark.parametrize("version", [(5, 9, 0, 1), (3, 15, 0, 1)])
def test_before_5_10_the_payload_has_no_inertia(
    arm: UrArm, controller: Controller, version: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.close()
    monkeypatch.setattr(Controller, "version", version)
    controller.kinematics = None
    controller.flange = partial(forward, MODELS["UR5" if version < (5,) else "UR5e"])
    arm.open(control=True)
    controller.did.clear()
    arm.set_payload(1.0, (0, 0, 0.05))
    assert controller.did == ["payload 1 [0.0, 0.0, 0.05]"]
    with pytest.raises(DeviceFault, match="does not accept the inertia"):
        arm.set_payload(1.0, (0, 0, 0.05), INERTIA)
    assert len(controller.did) == 1


@pytest.mark.parametrize(
    ("mass_kg", "com_m", "inertia", "says"),
    [
        (-0.1, (0, 0, 0.1), INERTIA, "mass_kg"),
        (float("nan"), (0, 0, 0.1), INERTIA, "mass_kg"),
        (1.0, (0, 0.1), INERTIA, "p_flange_com_m"),
        (1.0, (0, 0, float("inf")), INERTIA, "p_flange_com_m"),
        (1.0, (0, 0, 0.1), INERTIA[:3], "inertia_kg_m2"),
        (1.0, (0, 0, 0.1), (-0.01, *INERTIA[1:]), "inertia_kg_m2"),
        (1.0, (0, 0, 0.1), (134.0, *INERTIA[1:]), "inertia_kg_m2"),
    ],
)
def test_what_is_no_payload_is_not_sent(
    arm: UrArm, controller: Controller, mass_kg: float, com_m: Sequence[float], inertia: Sequence[float], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        arm.set_payload(mass_kg, com_m, inertia)
    assert not controller.did


@pytest.mark.parametrize("up", [(0, 0, 1.0), (0, 9.82), (0, 0, float("nan")), (0, 0, 98.2)])
def test_what_is_no_gravity_is_not_sent(arm: UrArm, controller: Controller, up: Sequence[float]) -> None:
    with pytest.raises(ValueError, match="up_base_m_s2"):
        arm.set_gravity(up)
    assert not controller.did


Send = Callable[[UrArm], None]
SENDS: tuple[Send, ...] = (lambda arm: arm.set_payload(1.0, (0, 0, 0.05)), lambda arm: arm.set_gravity((0, 0, 9.82)))


@pytest.mark.parametrize("send", SENDS)
def test_nothing_is_sent_to_an_arm_that_is_only_read(controller: Controller, send: Send) -> None:
    arm = UrArm(HOST, clock=controller.clock)
    arm.open()
    with pytest.raises(ConnectError, match="reading only"):
        send(arm)


@pytest.mark.parametrize("send", SENDS)
@pytest.mark.parametrize(
    ("fault", "says"),
    [({"safety_bits": 0b100}, "protective stop"), ({"program": 1}, "ended by itself"), ({"silent": True}, "stuck")],
)
def test_nothing_is_sent_to_an_arm_that_is_stopped_or_silent(
    arm: UrArm, controller: Controller, send: Send, fault: dict[str, Any], says: str
) -> None:
    for name, value in fault.items():
        setattr(controller, name, value)
    with pytest.raises((DeviceFault, DeviceTimeout), match=says):
        send(arm)
    assert not controller.did


@pytest.mark.parametrize("send", SENDS)
def test_nothing_is_sent_to_the_program_of_another(arm: UrArm, controller: Controller, send: Send) -> None:
    controller.hanging.add("tcp_offset")
    with pytest.raises(DeviceFault, match="another program"):
        send(arm)
    assert not controller.did


@pytest.mark.parametrize("send", SENDS)
def test_what_the_controller_does_not_confirm_is_an_error(arm: UrArm, controller: Controller, send: Send) -> None:
    controller.takes_settings = False
    with pytest.raises(DeviceFault, match="did not confirm"):
        send(arm)


# ------------------------------------------------------------------------------------------------------------- reading


class Stream:
    """The subscription, with these outputs."""

    def __init__(self, outputs: dict[str, Any], failure: Exception | None = None) -> None:
        self._outputs, self._failure = outputs, failure
        self.closed = False

    def read(self, timeout_s: float) -> list[bytes]:
        assert timeout_s > 0
        if self._failure:
            raise self._failure
        return [b"old", b"new"]

    def decode(self, samples: Sequence[bytes]) -> dict[str, NDArray[Any]]:
        assert samples == [b"new"]
        return {name: np.array([value]) for name, value in self._outputs.items()}

    def close(self) -> None:
        self.closed = True


def read(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> ControllerSettings:
    monkeypatch.setattr(controller_settings, "Subscription", lambda *_, **__: stream)
    return read_controller_settings(HOST, timeout_s=2.0, clock=FakeClock())


def test_everything_that_a_controller_reports_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    outputs = {
        "timestamp": 7.0,
        "payload": 1.442,
        "payload_cog": (0.01, 0.0, 0.08),
        "payload_inertia": INERTIA,
        "target_gravity": (0.0, 0.3, 9.81),
    }
    stream = Stream(outputs)
    assert read(stream, monkeypatch) == ControllerSettings(1.442, (0.01, 0.0, 0.08), INERTIA, (0.0, 0.3, 9.81))
    assert stream.closed


def test_a_control_process_that_hangs_is_an_error(arm: UrArm, controller: Controller) -> None:
    controller.hanging.add("set_payload")
    began_s = controller.clock.now_s()
    with pytest.raises((DeviceTimeout, StreamBroken)):
        arm.set_payload(1.0, (0, 0, 0.05))
    assert controller.clock.now_s() - began_s < 2.5


@pytest.mark.parametrize(("failure", "kind"), [(TimeoutError(), DeviceTimeout), (ConnectionResetError(), StreamBroken)])
def test_a_link_that_fails_is_an_error_of_the_device(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, kind: type[Exception]
) -> None:
    stream = Stream({}, failure)
    with pytest.raises(kind, match=HOST):
        read(stream, monkeypatch)
    assert stream.closed


def test_a_closed_arm_reads_nothing() -> None:
    with pytest.raises(ConnectError, match="not open"):
        UrArm(HOST).controller_settings()
