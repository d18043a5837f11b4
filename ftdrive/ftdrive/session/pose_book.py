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
from ftdrive.session.open_cell import OpenCell


@dataclass(frozen=True, slots=True, eq=False)
class PoseBook:
    """Keeps the poses of a session, and judges them."""

    cell: OpenCell
    run: Run
    judge: Judge
    down_base: Array
    """(3,) unit vector down in base, as mounted."""

    @contextmanager
    def reporting_early_end(self) -> Iterator[None]:
        """Show where the poses are if the block ends early."""
        try:
            yield
        except BaseException:
            run = self.run
            if run.header().get("mode") == "sweep":
                words = f"the sweep was not completed: {run.folder} has its events, and no recording"
                self.cell.journal.show(Noted(words=words), sync=True)
                raise
            words = f"{len(run.stops())} poses saved in {run.folder}; continue with\n{run.resume_command}"
            if run.stops() and run.command == "calibrate":
                words += f"\nor solve them with\n{run.solve_command}"
            self.cell.journal.show(Noted(words=words), sync=True)
            raise

    def keep(self, record: PoseRecord, *, stops: int, settle_s: float, average_s: float) -> Estimated | Compared:
        """Commit and show a pose; return what the poses show now."""
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
