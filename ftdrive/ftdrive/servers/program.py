"""Weight and contact wrench for the program on the controller, through registers.

The program writes a request, and the service answers: see the table in docs/reference/program-registers.md. A register
keeps its last value when the service stops. Therefore the live counter advances with each new wrench, and a program
must check the counter before it uses a value.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Final, get_args

import numpy as np

from ftcalib.files import JSON
from ftcalib.model import angle_between_vectors
from ftdrive.stream.samples import Block, StreamEvent, Tracking
from ftdrive.stream.stream import Sink, Stream, pump
from ftdrive.stream.weighing import WEIGH_S, CannotWeigh, Scale, load_values
from ftdrivers.errors import DeviceError
from ftdrivers.ur.rtde import ProgramRegisters

INTEGERS: Final = ("state", "code", "condition", "number", "live", "tracking")
DOUBLES: Final = (
    *("fx", "fy", "fz", "tx", "ty", "tz"),
    *("mass", "mass_sigma", "least_mass"),
    *("com_x", "com_y", "com_z", "com_sigma_x", "com_sigma_y", "com_sigma_z"),
)
"""Values that the service writes to double registers of the controller, from the first register on."""
TRACKED: Final = ("bias_fx", "bias_fy", "bias_fz", "bias_tx", "bias_ty", "bias_tz", "bias_age")
"""Values written after `DOUBLES` if bias and part are tracked. If `tracking` is 0, they are not written."""

STALE_S: Final = 0.05
"""The wrench is stale after this time without a sample, s."""
PATIENCE_S: Final = 1.0
"""A request is refused if the arm does not come to rest in this time, s; a weighing at rest takes `WEIGH_S`."""
_TRY_NS: Final = 20_000_000
_WAITS: Final = ("samples", "moving", "unsteady")
# A contact whose force is within this angle, rad, of gravity, up or down, is taken for an unknown load.
_ALIKE_RAD: Final = 0.1
_COUNT_LIMIT: Final = 2**30


class ServiceCommand(IntEnum):
    """Request that a program on the controller can make."""

    WEIGH, ZERO, STATUS = 1, 2, 3


class ServiceState(IntEnum):
    """State of the service; while `number` is the number of the last request, the state of that request."""

    STOPPED, READY, BUSY, REFUSED = range(4)


class Condition(IntEnum):
    """Condition of the wrench; the wrench is valid only while the live counter advances."""

    FREE, CONTACT, UNKNOWN_LOAD, STALE = range(4)


_REASONS: Final = "samples", "moving", "unsteady", "contact", "cable", "changed", "lifted", "not-empty", "command"
CODES: Final = {"": 0} | {reason: number for number, reason in enumerate(_REASONS, 1)}
"""Code of each reason to refuse a request. Programs on arms use the numbers, so add new reasons at the end."""


def doubles_of(track: Tracking) -> tuple[str, ...]:
    """Return the names of the values in the double registers, depending on whether bias and part are tracked."""
    return DOUBLES if track == "off" else DOUBLES + TRACKED


class ProgramService(Sink):
    """Answers the requests of one program on the controller, and writes the contact wrench to its registers.

    Parameters
    ----------
    stream : Stream
        An open stream in the frame for the program, read by `run`. With `stream.track`, the program also gets the
        tracked bias.
    connect : callable
        Opens registers for `INTEGERS` and `doubles_of(stream.track)`; called again after a loss of the connection.
    say : callable
        Receives sentences for the operator, from any thread.
    keep : callable
        Receives each weighing and each refused weighing; see `WeighingLog.keep`.
    """

    label, keeps_all = "registers", True

    def __init__(
        self,
        stream: Stream,
        connect: Callable[[], ProgramRegisters],
        say: Callable[[str], object],
        keep: Callable[[Mapping[str, JSON]], object] = lambda _: None,
    ) -> None:
        self._stream, self._connect, self._say, self._keep = stream, connect, say, keep
        self._registers: ProgramRegisters | None = connect()
        self._scale = Scale(stream)
        self._lock = threading.Lock()
        self._live = 0
        # Number of the last request. None until a first one is read, which is ignored: it may be an earlier program's.
        self._number: int | None = None
        self._command, self._since_ns, self._due_ns = 0, 0, 0
        self._state, self._code, self._condition = ServiceState.READY, 0, Condition.FREE
        self._wrench, self._weight = [0.0] * 6, [0.0] * 9
        self._newest_ns = 0
        self._ends = threading.Event()
        self._watching = threading.Thread(target=self._watch, daemon=True)

    def run(self) -> None:
        """Serve until an exception; wait while a device or the controller does not answer."""
        stream, clock = self._stream, self._stream.clock
        end_s = clock.now_s() + WEIGH_S
        for _ in pump(stream, until=lambda: clock.now_s() >= end_s, patience_s=0.0):
            pass
        self._scale.warm_up()
        # an emulated controller must keep up on a busy computer
        with clock.keeping_up():
            meanwhile = "The program sees a stale wrench."
            for _ in pump(stream, [self], patience_s=math.inf, say=self._say, meanwhile=meanwhile):
                pass

    def begin(self, _: Stream) -> None:
        """Start the thread that watches samples and controller."""
        self._watching.start()

    def add(self, block: Block | None, _: Sequence[StreamEvent]) -> None:
        """Write the newest sample of a block, and continue a request."""
        if not block:
            return
        t_ns = int(block.t_host_ns[-1])
        with self._lock:
            self._newest_ns = t_ns
            self._wrench = block.wrench[-1].tolist()
            self._condition = self._judge(block)
            self._work(t_ns)
            # Count also in contact, because a program must be able to react to a contact force.
            self._live = (self._live + 1) % _COUNT_LIMIT
            self._write()

    def end(self) -> None:
        """Write to the registers that the service has stopped, and close them."""
        # Ctrl-C may arrive while the thread starts; the thread must end before the cell.
        self._ends.set()
        if self._watching.ident is not None:
            self._watching.join()
        with self._lock:
            self._state, self._condition = ServiceState.STOPPED, Condition.STALE
            self._write()
            if self._registers is not None:
                self._registers.close()

    def _watch(self) -> None:
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
            self._registers, self._number, self._state, self._code = registers, None, ServiceState.READY, 0
        self._say("The controller answers again.")

    def _write(self) -> None:
        if self._registers is None:
            return
        tracking = get_args(Tracking).index(self._stream.track)
        integers = [self._state, self._code, self._condition, self._number or 0, self._live, tracking]
        tracked = self._tracked() if tracking else []
        try:
            # All inputs are sent in one package, so that a program never reads part of an answer.
            self._registers.write(integers, [*self._wrench, *self._weight, *tracked])
        except DeviceError as error:
            if self._state is not ServiceState.STOPPED:
                self._say(f"{error}. Trying again.")
            self._registers.close()
            self._registers = None

    def _tracked(self) -> list[float]:
        """Return tracked change of the bias since calibration, and age, s, of its last observation (-1: none)."""
        tracked = self._stream.processor.monitor.tracked
        if tracked is None or not np.isfinite(tracked.last_seen_s):
            return [*[0.0] * 6, -1.0]
        return [*tracked.bias.tolist(), tracked.last_seen_s + max(self._newest_ns * 1e-9 - tracked.t_s, 0.0)]

    def _judge(self, block: Block) -> Condition:
        if not block.in_contact[-1]:
            return Condition.FREE
        R_base_sensor = block.R_base_flange[-1] @ self._stream.info.calibration.R_flange_sensor
        force_N = R_base_sensor @ self._stream.processor.monitor.reading[:3]
        leans_rad = angle_between_vectors(force_N, self._stream.info.calibration.gravity_force_base_N)
        return Condition.UNKNOWN_LOAD if min(leans_rad, np.pi - leans_rad) < _ALIKE_RAD else Condition.CONTACT

    # -------------------------------------------------------------------------------------------------------- requests

    def _work(self, t_ns: int) -> None:
        try:
            request = None if self._registers is None else self._registers.request
        except DeviceError:
            # the next write to the registers reports the lost connection
            request = None
        if request is not None and self._number is None:
            self._number = request[0]
        elif request is not None and request[0] != self._number:
            (self._number, self._command), self._since_ns = request, t_ns
            self._due_ns = t_ns + round(WEIGH_S * 1e9)
            self._state, self._code = ServiceState.BUSY, 0
        if self._state is not ServiceState.BUSY:
            return
        if self._command == ServiceCommand.STATUS:
            self._answer("")
        elif self._command not in (ServiceCommand.WEIGH, ServiceCommand.ZERO):
            self._answer("command")
        elif t_ns >= self._due_ns:
            self._due_ns = t_ns + _TRY_NS
            try:
                if self._command == ServiceCommand.WEIGH:
                    self._weigh()
                else:
                    self._scale.zero(self._since_ns)
                    self._stream.processor.monitor.hold(None)
            except CannotWeigh as refusal:
                if refusal.code not in _WAITS or (t_ns - self._since_ns) * 1e-9 > PATIENCE_S:
                    self._answer(refusal.code)
                    self._keep({"refused": refusal.code})
            else:
                self._answer("")

    def _answer(self, code: str) -> None:
        self._state, self._code = ServiceState.REFUSED if code else ServiceState.READY, CODES[code]
        if code:
            self._weight = [0.0] * 9

    def _weigh(self) -> None:
        weight = self._scale.weigh(self._since_ns)
        values = load_values(weight, self._stream.info)
        mass_kg, place = 0.0, [0.0] * 6
        if weight.is_something:
            mass_kg, place = weight.mass_kg, [*values["p_flange_com_m"], *values["p_flange_com_sigma_m"]]
        self._weight = [mass_kg, weight.mass_sigma_kg, weight.least_kg, *place]
        self._stream.processor.monitor.hold(weight if weight.is_something else None)
        self._stream.processor.note("load", f"weighed for the program: {weight.mass_kg:.4f} kg", values)
        self._keep(values)
