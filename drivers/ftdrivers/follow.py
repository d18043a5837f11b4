"""Reading a stream without gaps: what every follower of a device shares."""

from collections.abc import Callable
from typing import Generic, TypeVar

from ftdrivers.errors import StreamBroken

Samples = TypeVar("Samples")
Item = TypeVar("Item")


class Follow(Generic[Samples]):
    """Reads every sample of a device, as long as `with device.follow() as follow:` lasts."""

    def __init__(self, read: Callable[[float], Samples]) -> None:
        self._read = read

    def read(self, timeout_s: float) -> Samples:
        """Return every sample since the last read, in order; wait up to `timeout_s` for the first of them.

        The result has no rows if none arrived in time. Samples that arrived before a failure are returned first.

        Raises
        ------
        DeviceTimeout
            No sample arrived for longer than the stream allows.
        StreamBroken
            The connection was lost, the device was closed or reopened, or too many samples were not read.
        DeviceFault
            The device reports a fault.
        """
        return self._read(timeout_s)


class Unread(Generic[Item]):
    """What one follower has not read yet, in order. The lock of the stream protects it.

    Parameters
    ----------
    name
        The device; begins the error message.
    most
        The most samples that may wait. More is an error, never a dropped sample.
    """

    def __init__(self, name: str, most: int) -> None:
        self._name = name
        self._most = most
        self._items: list[Item] = []
        self._samples = 0

    def put(self, item: Item, samples: int = 1) -> None:
        """Add an item of so many samples."""
        self._samples += samples
        if self._samples <= self._most:
            self._items.append(item)
        else:
            self._items.clear()

    def check(self) -> None:
        """Raise `StreamBroken` if too many samples were not read."""
        if self._samples > self._most:
            raise StreamBroken(
                f"{self._name}: {self._samples} samples have not been read, {self._most} may wait",
                "read more often, or collect in shorter pieces",
            )

    def take(self) -> list[Item]:
        """Return what waits, and empty the queue. Raises as `check`."""
        self.check()
        items, self._items, self._samples = self._items, [], 0
        return items
