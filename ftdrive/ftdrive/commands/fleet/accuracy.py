"""`ftdrive fleet accuracy`: whether the stated sigmas hold, by repeating calibrations with simulated noise."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from math import ceil, degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive import __version__
from ftdrive.commands.common import FOLDER, JSON, STORE, write_json
from ftdrive.commands.fleet.engine import ENGINE, open_workers, runs_to_solve, with_progress
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.fleet.accuracy import Accuracy, Group

_LABELS = {
    "R_flange_sensor": ("mounting rotation", degrees(1), "°"),
    "gravity_force_base_N": ("gravity force", 1.0, " N"),
    "force_bias_N": ("force bias", 1.0, " N"),
    "p_sensor_com_m": ("centre of mass", 1e3, " mm"),
    "torque_bias_Nm": ("torque bias", 1.0, " N·m"),
    "mass_kg": ("mass", 1e3, " g"),
}
"""Name, factor and unit of each of `ftdrive.fleet.accuracy.GROUPS`, as printed."""
_TITLES = ("", "stated sigma", "scatter", "ratio", "sigma of ratio", "inside 95 %")


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--draws", type=click.IntRange(min=20), default=1000, show_default=True, help="Datasets for each run.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the random numbers.")
@ENGINE
@STORE
@JSON
def accuracy(
    folders: Sequence[Path],
    draws: int,
    seed: int,
    workers: int | None,
    cluster: str | None,
    url: str | None,
    as_json: bool,
) -> None:
    """Check by simulation whether the stated sigmas of calibrations hold.

    The result of each run is taken as the truth. Datasets with the poses of the run are drawn and solved as the run
    was, and the scatter of their results is compared with the stated sigmas. Drawn are the measured noise and the
    components that the result states: additional white noise, inexact orientations, drift of the bias, gain and
    cross-talk. A gain common to all axes is not drawn, and the sigma of the mass is without it.

    RUNS are run folders or folders of runs, by default all runs that the store knows. Verifications are left out, and
    so are runs without a calibration. Nothing is written. The numbers are the same for any number of workers.

    A sigma that does not hold is a finding, with exit code 0. The exit code is 7 if a run could not be read or solved.
    """
    from ftdrive.errors import NotAccepted
    from ftdrive.fleet.accuracy import BLOCK, accuracy_of

    runs, found, failed = _calibrated(runs_to_solve(folders, url)), list[dict[str, Any]](), list[dict[str, str]]()
    with open_workers(workers, cluster) as pool:
        for run in runs:
            show = partial(with_progress, run.name, total=ceil(draws / BLOCK))
            one = accuracy_of(run, pool, draws=draws, seed=seed, show=show)
            if isinstance(one, str):
                failed.append({"run": str(run), "reason": one})
            else:
                found.append({"run": str(run), **_as_json(one)})
            if not as_json:
                _print(run, one)
    if as_json:
        about = {"schema_version": 1, "version": __version__, "draws": draws, "seed": seed}
        write_json({**about, "runs": found, "failed": failed})
    if failed:
        raise NotAccepted(f"{len(failed)} of {len(runs)} runs could not be solved: fix the reasons, and repeat")


def _calibrated(runs: Sequence[Path]) -> list[Path]:
    """Return the runs that have a calibration, and those that cannot be read."""
    from ftdrive.runs.run import Run
    from ftdrive.terminal.console import talk

    kept = [run for run in runs if not run.is_dir() or Run(run).calibration_path.exists()]
    if left_out := len(runs) - len(kept):
        talk.print(f"Left out, because they have no calibration: {left_out} runs; `ftdrive solve RUN` shows why.")
    return kept


def _print(run: Path, found: "Accuracy | str") -> None:
    """Print a table and the findings in words, or why the run failed."""
    from ftdrive.terminal.table import print_table

    if isinstance(found, str):
        echo(f"failed: {run}: {found}")
        return
    noise = ", ".join(["the measured noise", *(f"{name} {size:.2g}" for name, size in found.components.items())])
    echo(f"{run}: {found.draws} draws of {found.poses} poses with {noise}")
    if found.groups:
        print_table(_TITLES, [_row(group) for group in found.groups], folding=())
        echo(f"chi2 / 15: {found.chi2_per_dof:.3f}")
    echo(f"{found.rejected} draws were rejected, {found.not_observable} were not observable.")
    for words in _in_words(found):
        echo(words)


def _row(group: "Group") -> tuple[str, ...]:
    label, factor, unit = _LABELS[group.name]
    stated, scatter = (f"{factor * size:.3g}{unit}" for size in (group.stated, group.scatter))
    return label, stated, scatter, f"{group.ratio:.3f}", f"{group.ratio_sigma:.3f}", f"{100 * group.inside:.1f} %"


def _in_words(found: "Accuracy") -> list[str]:
    if not found.groups:
        accepted = found.draws - found.rejected - found.not_observable
        return [f"Only {accepted} draws were accepted, too few for a statement: take more with --draws."]
    return [
        f"The stated sigma of the {_LABELS[one.name][0]} is too {'small' if one.ratio > 1 else 'large'}: "
        f"the scatter is {one.ratio:.2f} times as large."
        for one in found.groups
        if not one.holds
    ] or ["The stated sigmas hold."]


def _as_json(found: "Accuracy") -> dict[str, Any]:
    groups = {
        one.name: {key: value for key, value in asdict(one).items() if key != "name"}
        | {"ratio": one.ratio, "holds": one.holds}
        for one in found.groups
    }
    return {**asdict(found), "groups": groups}
