"""The solver core: from poses and wrenches to a calibration. Pure: numpy and scipy, no device."""

from calib.data.dataset import CalibrationDataset, read_csv
from calib.data.dwell_mean import PoseMean, is_stationary, mean_and_covariance
from calib.errors import BadCalibration, BadDataset, CalibError, NotObservable
from calib.known import Known
from calib.model import PARAMETER_NAMES, Parameters
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
