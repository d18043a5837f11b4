"""What a free tool weighs at each orientation, learned while it moves: the contact guard of a sweep needs no poses."""

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from ftcalib.model import STANDARD_GRAVITY_M_S2, Array
from ftcalib.routine import PoseRecord
from ftdrive.session.events import Estimated
from ftdrive.session.guards import Guard, Seen

KNOWN_S: Final = 3.0
"""The motion teaches so long before anything is predicted."""
BEHIND_S: Final = 1.0
"""The newest looks do not teach: a contact that grows must not pass for weight."""
_NOISE_N: Final = 2.0
"""Of one look, vibration and acceleration included."""
_UNSURE_N: Final = 2.5
"""A prediction with a larger sigma is none."""


@dataclass
class FreeTool(Guard):
    """Recursive least squares of the wrench as a linear function of the direction of gravity in the flange.

    Force and torque are linear in it, whatever mounting, weight, centre of mass and bias are. It looks as a guard, but
    never trips.
    """

    weighed_kg: ClassVar[None] = None
    down_base: Array
    """(3,) unit vector."""
    heaviest_kg: float
    """Of a possible tool: the size of what is unknown."""
    _moving_s: float = field(default=0.0, init=False)
    _sample: int = field(default=-1, init=False)
    _waiting: deque[tuple[float, Array, Array]] = field(default_factory=deque, init=False)
    _covariance: Array = field(default_factory=lambda: np.zeros((4, 4)), init=False)
    _coefficients: Array = field(default_factory=lambda: np.zeros((4, 6)), init=False)

    def begin(self, seen: Seen) -> None:
        """Forget everything: after a stop the tool may be another, and the sensor may have another zero."""
        unknown = (self.heaviest_kg * STANDARD_GRAVITY_M_S2 / _NOISE_N) ** 2
        self._covariance = np.diag([unknown, unknown, unknown, 1e6])
        self._coefficients = np.zeros((4, 6))
        self._waiting.clear()
        self._moving_s = 0.0
        del seen

    def look(self, seen: Seen) -> None:
        """Learn from what was seen a second ago."""
        if seen.motion.curve_rad is not None:
            self._moving_s += seen.dt_s
        if seen.sample == self._sample:
            return
        self._sample = seen.sample
        self._waiting.append((seen.t_s, self._features(seen.state.R_base_flange), seen.wrench))
        while self._waiting[0][0] < seen.t_s - BEHIND_S:
            _, x, wrench = self._waiting.popleft()
            Px = self._covariance @ x
            gain = Px / (1.0 + x @ Px)
            self._coefficients = self._coefficients + np.outer(gain, wrench - x @ self._coefficients)
            self._covariance = self._covariance - np.outer(gain, Px)

    def add(self, record: PoseRecord) -> Estimated:
        """Raise: a sweep has no poses."""
        raise NotImplementedError(f"pose {record.stop} of a sweep")

    def remove(self, stop: int) -> None:
        """Do nothing."""

    def predict(self, R_base_flange: Array) -> Array | None:
        """Wrench (6,) of a free tool at this orientation (3, 3); None while it is uncertain."""
        if self._moving_s < KNOWN_S:
            return None
        x = self._features(R_base_flange)
        if float(x @ self._covariance @ x) > (_UNSURE_N / _NOISE_N) ** 2:
            return None
        return np.asarray(x @ self._coefficients)

    def _features(self, R_base_flange: Array) -> Array:
        return np.append(self.down_base @ R_base_flange, 1.0)
