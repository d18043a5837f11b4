"""Solver for calibrations from poses and wrenches. It needs numpy and scipy and accesses no device.

Names are imported at their first use, so that `import ftcalib.errors` needs neither numpy nor scipy.
"""

from importlib import import_module

# Type checkers treat this name like `typing.TYPE_CHECKING`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ftcalib.after.weighing import Weight
    from ftcalib.compensation import Compensator
    from ftcalib.data.dataset import CalibrationDataset
    from ftcalib.data.dwell_mean import PoseMean, is_stationary, mean_and_covariance
    from ftcalib.errors import BadCalibration, BadDataset, NotObservable
    from ftcalib.findings import Finding
    from ftcalib.known import Known, Setup
    from ftcalib.loads.model import KnownLoad, LoadRun
    from ftcalib.loads.solve import solve_loads
    from ftcalib.model import PARAMETER_NAMES, Parameters, predict
    from ftcalib.result import CalibrationResult
    from ftcalib.sensor_matrix import SensorMatrix
    from ftcalib.solver import solve

__all__ = [
    "PARAMETER_NAMES",
    "BadCalibration",
    "BadDataset",
    "CalibrationDataset",
    "CalibrationResult",
    "Compensator",
    "Finding",
    "Known",
    "KnownLoad",
    "LoadRun",
    "NotObservable",
    "Parameters",
    "PoseMean",
    "SensorMatrix",
    "Setup",
    "Weight",
    "is_stationary",
    "mean_and_covariance",
    "predict",
    "solve",
    "solve_loads",
]

_MODULES = {
    "ftcalib.after.weighing": ("Weight",),
    "ftcalib.compensation": ("Compensator",),
    "ftcalib.data.dataset": ("CalibrationDataset",),
    "ftcalib.data.dwell_mean": ("PoseMean", "is_stationary", "mean_and_covariance"),
    "ftcalib.errors": ("BadCalibration", "BadDataset", "NotObservable"),
    "ftcalib.findings": ("Finding",),
    "ftcalib.known": ("Known", "Setup"),
    "ftcalib.loads.model": ("KnownLoad", "LoadRun"),
    "ftcalib.loads.solve": ("solve_loads",),
    "ftcalib.model": ("PARAMETER_NAMES", "Parameters", "predict"),
    "ftcalib.result": ("CalibrationResult",),
    "ftcalib.sensor_matrix": ("SensorMatrix",),
    "ftcalib.solver": ("solve",),
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
