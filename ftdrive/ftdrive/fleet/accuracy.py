"""Monte-Carlo accuracy of a calibration: a parametric bootstrap.

The result of a run is taken as the truth. Datasets are drawn with the noise that it states, and solved as the run was.
The scatter of their estimates shows whether the stated sigmas hold.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.errors import BadCalibration, FtdriveError
from ftdrive.fleet.draws import ACCEPTED, DRAW, NOT_OBSERVABLE, REJECTED, solved_draws, stated_sigma
from ftdrive.fleet.resolve import task_of
from ftdrive.fleet.workers import Answer, OtherVersion, Workers, answers, in_words
from ftdrive.runs.run import Run

BLOCK: Final = 10
"""Draws that a worker gets at once."""
FEWEST: Final = 20
"""Accepted draws that show a scatter."""
SIGNIFICANT, RELEVANT = 4.0, 0.1
"""A ratio of scatter to sigma differs from 1 by more than so many of its own sigmas, and by more than this."""

GROUPS: Final = {
    "R_flange_sensor": slice(0, 3),
    "gravity_force_base_N": slice(3, 6),
    "force_bias_N": slice(6, 9),
    "p_sensor_com_m": slice(9, 12),
    "torque_bias_Nm": slice(12, 15),
    "mass_kg": slice(15, 16),
}
"""Columns of an error: the 15 coordinates `ftcalib.model.PARAMETER_NAMES` (the rotation in rad), then the mass."""

_Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Group:
    """One quantity over the draws; sigma and scatter are root mean squares over its axes."""

    name: str
    """One of `GROUPS`."""
    stated: float
    """Sigma of the run's result."""
    scatter: float
    """Root mean square error of the accepted draws."""
    ratio_sigma: float
    """Standard deviation of the ratio, from the draws."""
    inside: float
    """Share of draws whose own 95 % interval contains the truth."""

    @property
    def ratio(self) -> float:
        """Scatter over stated sigma: 1 expected."""
        return self.scatter / self.stated

    @property
    def holds(self) -> bool:
        """Whether the stated sigma agrees with the scatter."""
        off = abs(self.ratio - 1)
        return off < SIGNIFICANT * self.ratio_sigma or off <= RELEVANT


@dataclass(frozen=True, slots=True)
class Accuracy:
    """What the draws of a run show."""

    poses: int
    """Used poses."""
    components: dict[str, float]
    """Of the noise that was drawn beside the measured one: `CalibrationResult.components`."""
    draws: int
    rejected: int
    not_observable: int
    chi2_per_dof: float | None
    """Mean of e' C^-1 e / 15 with the covariance C that each draw itself states: 1 expected."""
    groups: tuple[Group, ...]
    """Empty if fewer than `FEWEST` draws were accepted."""


def accuracy_of(
    folder: Path,
    workers: Workers,
    *,
    draws: int = 1000,
    seed: int = 0,
    show: Callable[[Iterator[tuple[int, Answer]]], Iterable[tuple[int, Answer]]] = iter,
) -> Accuracy | str:
    """Draw and solve datasets of a run, and compare their scatter with the sigmas of its newest calibration.

    Parameters
    ----------
    folder : Path
    workers : Workers
    draws, seed : int
        The result is the same for any number of workers.
    show : callable
        Passes on the answers, of `BLOCK` draws each, as they come: for a progress bar.

    Returns
    -------
    Accuracy, or why the run could not be read or solved.

    Raises
    ------
    OtherVersion
        A worker has another version.
    """
    try:
        given = _arguments(folder)
    except (FtdriveError, OSError) as error:
        return in_words(error)

    def block(first: int) -> tuple[object, ...]:
        return *given, seed, first, min(BLOCK, draws - first)

    # One block a message: a cluster would give eight to one worker, and most of a run's blocks to few.
    found = answers(solved_draws, block, range(0, draws, BLOCK), replace(workers, group=1))
    blocks = [answer for _, answer in sorted(show(found), key=lambda one: one[0])]
    for answer in blocks:
        if isinstance(answer, OtherVersion):
            raise answer
        if isinstance(answer, BaseException):
            return in_words(answer)
    return compared(
        CalibrationResult.from_dict(json.loads(given[1])),
        np.frombuffer(b"".join(one for one in blocks if isinstance(one, bytes)), DRAW),
    )


def _arguments(folder: Path) -> tuple[bytes, bytes, bytes]:
    """Return dataset, calibration and circumstances of a run, for `solved_draws`."""
    run = Run(folder)
    dataset, task = task_of(folder)
    result = CalibrationResult.load(run.calibration_path)
    if result.provenance.get("dataset_sha256") != CalibrationDataset.load(run.dataset_path).sha256():
        raise BadCalibration(
            f"{run.calibration_path.name} is not of the poses in {run.dataset_path.name}, which have no calibration: "
            f"`{run.solve_command}` shows why"
        )
    if not stated_sigma(result).all():
        raise BadCalibration(
            f"{run.calibration_path.name} was solved with exactly known values, which a run does not have: "
            "keep it elsewhere"
        )
    return dataset, run.calibration_path.read_bytes(), task


def compared(result: CalibrationResult, draws: NDArray[np.void]) -> Accuracy:
    """Compare draws, in their order, with the result that they were drawn from."""
    accepted = draws[draws["outcome"] == ACCEPTED]
    n, sigma, groups = len(accepted), stated_sigma(result), list[Group]()
    covered = np.abs(accepted["error"]) < _Z95 * accepted["sigma"]
    for name, columns in GROUPS.items() if n >= FEWEST else ():
        square = (accepted["error"][:, columns] ** 2).mean(axis=1)
        stated, scatter = np.sqrt([np.mean(sigma[columns] ** 2), square.mean()]).tolist()
        of_ratio = float(np.std(square, ddof=1)) / np.sqrt(n) / (2 * scatter * stated)
        groups.append(Group(name, stated, scatter, float(of_ratio), float(covered[:, columns].mean())))
    return Accuracy(
        poses=result.n_poses - len(result.rejected_poses),
        components=dict(result.components),
        draws=len(draws),
        rejected=int((draws["outcome"] == REJECTED).sum()),
        not_observable=int((draws["outcome"] == NOT_OBSERVABLE).sum()),
        chi2_per_dof=float(accepted["chi2"].mean()) / 15 if groups else None,
        groups=tuple(groups),
    )
