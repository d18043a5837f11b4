"""What can go wrong with a device.

DriverError
├── ConnectError      the device could not be opened, or is not what it should be
│   ├── PortInUse     another program has its port
│   ├── Unreachable   nobody answers at its address
│   ├── ModelUnknown  an arm does not tell which model it is, and nobody else has
│   └── NoDashboard   the dashboard server of an arm does not answer, or refuses
├── StreamBroken      the connection was lost after it had worked
├── DeviceTimeout     nothing arrived in time (also a TimeoutError)
├── ProtocolError     bytes arrived that the document does not allow
└── DeviceFault       the device itself reports a fault: sensor status, protective or emergency stop
    └── Frozen        a sensor says the same again and again

Every error says in `found` what happened, with the value, and in `fix` what to do next, where the driver knows it; its
text is "found; fix", without capital and full stop. One that is raised anew as another kind keeps its fix.
"""

from typing import Final

UNUSABLE: Final = "its data must not be used: check load, supply and cable, then power it off and on"
"""What follows from a critical status."""


class DriverError(Exception):
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


class ConnectError(DriverError):
    """The device could not be opened, or is not what it should be."""


class PortInUse(ConnectError):
    """Another program has the port of the device."""


class Unreachable(ConnectError):
    """Nobody answers at the address of the device."""


class ModelUnknown(ConnectError):
    """An arm does not tell which model it is, and nobody else has."""


class NoDashboard(ConnectError):
    """The dashboard server of an arm does not answer, or refuses."""


class StreamBroken(DriverError):
    """The connection was lost after it had worked."""


class DeviceTimeout(DriverError, TimeoutError):
    """Nothing arrived in time."""


class ProtocolError(DriverError):
    """Bytes arrived that the device's document does not allow."""


class DeviceFault(DriverError):
    """The device reports a fault of its own."""


class Frozen(DeviceFault):
    """A sensor says the same again and again, and one that measures has noise."""
