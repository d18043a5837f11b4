"""Shows a session on a page, and how a calibration or a verification ended."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.rounding import to_place_of
from ftdrive.errors import Declined, in_a_sentence
from ftdrive.runs.verification import Verified
from ftdrive.session.events import Operator
from ftdrive.session.open_session import SessionOptions
from ftdrive.view.page import Page
from ftdrive.view.parts import BAD, GOOD, WARN, reading
from ftdrive.view.session_page import SessionPage, conclude
from ftdrive.words.result import conclusion, verification_in_lines
from ftdrive.words.text import in_one_line

# Estimates that the page shows at the end of a calibration.
_SHOWN: Final = {"mass_kg", "p_sensor_com_m", "R_flange_sensor"}


@contextmanager
def on_page(
    page: Page | None, operator: Operator, options: SessionOptions, command: str = "calibrate"
) -> Iterator[tuple[Operator, SessionOptions]]:
    """Show a session on a page while the block runs; yield the operator and options for the session.

    Without a page, these are the given ones. If the block raises an error, the page shows its message.
    """
    if page is None:
        yield operator, options
        return
    shown = SessionPage(page, operator, command)
    try:
        with shown:
            yield shown, replace(options, watch=shown.watch)
    except BaseException as error:
        head, _, words = _last_line(error).partition(": ")
        conclude(page, head[:1].upper() + head[1:], words, *shown.kept, tone=BAD)
        raise


def _last_line(error: BaseException) -> str:
    if isinstance(error, Declined):
        return str(error)
    return "interrupted" if isinstance(error, KeyboardInterrupt) else f"error: {in_one_line(in_a_sentence(error))}"


def conclude_calibration(page: Page | None, result: CalibrationResult, commands: Sequence[str]) -> None:
    """Show verdict, estimates, findings and next commands of a calibration on its page; None is no page."""
    if page is None:
        return
    figures = []
    for label, factor, unit, key, values, sigmas, known in result.estimates:
        if key in _SHOWN and not known.all():
            sigma = float((factor * sigmas).max())
            rounded = ", ".join(to_place_of(factor * value, sigma) for value in values)
            figures.append(reading(label, rounded, unit, sigma=f"± {to_place_of(sigma, sigma)} (1 sigma)"))
    lines = [f"{one.head}{one.words}".strip() for one in conclusion(result, hinted=False)]
    tone = {"good": GOOD, "usable": WARN, "rejected": BAD}[result.verdict]
    conclude(page, result.verdict.upper(), *lines, tone=tone, figures=figures, following=commands)


def conclude_verification(page: Page | None, verified: Verified, *following: str) -> None:
    """Show outcome, largest differences and next commands of a verification on its page; None is no page."""
    if page is None:
        return
    found, figures = verified.verification, []
    for name, unit, axes in (("force", "N", slice(3)), ("torque", "N·m", slice(3, 6))):
        sizes = np.linalg.norm(found.residual[:, axes], axis=1)
        sigma = float(np.linalg.norm(found.predicted_sigma[sizes.argmax(), axes]))
        value = to_place_of(sizes.max(), sigma)
        figures.append(
            reading(f"largest difference, {name}", value, unit, sigma=f"± {to_place_of(sigma, sigma)} (1 sigma)")
        )
    head, tone = ("PASS", GOOD) if verified.passed else ("FAILED", BAD)
    lines = [f"{one.head}{one.words}".strip() for one in verification_in_lines(verified)]
    conclude(page, head, *lines, tone=tone, figures=figures, following=following)
