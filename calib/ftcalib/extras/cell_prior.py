"""What an earlier result knows of a cell: mounting, direction of gravity, gain, cross-talk; and what contradicts it."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import chdtrc as chi2_sf

from ftcalib.errors import NotObservable
from ftcalib.model import Array, Parameters, angle_between, angle_between_vectors, skew
from ftcalib.result import CalibrationResult

FALSE_ALARMS = 1e-4
"""Share of good runs that the test of what was kept rejects."""
WHOLE = (0, 1, 2, 3, 4)
"""Rows of a prior: three of the mounting, two of the base."""
_MOUNTING, _BASE = WHOLE[:3], WHOLE[3:]

Refit = Callable[[Sequence[int]], tuple[float, int, Parameters]]
"""From the rows of the prior that count to the misfit, its degrees of freedom, and the parameters."""


class CellPrior:
    """A Gaussian prior of mounting and direction of gravity, and of gain and cross-talk where the result has them.

    Parameters
    ----------
    earlier : CalibrationResult
        Of the same sensor, mounting and base, with any tool.
    """

    def __init__(self, earlier: CalibrationResult) -> None:
        self.earlier, gain = earlier, earlier.response
        self.coefficients = np.zeros(0) if gain is None else np.array(gain.coefficients)
        """(11,) of gain and cross-talk, or none."""
        self._covariance = np.array(earlier.covariance if gain is None else gain.covariance)
        self._across = np.linalg.svd(skew(earlier.parameters.gravity_force_base_N))[0][:, :2]  # gravity

    @property
    def has_response(self) -> bool:
        """Whether gain and cross-talk are known."""
        return len(self.coefficients) > 0

    def count(self, kept: Sequence[int]) -> int:
        """Return the number of rows; `kept` as of `rows`."""
        return len(kept) + len(self.coefficients) * bool(kept)

    def rows(self, p: Parameters, coefficients: Array, kept: Sequence[int] = WHOLE) -> tuple[Array, Array]:
        """Return the derivative (k, 15 or 26) and the residual (k,), earlier minus present, in standard deviations.

        Parameters
        ----------
        p : Parameters
            The present ones.
        coefficients : array, shape (11,) or (0,)
            Of gain and cross-talk.
        kept : sequence of int
            Which count: 0 to 2 mounting, 3 and 4 base. Gain and cross-talk do unless it is empty.
        """
        rows = [*kept, *range(len(WHOLE), len(WHOLE) + len(self.coefficients))] if kept else []
        old = self.earlier.parameters
        before = self._derivative(old)[rows]
        V = before @ self._covariance @ before.T
        root = np.linalg.inv(np.linalg.cholesky(V + 1e-12 * np.diag(np.diag(V)) + 1e-24 * np.eye(len(V))))
        apart = [p.difference(old)[:3], self._across.T @ (down(old) - down(p)), self.coefficients - coefficients]
        return root @ self._derivative(p)[rows], root @ np.concatenate(apart)[rows]

    def _derivative(self, p: Parameters) -> Array:
        size = len(self._covariance)
        F, u = float(np.linalg.norm(p.gravity_force_base_N)), down(p)
        rows = np.zeros((len(WHOLE) + size - 15, size))
        rows[:3, :3] = np.eye(3)
        rows[3:5, 3:6] = self._across.T @ (np.eye(3) - np.outer(u, u)) / F
        rows[5:, 15:] = np.eye(size - 15)
        return rows

    def contradiction(self, chi2: float, dof: int, refit: Refit, what: str, alone: str) -> str:
        """Name what does not hold any more; empty where the prior fits.

        Parameters
        ----------
        chi2, dof : float, int
            Misfit with the whole prior.
        refit : callable
            Fits without a part of it. May raise `NotObservable`.
        what, alone : str
            Name of the data, and how to calibrate without the earlier result.
        """
        if not dof or chi2_sf(dof, chi2) >= FALSE_ALARMS:
            return ""
        explained, old = list[tuple[float, str]](), self.earlier.parameters
        for cause, kept in (("the sensor is mounted otherwise", _BASE), ("the base leans otherwise", _MOUNTING)):
            try:
                left, freedom, new = refit(kept)
            except NotObservable:
                continue
            if not freedom or chi2_sf(freedom, left) >= FALSE_ALARMS:
                turned = float(angle_between(old.R_flange_sensor, new.R_flange_sensor))
                if kept == _MOUNTING:
                    turned = angle_between_vectors(down(old), down(new))
                explained.append((left, f"{cause}, by {np.degrees(turned):.2g}°"))
        misfit = f"chi2 {chi2:.0f} for {dof} degrees of freedom"
        if not explained:
            return (
                f"{what} do not fit mounting and base of {self.earlier.id} ({misfit}): check for contact, or solve "
                "alone."
            )
        explained.sort()
        found = " or ".join(text for left, text in explained if left < explained[0][0] + 10)
        return f"{found} since {self.earlier.id} ({misfit}): {alone}."


def down(p: Parameters) -> Array:
    """Return the direction (3,) of gravity in base."""
    return np.asarray(p.gravity_force_base_N / np.linalg.norm(p.gravity_force_base_N))
