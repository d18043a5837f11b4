"""The solver core: from poses and wrenches to a calibration. Pure: numpy and scipy, no device."""

from calib.dataset import CalibrationDataset, read_csv
from calib.errors import BadCalibration, BadDataset, CalibError, NotObservable
from calib.known import Known
from calib.model import PARAMETER_NAMES, Parameters
from calib.noise import PoseMean, is_stationary, mean_and_covariance
from calib.result import CalibrationResult
from calib.solver import solve

__all__ = [
    "PARAMETER_NAMES",
    "BadCalibration",
    "BadDataset",
    "CalibError",
    "CalibrationDataset",
    "CalibrationResult",
    "Known",
    "NotObservable",
    "Parameters",
    "PoseMean",
    "is_stationary",
    "mean_and_covariance",
    "read_csv",
    "solve",
]
