"""Payload and gravity of an emulated controller on the wire: what it starts with, and who changes it."""

import struct
from collections.abc import Iterator

import numpy as np
import pytest

from ftmocks.ur import rtde
from tests.wire.rtde_socket import RtdeSocket
from tests.wire.station_process import StationProcess
from tests.wire.waiting import wait_until

OPTIONS = ("--polyscope", "5.26", "--mount", "wall", "--time-scale", "20")
SENSOR = ("--sensor-mass-kg", "0.4", "--sensor-origin", "0,0.01,0.06")
CONTROL_SCRIPT = b"def rtde_control():\nend\n"
UPRIGHT = (0.0, 0.0, 9.82)


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    with StationProcess(*OPTIONS, *SENSOR) as cell:
        yield cell


class Settings:
    """Reads gravity and payload from the samples of one connection."""

    def __init__(self, client: RtdeSocket) -> None:
        self._client = client
        types = client.ask("O", struct.pack(">d", 100.0) + b"target_gravity,payload,payload_cog")
        assert types == b"\x01VECTOR3D,DOUBLE,VECTOR3D"
        assert client.ask("S") == b"\x01"

    def read(self) -> dict[str, rtde.Value]:
        """The next sample."""
        recipe = rtde.Recipe(1, ["gravity", "kg", "cog_m"], ["VECTOR3D", "DOUBLE", "VECTOR3D"])
        while (package := self._client.answer())[2:3] != b"U":
            pass
        return recipe.unpack(package[4:])

    def become(self, gravity: tuple[float, float, float]) -> None:
        """Wait for a gravity."""
        wait_until(lambda: self.read()["gravity"] == pytest.approx(gravity, abs=1e-12))


def test_the_controller_starts_with_its_mounting_and_the_true_payload(station: StationProcess) -> None:
    truth = station.hello["truth"]
    assert truth["sensor_mass_kg"] == 0.4
    tool_m = np.array(truth["p_flange_sensor_m"]) + np.array(truth["R_flange_sensor"]) @ truth["p_sensor_com_m"]
    moment = truth["mass_kg"] * tool_m + 0.4 * np.array([0, 0.005, 0.03])
    with RtdeSocket(station.host) as client:
        found = Settings(client).read()
    assert found["gravity"] == pytest.approx((9.82, 0.0, 0.0), abs=1e-12)
    assert found["kg"] == truth["payload_kg"] == pytest.approx(truth["mass_kg"] + 0.4)
    np.testing.assert_allclose(found["cog_m"], truth["payload_cog_m"])
    np.testing.assert_allclose(moment / truth["payload_kg"], truth["payload_cog_m"])


def test_operator_program_and_command_59_set_gravity(station: StationProcess) -> None:
    with RtdeSocket(station.host) as client, station.connect(30002) as script:
        settings = Settings(client)
        station.ask("set-mounting", up=[0, 0, -2])
        settings.become((0.0, 0.0, -9.82))
        script.sendall(b"def upright():\n  set_gravity([0, 0, 9.82])\nend\n")
        settings.become(UPRIGHT)
        known = len(station.ask("state")["events"])
        script.sendall(CONTROL_SCRIPT)
        station.wait_for_event("started rtde_control", since=known)
        assert "PLAYING" in station.refusal("set-mounting", up=[1, 0, 0])
        names = [b"input_int_register_0", *(b"input_double_register_%d" % i for i in range(4))]
        assert client.ask("I", b",".join(names)) == b"\x01INT32" + b",DOUBLE" * 4
        client.send_package("U", b"\x01" + struct.pack(">i4d", 59, 1.0, 2.0, 9.5, 0.0))
        settings.become((1.0, 2.0, 9.5))
        station.ask("dashboard-stop")
        assert station.ask("state")["target_gravity_m_s2"] == [1.0, 2.0, 9.5], "it outlives the program"
