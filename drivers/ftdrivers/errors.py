"""What can go wrong with a device; `DeviceError` is the base of all.

`found` is what happened, with the value. `fix` starts with a verb and is what to do next, where the driver knows it.
The text of an error is "found; fix", without capital and full stop. A conversion to another class keeps the fix.
"""

from typing import Final

UNUSABLE: Final = "discard its data, check load, supply and cable, then power it off and on"
"""The fix for a critical status."""


class DeviceError(Exception):
    """Base of all device errors.

    Parameters
    ----------
    found
        What happened, with the value.
    fix
        What to do next; empty where the driver does not know.
    """

    def __init__(self, found: str, fix: str = "") -> None:
        super().__init__(f"{found}; {fix}" if fix else found)  # one argument: two would be those of an `OSError`
        self.found = found
        self.fix = fix


class ConnectError(DeviceError):
    """The device could not be opened, or is not what it should be."""


class PortInUse(ConnectError):
    """Another program has the port of the device."""


class Unreachable(ConnectError):
    """Nothing answers at the address of the device."""


class ModelUnknown(ConnectError):
    """An arm does not report its model, and none is configured."""


class NoDashboard(ConnectError):
    """The dashboard server of an arm, or its Robot API, does not answer or refuses."""


class StreamBroken(DeviceError):
    """The connection was lost after it had worked."""


class DeviceTimeout(DeviceError, TimeoutError):
    """Nothing arrived in time; also a `TimeoutError`."""


class ProtocolError(DeviceError):
    """Bytes arrived that the device's document does not allow."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own."""


class Frozen(DeviceFault):
    """A sensor repeats one reading, although a sensor that measures has noise."""
