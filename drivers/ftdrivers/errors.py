"""Errors of devices. Each `DeviceError` has `found`, what happened, and `fix`, what to do.

DeviceError
├── ConnectError      the device could not be opened, or is not the expected one
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
"""Text that says what to do about a critical status of a sensor."""


class ConnectError(DeviceError):
    """The device could not be opened, or is not the expected one."""


class PortInUse(ConnectError):
    """Another program uses the port of the device."""


class Unreachable(ConnectError):
    """No device answers at the address."""


class ModelUnknown(ConnectError):
    """The arm does not report its model, and no model is configured."""


class NoDashboard(ConnectError):
    """The dashboard server or the Robot API of an arm does not answer, or refuses a request."""


class StreamBroken(DeviceError):
    """An established connection to a device was lost."""


class DeviceTimeout(DeviceError):
    """A device sent no data or no answer within a time-out."""


class ProtocolError(DeviceError):
    """Received bytes violate the documented protocol of the device."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own."""


class Frozen(DeviceFault):
    """A sensor repeats one reading; a sensor that measures has noise."""


class BadUrl(UsageError):
    """The address of a device is invalid: an error in the configuration, not in the device."""


class NoRos2(UsageError):
    """rclpy or its message packages cannot be imported, or ROS rejects its arguments."""


class BadTranscript(DataError):
    """A file is not a transcript, or has a format that this version cannot play."""
