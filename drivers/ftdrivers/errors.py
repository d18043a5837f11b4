"""What can go wrong with a device. All are a `DeviceError` with `found` and `fix`, but an address that cannot be used.

DeviceError
├── ConnectError      the device could not be opened, or is not what it should be
│   ├── PortInUse
│   ├── Unreachable
│   ├── ModelUnknown
│   └── NoDashboard
├── StreamBroken
├── DeviceTimeout
├── ProtocolError
└── DeviceFault       the device reports a fault of its own
    └── Frozen
UsageError
├── BadUrl
└── NoRos2
DataError
└── BadTranscript
"""

from typing import Final

from ftcalib.errors import DataError, DeviceError, UsageError

__all__ = [
    "UNUSABLE",
    "BadTranscript",
    "BadUrl",
    "ConnectError",
    "DeviceError",
    "DeviceFault",
    "DeviceTimeout",
    "Frozen",
    "ModelUnknown",
    "NoDashboard",
    "NoRos2",
    "PortInUse",
    "ProtocolError",
    "StreamBroken",
    "Unreachable",
]

UNUSABLE: Final = "discard its data, check load, supply and cable, then power it off and on"
"""The fix for a critical status."""


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


class DeviceTimeout(DeviceError):
    """Nothing arrived in time."""


class ProtocolError(DeviceError):
    """Bytes arrived that the device's document does not allow."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own."""


class Frozen(DeviceFault):
    """A sensor repeats one reading, although a sensor that measures has noise."""


class BadUrl(UsageError):
    """An address that no driver understands: an error in the configuration, not in the device."""


class NoRos2(UsageError):
    """rclpy, or messages that are needed, cannot be imported, or the arguments of ROS cannot be read."""


class BadTranscript(DataError):
    """A file is not a transcript that this version can play."""
