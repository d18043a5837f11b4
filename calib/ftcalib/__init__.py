"""The solver core: from poses and wrenches to a calibration. Pure: numpy and scipy, no device.

The names are imported at their first use, so that `import ftcalib.errors` needs neither numpy nor scipy.
"""

from importlib import import_module

# Type checkers take it for that of `typing`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ftcalib.data.dataset import CalibrationDataset
    from ftcalib.data.dwell_mean import PoseMean, is_stationary, mean_and_covariance
    from ftcalib.errors import BadCalibration, BadDataset, NotObservable
    from ftcalib.findings import Finding
    from ftcalib.known import Known, Setup
    from ftcalib.model import PARAMETER_NAMES, Parameters
    from ftcalib.result import CalibrationResult
    from ftcalib.solver import solve

__all__ = [
    "PARAMETER_NAMES",
    "BadCalibration",
    "BadDataset",
    "CalibrationDataset",
    "CalibrationResult",
    "Finding",
    "Known",
    "NotObservable",
    "Parameters",
    "PoseMean",
    "Setup",
    "is_stationary",
    "mean_and_covariance",
    "solve",
]

_MODULES = {
    "ftcalib.data.dataset": ("CalibrationDataset",),
    "ftcalib.data.dwell_mean": ("PoseMean", "is_stationary", "mean_and_covariance"),
    "ftcalib.errors": ("BadCalibration", "BadDataset", "NotObservable"),
    "ftcalib.findings": ("Finding",),
    "ftcalib.known": ("Known", "Setup"),
    "ftcalib.model": ("PARAMETER_NAMES", "Parameters"),
    "ftcalib.result": ("CalibrationResult",),
    "ftcalib.solver": ("solve",),
}

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        for module, names in _MODULES.items():
            if name in names:
                value = globals()[name] = getattr(import_module(module), name)
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
