"""Registers through which a client answers the program that runs on a UR controller. Nothing else is sent.

Ref: Universal Robots, RTDE guide, general-purpose registers: RTDE clients own the inputs 24 to 47 from PolyScope 3.9
and 5.3 on, fieldbuses and PLCs those below. A data package sets all inputs of a recipe in one control cycle.
Checked on hardware: no.

The IO client of ur_rtde writes five registers of each kind, each in a package of its own, so a program could read half
of an answer.
"""

import struct
import threading
from collections.abc import Sequence
from typing import Final

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceError, ProtocolError, StreamBroken
from ftdrivers.ur.rtde import Subscription

FIRST: Final = 24
LAST: Final = 47
"""Registers of RTDE clients."""
_REQUESTS_HZ: Final = 125.0
_SILENT_S: Final = 1.0


class ProgramRegisters:
    """Input registers that this client writes, and two output registers that the program writes.

    Parameters
    ----------
    host : str
    first : int
        Of the registers of each kind.
    integers, doubles : int
        How many inputs are owned.
    timeout_s : float
        Of the connection.
    clock : Clock

    Raises
    ------
    ValueError
        The registers are not those of RTDE clients.
    ConnectError
        Nothing answers, another client or a fieldbus owns a register, or this version has none.
    """

    def __init__(
        self, host: str, first: int, integers: int, doubles: int, *, timeout_s: float = 2.0, clock: Clock = REAL
    ) -> None:
        if not FIRST <= first <= LAST + 1 - max(integers, doubles):
            raise ValueError(f"registers from {first} are not within {FIRST} to {LAST}")
        inputs = {f"input_int_register_{first + i}": "INT32" for i in range(integers)}
        inputs |= {f"input_double_register_{first + i}": "DOUBLE" for i in range(doubles)}
        self._names = tuple(f"output_int_register_{first + i}" for i in range(2))
        self._link = Subscription(
            host, dict.fromkeys(self._names, "INT32"), _REQUESTS_HZ, timeout_s=timeout_s, clock=clock, inputs=inputs
        )
        self._lock = threading.Lock()
        self._failure: DeviceError | None = None
        self._request: tuple[int, int] | None = None
        self._reader = threading.Thread(target=self._read, name="program registers", daemon=True)
        self._reader.start()

    @property
    def request(self) -> tuple[int, int] | None:
        """Number and command of the last request, as the program has written them; None before the first sample.

        Raises `DeviceError` when the connection is lost.
        """
        if self._failure is not None:
            raise self._failure
        return self._request

    def write(self, integers: Sequence[int], doubles: Sequence[float]) -> None:
        """Set all inputs at once. Raises `DeviceError` when the connection is lost."""
        try:
            with self._lock:
                self._link.write([*integers, *doubles])
        except OSError as error:
            raise StreamBroken(f"the controller does not take registers ({error})", "check the cable") from error
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Close the connection; the registers keep their last values. Idempotent."""
        self._link.close()
        self._reader.join(1.0)

    def _read(self) -> None:
        try:
            while True:
                values = self._link.decode(self._link.read(_SILENT_S))
                number, command = (int(np.asarray(values[name])[-1]) for name in self._names)
                self._request = number, command
        except (OSError, StreamBroken, ProtocolError, struct.error) as error:
            self._failure = StreamBroken(f"the registers of the controller are lost ({error})", "check robot and cable")
