"""What happens to each pose, on every path: it goes to disk, then into the estimate."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ftcalib.model import Array
from ftcalib.routine import PoseRecord
from ftdrive.runs.run import Run
from ftdrive.session.events import Compared, Estimated, Noted, PoseTaken
from ftdrive.session.live_fit import Judge
from ftdrive.session.open_cell import Journal, OpenCell


@contextmanager
def reporting_early_end(journal: Journal, run: Run) -> Iterator[None]:
    """Show where the data of a run are if the block ends early."""
    try:
        yield
    except BaseException:
        journal.show(Noted(words=_describe_kept(run)), sync=True)
        raise


def _describe_kept(run: Run) -> str:
    if run.mode == "sweep":
        return f"the sweep was not completed: {run.folder} has its events, and no recording"
    if run.mode == "passive":
        kept = f"the recording so far is kept; solve it with\n{run.solve_command}"
        return kept if run.in_motion else f"nothing was recorded in {run.folder}"
    words = f"{len(run.stops())} poses saved in {run.folder}; continue with\n{run.resume_command}"
    return words + (f"\nor solve them with\n{run.solve_command}" if run.stops() and run.command == "calibrate" else "")


@dataclass(frozen=True, slots=True, eq=False)
class PoseBook:
    """Keeps the poses of a session, and judges them."""

    cell: OpenCell
    run: Run
    judge: Judge
    down_base: Array
    """(3,) unit vector down in base, as mounted."""

    def keep(self, record: PoseRecord, *, stops: int, settle_s: float, average_s: float) -> Estimated | Compared:
        """Commit and show a pose; return what the poses show now."""
        # Each pose is on disk before the arm moves on: a crash costs only the pose in progress.
        record = self.run.commit(record)
        self.cell.journal.show(
            PoseTaken(
                stop=record.stop,
                stops=stops,
                number=record.pose.number,
                gravity_flange=record.before.R_base_flange.T @ self.down_base,
                mean=record.mean.mean,
                sigma=np.sqrt(np.diag(record.mean.covariance)),
                samples=len(record.samples.t_host_ns),
                settle_s=settle_s,
                average_s=average_s,
                attempts=record.attempts,
                steady=record.steady,
                temperature_C=self.cell.sensor.temperature_C(),
            ),
            sync=True,
        )
        return self.judge.add(record)
