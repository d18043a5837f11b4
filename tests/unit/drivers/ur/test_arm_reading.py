"""What a `Reader` believes of what ur_rtde and the controller tell."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.errors import ConnectError, DeviceFault, DeviceTimeout
from drivers.interfaces import DeviceInfo
from drivers.ur.kinematics import MODELS, Pose, forward
from drivers.ur.reading import Look, Reader

Q_RAD = [0.1, -1.2, 1.5, -0.7, -1.4, 0.3]


class FakeReceive:
    """ur_rtde's receiving side: every value of sample k is k. A new sample comes after so many questions."""

    def __init__(self, *questions: int) -> None:
        self._left = list(questions)
        self.k = 1

    def isConnected(self) -> bool:
        return True

    def __getattr__(self, name: str) -> Callable[[], float | list[float]]:
        def tell() -> float | list[float]:
            if self._left and self._left[0] == 0:
                self._left.pop(0)
                self.k += 1
            elif self._left:
                self._left[0] -= 1
            return [float(self.k)] * 6 if name.startswith(("getActual", "getTarget")) else self.k

        return tell


class FakeLive:
    """Our own client, at controller time `t_s`."""

    def __init__(self, t_s: float = 0.0, missing: frozenset[str] = frozenset()) -> None:
        self._t_s = t_s
        self.missing = missing

    def now_s(self, *, limit_s: float) -> float:
        assert limit_s > 0
        return self._t_s

    def check(self) -> None:
        pass


def reader_of(receive: FakeReceive | None = None, live: FakeLive | None = None) -> Reader:
    reader: Any = Reader.__new__(Reader)
    reader._host, reader._receive, reader._live = "192.0.2.1", receive, live or FakeLive()
    reader.version = (5, 15, 0, 0)
    reader.info = DeviceInfo(model="UR5e", serial="1", firmware="5.15")
    assert isinstance(reader, Reader)
    return reader


def assert_one_sample(look: Look, k: int) -> None:
    assert look.t_device_s == look.robot_mode == look.safety_bits == look.program_state == k
    for values in (look.q_rad, look.qd_rad_s, look.target_q_rad, look.target_qd_rad_s, look.tcp_pose):
        assert values == [k] * 6


@pytest.mark.parametrize("questions", range(1, 10))
def test_a_look_is_of_one_sample(questions: int) -> None:
    assert_one_sample(reader_of(FakeReceive(questions)).look(since_s=0.0), 2)


def test_samples_that_never_hold_still_are_told() -> None:
    with pytest.raises(DeviceTimeout, match="no consistent sample"):
        reader_of(FakeReceive(*[3] * 1000)).look(since_s=0.0)


@pytest.mark.parametrize("since_s", [None, 3.0], ids=["now", "since"])
def test_a_look_is_not_older_than_asked_for(since_s: float | None) -> None:
    live = FakeLive(0.0 if since_s else 3.0)
    receive = FakeReceive(25, 25)  # each sample is read twice
    assert_one_sample(reader_of(receive, live).look(since_s=since_s), 3)


def test_samples_that_stay_away_are_told() -> None:
    with pytest.raises(DeviceTimeout, match=r"samples of 192\.0\.2\.1 have stayed away"):
        reader_of(FakeReceive(), FakeLive(5.0)).look(limit_s=0.01)


def test_a_controller_that_lacks_what_is_needed_is_refused() -> None:
    missing = frozenset({"runtime_state", "payload", "payload_cog", "tcp_offset"})  # not the three younger ones
    with pytest.raises(ConnectError, match="does not tell runtime_state over RTDE; update its PolyScope"):
        reader_of(live=FakeLive(missing=missing))._identify("UR5e")


@pytest.mark.parametrize(
    ("moved_mm", "turned_deg", "wrong"),
    [(0, 0, False), (4, 0.4, False), (6, 0, True), (0, 0.6, True)],
)
def test_a_flange_that_does_not_fit_the_joints_is_refused(moved_mm: float, turned_deg: float, wrong: bool) -> None:
    nudge = Pose.from_ur([1e-3 * moved_mm, 0.0, 0.0, 0.0, math.radians(turned_deg), 0.0])
    flange = forward(MODELS["UR5e"], Q_RAD) @ nudge
    look = Look(0, 0.0, Q_RAD, Q_RAD, Q_RAD, Q_RAD, np.zeros(6).tolist(), 7, 1, 2)
    if not wrong:
        reader_of()._check_model(look, flange)
        return
    with pytest.raises(DeviceFault, match=r"the flange is .* from where a UR5e has it"):
        reader_of()._check_model(look, flange)
