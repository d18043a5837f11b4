"""Give weight and contact wrench to the program that runs on the controller, through registers.

The program sets a request, the service answers: docs/reference/program-registers.md has the table. The live counter
advances with each new wrench, and stands still when there is none: a register keeps its last value for ever, so a
program must look at the counter and never at a number alone.
"""

import math
import threading
from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Protocol, get_args

import numpy as np

from ftcalib.after.weighing import Weight
from ftcalib.model import angle_between_vectors
from ftdrive.live.samples import Block, StreamInfo, Tracking
from ftdrive.live.stream import BlockReader, CompensatedStream
from ftdrive.live.weighing import WEIGH_S, CannotWeigh, Scale, load_values
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import Array

if TYPE_CHECKING:
    from ftdrive.store.weighing_log import WeighingLog

INTEGERS: Final = ("state", "code", "condition", "number", "live", "tracking")
DOUBLES: Final = (
    *("fx", "fy", "fz", "tx", "ty", "tz"),
    *("mass", "mass_sigma", "least_mass"),
    *("com_x", "com_y", "com_z", "com_sigma_x", "com_sigma_y", "com_sigma_z"),
)
"""What the input registers hold from the first one on, of each kind."""
TRACKED: Final = ("bias_fx", "bias_fy", "bias_fz", "bias_tx", "bias_ty", "bias_tz", "bias_age")
"""Further doubles where bias and part are followed."""
TRACKINGS: Final[tuple[Tracking, ...]] = get_args(Tracking)
"""What `tracking` counts: where it is 0, the registers of `TRACKED` are not those of the service."""
NEVER_S: Final = -1.0
"""Age of the last look at the bias, before the first one."""

STALE_S: Final = 0.05
"""Without a sample for so long the wrench counts as stale."""
PATIENCE_S: Final = 1.0
"""So long a request waits for rest before it is refused; a weighing at rest takes `WEIGH_S`."""
_TRY_NS: Final = 20_000_000
_WAITS: Final = ("samples", "moving", "unsteady")
# A load differs from a push by the direction of its force, which is so near to gravity.
_ALIKE_RAD: Final = 0.1
_COUNT_LIMIT: Final = 2**30


class Command(IntEnum):
    """What a program may request."""

    WEIGH, ZERO, STATUS = 1, 2, 3


class State(IntEnum):
    """State of the service, and of the last request while `number` is its number."""

    STOPPED, READY, BUSY, REFUSED = range(4)


class Condition(IntEnum):
    """What the wrench is. Whatever it is, the wrench is valid only while the live counter advances."""

    FREE, CONTACT, UNKNOWN_LOAD, STALE = range(4)


CODES: Final = {
    "": 0,
    "samples": 1,
    "moving": 2,
    "unsteady": 3,
    "contact": 4,
    "cable": 5,
    "changed": 6,
    "lifted": 7,
    "not-empty": 8,
    "command": 9,
}
"""Why a request was refused."""


class Registers(Protocol):
    """Registers of the controller, see `ftdrivers.ur.rtde`."""

    @property
    def request(self) -> tuple[int, int] | None:
        """Number and command of the last request."""

    def write(self, integers: list[int], doubles: list[float]) -> None:
        """Set all inputs at once."""

    def close(self) -> None:
        """Close the connection."""


def doubles_of(track: Tracking) -> tuple[str, ...]:
    """Return what the double registers hold."""
    return DOUBLES if track == "off" else DOUBLES + TRACKED


class ProgramService:
    """Answers one program.

    Parameters
    ----------
    stream : CompensatedStream
        Open, in the frame that the program gets; read here. With `stream.track` the program gets the tracked bias too.
    connect : callable
        Opens the registers, as many as `INTEGERS` and `doubles_of(stream.track)`; called again after they were lost.
    say : callable
        Takes a sentence for the operator, from any thread.
    log : WeighingLog, optional
        Keeps the answers.
    """

    def __init__(
        self,
        stream: CompensatedStream,
        connect: Callable[[], Registers],
        say: Callable[[str], object],
        log: "WeighingLog | None" = None,
    ) -> None:
        self._stream, self._connect, self._say, self._log = stream, connect, say, log
        self._registers: Registers | None = connect()
        self._scale = Scale(stream)
        self._lock = threading.Lock()
        self._live = 0
        self._answered: int | None = None
        # Number, command and time of the request in progress.
        self._busy: tuple[int, int, int] | None = None
        self._tried_ns = 0
        self._state, self._code, self._condition = State.READY, 0, Condition.FREE
        self._wrench = np.zeros(6)
        self._weight = np.zeros(9)
        self._newest_ns = 0
        self._ends = threading.Event()
        self.on_block: Callable[[Block], object] | None = None
        """Called with each block after its wrench was written."""

    def run(self) -> None:
        """Serve until an exception; a failed device or a lost controller is waited for."""
        clock = self._stream.clock
        begin_s = clock.now_s()
        while clock.now_s() - begin_s < WEIGH_S:
            self._stream.read()
        self._scale.warm_up()
        watch = threading.Thread(target=self._watch, daemon=True)
        try:
            watch.start()
            # an emulated controller must not wait for a busy computer
            with clock.keeping_up():
                self._serve()
        finally:
            # Ctrl-C may come while the thread starts: it must not outlive the cell.
            self._ends.set()
            if watch.ident is not None:
                watch.join()
            self.stop()

    def _serve(self) -> None:
        meanwhile = "The program sees a stale wrench."
        for block in BlockReader(self._stream, math.inf, say=self._say, meanwhile=meanwhile):
            if block is not None:
                self.take(block)
                # nothing records events, and they would pile up as long as the service runs
                self._stream.take_events()

    def stop(self) -> None:
        """Write that the service has ended, and close."""
        with self._lock:
            self._state, self._condition = State.STOPPED, Condition.STALE
            self._write()
            if self._registers is not None:
                self._registers.close()

    def take(self, block: Block) -> None:
        """Write the newest sample of a block, and work on a request."""
        t_ns = int(block.t_host_ns[-1])
        with self._lock:
            self._newest_ns = t_ns
            self._wrench = block.wrench[-1]
            self._condition = self._judge(block)
            self._work(t_ns)
            # In contact too, because a program must be able to react to a contact force.
            self._live = (self._live + 1) % _COUNT_LIMIT
            self._write()
        if self.on_block is not None:
            self.on_block(block)

    def _watch(self) -> None:
        """Write that the wrench is stale when no sample comes, and reconnect to the controller."""
        clock = self._stream.clock
        while not self._ends.wait(0.02):
            with self._lock:
                if (clock.now_ns() - self._newest_ns) * 1e-9 > STALE_S and self._condition is not Condition.STALE:
                    self._condition = Condition.STALE
                    self._write()
                lost = self._registers is None
            if lost:
                self._reconnect()

    def _reconnect(self) -> None:
        try:
            registers = self._connect()
        except DeviceError:
            self._ends.wait(0.5)
            return
        with self._lock:
            self._registers = registers
            self._answered = self._busy = None
        self._say("The controller answers again.")

    def _write(self) -> None:
        if self._registers is None:
            return
        busy = self._busy is not None
        number = self._busy[0] if self._busy is not None else self._answered or 0
        state = State.BUSY if busy and self._state is not State.STOPPED else self._state
        tracking = TRACKINGS.index(self._stream.track)
        integers = [int(state), 0 if busy else self._code, int(self._condition), number, self._live, tracking]
        tracked = self._tracked() if tracking else []
        try:
            # All inputs go in one package, so that a program never reads half of an answer.
            self._registers.write(integers, [*self._wrench.tolist(), *self._weight.tolist(), *tracked])
        except DeviceError as error:
            if self._state is not State.STOPPED:
                self._say(f"{error}. Trying again.")
            self._registers.close()
            self._registers = None

    def _tracked(self) -> list[float]:
        """Return the tracked change of the bias since the calibration, and the age of the last look at it."""
        tracked = self._stream.tracked
        if tracked is None or not np.isfinite(tracked.last_seen_s):
            return [0.0] * 6 + [NEVER_S]
        return [*tracked.bias.tolist(), tracked.last_seen_s + max(self._newest_ns * 1e-9 - tracked.t_s, 0.0)]

    def _judge(self, block: Block) -> Condition:
        """Return what touches the tool; a load that is not known pulls along gravity."""
        if not block.in_contact[-1]:
            return Condition.FREE
        R_base_sensor = block.R_base_flange[-1] @ self._stream.info.calibration.R_flange_sensor
        force_N = R_base_sensor @ self._stream.contact_reading()[:3]
        down = self._stream.info.calibration.gravity_force_base_N
        leans_rad = angle_between_vectors(force_N, down)
        return Condition.UNKNOWN_LOAD if min(leans_rad, np.pi - leans_rad) < _ALIKE_RAD else Condition.CONTACT

    # -------------------------------------------------------------------------------------------------------- requests

    def _work(self, t_ns: int) -> None:
        try:
            request = None if self._registers is None else self._registers.request
        except DeviceError:
            # the next write finds it too
            request = None
        if request is not None and self._answered is None and self._busy is None:
            # of a program before us
            self._answered = request[0]
            self._state, self._code = State.READY, 0
        elif request is not None and request[0] != (self._busy[0] if self._busy else self._answered):
            self._busy, self._tried_ns = (*request, t_ns), t_ns + round(WEIGH_S * 1e9)
        if self._busy is None:
            return
        _, command, since_ns = self._busy
        if command == Command.STATUS:
            self._answer("")
        elif command not in (Command.WEIGH, Command.ZERO):
            self._answer("command")
        elif t_ns >= self._tried_ns:
            self._tried_ns = t_ns + _TRY_NS
            try:
                self._weigh(since_ns) if command == Command.WEIGH else self._zero(since_ns)
            except CannotWeigh as refusal:
                if refusal.code not in _WAITS or (t_ns - since_ns) * 1e-9 > PATIENCE_S:
                    self._answer(refusal.code)
                    if self._log is not None:
                        self._log.refused(refusal.code)
            else:
                self._answer("")

    def _answer(self, code: str) -> None:
        assert self._busy is not None  # noqa: S101 - the callers work on a request
        self._answered, self._busy = self._busy[0], None
        self._state, self._code = State.REFUSED if code else State.READY, CODES[code]
        if code:
            self._weight = np.zeros(9)

    def _weigh(self, since_ns: int) -> None:
        weight = self._scale.weigh(since_ns)
        info, known = self._stream.info, weight.is_something
        mass = [weight.mass_kg if known else 0.0, weight.mass_sigma_kg, weight.least_kg]
        self._weight = np.array([*mass, *(_placed(weight, info) if known else np.zeros(6))])
        self._stream.hold(weight if known else None)
        values = load_values(weight, info)
        self._stream.note("load", f"weighed for the program: {weight.mass_kg:.4f} kg", values)
        if self._log is not None:
            self._log.weighed(values)

    def _zero(self, since_ns: int) -> None:
        self._scale.zero(since_ns)
        self._stream.hold(None)


def _placed(weight: Weight, info: StreamInfo) -> Array:
    """Return centre of mass and sigma in flange axes from the flange, (6,)."""
    R = info.calibration.R_flange_sensor
    p_m, C = info.p_flange_sensor_m + R @ weight.p_sensor_com_m, R @ weight.com_covariance @ R.T
    return np.concatenate([p_m, np.sqrt(np.diag(C))])
