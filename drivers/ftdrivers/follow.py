"""Reading every sample of a stream without gaps: classes that all devices share."""

from collections.abc import Callable
from typing import Generic, TypeVar

from ftdrivers.errors import StreamBroken

Samples = TypeVar("Samples")
Item = TypeVar("Item")


class Follow(Generic[Samples]):
    """Reads every sample of a device within a block `with device.follow() as follow:`."""

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
    """Queue of the samples that one follower has not read yet. The lock of the stream protects it.

    Parameters
    ----------
    name
        Name of the device, for the error message.
    most
        Largest number of samples in the queue. If there are more, `check` raises; no sample is dropped silently.
    """

    def __init__(self, name: str, most: int) -> None:
        self._name = name
        self._most = most
        self._items: list[Item] = []
        self._samples = 0

    def put(self, item: Item, samples: int = 1) -> None:
        """Add an item that holds this number of samples."""
        self._samples += samples
        if self._samples <= self._most:
            self._items.append(item)
        else:
            self._items.clear()

    def check(self) -> None:
        """Raise `StreamBroken` if too many samples were not read."""
        if self._samples > self._most:
            raise StreamBroken(
                f"{self._name}: {self._samples} samples are waiting to be read, and the limit is {self._most}",
                "read more often, or collect in shorter pieces",
            )

    def take(self) -> list[Item]:
        """Return the items of the queue and empty it. Raises whatever `check` raises."""
        self.check()
        items, self._items, self._samples = self._items, [], 0
        return items
