"""The control program on a controller in memory: what `drivers/ftdrivers/ur/program.script` does, on a `FakeClock`.

The text itself runs on the emulated controller: tests/wire/test_ur_failures.py.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.errors import StreamBroken
from ftdrivers.ur import opening, script_control
from ftdrivers.ur.control import STOP_RAD_S2
from ftdrivers.ur.primary import Message
from ftdrivers.ur.script_control import INPUTS, OUTPUTS, ScriptControl
from ftdrivers.ur.timing import UrTiming
from tests.unit.drivers.ur.controller_in_memory import CYCLE_S, HOST, Controller

COMMANDS = {1: "move", 2: "stop", 3: "limits", 4: "tcp_offset", 5: "set_payload", 6: "set_gravity", 7: "quit"}
COMMANDS |= {8: "wave", 9: "sweep"}


class Registers:
    """The RTDE inputs and outputs of the program, and the program itself."""

    def __init__(self, controller: Controller) -> None:
        self.far = controller
        self.inputs: Sequence[float] = (0.0,) * 14
        """Heartbeat, token, sequence number, command; ten numbers. They keep their values when a client goes."""
        self.outputs = [0.0] * 10
        """Token, state, sequence number, answer; the TCP."""
        self.running = False
        self.waves = [(0.0, 0.0, 0.0)] * 6
        self._hangs = False

    def start(self, token: int) -> None:
        """Run the program with this token."""
        self.token, self.running, self._hangs = token, True, False
        self._done, self._missed_s, self._alive, self._moving = 0, 0.0, False, False
        self._beat = self.inputs[0]
        self.outputs[1:3] = 0, 0
        self.far.did.append("start our program")
        self.far.program = 2
        self.far.clock.at(CYCLE_S, self._cycle)

    def _cycle(self) -> None:
        far = self.far
        if not self.running or far.program == 1:  # stopped from outside
            self.running = False
            return
        far.clock.at(CYCLE_S, self._cycle)
        paused = far.program != 2 or far.safety_bits != 1
        if paused or self._hangs:  # it hangs; or another program has replaced it, which uses other registers
            return
        beat, token, sequence, command = self.inputs[:4]
        self._missed_s = self._missed_s + CYCLE_S if beat == self._beat else 0.0
        self._alive |= beat != self._beat
        self._beat = beat
        if token != self.token:
            return self._end(-3)
        if self._missed_s > 0.2:
            return self._end(-2)
        if self._alive and sequence > self._done:
            name = COMMANDS[int(command)]
            if name in far.hanging:
                self._hangs = True
                return
            self._done = int(sequence)
            self.outputs[3] = self._carry_out(name, self.inputs[4:])
            if name == "quit":
                return self._end(-1)
        self._moving = self._moving and far.goal_rad is not None
        if self._alive:
            self.outputs[0] = self.token
        self.outputs[1:3] = 2 if self._moving else 1, self._done

    def _carry_out(self, name: str, numbers: Sequence[float]) -> bool:
        far = self.far
        if name == "move":
            if self._moving:
                return False
            self._moving = far.moveJ(list(numbers[:6]), numbers[6], numbers[7], True)
        elif name == "stop":
            if self._moving:
                far.stopJ(4.0)
                self._moving = not far.stopping_works
        elif name == "wave":
            self.waves[round(numbers[0])] = (numbers[1], numbers[2], numbers[3])
        elif name == "sweep":
            if self._moving or not np.allclose(numbers[:6], far.q_rad, atol=1e-3):
                return False
            far.swept = tuple(numbers[:8])
            self._moving = far.sweep(numbers[6])
        elif name == "limits":
            return abs(numbers[5]) < 2.0
        elif name == "tcp_offset":
            self.outputs[4:] = far.tcp_offset
        elif name == "set_payload":
            return far.setTargetPayload(numbers[0], list(numbers[1:4]), list(numbers[4:10]))
        elif name == "set_gravity":
            return far.setGravity(list(numbers[:3]))
        return True

    def _end(self, state: int) -> None:
        self.outputs[1:3] = state, self._done
        if self._moving:
            self.far.stopJ(4.0)
        if state == -1:
            self.far.did.append("end our program")
        self.running = False
        self.far.program, self.far.goal_rad = 1, None


class Link:
    """The connection that owns the inputs, in place of `Subscription`."""

    def __init__(self, registers: Registers) -> None:
        self.registers = registers
        self.closed = False
        self.cut = False
        """What is sent in either direction is lost."""
        self.failure: Exception | None = None
        self.sent: deque[tuple[float, ...]] = deque()

    def sample(self) -> None:
        far = self.registers.far
        if not (self.cut or far.silent):
            self.sent.append((far.t_s, *self.registers.outputs))

    def read(self, timeout_s: float) -> list[tuple[float, ...]]:
        assert timeout_s <= 0.05
        if self.closed:
            raise OSError("closed")
        if self.failure or self.registers.far.failure:
            raise self.failure or StreamBroken("closed")
        if not self.sent:
            raise TimeoutError
        samples = [*self.sent]
        self.sent.clear()
        return samples

    def decode(self, samples: Sequence[tuple[float, ...]]) -> Mapping[str, NDArray[Any]]:
        return dict(zip(OUTPUTS, np.array(samples).T, strict=True))

    def write(self, values: Sequence[float]) -> None:
        if self.closed:
            raise OSError("closed")
        assert len(values) == len(INPUTS)
        if not self.cut:
            self.registers.inputs = values

    def close(self) -> None:
        self.closed = True


class ScriptInMemory(ScriptControl):
    """The control path, its thread in turns on the fake clock: with each sample, or with the time-out of a read."""

    suspended = False

    def __init__(self, link: Link, timing: UrTiming) -> None:
        self.link = link
        super().__init__(HOST, link.registers.far.version, STOP_RAD_S2, clock=link.registers.far.clock, timing=timing)
        link.registers.far.control = self
        self._stream = stream = self._connect()

        def cycle() -> None:
            link.sample()
            if self.suspended or self._turn(stream):
                self._clock_at(CYCLE_S, cycle)

        self._clock_at(CYCLE_S, cycle)

    def _clock_at(self, delay_s: float, action: Callable[[], None]) -> None:
        self.link.registers.far.clock.at(delay_s, action)

    def send_again(self, command: tuple[int, int, tuple[float, ...]]) -> None:
        self._command = command

    @property
    def token(self) -> int:
        return self._token


class PrimaryInMemory:
    """The primary interface: it starts the program after a while."""

    closed = False

    def __init__(self, registers: Registers, messages: list[Message], closes: Callable[[], bool]) -> None:
        self._registers = registers
        self._messages = messages
        self._closes = closes

    def send(self, program: str) -> None:
        token = int(program.split("ft_token = ")[1].split(maxsplit=1)[0])
        self._registers.far.clock.at(self._registers.far.starts_in_s, lambda: self._start(token))

    def _start(self, token: int) -> None:
        if not self._messages and not self._closes():
            self._registers.start(token)

    def read(self, _: float = 0.0) -> list[Message]:
        self.closed = self._closes()
        messages = [*self._messages]
        self._messages.clear()
        return messages

    def close(self) -> None: ...


class ThreadInMemory:
    """In place of a `Follower`, whose work the fake clock does."""

    def __init__(self, *_: object) -> None: ...

    def start(self) -> None: ...

    def is_alive(self) -> bool:
        return False


class Script:
    """What tests of the script path reach: registers, link and messages of the controller."""

    def __init__(self, controller: Controller) -> None:
        self.registers = Registers(controller)
        self.messages: list[Message] = []
        self.read_only = False
        self.link = Link(self.registers)
        """Of the newest control path."""


def install_script(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> Script:
    """Let every control path of `UrArm` find this controller."""
    script = Script(controller)

    def link(*_: object, **__: object) -> Link:
        return script.link

    def control(*_: object, timing: UrTiming, **__: object) -> ScriptInMemory:
        script.link = Link(script.registers)
        return ScriptInMemory(script.link, timing)

    def primary(*_: object, **__: object) -> PrimaryInMemory:
        return PrimaryInMemory(script.registers, script.messages, lambda: script.read_only)

    monkeypatch.setattr(script_control, "Subscription", link)
    monkeypatch.setattr(script_control, "Follower", ThreadInMemory)
    monkeypatch.setattr(script_control, "Primary", primary)
    monkeypatch.setattr(opening, "ScriptControl", control)
    return script
