"""The emulated UR controller on the wire: bytes of the RTDE guide, a hand-written client, the unmodified ur_rtde."""

import contextlib
import itertools
import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocks.ur import rtde
from mocks.ur.script import take_uploads
from mocks.ur.variables import INPUTS, OUTPUTS

ROOT = Path(__file__).parents[2]


class Station:
    """A station process: first line, control channel, end."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "mocks",
                "station",
                *(() if "--sensor" in options else ("--sensor", "none")),
                *options,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        self.hello = json.loads(self._line())
        self.host: str = self.hello["arm"]["host"]

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def ask(self, **request: Any) -> dict[str, Any]:
        return self.say(json.dumps(request))

    def say(self, line: str) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._line())
        return answer

    def close(self) -> int:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            return self.process.wait(5.0)
        finally:
            self.process.kill()
            self.process.stdout.close()


OPTIONS = ("--time-scale", "20", "--plane", "0,0,1,0.2", "--payload", "0.7")


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    """A fast UR5e whose tool must stay above z = 0.2 m, shared by the tests that leave it as it is."""
    cell = Station(*OPTIONS)
    yield cell
    cell.close()


@pytest.fixture
def fresh() -> Iterator[Station]:
    """The same, for one test alone."""
    cell = Station(*OPTIONS)
    yield cell
    cell.close()


def run_client(scenario: str, station: Station, timeout_s: float = 30.0) -> dict[str, Any]:
    """Run a scenario of ur_emulator_client.py in its own process and hand its questions to the station."""
    pytest.importorskip("rtde_control")
    client = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("ur_emulator_client.py")), scenario, station.host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert client.stdin is not None
    assert client.stdout is not None
    assert client.stderr is not None
    alarm = threading.Timer(timeout_s, client.kill)
    alarm.start()
    result: dict[str, Any] | None = None
    try:
        for line in client.stdout:
            if line.startswith("@ask "):
                client.stdin.write(json.dumps(station.say(line[5:].strip())) + "\n")
                client.stdin.flush()
            elif line.startswith("@result "):
                result = json.loads(line[8:])
        client.wait()
        assert result is not None, f"{scenario} ended with {client.returncode}: {client.stderr.read()}"
    finally:
        alarm.cancel()
        client.kill()
        client.wait()
        for pipe in (client.stdin, client.stdout, client.stderr):
            pipe.close()
    state = station.ask(do="state")
    assert state["bad_inputs"] == []
    return result


class RtdeSocket:
    """The smallest RTDE client: plain bytes."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30004), 2.0)
        self._buffer = bytearray()

    def __enter__(self) -> "RtdeSocket":
        return self

    def __exit__(self, *_exc: object) -> None:
        self._socket.close()

    def send(self, hexadecimal: str) -> None:
        self._socket.sendall(bytes.fromhex(hexadecimal))

    def send_package(self, kind: str, payload: bytes = b"") -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def answer(self) -> bytes:
        """The next whole package, header included."""
        while len(self._buffer) < 3 or len(self._buffer) < struct.unpack_from(">H", self._buffer)[0]:
            data = self._socket.recv(4096)
            if not data:
                raise ConnectionError("the server hung up")
            self._buffer += data
        (size,) = struct.unpack_from(">H", self._buffer)
        package = bytes(self._buffer[:size])
        del self._buffer[:size]
        return package

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Payload of the answer of the same kind; samples on the way are skipped."""
        self.send_package(kind, payload)
        while True:
            package = self.answer()
            if package[2:3] == kind.encode():
                return package[3:]


def wait_for_state(station: Station, key: str, value: Any) -> None:
    end = time.monotonic() + 3.0
    while (state := station.ask(do="state"))[key] != value:
        assert time.monotonic() < end, f"{key} stayed {state[key]}, not {value}"


def wait_for_event(station: Station, what: str, *, accepted: bool = True) -> dict[str, Any]:
    """The first such event."""
    end = time.monotonic() + 3.0
    while True:
        events: list[dict[str, Any]] = station.ask(do="state")["events"]
        for event in events:
            if (event["what"], event["accepted"]) == (what, accepted):
                return event
        assert time.monotonic() < end, f"no {what} in {events}"


# -- codec ------------------------------------------------------------------------------------------------------------

CONTROL_OUTPUTS = [
    "timestamp", "robot_status_bits", "safety_status_bits", "runtime_state",
    *[f"output_int_register_{i}" for i in range(3)], *[f"output_double_register_{i}" for i in range(6)],
]  # fmt: skip


def test_packages_of_the_guide() -> None:
    assert rtde.package(rtde.VERSION, b"\x01") == bytes.fromhex("00045601")
    assert rtde.package(rtde.CONTROLLER_VERSION, struct.pack(">4I", 5, 15, 0, 1)) == bytes.fromhex(
        "001376000000050000000f0000000000000001"
    )
    assert rtde.package(rtde.START, b"\x01") == bytes.fromhex("00045301")
    recipe = rtde.Recipe(1, CONTROL_OUTPUTS, [OUTPUTS[name][0] for name in CONTROL_OUTPUTS])
    answer = rtde.package(rtde.SETUP_OUTPUTS, recipe.answer())
    assert answer.startswith(bytes.fromhex("005b4f01") + b"DOUBLE,UINT32,UINT32,UINT32,INT32,INT32,INT32,DOUBLE,")
    sample = recipe.pack([1.5, 1, 1, 2, 1, 0, 0, *[0.0] * 6])
    assert len(sample) == 84
    assert sample.startswith(bytes.fromhex("00545501 3ff8000000000000 00000001"))


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
    ],
    ids=["stopScript", "setPayload", "stopJ"],
)
def test_commands_as_ur_rtde_sends_them(data: str, names: list[str], fields: dict[str, float]) -> None:
    ((kind, payload),) = rtde.take_packages(bytearray(bytes.fromhex(data)))
    recipe = rtde.Recipe(payload[0], names, [INPUTS[name] for name in names])
    assert kind == rtde.DATA
    assert len(payload) == 1 + recipe.size
    assert recipe.unpack(payload[1:]).items() >= fields.items()


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=6), st.integers(1, 9))
def test_packages_survive_any_cutting_of_the_stream(packages: list[tuple[int, bytes]], step: int) -> None:
    stream = b"".join(rtde.package(kind, payload) for kind, payload in packages)
    buffer, found = bytearray(), []
    for i in range(0, len(stream), step):
        buffer += stream[i : i + step]
        found += list(rtde.take_packages(buffer))
    assert found == packages
    assert buffer == b""


def test_a_package_smaller_than_its_header_is_an_error() -> None:
    with pytest.raises(rtde.RtdeError, match="2 bytes"):
        list(rtde.take_packages(bytearray(b"\x00\x02V")))


values = {
    "BOOL": st.booleans(),
    "UINT8": st.integers(0, 2**8 - 1),
    "UINT32": st.integers(0, 2**32 - 1),
    "UINT64": st.integers(0, 2**64 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "DOUBLE": st.floats(allow_nan=False),
    "VECTOR3D": st.tuples(*[st.floats(allow_nan=False)] * 3),
    "VECTOR6D": st.tuples(*[st.floats(allow_nan=False)] * 6),
    "VECTOR6INT32": st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6),
    "VECTOR6UINT32": st.tuples(*[st.integers(0, 2**32 - 1)] * 6),
}


@given(st.lists(st.sampled_from(sorted(values)).flatmap(lambda t: st.tuples(st.just(t), values[t])), min_size=1))
def test_recipes_decode_what_they_encode(fields: list[tuple[str, Any]]) -> None:
    names = [f"v{i}" for i in range(len(fields))]
    recipe = rtde.Recipe(3, names, [kind for kind, _value in fields])
    ((_kind, payload),) = rtde.take_packages(bytearray(recipe.pack([value for _kind, value in fields])))
    assert payload[0] == 3
    assert list(recipe.unpack(payload[1:]).values()) == [value for _kind, value in fields]


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
    assert found[2].is_control_script
    assert (found[2].register_offset("float"), found[2].register_offset("int")) == (24, 0)


# -- a hand-written client --------------------------------------------------------------------------------------------


def test_handshake_bytes(station: Station) -> None:
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


@pytest.mark.parametrize("name", ["tcp_offset", "payload", "payload_cog", "actual_q", "safety_status_bits"])
def test_one_variable_alone(station: Station, name: str) -> None:
    station.ask(do="set-tcp", tcp=[0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    kind = OUTPUTS[name][0]
    expected = {
        "tcp_offset": (0.01, 0.02, 0.03, 0.1, 0.2, 0.3),
        "payload": 0.7,
        "payload_cog": (0.0, 0.0, 0.0),
        "actual_q": tuple(station.ask(do="state")["q_rad"]),
        "safety_status_bits": 1,
    }[name]
    with RtdeSocket(station.host) as client:
        assert client.ask("V", b"\x00\x02") == b"\x01"
        assert client.ask("O", struct.pack(">d", 10.0) + name.encode()) == b"\x01" + kind.encode()
        assert client.ask("S") == b"\x01"
        assert rtde.Recipe(1, [name], [kind]).unpack(client.answer()[4:]) == {name: expected}


def test_every_documented_variable_can_be_read_and_unknown_ones_are_named(station: Station) -> None:
    with RtdeSocket(station.host) as client:
        known = [name for name in OUTPUTS if "register" not in name and name != "actual_current_as_torque"]
        answer = client.ask("O", struct.pack(">d", 500.0) + ",".join(known).encode())
        assert answer[1:].decode().split(",") == [OUTPUTS[name][0] for name in known]
        assert client.ask("S") == b"\x01"
        assert client.ask("P") == b"\x01"
        answer = client.ask("O", struct.pack(">d", 500.0) + b"timestamp,no_such_thing")
        assert answer[1:] == b"DOUBLE,NOT_FOUND"
        assert client.ask("S") == b"\x00"


def test_an_old_controller_does_not_know_new_variables() -> None:
    cell = Station("--polyscope", "5.4")
    try:
        with RtdeSocket(cell.host) as client:
            answer = client.ask("O", struct.pack(">d", 500.0) + b"payload,ft_raw_wrench,actual_q")
            assert answer[1:] == b"NOT_FOUND,NOT_FOUND,VECTOR6D"
    finally:
        cell.close()


def test_an_input_belongs_to_one_client_until_it_leaves(station: Station) -> None:
    name = b"input_int_register_5"
    with RtdeSocket(station.host) as second:
        with RtdeSocket(station.host) as first:
            assert first.ask("I", name) == b"\x01INT32"
            assert first.ask("I", b"input_int_register_6," + name + b",") == b"\x02INT32,INT32"
            assert second.ask("I", name) == b"\x01IN_USE"
        end = time.monotonic() + 2.0
        while (answer := second.ask("I", name)[1:]) != b"INT32":
            assert time.monotonic() < end, answer


def test_wrong_packages_are_noted_and_do_no_harm(fresh: Station) -> None:
    with RtdeSocket(fresh.host) as client:
        assert client.ask("V", b"\x00\x01") == b"\x00"
        client.ask("I", b"input_int_register_5")
        client.send_package("U", b"\x01\x00\x00")
        client.send_package("U", b"\x09\x00\x00\x00\x07")
        client.send_package("x")
        assert client.ask("V", b"\x00\x02") == b"\x01"
    assert len(fresh.ask(do="state")["bad_inputs"]) == 3


def test_garbage_on_any_port_harms_nobody(fresh: Station) -> None:
    noise = Random(1)
    for port in (29999, 30002, 30003, 30004):
        for _ in range(20):
            with socket.create_connection((fresh.host, port), 2.0) as client:
                client.sendall(noise.randbytes(300) + b"\n")
    with RtdeSocket(fresh.host) as client:
        client.ask("I", b"input_int_register_0," + b",".join(b"input_double_register_%d" % i for i in range(6)))
        with socket.create_connection((fresh.host, 30003), 2.0) as script:
            script.sendall(b"def rtde_control():\nend\n")
            wait_for_state(fresh, "runtime_state", "PLAYING")
        client.send_package("U", b"\x01" + struct.pack(">i6d", 29, *[math.nan] * 6))
        wait_for_state(fresh, "runtime_state", "STOPPED")
        assert "nan" in fresh.ask(do="state")["events"][-1]["why"]


def stamps_of(client: RtdeSocket, rate_Hz: float) -> tuple[list[float], float]:
    """Receive for half a second; returns the controller's time of each sample, and how long that took, s."""
    client.ask("O", struct.pack(">d", rate_Hz) + b"timestamp")
    client.ask("S")
    stamps, begun = [], time.monotonic()
    while time.monotonic() < begun + 0.5:
        stamps.append(struct.unpack_from(">d", client.answer(), 4)[0])
    return stamps, time.monotonic() - begun


def test_rate_follows_the_request_and_the_real_clock(station: Station) -> None:
    with RtdeSocket(station.host) as client:
        stamps, took_s = stamps_of(client, 100.0)
        assert stamps[-1] - stamps[0] == pytest.approx(20 * took_s, abs=20 * 0.2)  # time-scale 20
        assert min(b - a for a, b in itertools.pairwise(stamps)) > 20 * 0.0019
        assert len(stamps) <= 54


def test_the_clock_of_a_fast_arm_with_a_sensor_of_its_own_is_real() -> None:
    """It stamps what the sensor measures: one control period a sample, and a stall is as long as it was."""
    cell = Station("--sensor", "ur-ft", "--time-scale", "20")
    try:
        with RtdeSocket(cell.host) as client:
            stamps, took_s = stamps_of(client, 500.0)
            assert stamps[-1] - stamps[0] == pytest.approx(took_s, abs=0.2)
            assert min(b - a for a, b in itertools.pairwise(stamps)) == pytest.approx(0.002)
    finally:
        cell.close()


# -- the unmodified ur_rtde -------------------------------------------------------------------------------------------


def test_receive(fresh: Station) -> None:
    out = run_client("receive", fresh)
    assert out["advanced"]
    assert out["q"] == pytest.approx(out["true_q"], abs=1e-12)
    assert out["same_q"] == out["q"]
    assert out["same_pose"] == out["pose"]
    assert out["modes"] == [7, 1, 1]
    assert out["payload"] == [0.7, 0.7]
    assert out["scaling"] == [1.0, 1.0]


def test_moves(fresh: Station) -> None:
    out = run_client("moves", fresh)
    seconds = out.pop("seconds")
    assert 0.075 - 0.01 <= seconds < 1.0  # 1.5 s of motion, 20 times faster
    assert out.pop("moveL_error_m") < 1e-3
    assert out.pop("next_operation") == 1
    assert {name: value for name, value in out.items() if value is not True} == {}


def test_kinematics(fresh: Station) -> None:
    out = run_client("kinematics", fresh)
    assert out["ik"] == pytest.approx(out["q"], abs=1e-9)
    assert out["ik_near"] == pytest.approx(out["q"], abs=1e-9)
    assert [out["has"], out["has_not"]] == [True, False]
    assert out["fk"] == pytest.approx(out["pose"], abs=1e-9)
    assert out["fk_of_q"] == pytest.approx(out["pose"], abs=1e-9)
    assert out["flange"] == pytest.approx(out["pose"], abs=1e-9)
    assert out["trans"] == pytest.approx([1.0, 3.0, 3.0, 0.0, 0.0, math.pi / 2])
    assert [out["joints_safe"], out["joints_unsafe"]] == [True, False]
    assert [out["pose_safe"], out["pose_below_plane"], out["pose_unreachable"]] == [True, False, False]
    assert out["script_alive"]
    assert out["unreachable_ik"] == []
    assert out["script_died"]


def test_settings(fresh: Station) -> None:
    out = run_client("settings", fresh)
    assert out["offset_before"] == [0.0] * 6
    assert out["offset"] == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
    assert out["flange_after"] == pytest.approx(out["flange"], abs=1e-12)
    assert out["bare"] == pytest.approx(out["flange"], abs=1e-12)
    assert math.dist(out["tcp"][:3], out["bare"][:3]) == pytest.approx(0.1)
    assert out["tcp"][3:] == pytest.approx(out["bare"][3:], abs=1e-9)
    for name in ("setTcp", "pushed", "zeroed", "setPayload", "payload_seen", "setTargetPayload", "inertia_seen"):
        assert out[name] is True, name
    assert out["setSpeedSlider"]
    assert out["slider_seen"]


def test_program(fresh: Station) -> None:
    out = run_client("program", fresh)
    assert out["version"].startswith("5.15.0.")
    assert out["serial"] == fresh.hello["arm"]["serial_number"]
    assert out["model"] == "UR5"
    assert [out["remote"], out["mode"], out["safety"]] == [True, "Robotmode: RUNNING", "Safetymode: NORMAL"]
    assert out["running_before"] is False
    assert out["state"] == "PLAYING rtde_control"
    assert out["stopped"] == [False, "STOPPED", 1]
    assert out["command_when_stopped"] is False
    for name in ("reupload", "alive", "kicked", "watchdog_bites", "arm_stands", "short_of_goal", "again"):
        assert out[name] is True, name
    assert "already in use" in out["second"]
    assert out["dashboard_stop"]


def test_stops(fresh: Station) -> None:
    out = run_client("stops", fresh)
    assert out["stop_seen"]
    assert out["status"] == [3, 0x404, 7, 4]
    assert out["stands"]
    assert out["still_running_says_the_word"] is True
    assert out["move_refused"] is False
    assert out["play"] == "Failed to execute: play"
    assert "until 5s after occurrence" in out["too_early"]
    assert out["unlocked"]
    assert out["finishes_the_interrupted_move"]
    assert [out["trigger"], out["triggered"]] == [False, True]
    assert out["recovered"]
    assert out["estop_seen"]
    assert out["estop_status"] == [7, 0x4C0, 3, 1]
    assert out["estop_move"] is False
    assert [out["idle"], out["running"], out["moves_again"]] == [True, True, True]


def test_link(fresh: Station) -> None:
    out = run_client("link", fresh)
    assert out["frozen_for"] <= 20 * 0.02  # time-scale 20
    assert out["thawed"]
    assert out["dropped"]["connections"] == 1
    assert [out["loss_seen"], out["reconnect"], out["alive"]] == [True, True, True]


# -- the station process ----------------------------------------------------------------------------------------------


def test_the_first_line_tells_where_and_what(station: Station) -> None:
    hello = station.hello
    assert hello["format"] == "mocks.station/1"
    assert hello["arm"]["model"] == "UR5e"
    assert hello["arm"]["host"].startswith("127.")
    assert hello["sensors"] == {}
    truth = hello["truth"]
    assert truth["weight_N"] == pytest.approx(truth["mass_kg"] * truth["g_m_s2"])
    assert math.hypot(*truth["gravity_force_base_N"]) == pytest.approx(truth["weight_N"])


def test_options_override_the_seed() -> None:
    options = ("--seed", "3", "--mass", "1.25", "--com", "0.001,0.002,0.06", "--mount", "ceiling", "--tilt-deg", "1,2")
    cell = Station(*options, "--sensor-rotvec-deg", "0,0,90", "--tcp", "0,0,0.1,0,0,0", "--model", "UR10e")
    try:
        truth = cell.hello["truth"]
        assert truth["mass_kg"] == 1.25
        assert truth["p_sensor_com_m"] == [0.001, 0.002, 0.06]
        assert truth["R_flange_sensor"][1] == pytest.approx([1, 0, 0])
        assert math.degrees(truth["tilt_alpha_rad"]) == pytest.approx(1)
        assert math.degrees(truth["tilt_beta_rad"]) == pytest.approx(-178)
        assert truth["gravity_force_base_N"][2] > 0
        assert cell.hello["arm"]["model"] == "UR10e"
        assert cell.ask(do="state")["tcp_offset"] == [0, 0, 0.1, 0, 0, 0]
    finally:
        cell.close()


def test_two_stations_live_side_by_side(station: Station) -> None:
    other = Station()
    try:
        assert other.host != station.host
        taken = subprocess.run(
            [sys.executable, "-m", "mocks", "station", "--sensor", "none", "--host", station.host],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            cwd=ROOT,
            check=False,
        )
        assert taken.returncode == 3
        assert "cannot listen" in taken.stderr
    finally:
        other.close()


@pytest.mark.parametrize("how", ["stdin", "SIGTERM", "frozen"])
def test_a_station_ends_at_once(how: str) -> None:
    cell = Station()
    with RtdeSocket(cell.host) as client:
        client.ask("O", struct.pack(">d", 500.0) + b"timestamp")
        client.ask("S")
        if how == "frozen":
            cell.ask(do="freeze", on=True)
        begun = time.monotonic()
        if how == "SIGTERM":
            cell.process.send_signal(signal.SIGTERM)
            assert cell.process.wait(5.0) == 0
        assert cell.close() == 0
        assert time.monotonic() - begun < 1.0  # half a second of its own, and room for a busy machine


@pytest.mark.parametrize(
    "line",
    ['{"do": "dance"}', "not json", "[]", '{"do": "push", "wrench": [1]}', '{"do": "unplug", "device": "radio"}'],
)
def test_what_is_not_understood_is_answered_with_an_error(station: Station, line: str) -> None:
    assert "error" in station.say(line)
    assert "error" not in station.ask(do="state")


def test_a_push_shows_in_the_truth(station: Station) -> None:
    before = station.ask(do="state")["true_wrench"]
    assert station.ask(do="push", wrench=[1, 2, 3, 0.1, 0.2, 0.3]) == {"done": "push"}
    after = station.ask(do="state")["true_wrench"]
    assert [b - a for a, b in zip(before, after, strict=True)] == pytest.approx([1, 2, 3, 0.1, 0.2, 0.3])


def test_no_program_starts_without_remote_control(fresh: Station) -> None:
    fresh.ask(do="remote-control", on=False)
    with socket.create_connection((fresh.host, 30002), 2.0) as script:
        script.sendall(b"def rtde_control():\nend\n")
        wait_for_event(fresh, "program rtde_control", accepted=False)
        fresh.ask(do="remote-control", on=True)
        script.sendall(b"def rtde_control():\nend\n")
        wait_for_state(fresh, "runtime_state", "PLAYING")
        script.sendall(b"def other():\nend\n")
        wait_for_state(fresh, "runtime_state", "STOPPED")


def test_dashboard_lines_end_with_a_bare_line_feed(station: Station) -> None:
    with socket.create_connection((station.host, 29999), 2.0) as client, client.makefile("rb") as lines:
        assert lines.readline() == b"Connected: Universal Robots Dashboard Server\n"
        client.sendall(b"ROBOTMODE\nplay\nget loaded program\nload a.urp\nnonsense\nquit\n")
        assert [lines.readline() for _ in range(6)] == [
            b"Robotmode: RUNNING\n",
            b"Failed to execute: play\n",
            b"No program loaded\n",
            b"Loading program: a.urp\n",
            b"could not understand: 'nonsense'\n",
            b"Disconnected\n",
        ]
        assert lines.readline() == b""


@pytest.mark.skipif(find_spec("mocks.ati_can") is None, reason="the sensor emulators are not there")
def test_sensors_share_the_station() -> None:
    cell = Station("--sensor", "both")
    try:
        can, serial = cell.hello["sensors"]["can"], cell.hello["sensors"]["serial"]
        assert {key: can[key] for key in ("interface", "bitrate", "base")} == {
            "interface": "slcan",
            "bitrate": 250_000,
            "base": 0x20,
        }
        assert can["channel"] != serial["port"]
        for path in (can["channel"], serial["port"]):
            os.close(os.open(path, os.O_RDWR | os.O_NOCTTY))
        assert cell.ask(do="unplug", device="sensor") == {"done": "unplug", "devices": ["can", "serial"]}
        with pytest.raises(OSError, match=can["channel"]):
            os.open(can["channel"], os.O_RDWR | os.O_NOCTTY)
    finally:
        begun = time.monotonic()
        assert cell.close() == 0
        assert time.monotonic() - begun < 1.0
