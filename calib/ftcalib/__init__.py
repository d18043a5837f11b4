"""The solver core: from poses and wrenches to a calibration. Pure: numpy and scipy, no device."""

from ftcalib.data.dataset import CalibrationDataset, read_csv
from ftcalib.data.dwell_mean import PoseMean, is_stationary, mean_and_covariance
from ftcalib.errors import BadCalibration, BadDataset, CalibError, NotObservable
from ftcalib.findings import Finding
from ftcalib.known import Known
from ftcalib.model import PARAMETER_NAMES, Parameters
from ftcalib.result import CalibrationResult
from ftcalib.setup import Setup
from ftcalib.solver import solve

__all__ = [
    "PARAMETER_NAMES",
    "BadCalibration",
    "BadDataset",
    "CalibError",
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
    "read_csv",
    "solve",
]
