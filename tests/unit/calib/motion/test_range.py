"""How far a recording turns the tool."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.motion.solve import _range_deg


class FakeRows:
    def __init__(self, rotation: Rotation) -> None:
        self.motion = SimpleNamespace(R_base_flange=rotation.as_matrix())

    def __len__(self) -> int:
        return len(self.motion.R_base_flange)


@pytest.mark.parametrize("half_deg", [5.0, 30.0, 80.0])
def test_the_range_of_a_motion_is_that_from_end_to_end(half_deg: float) -> None:
    turns = Rotation.from_rotvec(np.outer(np.linspace(-half_deg, half_deg, 41), [0.0, 0.6, 0.8]), degrees=True)
    rows = cast(Any, FakeRows(Rotation.from_euler("xyz", [100, 20, -60], degrees=True) * turns))
    assert _range_deg(rows) == pytest.approx(2 * half_deg, abs=0.01)
