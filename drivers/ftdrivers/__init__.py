"""Adapters for arms and force/torque sensors behind two abstract interfaces.

The exported names are what a driver in another package needs. Each is imported at its first use.
"""

from importlib import import_module

# Type checkers treat this name like `typing.TYPE_CHECKING`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ftdrivers.interfaces import ArmState, DeviceInfo, ForceTorqueSensor, FtSamples, ReadOnlyArm, RobotArm
    from ftdrivers.streaming.sensor import StreamingSensor

__all__ = [
    "ArmState",
    "DeviceInfo",
    "ForceTorqueSensor",
    "FtSamples",
    "ReadOnlyArm",
    "RobotArm",
    "StreamingSensor",
]

_MODULES = {
    "ftdrivers.interfaces": ("ArmState", "DeviceInfo", "ForceTorqueSensor", "FtSamples", "ReadOnlyArm", "RobotArm"),
    "ftdrivers.streaming.sensor": ("StreamingSensor",),
}


def __dir__() -> list[str]:
    return __all__


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        for module, names in _MODULES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(module), name)
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
