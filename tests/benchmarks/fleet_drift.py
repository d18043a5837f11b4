"""Drift of the bias in a simulated fleet: days until it is found, and false alarms.

    uv run python -m tests.benchmarks.fleet_drift [--cells 200] [--seed 1]

The first row is a year of a fleet with daily verifications, five cells of which drift by 1 sigma a week from a random
day on. The others show unchanged cells, tares, other rates, and verifications once a week. Every verification is a look
at the last 90 days, as `fleet status` does it. Sigma is that of a verification; the calibration has half of it.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import click
import numpy as np
from numpy.typing import NDArray

from ftcalib.after.series import drift_onset
from ftcalib.model import Array
from ftdrive.fleet.cells import WINDOW

YEAR = 365
COMMON = 0.5
NEVER = float("inf")


@dataclass(frozen=True)
class Case:
    """What happens in a cell."""

    title: str
    every_days: float = 1.0
    a_week: float = 0.0
    """Drift of one component, in sigmas, from a random day of the year on."""
    scatter: float = 1.0
    """True sigma over the stated one."""
    tare: float = 0.0
    """Norm of a sudden change of all components on a random day, in sigmas."""


CASES = (
    Case("unchanged, daily"),
    Case("unchanged, weekly", every_days=7),
    Case("unchanged, daily, sigmas 2 times too small", scatter=2),
    Case("unchanged, weekly, sigmas 2 times too small", every_days=7, scatter=2),
    Case("tare by 20 sigma, daily", tare=20),
    Case("tare by 1000 sigma, daily", tare=1000),
    Case("sudden change by 5 sigma, daily", tare=5),
    Case("0.5 sigma a week, daily", a_week=0.5),
    Case("1 sigma a week, daily", a_week=1),
    Case("2 sigma a week, daily", a_week=2),
    Case("5 sigma a week, daily", a_week=5),
    Case("1 sigma a week, weekly", every_days=7, a_week=1),
    Case("1 sigma a week, daily, sigmas 2 times too small", a_week=1, scatter=2),
)


@dataclass(frozen=True)
class Year:
    """What one cell has shown."""

    delay_days: float
    """From the onset until the drift is found."""
    false_alarms: int
    """Times that a drift begins to be reported in a component that does not drift, or before the onset."""
    false_days: int


def simulated(case: Case, rng: np.random.Generator) -> Year:
    """A year of one cell."""
    t = np.arange(0.0, YEAR, case.every_days)
    t += rng.uniform(0.0, 0.3, len(t))
    change = case.scatter * rng.normal(size=(len(t), 6)) + COMMON * rng.normal(size=6)
    onset, component = rng.uniform(30, YEAR - 120), int(rng.integers(6))
    change[:, component] += case.a_week / 7 * np.maximum(0.0, t - onset)
    if case.tare:
        step = rng.normal(size=6)
        change += np.outer(t > onset, case.tare * step / np.linalg.norm(step))
    drifting = np.arange(6) == component if case.a_week else np.zeros(6, bool)
    delay, alarms, days, before = NEVER, 0, 0, False
    for found, now in _looks(t, change):
        real = drifting & (now > onset)
        if (found & real).any():
            delay = now - onset
            break
        wrong = bool((found & ~real).any())
        alarms, days, before = alarms + (wrong and not before), days + wrong, wrong
    return Year(delay, alarms, days)


def _looks(t: Array, change: Array) -> Iterator[tuple[NDArray[np.bool_], float]]:
    """Yield at each verification which components are found to drift, and the time."""
    starts = np.searchsorted(t, t - WINDOW.days)
    for n, start in enumerate(starts, 1):
        rows = slice(int(start), n)
        found = drift_onset(t[rows], change[rows], np.ones((n - start, 6)), np.full(6, COMMON))
        yield (np.zeros(6, bool) if found is None else found.found), float(t[n - 1])


def fleet_year(cells: int, drifting: int, rng: np.random.Generator) -> None:
    """Print the year of a fleet in which some cells drift."""
    years = [simulated(Case("", a_week=1.0 if i < drifting else 0.0), rng) for i in range(cells)]
    delays = sorted(one.delay_days for one in years[:drifting])
    alarms = sum(one.false_alarms for one in years)
    click.echo(f"A fleet of {cells} cells, a year of daily verifications, {drifting} of them drift by 1 sigma a week:")
    click.echo(f"  found after {', '.join(f'{days:.0f}' for days in delays)} days (target: 21)")
    longest = max(one.false_days for one in years)
    click.echo(f"  {alarms} false alarms in {cells} cell-years (target: {cells}), none longer than {longest} days\n")


def main() -> None:
    """Print the year of a fleet, then one row per case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    fleet_year(options.cells, min(5, options.cells), np.random.default_rng(options.seed))
    click.echo("| case | found after, days: median, 90 %, 99 % | false alarms a cell-year |")
    click.echo("|---|---|---|")
    for number, case in enumerate(CASES):
        rng = np.random.default_rng([options.seed, number])
        years = [simulated(case, rng) for _ in range(options.cells)]
        delays = np.sort([one.delay_days for one in years])
        shown = [delays[int(np.ceil(share * len(delays))) - 1] for share in (0.5, 0.9, 0.99)]
        found = ", ".join("-" if np.isinf(days) else f"{days:.0f}" for days in shown) if case.a_week else ""
        alarms = sum(one.false_alarms for one in years) / options.cells
        click.echo(f"| {case.title} | {found} | {'' if case.a_week else f'{alarms:.3f}'} |")


if __name__ == "__main__":
    main()
