"""What the live screen draws, and the lines it draws it with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import NamedTuple, Self

import numpy as np
from rich.cells import cell_len, set_cell_size
from rich.text import Text

from ftdrive.checks.check import Check
from ftdrive.live.samples import Stages, StreamInfo, StreamStatus, WrenchFrame
from ftdrive.terminal.live.history import Columns
from ftdrive.terminal.text import visible
from ftdrivers.interfaces import Array

BAD, WARNING, GOOD = "red bold", "bold black on yellow", "green"
TRACE, CONTACT, FAINT, STRONG = "green", "magenta", "dim", "bold"


class Part(NamedTuple):
    """A piece of a line."""

    text: str
    style: str = ""
    key: str = ""
    """The key that a click on it stands for."""


class Line:
    """A line under construction."""

    def __init__(self, text: str = "", style: str = "", key: str = "") -> None:
        self.parts: list[Part] = []
        self.width = 0
        self.add(text, style, key)

    def add(self, text: str, style: str = "", key: str = "") -> Self:
        """Append text."""
        text = visible(text)
        self.width += cell_len(text)
        if self.parts and self.parts[-1][1:] == (style, key):
            self.parts[-1] = Part(self.parts[-1].text + text, style, key)
        elif text:
            self.parts.append(Part(text, style, key))
        return self

    def to(self, column: int) -> Self:
        """Append blanks up to a column."""
        return self.add(" " * (column - self.width))

    def join(self, other: "Line") -> Self:
        """Append another line."""
        self.parts += other.parts
        self.width += other.width
        return self

    def fit(self, width: int) -> "Line":
        """Return this line padded to `width` cells, or the words that fit and an ellipsis."""
        if self.width <= width:
            return self.to(width)
        fitted = Line()
        for part in self.parts:
            room = width - 1 - fitted.width
            if cell_len(part.text) > room:
                text = set_cell_size(part.text, max(room, 0))
                if not part.text.startswith(" ", len(text)):  # a whole word or none of it
                    text = text[: text.rfind(" ") + 1]
                fitted.add(text, part.style, part.key)
                break
            fitted.add(*part)
        return fitted.add("…"[:width]).to(width)

    @classmethod
    def of_cells(cls, text: Sequence[str], styles: Sequence[str]) -> Self:
        """Build a line of characters, each with its own style."""
        line, start = cls(), 0
        for style, alike in groupby(styles):
            end = start + sum(1 for _ in alike)
            line.add("".join(text[start:end]), style)
            start = end
        return line

    def as_text(self) -> Text:
        """Return this line for rich."""
        return Text.assemble(*((part.text, part.style) for part in self.parts), no_wrap=True)

    def __str__(self) -> str:
        return "".join(part.text for part in self.parts)


@dataclass(frozen=True, slots=True)
class Note:
    """An event, or an answer to a key."""

    t_host_ns: int | None
    text: str
    style: str = ""
    is_mark: bool = False
    """Whether the plots show its time."""
    times: int = 1
    """How often it came in a row."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The mean of the last 0.1 s of samples."""

    t_host_ns: int
    wrench: Array
    """(6,) N and N·m, in `frame`."""
    raw: Array
    """(6,) N and N·m, sensor axes, about the sensor origin."""
    raw_in_frame: Array
    """(6,) the same in `frame`."""
    sigma: Array
    """(6,) of `wrench`: noise and calibration; NaN until the noise is known."""
    sample_sigma: Array
    """(6,) of one sample."""
    chi2: float
    """Of the newest sample."""
    in_contact: bool
    R_base_flange: Array
    frame: WrenchFrame
    stages: Stages


@dataclass(slots=True, eq=False)
class Peaks:
    """Extremes since the last reset."""

    low: Array = field(default_factory=lambda: np.full(6, np.inf))
    high: Array = field(default_factory=lambda: np.full(6, -np.inf))
    force_N: float = 0.0
    torque_Nm: float = 0.0

    def add(self, wrench: Array) -> None:
        """Take samples (n, 6) into account."""
        np.minimum(self.low, wrench.min(axis=0), out=self.low)
        np.maximum(self.high, wrench.max(axis=0), out=self.high)
        squares = np.square(wrench)
        self.force_N = max(self.force_N, float(np.sqrt(squares[:, :3].sum(axis=1).max())))
        self.torque_Nm = max(self.torque_Nm, float(np.sqrt(squares[:, 3:].sum(axis=1).max())))


@dataclass(frozen=True, slots=True)
class Replay:
    """The state of a replayed recording."""

    at_s: float
    duration_s: float
    speed: float
    is_paused: bool
    has_ended: bool


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The state that the screen draws."""

    info: StreamInfo
    status: StreamStatus
    reading: Reading | None
    """None before the first sample."""
    silent: str
    """Which device is silent, and what to do; empty while numbers are fresh."""
    peaks: Peaks
    contact_s: float
    """Duration of the present contact."""
    notes: Sequence[Note]
    """Newest first."""
    checks: Sequence[Check]
    columns: Callable[[int], Columns]
    """The recent past in that many columns."""
    recording_s: float | None
    """Duration of the recording; None without one."""
    is_frozen: bool = False
    can_push: bool = False
    """Whether the tool is emulated, so that a key can push it."""
    replay: Replay | None = None
    calibrated: Array | None = None
    """(n, 3) directions of gravity in flange axes at the calibrated orientations, as unit vectors; None: unknown."""
