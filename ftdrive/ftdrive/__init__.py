"""ftdrive: calibrate a wrist force/torque sensor on a Universal Robots arm, and see the true contact force.

The names below are the library. Each is imported at its first use, so that `import ftdrive` takes a few milliseconds.
Modules behind them may move; these names stay.

| task | names |
|---|---|
| calibrate from data | `solve`, `read_dataset`, `TableOptions`, `CalibrationDataset`, `Known`, `Setup`, `compare` |
| judge a result | `CalibrationResult`, `Finding` |
| keep and read results | `read_calibration`, `Run`, `read_recording`, `write_recording` |
| compensate | `CalibrationResult.compensate`, `Compensator`, `predict`, `Parameters` |
| know the sensor | `SensorMatrix`, `KnownLoad`, `LoadRun`, `solve_loads` |
| live | `open_stream`, `WrenchFrame`, `Stages`, `Contact` |
| weigh | `weigh`, `Weight`, `CannotWeigh` |
| devices | `open_sensor`, `open_arm`, `ForceTorqueSensor`, `RobotArm`, `FtSamples`, `ArmState`, `DeviceInfo` |
| own drivers | `StreamingSensor`, `ReadOnlyArm` |
| plan | `plan_tour` |
| errors | `FtdriveError`, `UsageError`, `DeviceError`, `DataError`, `AcceptanceError` |
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers take it for that of `typing`, whose import would take most of the time
if TYPE_CHECKING:
    from ftcalib.after.weighing import Weight
    from ftcalib.compare import compare
    from ftcalib.compensation import Compensator
    from ftcalib.data.dataset import CalibrationDataset
    from ftcalib.errors import AcceptanceError, DataError, DeviceError, FtdriveError, UsageError
    from ftcalib.findings import Finding
    from ftcalib.known import Known, Setup
    from ftcalib.loads.model import KnownLoad, LoadRun
    from ftcalib.loads.solve import solve_loads
    from ftcalib.model import Parameters, predict
    from ftcalib.result import CalibrationResult
    from ftcalib.sensor_matrix import SensorMatrix
    from ftdrive.library import open_arm, open_sensor, open_stream, plan_tour, read_recording, solve
    from ftdrive.live.contact import Contact
    from ftdrive.live.samples import Stages, WrenchFrame
    from ftdrive.live.weighing import CannotWeigh, weigh
    from ftdrive.recording.files import write_recording
    from ftdrive.runs.run import Run
    from ftdrive.runs.source import read_calibration, read_dataset
    from ftdrive.tables.table import TableOptions
    from ftdrivers.interfaces import ArmState, DeviceInfo, ForceTorqueSensor, FtSamples, ReadOnlyArm, RobotArm
    from ftdrivers.streaming.sensor import StreamingSensor

__version__ = "0.1.0"

__all__ = [
    "AcceptanceError",
    "ArmState",
    "CalibrationDataset",
    "CalibrationResult",
    "CannotWeigh",
    "Compensator",
    "Contact",
    "DataError",
    "DeviceError",
    "DeviceInfo",
    "Finding",
    "ForceTorqueSensor",
    "FtSamples",
    "FtdriveError",
    "Known",
    "KnownLoad",
    "LoadRun",
    "Parameters",
    "ReadOnlyArm",
    "RobotArm",
    "Run",
    "SensorMatrix",
    "Setup",
    "Stages",
    "StreamingSensor",
    "TableOptions",
    "UsageError",
    "Weight",
    "WrenchFrame",
    "compare",
    "open_arm",
    "open_sensor",
    "open_stream",
    "plan_tour",
    "predict",
    "read_calibration",
    "read_dataset",
    "read_recording",
    "solve",
    "solve_loads",
    "weigh",
    "write_recording",
]

_MODULES = {
    "ftcalib.compare": ("compare",),
    "ftcalib.compensation": ("Compensator",),
    "ftcalib.data.dataset": ("CalibrationDataset",),
    "ftcalib.errors": ("AcceptanceError", "DataError", "DeviceError", "FtdriveError", "UsageError"),
    "ftcalib.after.weighing": ("Weight",),
    "ftcalib.findings": ("Finding",),
    "ftcalib.known": ("Known", "Setup"),
    "ftcalib.loads.model": ("KnownLoad", "LoadRun"),
    "ftcalib.loads.solve": ("solve_loads",),
    "ftcalib.model": ("Parameters", "predict"),
    "ftcalib.result": ("CalibrationResult",),
    "ftcalib.sensor_matrix": ("SensorMatrix",),
    "ftdrive.library": ("open_arm", "open_sensor", "open_stream", "plan_tour", "read_recording", "solve"),
    "ftdrive.live.contact": ("Contact",),
    "ftdrive.live.samples": ("Stages", "WrenchFrame"),
    "ftdrive.live.weighing": ("CannotWeigh", "weigh"),
    "ftdrive.recording.files": ("write_recording",),
    "ftdrive.runs.run": ("Run",),
    "ftdrive.runs.source": ("read_calibration", "read_dataset"),
    "ftdrive.tables.table": ("TableOptions",),
    "ftdrivers.interfaces": ("ArmState", "DeviceInfo", "ForceTorqueSensor", "FtSamples", "ReadOnlyArm", "RobotArm"),
    "ftdrivers.streaming.sensor": ("StreamingSensor",),
}


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        for module, names in _MODULES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(module), name)
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
