"""The connection of an RTDE client: recipes, samples and their delay."""

import socket
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from ftmocks.ur import dashboard, rtde
from ftmocks.ur.clients import Client
from ftmocks.ur.robot import Robot
from ftmocks.ur.variables import INPUTS, OUTPUTS, Reader, output_type


@dataclass
class RtdeLink:
    """State that all RTDE clients of a controller share."""

    input_owners: dict[str, "RtdeClient"] = field(default_factory=dict)
    claimed: set[str] = field(default_factory=set)
    """Input variables that an emulated fieldbus owns; it does not take those that a client owned before."""
    bad_inputs: list[str] = field(default_factory=list)
    """Descriptions of packages that violate the protocol."""
    delay_s: float = 0.0
    """Delay from the cycle of a sample to its sending, s."""


class RtdeClient(Client):
    """A client of port 30004, with one output recipe and any number of input recipes."""

    kind = "rtde"

    def __init__(
        self, robot: Robot, connection: socket.socket, forget: Callable[[Client], None], link: RtdeLink
    ) -> None:
        super().__init__(robot, connection, forget)
        self._link = link
        self._outputs: rtde.Recipe | None = None
        self._readers: list[Reader] = []
        self._every = 1
        self._inputs: list[rtde.Recipe] = []
        self._started = False
        self._outbox: deque[tuple[float, bytes]] = deque()
        """Samples that are waiting, with the time on the cell's clock at which each is sent."""
        self._last = b""

    def close(self, *, reset: bool = False) -> None:
        """Close the connection, which releases its input variables."""
        super().close(reset=reset)
        owned = [name for name, owner in self._link.input_owners.items() if owner is self]
        for name in owned:
            del self._link.input_owners[name]

    def on_bytes(self, buffer: bytearray) -> None:
        """Take the complete packages from `buffer` and answer them."""
        try:
            for kind, payload in rtde.take_packages(buffer):
                self._on_package(kind, payload)
        except rtde.RtdeError as error:
            self._link.bad_inputs.append(str(error))
            self.close()

    def sample(self) -> None:
        """Sample the outputs if this cycle is due. They are sent after the delay of the link."""
        if self._started and self.robot.cycle % self._every == 0 and self._outputs is not None:
            self._outbox.append((self.robot.cycle_s + self._link.delay_s, self._packed(self._outputs)))

    def _packed(self, outputs: rtde.Recipe) -> bytes:
        return outputs.pack([read(self.robot) for read in self._readers])

    def deliver(self, now_s: float) -> float | None:
        """Send the due samples, except those for which a lagging client has no room.

        Returns
        -------
        Time until the next one is due, s; None if there is none.
        """
        while self._outbox and self._outbox[0][0] <= now_s:
            self._last = self._outbox.popleft()[1]
            if not self.lagging:
                self.send(self._last)
        return self._outbox[0][0] - now_s if self._outbox else None

    def repeat(self) -> None:
        """Send the last sample again, if this client sends commands."""
        if self._started and self._inputs and not self.lagging and self._outputs is not None:
            self._last = self._last or self._packed(self._outputs)
            self.send(self._last)

    def _on_package(self, kind: int, payload: bytes) -> None:
        if kind == rtde.VERSION:
            self._reply(kind, bytes([payload == b"\x00\x02"]))
        elif kind == rtde.CONTROLLER_VERSION:
            self._reply(kind, struct.pack(">4I", *self.robot.settings.polyscope, dashboard.BUILD))
        elif kind == rtde.SETUP_OUTPUTS:
            self._set_up_outputs(payload)
        elif kind == rtde.SETUP_INPUTS:
            self._set_up_inputs(payload)
        elif kind == rtde.START:
            self._started = self._outputs is not None
            self._reply(kind, bytes([self._started]))
        elif kind == rtde.PAUSE:
            self._started = False
            self._outbox.clear()
            self._reply(kind, b"\x01")
        elif kind == rtde.DATA:
            self._take_inputs(payload)
        elif kind != rtde.TEXT:
            self._link.bad_inputs.append(f"package type {kind}")

    def _reply(self, kind: int, payload: bytes) -> None:
        self.send(rtde.package(kind, payload))

    def _set_up_outputs(self, payload: bytes) -> None:
        if len(payload) < 8:
            self._link.bad_inputs.append(f"output setup of {len(payload)} bytes")
            return
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = rtde.names_in(payload[8:])
        recipe = rtde.Recipe(1, names, [output_type(self.robot, name) for name in names])
        self._outputs, self._last = recipe if recipe.valid else None, b""
        self._readers = [OUTPUTS[name][1] for name in names] if recipe.valid else []
        base_hz = self.robot.frequency_hz
        self._every = max(1, int(base_hz / frequency_hz)) if frequency_hz > 1e-3 else 1
        self._reply(rtde.SETUP_OUTPUTS, recipe.answer())

    def _set_up_inputs(self, payload: bytes) -> None:
        names = rtde.names_in(payload)
        owners = self._link.input_owners
        types = []
        for name in names:
            owner = owners.get(name)
            taken = owner is not self and (owner is not None or name in self._link.claimed)
            types.append("IN_USE" if taken else INPUTS.get(name, "NOT_FOUND"))
        recipe = rtde.Recipe(len(self._inputs) + 1, names, types)
        self._inputs.append(recipe)
        if recipe.valid:
            owners.update(dict.fromkeys(names, self))
        self._reply(rtde.SETUP_INPUTS, recipe.answer())

    def _take_inputs(self, payload: bytes) -> None:
        recipe_id = payload[0] if payload else 0
        if not 1 <= recipe_id <= len(self._inputs) or not self._inputs[recipe_id - 1].valid:
            self._link.bad_inputs.append(f"data for unknown input recipe {recipe_id}")
            return
        recipe = self._inputs[recipe_id - 1]
        size = len(payload) - 1
        if size != recipe.size:
            self._link.bad_inputs.append(f"{size} bytes of data for input recipe {recipe_id}, which has {recipe.size}")
        if size >= recipe.size:
            self.robot.write_inputs(recipe.unpack(payload[1:]))
