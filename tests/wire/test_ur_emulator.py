"""The emulated UR controller on the wire: bytes of the RTDE guide, and a hand-written client."""

import math
import signal
import socket
import struct
from collections.abc import Iterator
from random import Random

import pytest

from ftmocks.ur import rtde
from ftmocks.ur.uploads import take_uploads
from ftmocks.ur.variables import INPUTS, OUTPUTS
from tests.wire.rtde_socket import RtdeSocket
from tests.wire.station_process import StationProcess
from tests.wire.waiting import LIMIT_S, wait_until

pytestmark = pytest.mark.slow  # every test needs a process of its own

OPTIONS = ("--time-scale", "20", "--plane", "0,0,1,0.2", "--payload", "0.7")


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    """A fast UR5e whose tool must stay above z = 0.2 m, shared by the tests that leave it as it is."""
    with StationProcess(*OPTIONS) as cell:
        yield cell


@pytest.fixture(scope="module")
def worn() -> Iterator[StationProcess]:
    """The same, for the tests that leave it in another state."""
    with StationProcess(*OPTIONS) as cell:
        yield cell


# -- codec ------------------------------------------------------------------------------------------------------------

CONTROL_OUTPUTS = [
    "timestamp", "robot_status_bits", "safety_status_bits", "runtime_state",
    *[f"output_int_register_{i}" for i in range(3)], *[f"output_double_register_{i}" for i in range(6)],
]  # fmt: skip


def test_packages_of_the_guide() -> None:
    recipe = rtde.Recipe(1, CONTROL_OUTPUTS, [OUTPUTS[name][0] for name in CONTROL_OUTPUTS])
    answer = rtde.package(rtde.SETUP_OUTPUTS, recipe.answer())
    assert answer.startswith(bytes.fromhex("005b4f01") + b"DOUBLE,UINT32,UINT32,UINT32,INT32,INT32,INT32,DOUBLE,")
    sample = recipe.pack([1.5, 1, 1, 2, 1, 0, 0, *[0.0] * 6])
    assert len(sample) == 84
    assert sample.startswith(bytes.fromhex("00545501 3ff8000000000000 00000001"))
    gravity = rtde.Recipe(2, ["target_gravity"], [OUTPUTS["target_gravity"][0]])
    assert gravity.answer() == b"\x02VECTOR3D"
    assert gravity.pack([(0.0, 0.0, 9.82)]) == bytes.fromhex(
        "001c5502 0000000000000000 0000000000000000 4023a3d70a3d70a4"
    )


@pytest.mark.parametrize(
    ("data", "names", "fields"),
    [
        ("00 08 55 04 000000ff", ["input_int_register_0"], {"input_int_register_0": 255}),
        (
            "00 28 55 07 00000011 3ff8000000000000 0000000000000000 0000000000000000 3fa999999999999a",
            ["input_int_register_0", *[f"input_double_register_{i}" for i in range(4)]],
            {"input_int_register_0": 17, "input_double_register_0": 1.5, "input_double_register_3": 0.05},
        ),
        (
            "00 14 55 13 00000022 4000000000000000 00000000",
            ["input_int_register_0", "input_double_register_0", "input_int_register_1"],
            {"input_int_register_0": 34, "input_double_register_0": 2.0, "input_int_register_1": 0},
        ),
        (
            "00 28 55 07 0000003b 0000000000000000 0000000000000000 4023a3d70a3d70a4 0000000000000000",
            ["input_int_register_0", *[f"input_double_register_{i}" for i in range(4)]],
            {"input_int_register_0": 59, "input_double_register_1": 0.0, "input_double_register_2": 9.82},
        ),
    ],
    ids=["stopScript", "setPayload", "stopJ", "setGravity"],
)
def test_commands_as_ur_rtde_sends_them(data: str, names: list[str], fields: dict[str, float]) -> None:
    ((kind, payload),) = rtde.take_packages(bytearray(bytes.fromhex(data)))
    recipe = rtde.Recipe(payload[0], names, [INPUTS[name] for name in names])
    assert kind == rtde.DATA
    assert len(payload) == 1 + recipe.size
    assert recipe.unpack(payload[1:]).items() >= fields.items()


def test_a_package_smaller_than_its_header_is_an_error() -> None:
    with pytest.raises(rtde.RtdeError, match="2 bytes"):
        list(rtde.take_packages(bytearray(b"\x00\x02V")))


def test_programs_are_cut_at_end_in_column_zero() -> None:
    control = "def rtde_control():\n# float register offset\n24    x\n    if a:\n    end\nend\n"
    text = f"sec note():\n  textmsg(1)\nend\n\nstopj(2.0)\n{control}"
    buffer = bytearray(text.encode())
    tail = bytearray()
    found = []
    for byte in bytes(buffer):
        tail.append(byte)
        found += take_uploads(tail)
    assert [(u.name, u.secondary) for u in found] == [("note", True), ("statement", False), ("rtde_control", False)]
    assert (found[2].register_offset("float"), found[2].register_offset("int")) == (24, 0)


# -- a hand-written client --------------------------------------------------------------------------------------------


def test_handshake_bytes(station: StationProcess) -> None:
    with RtdeSocket(station.host) as client:
        client.send("00 05 56 00 02")
        assert client.answer() == bytes.fromhex("00045601")
        client.send("00 03 76")
        assert client.answer()[:15] == bytes.fromhex("001376 00000005 0000000f 00000000")
        names = ",".join(CONTROL_OUTPUTS) + ","
        assert len(names) + 11 == 0x120
        client.send_package("O", struct.pack(">d", 500.0) + names.encode())
        assert client.answer()[:4] == bytes.fromhex("005b4f01")
        client.send_package("S")
        assert client.answer() == bytes.fromhex("00045301")
        first, second = client.answer(), client.answer()
        assert len(first) == 84
        stamps = [struct.unpack_from(">d", sample, 4)[0] for sample in (first, second)]
        assert stamps[1] > stamps[0]


def test_every_documented_variable_can_be_read_and_unknown_ones_are_named(station: StationProcess) -> None:
    with RtdeSocket(station.host) as client:
        newer = {"actual_current_as_torque", "target_gravity"}
        known = [name for name in OUTPUTS if "register" not in name and name not in newer]
        answer = client.ask("O", struct.pack(">d", 500.0) + ",".join(known).encode())
        assert answer[1:].decode().split(",") == [OUTPUTS[name][0] for name in known]
        assert client.ask("S") == b"\x01"
        assert client.ask("P") == b"\x01"
        answer = client.ask("O", struct.pack(">d", 500.0) + b"timestamp,no_such_thing")
        assert answer[1:] == b"DOUBLE,NOT_FOUND"
        assert client.ask("S") == b"\x00"


def test_an_input_belongs_to_one_client_until_it_leaves(station: StationProcess) -> None:
    name = b"input_int_register_5"
    with RtdeSocket(station.host) as second:
        with RtdeSocket(station.host) as first:
            assert first.ask("I", name) == b"\x01INT32"
            assert first.ask("I", b"input_int_register_6," + name + b",") == b"\x02INT32,INT32"
            assert second.ask("I", name) == b"\x01IN_USE"
        wait_until(lambda: second.ask("I", name)[1:] == b"INT32")


def test_wrong_packages_are_noted_and_do_no_harm(worn: StationProcess) -> None:
    known = len(worn.ask("state")["bad_inputs"])
    with RtdeSocket(worn.host) as client:
        assert client.ask("V", b"\x00\x01") == b"\x00"
        client.ask("I", b"input_int_register_5")
        client.send_package("U", b"\x01\x00\x00")
        client.send_package("U", b"\x09\x00\x00\x00\x07")
        client.send_package("x")
        assert client.ask("V", b"\x00\x02") == b"\x01"
    assert len(worn.ask("state")["bad_inputs"]) == known + 3


def test_garbage_on_any_port_does_no_harm(worn: StationProcess) -> None:
    noise, known = Random(1), len(worn.ask("state")["events"])
    for port in (29999, 30002, 30003, 30004):
        for _ in range(5):
            with socket.create_connection((worn.host, port), LIMIT_S) as client:
                client.sendall(noise.randbytes(300) + b"\n")
    with RtdeSocket(worn.host) as client:
        client.ask("I", b"input_int_register_0," + b",".join(b"input_double_register_%d" % i for i in range(6)))
        with socket.create_connection((worn.host, 30003), LIMIT_S) as script:
            script.sendall(b"def rtde_control():\nend\n")
            worn.wait_for_event("started rtde_control", since=known)
        client.send_package("U", b"\x01" + struct.pack(">i6d", 29, *[math.nan] * 6))
        assert "nan" in worn.wait_for_event("stopped rtde_control", since=known)["why"]


# -- the station process ----------------------------------------------------------------------------------------------


def test_the_first_line_reports_addresses_and_truth(station: StationProcess) -> None:
    hello = station.hello
    assert hello["format"] == "mocks.station/1"
    assert hello["arm"]["model"] == "UR5e"
    assert hello["arm"]["host"].startswith("127.")
    assert hello["sensors"] == {}
    truth = hello["truth"]
    assert truth["weight_N"] == pytest.approx(truth["mass_kg"] * truth["g_m_s2"])
    assert math.hypot(*truth["gravity_force_base_N"]) == pytest.approx(truth["weight_N"])


@pytest.mark.parametrize("how", ["SIGTERM", "frozen"])
def test_a_station_ends(how: str) -> None:
    with StationProcess() as cell, RtdeSocket(cell.host) as client:
        client.ask("O", struct.pack(">d", 500.0) + b"timestamp")
        client.ask("S")
        if how == "frozen":
            cell.ask("freeze", on=True)
        if how == "SIGTERM":
            cell.process.send_signal(signal.SIGTERM)
            assert cell.process.wait(LIMIT_S) == 0
        assert cell.quit() == 0


def test_dashboard_lines_end_with_a_bare_line_feed(station: StationProcess) -> None:
    with socket.create_connection((station.host, 29999), LIMIT_S) as client, client.makefile("rb") as lines:
        assert lines.readline() == b"Connected: Universal Robots Dashboard Server\n"
        client.sendall(b"ROBOTMODE\nplay\nget loaded program\nload a.urp\nnonsense\nquit\n")
        assert [lines.readline() for _ in range(6)] == [
            b"Robotmode: RUNNING\n",
            b"Failed to execute: play\n",
            b"No program loaded\n",
            b"Loading program: /programs/a.urp, /programs/default.installation\n",
            b"could not understand: 'nonsense'\n",
            b"Disconnected\n",
        ]
        assert lines.readline() == b""
