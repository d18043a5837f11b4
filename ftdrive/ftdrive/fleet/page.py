"""The state of a fleet as a self-contained HTML page."""

from datetime import datetime

import numpy as np

from ftdrive import __version__
from ftdrive.fleet.cells import WINDOW, Changes, Observed
from ftdrive.fleet.state import Fleet, attention, summary, times_in_words
from ftdrive.report.page import templates, with_code

WIDTH, HEIGHT, MARGIN = 220, 44, 3
# A plot of the bias shows at least this range, in sigmas to each side of zero.
LEAST_SIGMAS = 4.0


def fleet_page(fleet: Fleet, observed: Observed, store: str) -> str:
    """Return the page; `store` is the name of the store. Raises `ConfigError` without the extra `fleet`."""
    environment = templates("ftdrive.fleet", "the page of a fleet", "fleet", "--json")
    from markupsafe import Markup

    environment.filters["with_code"] = with_code
    rows = []
    for state in fleet.cells:
        changes = observed.changes.get(state.calibration_id or "")
        drawn = (
            "" if changes is None or state.calibrated is None else _bias_plot(changes, state.calibrated, observed.now)
        )
        drift = "-" if state.drift is None else f"{state.drift.level_sigmas:.1f} σ"
        rows.append({"state": state, "plot": Markup(drawn), "drift": drift, **times_in_words(state, observed.now)})
    return environment.get_template("fleet.html.j2").render(
        rows=rows,
        summary=summary(fleet, observed.now),
        attention=attention(fleet, observed.now),
        now=observed.now,
        store=store,
        days=WINDOW.days,
        version=__version__,
    )


def _bias_plot(changes: Changes, start: datetime, now: datetime) -> str:
    """Return the changes of the bias in the last 90 days as SVG, in sigmas; the grey band is ±2 sigmas."""
    # Plain SVG, because matplotlib is too slow for 200 plots.
    first = (now - WINDOW - start).total_seconds() / 86400
    x = MARGIN + (changes["t_days"] - first) / WINDOW.days * (WIDTH - 2 * MARGIN)
    sigmas = changes["change"] / changes["sigma"]
    most = max(LEAST_SIGMAS, float(np.abs(sigmas).max()))
    middle, unit = HEIGHT / 2, (HEIGHT / 2 - MARGIN) / most
    band = f'<rect x="0" y="{middle - 2 * unit:.1f}" width="{WIDTH}" height="{4 * unit:.1f}" class="band"/>'
    lines = "".join(
        f'<polyline class="{"force" if k < 3 else "torque"}" points="'
        + " ".join(f"{a:.1f},{middle - unit * b:.1f}" for a, b in zip(x, sigmas[:, k], strict=True))
        + '"/>'
        for k in (3, 4, 5, 0, 1, 2)
    )
    label = f"changes of the six biases in the last {WINDOW.days} days, at most {most:.1f} sigma"
    whole = WIDTH + 40
    return (
        f'<svg viewBox="0 0 {whole} {HEIGHT}" width="{whole}" height="{HEIGHT}" role="img" aria-label="{label}">'
        f'{band}<path class="zero" d="M0 {middle}H{WIDTH}"/>{lines}'
        f'<text x="{WIDTH + 6}" y="{middle + 3}">±{most:.0f} σ</text></svg>'
    )
