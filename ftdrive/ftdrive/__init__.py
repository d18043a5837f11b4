"""ftdrive: calibrate a wrist force/torque sensor on a Universal Robots arm, and see the true contact force.

The names below are the library. Each is imported at its first use, so that `import ftdrive` takes a few milliseconds.
Their modules may move; these names stay.

| task | names |
|---|---|
| calibrate from data | `solve`, `read_dataset`, `TableOptions`, `CalibrationDataset`, `Known`, `Setup`, `compare` |
| keep and read results | `CalibrationResult`, `read_calibration`, `Run`, `read_recording`, `write_recording` |
| live | `open_stream`, `WrenchFrame`, `Stages`, `Contact`, `weigh` |
| devices | `open_sensor`, `open_arm` |
| plan | `plan_tour` |
| errors | `FtdriveError`, `UsageError`, `DeviceError`, `DataError`, `AcceptanceError` |

Two packages come with it. `ftcalib` has the parts of the solver, such as `Parameters`, `predict`, `Compensator` and
`solve_loads`. `ftdrivers` has the parts for a custom driver, such as `StreamingSensor` and `ReadOnlyArm`.
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers take it as true; importing it from `typing` would take most of the import time
if TYPE_CHECKING:
    from ftcalib.compare import compare
    from ftcalib.data.dataset import CalibrationDataset
    from ftcalib.errors import AcceptanceError, DataError, DeviceError, FtdriveError, UsageError
    from ftcalib.known import Known, Setup
    from ftcalib.result import CalibrationResult
    from ftdrive.library import open_arm, open_sensor, open_stream, plan_tour, read_recording, solve
    from ftdrive.recording.files import write_recording
    from ftdrive.runs.calibration import read_calibration
    from ftdrive.runs.run import Run
    from ftdrive.runs.source import read_dataset
    from ftdrive.stream.contact import Contact
    from ftdrive.stream.samples import Stages, WrenchFrame
    from ftdrive.stream.weighing import weigh
    from ftdrive.tables.table import TableOptions

__version__ = "0.1.0"

__all__ = [
    "AcceptanceError",
    "CalibrationDataset",
    "CalibrationResult",
    "Contact",
    "DataError",
    "DeviceError",
    "FtdriveError",
    "Known",
    "Run",
    "Setup",
    "Stages",
    "TableOptions",
    "UsageError",
    "WrenchFrame",
    "compare",
    "open_arm",
    "open_sensor",
    "open_stream",
    "plan_tour",
    "read_calibration",
    "read_dataset",
    "read_recording",
    "solve",
    "weigh",
    "write_recording",
]

_MODULES = {
    "ftcalib.compare": ("compare",),
    "ftcalib.data.dataset": ("CalibrationDataset",),
    "ftcalib.errors": ("AcceptanceError", "DataError", "DeviceError", "FtdriveError", "UsageError"),
    "ftcalib.known": ("Known", "Setup"),
    "ftcalib.result": ("CalibrationResult",),
    "ftdrive.library": ("open_arm", "open_sensor", "open_stream", "plan_tour", "read_recording", "solve"),
    "ftdrive.stream.contact": ("Contact",),
    "ftdrive.stream.samples": ("Stages", "WrenchFrame"),
    "ftdrive.stream.weighing": ("weigh",),
    "ftdrive.recording.files": ("write_recording",),
    "ftdrive.runs.run": ("Run",),
    "ftdrive.runs.calibration": ("read_calibration",),
    "ftdrive.runs.source": ("read_dataset",),
    "ftdrive.tables.table": ("TableOptions",),
}


def __dir__() -> list[str]:
    return __all__


if not TYPE_CHECKING:  # otherwise, a type checker would accept any name

    def __getattr__(name: str) -> object:
        for module, names in _MODULES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(module), name)
                return value
        where = ""
        for package in () if name.startswith("_") else ("ftcalib", "ftdrivers"):
            if name in import_module(package).__all__:
                where = f": from {package} import {name}"
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{where}")
