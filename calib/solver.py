"""From a dataset to a calibration."""

from collections.abc import Mapping

from calib.dataset import CalibrationDataset
from calib.result import CalibrationResult, Method

STANDARD_GRAVITY_M_S2 = 9.80665


def solve(
    dataset: CalibrationDataset,
    method: Method = "ml",
    *,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    provenance: Mapping[str, object] | None = None,
) -> CalibrationResult:
    """Calibrate."""
    raise NotImplementedError
