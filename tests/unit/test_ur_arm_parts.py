"""What of `UrArm` needs no controller."""

import re
import subprocess
import sys
from math import inf, nan, radians
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import ConnectError, StreamBroken
from drivers.ur import arm as arm_module
from drivers.ur import control_child, library
from drivers.ur.arm import UrArm
from drivers.ur.control import ControlProcess
from drivers.ur.reading import Look


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
