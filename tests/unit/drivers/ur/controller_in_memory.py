"""A UR controller, its dashboard server and both control paths, all in memory and on a `FakeClock`.

The parts of `UrArm` that touch sockets and processes are replaced: the subscription, the dashboard client, the pipe to
the control process and ur_rtde inside it. Everything else, `Calls` of the control process included, is the real code.
The control program of the script path is in `program_in_memory.py`.
"""

import json
import struct
import subprocess
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftdrivers.errors import NoDashboard
from ftdrivers.ur import arm as arm_module
from ftdrivers.ur import control_child, opening, reading
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import STOP_RAD_S2
from ftdrivers.ur.control_process import ControlProcess
from ftdrivers.ur.kinematics import MODELS, Kinematics, Pose, forward
from ftdrivers.ur.reading import Reader
from ftdrivers.ur.rtde import Recipe
from ftdrivers.ur.sample import OUTPUTS
from ftdrivers.ur.services import Services, ServicesOf
from ftdrivers.ur.timing import STRICT, UrTiming
from tests.fake_clock import FakeClock

CYCLE_S = 0.008
HOST = "192.0.2.1"
LETTERS = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR3D": "3d", "VECTOR6D": "6d"}
"""Of `struct`, for the types of outputs."""

MakeArm = Callable[..., UrArm]


def pose_from_ur(pose: Sequence[float]) -> Pose:
    """Read x, y, z in metres, then a rotation vector in radians."""
    return Pose(Rotation.from_rotvec(pose[3:]).as_matrix(), np.array(pose[:3]))


def nominal_flange(q_rad: Sequence[float]) -> Pose:
    return forward(MODELS["UR5e"], q_rad)


@cache  # most tests move on the same path
def tcp_pose(flange: Callable[[Sequence[float]], Pose], *q_and_tcp: float) -> tuple[float, ...]:
    pose = flange(q_and_tcp[:6]) @ pose_from_ur(q_and_tcp[6:])
    return (*pose.p_m, *Rotation.from_matrix(pose.R).as_rotvec())


@cache
def outputs_without(unknown: frozenset[str]) -> dict[str, str]:
    return {name: kind for name, kind in OUTPUTS.items() if name not in unknown}


class Controller:
    """What the far side does. Tests set its attributes."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.t_s = 100.0
        self._began_s: float | None = None
        self.q_rad = [0.1, -1.2, 1.5, -0.7, -1.4, 0.3]
        self.qd_rad_s = [0.0] * 6
        self.flange: Callable[[Sequence[float]], Pose] = nominal_flange
        """Its forward kinematics."""
        self.goal_rad: list[float] | None = None
        self.sweeps_until_s = 0.0
        self.swept: tuple[float, ...] = ()
        """Numbers of the last sweep."""
        self.speed_rad_s = 0.0
        self.tcp_offset = [0.1, -0.02, 0.25, 0.3, -1.2, 0.7]
        self.robot_mode, self.safety_mode, self.safety_bits, self.program = 7, 1, 1, 1
        self.unknown: set[str] = set()
        """Outputs it does not know."""
        self.kinematics: Kinematics | None = MODELS["UR5e"]
        """What the primary interface sends."""
        self.registers_taken = False
        self.ur_rtde_is_installed = True
        self.silent = False
        """It sends no samples."""
        self.held_back = False
        """What it sends stays in the socket of a client that is suspended."""
        self.failure: Exception | None = None
        """Of the connection."""
        self.dashboard_answers = True
        self.dashboard_late_s: float | None = None
        """It answers only after so long, when the question has been given up and goes on in the background."""
        self.control_delay_s = 0.004
        self.starts_in_s = 0.1
        self.hanging: set[str] = set()
        """Calls to which the control process never answers."""
        self.did: list[str] = []
        self.stopped_at_rad_s2: list[float] = []
        """What it was asked to do."""
        self.dashboard_limits_s: list[float] = []
        self.stopping_works = self.takes_settings = True
        self.period_s = CYCLE_S
        self.stood_still_s = 0.0
        """For how long its clock has not run."""
        self.stalled_until_s = self._arrives_s = 0.0
        self.control: Any = None
        """The newest control path of an arm."""
        self._sent: deque[bytes] = deque()
        self._operation = 0
        self._services = ServicesInMemory(self)

    # ------------------------------------------------------------------ RTDE

    version = (5, 15, 0, 1)

    @property
    def rate_Hz(self) -> float:
        return 1.0 / self.period_s

    @property
    def missing(self) -> list[str]:
        return sorted(self.unknown)

    @property
    def _known(self) -> dict[str, str]:
        return outputs_without(frozenset(self.unknown))

    def read(self, timeout_s: float) -> list[bytes]:
        assert timeout_s <= 0.05
        if self.failure:
            raise self.failure
        if not self._sent:
            raise TimeoutError
        return [self._sent.popleft() for _ in range(-(-len(self._sent) // 2))]  # a burst comes in pieces

    def decode(self, samples: Sequence[bytes]) -> dict[str, NDArray[Any]]:
        return dict(zip(self._known, Recipe(1, tuple(self._known.values())).columns(samples), strict=True))

    def close(self) -> None:
        pass

    def sample(self) -> dict[str, tuple[float, ...]]:
        moving = 0.0 if self.goal_rad is None else self.speed_rad_s
        return {
            "timestamp": (self.t_s,),
            "actual_q": tuple(self.q_rad),
            "actual_qd": tuple(self.qd_rad_s),
            "target_q": tuple(self.q_rad),
            "target_qd": (0.0,) * 5 + (moving,),
            "actual_TCP_pose": tcp_pose(self.flange, *self.q_rad, *self.tcp_offset),
            "robot_mode": (self.robot_mode,),
            "safety_mode": (self.safety_mode,),
            "safety_status_bits": (self.safety_bits,),
            "runtime_state": (self.program,),
            "speed_scaling": (1.0,),
            "target_speed_fraction": (0.5,),
            "tcp_offset": tuple(self.tcp_offset),
            "payload": (1.5,),
            "payload_cog": (0.0, 0.0, 0.05),
        }

    def _packed(self) -> bytes:
        """Pack the sample, after the number of the recipe."""
        sample, known = self.sample(), self._known
        layout = ">B" + "".join(map(LETTERS.__getitem__, known.values()))
        return struct.pack(layout, 1, *chain.from_iterable(map(sample.__getitem__, known)))

    def run(self, reader: "ReaderInMemory") -> None:
        """Send a sample every `period_s` to a reader that has nothing else to do."""

        def cycle() -> None:
            if self._reader is not reader:
                return
            self.t_s = 100.0 + self.clock.now_s() - began_s - self.stood_still_s
            self._move()
            if not self.silent:
                self._send(self._packed(), receive)
            receive()
            self.clock.at(self.period_s, cycle)

        def receive() -> None:
            if not self.held_back:
                reader.receive()
                if self._sent:  # and a caller may look meanwhile
                    self.clock.at(1e-4, receive)

        self._reader = reader
        began_s = self._began_s = self.clock.now_s() if self._began_s is None else self._began_s
        self.clock.at(self.period_s, cycle)

    def _send(self, sample: bytes, receive: Callable[[], None]) -> None:
        """Send through a network that holds samples back until `stalled_until_s`, and is quicker than we are then."""
        self._arrives_s = max(self.clock.now_s(), self.stalled_until_s, self._arrives_s + 0.6 * self.period_s)

        def arrive() -> None:
            self._sent.append(sample)
            receive()

        if self._arrives_s > self.clock.now_s():
            self.clock.at(self._arrives_s - self.clock.now_s(), arrive)
        else:
            arrive()

    def _move(self) -> None:
        if self.goal_rad is None or self.program != 2 or self.safety_bits != 1:
            return
        if self.clock.now_s() < self.sweeps_until_s:
            return
        left_rad = self.goal_rad[5] - self.q_rad[5]
        step_rad = self.speed_rad_s * self.period_s
        if abs(left_rad) <= step_rad:
            self.q_rad, self.goal_rad = self.goal_rad, None
        else:
            self.q_rad = [*self.goal_rad[:5], self.q_rad[5] + (step_rad if left_rad > 0 else -step_rad)]

    # ------------------------------------------------------------------ dashboard server

    def ask(self, question: Callable[[Services], Any], timeout_s: float) -> Any:
        self.dashboard_limits_s.append(timeout_s)
        if self.dashboard_late_s is not None:
            self.clock.at(self.dashboard_late_s, lambda: question(self._services))
        if self.dashboard_late_s is not None or not self.dashboard_answers:
            self.clock.sleep(timeout_s)
            raise NoDashboard("the dashboard server does not answer")
        self.clock.sleep(0.02)
        return question(self._services)

    # ------------------------------------------------------------------ ur_rtde in the control process

    def moveJ(self, q: list[float], speed: float, acceleration: float, asynchronous: bool, /) -> bool:
        assert asynchronous
        assert acceleration > 0
        self.did.append("move")
        self._operation += 1
        self.goal_rad, self.speed_rad_s = q, speed
        return True

    def sweep(self, duration_s: float) -> bool:
        """Joint 6 moves away and back: what matters here is when it ends."""
        self.did.append("sweep")
        self.goal_rad, self.speed_rad_s = list(self.q_rad), 0.1
        self.sweeps_until_s = self.clock.now_s() + duration_s
        return True

    def getAsyncOperationProgressEx(self) -> "Controller":
        return self

    def operationId(self) -> int:
        return self._operation

    def isAsyncOperationRunning(self) -> bool:
        return self.goal_rad is not None

    def stopJ(self, deceleration: float, /) -> None:
        self.stopped_at_rad_s2.append(deceleration)
        self.did.append("stop softly")
        if self.stopping_works:
            self.goal_rad = None

    def stopScript(self) -> None:
        self.did.append("end our program")
        self.program = 1

    def isJointsWithinSafetyLimits(self, q: list[float], /) -> bool:
        return abs(q[5]) < 2.0

    def getTCPOffset(self) -> list[float]:
        return self.tcp_offset

    def setPayload(self, mass: float, cog: list[float], /) -> bool:
        self.did.append(f"payload {mass:g} {cog}")
        return self.takes_settings

    def setTargetPayload(self, mass: float, cog: list[float], inertia: list[float], /) -> bool:
        self.did.append(f"payload {mass:g} {cog} {inertia}")
        return self.takes_settings

    def setGravity(self, direction: list[float], /) -> bool:
        self.did.append(f"gravity {direction}")
        return self.takes_settings

    def isProgramRunning(self) -> bool:
        return self.program == 2

    def isConnected(self) -> bool:
        return True


class ServicesInMemory:
    """A dashboard server."""

    def __init__(self, controller: Controller) -> None:
        self._far = controller

    def stop(self) -> None:
        self._far.did.append("dashboard stop")
        self._far.program, self._far.goal_rad = 1, None

    def model(self) -> str | None:
        return "UR5"

    def serial(self) -> str | None:
        return "20225500001"

    def polyscope(self) -> str | None:
        return "5.15.0"

    def program(self) -> str | None:
        return "PLAYING other.urp"

    def in_remote_control(self) -> bool | None:
        return True

    def close(self) -> None: ...


class ControlInMemory(ControlProcess):
    """The control process without a process: its answers come by the fake clock."""

    def __init__(self, controller: Controller, timing: UrTiming) -> None:
        self._far = controller
        self._calls = control_child.Calls(controller, STOP_RAD_S2)
        self._asked = 0
        self._hangs = False
        super().__init__(HOST, STOP_RAD_S2, clock=controller.clock, timing=timing)
        controller.control = self
        assert isinstance(self._process, ProcessInMemory)
        self._process.take = self._take
        controller.clock.at(controller.starts_in_s, self._start)

    def _start(self) -> None:
        self._far.did.append("start our program")
        self._far.program = 2
        self._replies[0] = {"id": 0, "value": None}

    def _take(self, line: str) -> None:
        """Answer as `control_child.serve` does, later; and stop a move that the parent does not watch."""
        request = json.loads(line)
        self._asked += 1
        asked, far = self._asked, self._far
        self._hangs |= request["call"] in far.hanging
        if self._hangs:
            return

        def answer() -> None:
            if self.alive and (far.program == 2 or request["call"] in ("progress", "stop")):
                try:
                    value = getattr(self._calls, request["call"])(*request["args"])
                    self._replies[request["id"]] = {"id": request["id"], "value": value}
                except Exception as error:
                    self._replies[request["id"]] = {"id": request["id"], "error": str(error)}

        def watch() -> None:
            if self.alive and asked == self._asked and self._calls.moving:
                self._calls.stop_unwatched()

        far.clock.at(far.control_delay_s, answer)
        far.clock.at(self._timing.unwatched_s, watch)

    def kill(self) -> None:
        super().kill()
        self._ended = True

    def _read_replies(self, pipe: object) -> None:
        pass  # a fake clock is for one thread

    def _log_output(self, pipe: object) -> None:
        pass


class ProcessInMemory:
    """What of `subprocess.Popen` the parent uses."""

    pid, returncode = 0, -11

    def __init__(self, *_: object, **__: object) -> None:
        self._alive = True
        self.take: Callable[[str], None] = lambda _: None
        self.stdin = self.stdout = self.stderr = self

    def write(self, line: str) -> None:
        if not self._alive:
            raise BrokenPipeError
        self.take(line)

    def flush(self) -> None: ...

    def close(self) -> None: ...

    def kill(self) -> None:
        self._alive = False

    def wait(self, _: float | None = None) -> int:
        return self.returncode


class ReaderInMemory(Reader):
    """A reader whose samples come by the fake clock."""

    def __init__(self, controller: Controller, model: str | None, timing: UrTiming = STRICT) -> None:
        super().__init__(HOST, model, clock=controller.clock, timing=timing)
        controller.run(self)

    def receive(self) -> None:
        self._follow()

    @property
    def n_followers(self) -> int:
        return len(self._followers)

    def _run(self) -> None:
        pass  # a fake clock is for one thread


def install(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every `UrArm` and `Reader` find this controller."""
    monkeypatch.setattr(subprocess, "Popen", ProcessInMemory)
    monkeypatch.setattr(time, "sleep", controller.clock.sleep)  # in `Calls`
    monkeypatch.setattr(reading, "Subscription", lambda *_, **__: controller)
    monkeypatch.setattr(reading, "read_arm", lambda *_, **__: (None, controller.kinematics))
    monkeypatch.setattr(ServicesOf, "ask", lambda _, question, *, timeout_s, **__: controller.ask(question, timeout_s))
    monkeypatch.setattr(opening, "find_spec", lambda _: controller.ur_rtde_is_installed or None)
    monkeypatch.setattr(opening, "find_program_port", lambda *_, **__: None)
    monkeypatch.setattr(opening, "registers_in_use", lambda _, names, **__: [*names] * controller.registers_taken)
    monkeypatch.setattr(
        arm_module, "Reader", lambda _, model, *, timing, **__: ReaderInMemory(controller, model, timing)
    )
    monkeypatch.setattr(opening, "ControlProcess", lambda *_, timing, **__: ControlInMemory(controller, timing))


def away(controller: Controller) -> list[float]:
    return [*controller.q_rad[:5], controller.q_rad[5] + 1.0]  # 1 s


def no_guard() -> None:
    pass
