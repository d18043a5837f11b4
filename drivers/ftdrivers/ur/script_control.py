"""The control path `script`: a control program on the controller, which receives commands in RTDE registers.

`program.script` describes the registers, and tests compare both files. It only uses constructs of programs that are
known to run on controllers, see docs/reference/urscript-constructs.md. A thread answers every sample of the controller
with a heartbeat, on the connection that owns the inputs. If the heartbeat does not change for 0.2 s of the controller's
time, the program stops the arm and ends. This happens after a crash, a suspension or a power failure of this computer,
or if the cable is cut.

Ref: Universal Robots, URScript manual, "Real-Time Data Exchange (RTDE) Guide".
Checked on hardware: no.
"""

import logging
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Final, Self

from ftdrivers.clock import Clock, Follower
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.ur.control import Control, LookOut, ProgramRefused
from ftdrivers.ur.primary import Code, Failed, Primary, RobotType, Stopped
from ftdrivers.ur.rtde import Subscription
from ftdrivers.ur.timing import Patience, UrTiming, held

NAME: Final = "ftdrive_control"
"""Name of the control program on the controller."""
INPUTS: Final = MappingProxyType(
    {f"input_int_register_{k}": "INT32" for k in range(32, 36)}
    | {f"input_double_register_{k}": "DOUBLE" for k in range(24, 34)}
)
"""Inputs of the program: heartbeat, token, sequence number and command, then the numbers of the command."""
OUTPUTS: Final = MappingProxyType(
    {"timestamp": "DOUBLE"}
    | {f"output_int_register_{k}": "INT32" for k in range(32, 36)}
    | {f"output_double_register_{k}": "DOUBLE" for k in range(24, 30)}
)
"""Outputs: the controller's time, then token, state, sequence number and answer of the last command, then the TCP."""
NUMBERS: Final = 10
"""Number of registers for the numbers of one command."""
COMMANDS: Final = MappingProxyType(
    {
        "move": 1,
        "stop": 2,
        "within_safety_limits": 3,
        "tcp_offset": 4,
        "set_payload": 5,
        "set_gravity": 6,
        "quit": 7,
        "wave": 8,
        "sweep": 9,
    }
)
"""Codes of the commands, by the names of `control_child.Calls`, which has no sweep."""
# A command is executed once, if its sequence number is higher than the last one. Therefore no motion can start late.
MOVING: Final = ("move", "sweep")
"""Codes of the commands that start a motion."""
_MOVING: Final = 2
_NO_HEARTBEAT: Final = -2


@dataclass(frozen=True, slots=True)
class _Report:
    """Content of the output registers of the control program."""

    token: int = 0
    state: int = 0
    sequence: int = 0
    answer: int = 0
    tcp_offset: tuple[float, ...] = ()

    @classmethod
    def of(cls, numbers: Sequence[Any]) -> Self:
        """Build a report from the values of `OUTPUTS` after the first."""
        token, state, sequence, answer, *tcp_offset = numbers
        return cls(token, state, sequence, answer, tuple(tcp_offset))

    @property
    def moves(self) -> bool:
        return self.state == _MOVING

    @property
    def has_ended(self) -> bool:
        """Whether the control program reports that it has ended by itself."""
        return self.state < 0

    @property
    def missed_heartbeat(self) -> bool:
        return self.state == _NO_HEARTBEAT


def without_comments(text: str) -> str:
    """Return a program without comment lines and empty lines, which UR's client library removes too."""
    return "".join(f"{line}\n" for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))


def program_text(token: int, version: Sequence[int], stop_rad_s2: float) -> str:
    """Return the control program for one session on a controller of this version; stops decelerate by `stop_rad_s2`."""
    # set_target_payload exists since 5.10, and also sets the inertia.
    # The program text contains the token. A program that starts late finds another token, or no heartbeat, and
    # ends.
    com, inertia = (", ".join(f"ft_number({k})" for k in numbers) for numbers in (range(1, 4), range(4, 10)))
    payload = f"set_payload(ft_number(0), [{com}])"
    if tuple(version[:2]) >= (5, 10):
        payload = f"set_target_payload(ft_number(0), [{com}], [{inertia}])"
    text = without_comments(files("ftdrivers.ur").joinpath("program.script").read_text("ascii"))
    fields = {"$TOKEN": str(token), "$DECELERATION": f"{stop_rad_s2:.4f}", "$SET_PAYLOAD": payload}
    for field, value in fields.items():
        text = text.replace(field, value)
    return text


log = logging.getLogger(__name__)

# In 400 trials the arm began to decelerate at most 0.23 s after the last heartbeat.
STOPS_ITSELF_S: Final = 0.3
"""Longest time from the last heartbeat to the start of braking, s: 0.2 s plus cycles of controller and client."""
_RATE_HZ: Final = 125.0
_LOOK_OUT_S: Final = 0.05
_LARGEST: Final = 2**31 - 1


class ScriptControl(Control):
    """The control program `program.script`, and the connections to it."""

    stops_itself = True

    def __init__(
        self, host: str, version: Sequence[int], stop_rad_s2: float, *, clock: Clock, timing: UrTiming
    ) -> None:
        self._host = host
        self._clock = clock
        self._timing = timing
        self._token = 1 + secrets.randbelow(_LARGEST - 1)
        self._program = program_text(self._token, version, stop_rad_s2)
        self._changed = threading.Condition(threading.RLock())
        self._calling = threading.RLock()  # re-entrant, because a signal handler may stop the arm during a call
        self._beat = secrets.randbelow(_LARGEST)
        # The last command that was sent: sequence number, code, numbers.
        self._command: tuple[int, int, tuple[float, ...]] = (0, 0, (0.0,) * NUMBERS)
        self._report = _Report()
        self._beats = 0
        self._failure: DeviceError | None = None
        # The last error that the controller reported for any program.
        self._error: DeviceFault | None = None
        self._end_reason: DeviceError | None = None
        self._refusal: ProgramRefused | None = None
        self._killed = False
        self._moving = self._unwatched = False
        self._asked_s = self._heard_s = clock.now_s()
        self._silent_s = 0.0
        self._t_device_s = -1.0
        self._primary: Primary | None = None
        self._stream: Subscription | None = None
        self._thread = Follower(clock, self._run, "ur-heartbeat")
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the control program accepts calls."""
        return not self._killed and self._failure is None

    @property
    def has_ended(self) -> bool:
        """Whether the control program has reported its own end."""
        return self._report.token == self._token and self._report.has_ended

    def wait_until_ready(self, look_out: LookOut) -> None:
        """Send the program, and return when it reacts to heartbeats of this session; see `Control`."""
        wait = partial(self._wait, timeout_s=self._timing.starting_s, look_out=look_out, what="start")
        wait(lambda: self._beats >= 2 or self._refusal is not None)  # then the registers hold token and sequence number
        if self._refusal is not None:
            raise self._refusal
        try:
            primary = Primary(self._host, timeout_s=self._timing.connect_s)
        except ConnectError as error:
            raise ProgramRefused(error.found, error.fix) from error
        try:
            primary.send(self._program)
        except OSError as error:
            primary.close()
            raise StreamBroken(f"the program was not sent ({error})") from error
        with self._changed:
            self._primary = primary
        wait(lambda: self._report.token == self._token or self._refusal is not None)
        if self._refusal is not None:
            raise self._refusal

    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Send a command and wait for its answer, see `Control`."""
        with held(self._calling, self._clock):
            self._asked_s = self._clock.now_s()
            if name == "progress":
                return self._progress()
            with self._changed:
                if not self.alive:
                    raise self._loss()
                sequence = self._request(COMMANDS[name], tuple(_flat(args)))
            self._wait(
                lambda: self._report.sequence >= sequence,
                timeout_s=self._timing.call_s if timeout_s is None else timeout_s,
                look_out=look_out,
                what=f"answer the command {name}",
            )
            with self._changed:
                report = self._report
                self._moving = self._moving or (name in MOVING and bool(report.answer))
            if report.sequence > sequence:
                raise StreamBroken(f"another command replaced {name}", "open the arm again")
            if name == "tcp_offset":
                return list(report.tcp_offset)
            return bool(report.answer)

    def kill(self) -> None:
        """Request the end of the program once more, then end the heartbeat; the arm brakes within 0.3 s. Idempotent.

        A paused program finds the request in the registers when it is resumed, and does not move.
        """
        with self._changed:
            if not self._killed:
                self._killed = True
                with suppress(OSError):  # the connection may be lost
                    self._request(COMMANDS["quit"], ())
            self._changed.notify_all()
        self._close_stream()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=1.0)
        if self._primary is not None:
            self._primary.close()

    def end_reason(self) -> DeviceError | None:
        """Return why the program has ended: a run-time error, a missing heartbeat, or a lost connection."""
        return copy(self._end_reason or self._failure)

    def explained(self, error: DeviceError) -> DeviceError:
        """Return the error of a lost controller, completed by the information that its program stops the arm."""
        return type(error)(
            f"{error.found}, so the control program begins to stop the arm by itself within {STOPS_ITSELF_S} s",
            "check the robot and the cable, then open the arm again",
        )

    def _progress(self) -> tuple[bool, bool]:
        with self._changed:
            if not self.alive:
                raise self._loss()
            ended = not self._report.moves
            self._moving = self._moving and not ended
            return ended, self._unwatched

    def _wait(self, done: Callable[[], bool], *, timeout_s: float, look_out: LookOut, what: str) -> None:
        patience = Patience(self._clock, timeout_s)
        looked_s = self._clock.now_s()
        while True:
            with self._changed:
                if not done() and self.alive and not patience.is_over:
                    patience.wait(self._changed)
                if done():
                    return
                if not self.alive:
                    raise self._loss()
            if patience.is_over:
                self.kill()
                raise DeviceTimeout(
                    f"the control program did not {what} within {timeout_s:.1f} s, so its heartbeat was stopped",
                    "check the robot and the network, then open the arm again",
                )
            if self._clock.now_s() - looked_s >= _LOOK_OUT_S:
                look_out()
                looked_s = self._clock.now_s()

    def _loss(self) -> DeviceError:
        return copy(self._failure) or StreamBroken(f"the control of {self._host} was ended", "open the arm again")

    # ------------------------------------------------------------------ the heartbeat

    def _run(self) -> None:
        try:
            with self._clock.away():
                stream = self._connect()
        except DeviceError as error:
            self._refuse(error)
            return
        with self._changed:
            self._stream = stream
        try:
            while self._turn(stream):
                pass
        finally:
            self._fail("its thread has ended")  # keeps a reason that is known already

    def _connect(self) -> Subscription:
        timeout_s = self._timing.connect_s
        return Subscription(self._host, OUTPUTS, _RATE_HZ, timeout_s=timeout_s, clock=self._clock, inputs=INPUTS)

    def _turn(self, stream: Subscription) -> bool:
        """Read the samples that have arrived and answer with a heartbeat; return whether to continue."""
        # The heartbeat only advances with a new sample: it shows that samples arrive and that this process runs.
        try:
            outputs = stream.decode(stream.read(self._clock.poll_s)[-1:])
        except TimeoutError:
            return self._pause()
        except DeviceError as error:
            return self._fail(error.found)
        except OSError as error:
            return self._fail(str(error))
        t_device_s, *numbers = (column[-1].item() for column in outputs.values())
        if t_device_s == self._t_device_s:
            return self._pause()  # a repeated sample is no sign that the controller runs
        self._t_device_s, self._silent_s, self._heard_s = t_device_s, 0.0, self._clock.now_s()
        with self._changed:
            if self._killed:
                return False
            self._report = _Report.of(numbers)
            if self.has_ended and self._report.missed_heartbeat:
                self._end_reason = self._end_reason or DeviceTimeout(
                    "the control program has stopped the arm and ended, because it received no heartbeat for 0.2 s",
                    "keep the computer awake, check the network, then open the arm again",
                )
            try:
                self._watch()
                self._beat = (self._beat + 1) % _LARGEST
                self._beats += 1
                self._write()
            except OSError as error:
                return self._fail(str(error))
            self._changed.notify_all()
        self._read_messages()
        return True

    def _pause(self) -> bool:
        """Measure the silence of the controller. A suspension of this process adds two turns at most."""
        now_s = self._clock.now_s()  # an emulated cell waits for this thread
        self._silent_s += min(now_s - self._heard_s, 2 * self._clock.poll_s)
        self._heard_s = now_s
        if self._silent_s > self._timing.stale_s:
            return self._fail(f"the controller sent nothing for {self._silent_s:.2f} s")
        return not self._killed

    def _fail(self, why: str) -> bool:
        with self._changed:
            if not self._killed and self._failure is None:
                self._failure = self.explained(
                    StreamBroken(f"the connection to the control program on {self._host} was lost ({why})")
                )
            self._changed.notify_all()
        self._close_stream()  # from now on no command can arrive
        return False

    def _close_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()

    def _watch(self) -> None:
        """Stop a move that no caller has watched for too long."""
        if self._moving and self._clock.now_s() - self._asked_s > self._timing.unwatched_s:
            self._moving = False
            if self._report.moves:
                self._unwatched = True
                self._set(COMMANDS["stop"], ())

    def _read_messages(self) -> None:
        primary = self._primary
        if primary is None or primary.closed:
            return
        for message in primary.read():
            log.log(logging.DEBUG if isinstance(message, RobotType) else logging.INFO, "%s: %s", self._host, message)
            if isinstance(message, Failed):
                fix = "select the other control path, and report this error"
                self._error = DeviceFault(f"the control program failed in line {message.line}: {message.text}", fix)
                self._refuse(self._error)
            elif isinstance(message, Code) and message.is_read_only:
                self._refuse(self._read_only("error code 210: the connection is read-only"))
            elif isinstance(message, Stopped) and message.name == NAME:
                self._end_reason = self._end_reason or self._error
        if primary.closed:
            log.info("%s closed the primary interface", self._host)
            self._refuse(self._read_only("the controller closed the connection"))

    def _refuse(self, error: DeviceError) -> None:
        """Store the reason why the control program does not start; do nothing if it has started."""
        with self._changed:
            if self._report.token != self._token and self._refusal is None:
                self._refusal = ProgramRefused(error.found, error.fix)
            self._changed.notify_all()

    def _read_only(self, how: str) -> ConnectError:
        return ConnectError(
            f"{self._host} accepts no programs from the network ({how})",
            "switch the pendant to remote control (PolyScope X: Safety overview, Control mode, Remote)",
        )

    # ------------------------------------------------------------------ the registers

    def _request(self, command: int, numbers: Sequence[float]) -> int:
        """Send a command immediately; return its sequence number."""
        self._set(command, numbers)
        try:
            self._write()
        except OSError as error:
            if not self._killed:
                self._fail(str(error))
                raise self._loss() from error
        return self._command[0]

    def _set(self, command: int, numbers: Sequence[float]) -> None:
        if command in {COMMANDS[name] for name in MOVING}:
            self._unwatched = False
        padding = (0.0,) * (NUMBERS - len(numbers))
        self._command = (self._command[0] + 1, command, (*numbers, *padding))

    def _write(self) -> None:
        # One package holds heartbeat, token, sequence number and command, so that the program never reads half of them.
        sequence, command, numbers = self._command
        if self._stream is not None:
            self._stream.write((self._beat, self._token, sequence, command, *numbers))


def _flat(values: Sequence[object]) -> Iterator[float]:
    """Yield the numbers of an argument list, in which nested sequences are flattened and None is skipped."""
    for value in values:
        if isinstance(value, Sequence):
            yield from _flat(value)
        elif value is not None:
            yield float(value)  # type: ignore[arg-type]  # checked by the caller
