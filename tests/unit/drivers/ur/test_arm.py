"""What of `UrArm` needs no controller."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, radians
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import ConnectError, ProtocolError, StreamBroken
from drivers.ur import arm as arm_module
from drivers.ur import control_child, library
from drivers.ur.arm import UrArm
from drivers.ur.control import ControlProcess
from drivers.ur.reading import STALE_S, Look


def look(**different: Any) -> Look:
    six = [0.0] * 6
    values: dict[str, Any] = {
        "t_host_ns": 0,
        "t_device_s": 1.0,
        "q_rad": six,
        "qd_rad_s": six,
        "target_q_rad": six,
        "target_qd_rad_s": six,
        "tcp_pose": six,
        "robot_mode": 7,
        "safety_bits": 1,
        "program_state": 2,
    }
    return Look(**(values | different))


@pytest.mark.parametrize("speed", [0.0, -1.0, 1e-4, 30.0, nan, inf])
def test_absurd_speeds_and_accelerations_are_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed_rad_s"):
        UrArm("192.0.2.1", speed_rad_s=speed)
    with pytest.raises(ValueError, match="acceleration_rad_s2"):
        UrArm("192.0.2.1", acceleration_rad_s2=speed)


def test_unknown_models_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'kr6' is not known: choose one of .*UR5e"):
        UrArm("192.0.2.1", model="kr6")


def test_a_new_arm_talks_to_nobody_and_closes() -> None:
    arm = UrArm("192.0.2.1", model="ur5e", speed_rad_s=radians(60))
    arm.stop()
    arm.close()
    arm.close()
    with pytest.raises(ConnectError, match="not open"):
        arm.identify()


@pytest.mark.parametrize(
    ("different", "says"),
    [
        ({"safety_bits": 0x404}, "protective stop"),
        ({"safety_bits": 0x4C0, "robot_mode": 3}, "emergency stop"),
        ({"safety_bits": 0x420}, "emergency stop"),
        ({"safety_bits": 0x410}, "safeguard stop"),
        ({"safety_bits": 0x408}, "recovery"),
        ({"safety_bits": 0x600}, "violation or fault"),
        ({"safety_bits": 0x400}, "safety reason"),
        ({"robot_mode": 3}, r"robot mode 3 \(power off\); power the arm on"),
        ({"robot_mode": 5}, r"robot mode 5 \(idle\); release its brakes"),
        ({"robot_mode": 42}, "unknown"),
    ],
)
def test_every_safety_stop_has_a_cure(different: dict[str, int], says: str) -> None:
    fault = look(**different).safety_fault()
    assert fault is not None
    assert re.search(says, str(fault))
    assert fault.cure


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_normal_and_reduced_mode_are_no_fault(bits: int) -> None:
    assert look(safety_bits=bits).safety_fault() is None
    assert look(safety_bits=bits).program_fault() is None
    assert "paused" in str(look(program_state=4).program_fault())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("ur_rtde: One of the RTDE input registers are already in use! Currently", "another client"),
        ("ur_rtde: Please enable remote control on the robot!", "press Local, Remote Control"),
        ("Failed to start control script, before timeout of 5 seconds", "Failed to start control script.*pendant"),
    ],
)
def test_the_librarys_words_become_advice(words: str, says: str) -> None:
    assert re.search(says, str(arm_module._refusal("10.0.0.1", words)))


def test_without_ur_rtde_the_error_says_where_it_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(library, "import_module", missing)
    with pytest.raises(ConnectError, match=r"not installed for Python .*CPython 3\.11 or 3\.12 on 64-bit x86 Linux"):
        UrArm("192.0.2.1").open()


def test_importing_the_driver_does_not_load_ur_rtde() -> None:
    code = "import sys, drivers.ur.arm; sys.exit(any('rtde_' in n or n == 'dashboard_client' for n in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_the_library_says_comes_with_a_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    child = tmp_path / "child.py"
    child.write_text(
        "import json, sys\n"
        'print(json.dumps({"id": 0, "value": None}), flush=True)\n'
        "for line in sys.stdin:\n"
        '    print(json.dumps({"id": json.loads(line)["id"], "error": "the connection was lost"}), flush=True)\n'
    )
    monkeypatch.setattr(control_child, "__file__", str(child))
    control = ControlProcess("10.0.0.1", 125.0)
    try:
        control.wait_until_ready(lambda: None)
        with pytest.raises(StreamBroken, match="was lost; check the robot and the cable, then open the arm again"):
            control.call("progress")
    finally:
        control.kill()


class FakeReader:
    """Tells these looks one after the other, then the last one for ever."""

    def __init__(self, *looks: Look, silent: bool = False) -> None:
        self._looks = looks
        self.silent = silent
        self.told: list[Look] = []

    def look(self, *, limit_s: float = STALE_S) -> Look:
        assert limit_s <= STALE_S
        self.told.append(self._looks[min(len(self.told), len(self._looks) - 1)])
        return self.told[-1]

    def close(self) -> None:
        pass


def arm_with(reader: FakeReader, control: object = None) -> UrArm:
    arm: Any = UrArm("192.0.2.1")
    arm._reader, arm._control = reader, control
    assert isinstance(arm, UrArm)
    return arm


@pytest.mark.parametrize(
    "disturbed",
    [
        {"qd_rad_s": [0.0, 0.0, -0.003, 0.0, 0.0, 0.0]},
        {"target_qd_rad_s": [0.0, 0.0, 0.0, 0.0, 0.0, -1e-4]},
        {"target_q_rad": [0.0, 0.0, 0.0, 0.002, 0.0, 0.0]},
    ],
    ids=["shaking", "about to move", "not at the goal"],
)
def test_still_is_three_tenths_of_a_second_without_a_break(disturbed: dict[str, Any]) -> None:
    looks = [look(t_device_s=0.01 * k) for k in range(100)]
    looks[20] = replace(looks[20], **disturbed)
    arm = arm_with(reader := FakeReader(*looks))
    arm._goal = [0.0] * 6
    arm.wait_until_still(timeout_s=60, guard=lambda: None)
    assert reader.told[-1].t_device_s == pytest.approx(0.51, abs=0.011)  # counted from 0.21 s on


def test_still_needs_no_goal_where_the_arm_was_sent_nowhere() -> None:
    arm = arm_with(reader := FakeReader(*(look(t_device_s=0.01 * k, target_q_rad=[1.0] * 6) for k in range(100))))
    arm.wait_until_still(timeout_s=60, guard=lambda: None)
    assert reader.told[-1].t_device_s == pytest.approx(0.3, abs=0.011)


@pytest.mark.parametrize(
    ("silent", "set_point_rad_s", "fails", "ways"),
    [
        (False, 0.0, False, ["stop softly"]),
        (False, 0.1, False, ["stop softly", "kill", "stop the program"]),  # it says so, and the arm goes on
        (False, 0.0, True, ["stop softly", "kill", "stop the program"]),
        (True, 0.0, False, ["kill", "stop the program"]),  # there is no time for a way that cannot work
    ],
    ids=["works", "without effect", "fails", "silent"],
)
def test_the_ways_to_stop(
    silent: bool, set_point_rad_s: float, fails: bool, ways: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gone: list[str] = []

    class Control:
        alive = True

        def call(self, name: str, *_: object, **__: object) -> None:
            gone.append(f"{name} softly")
            if fails:
                raise StreamBroken("the control connection was lost")

        def kill(self) -> None:
            gone.append("kill")

    class Pendant:
        def stop(self) -> None:
            gone.append("stop the program")

    def ask(_: str, do: Callable[[Pendant], object], **__: float) -> None:
        do(Pendant())

    monkeypatch.setattr(arm_module, "ask_dashboard", ask)
    reader = FakeReader(look(target_qd_rad_s=[set_point_rad_s] * 6), silent=silent)
    arm_with(reader, Control()).stop()
    assert gone == ways
    assert not (silent and reader.told)


def test_what_rtde_may_not_say_refuses_the_opening_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(*_: object) -> None:
        raise ProtocolError("RTDE recipe cannot be read: 01", "is this an RTDE server?")

    monkeypatch.setattr(arm_module, "Reader", damaged)
    with pytest.raises(ConnectError, match=r"cannot open .* recipe cannot be read: 01; is this an RTDE server\?"):
        UrArm("192.0.2.1").open()


LIBRARY = """
import threading

class RTDEControlInterface:
    FLAG_UPLOAD_SCRIPT, FLAG_NO_EXT_FT = 1, 2

    def __init__(self, hostname, **how):
        if hostname == "hangs":
            threading.Event().wait()

    def getAsyncOperationProgressEx(self):
        return self

    def isAsyncOperationRunning(self):
        return False

    def stopScript(self):
        threading.Event().wait()
"""


@pytest.mark.parametrize(("host", "hangs"), [("hangs", "STARTING_S"), ("answers", "LEAVING_S")])
def test_a_library_that_hangs_does_not_keep_its_process(host: str, hangs: str, tmp_path: Path) -> None:
    (tmp_path / "rtde_control.py").write_text(LIBRARY)
    code = f"from drivers.ur import control_child; control_child.{hangs} = 1; control_child.main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, host, "125"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    ) as child:
        try:
            if host == "answers":
                assert child.stdout is not None
                assert child.stdout.readline() == b'{"id": 0, "value": null}\n'
                assert child.stdin is not None
                child.stdin.close()
            assert child.wait(20) == -signal.SIGALRM
        finally:
            child.kill()
