"""Options of a session, those that exclude one another, and the mode of a resumed run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self, cast, get_args

from ftcalib.published.methods import SPECIAL
from ftcalib.result import Method
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.runs.calibration import read_calibration
from ftdrive.runs.load import Load
from ftdrive.runs.run import Mode, Run
from ftdrive.session.guards import Guard, RangeGuard

_BY_HAND: Final = ("manual", "listen", "passive")
_LONGEST_SWEEP_S: Final = 120
_SAVED: Final = ("--output", "--png")
# Options of a session without a meaning where ftdrive neither plans nor moves.
_OF_MOTION: Final = ("--plan", "--fast", "--dry-run", "--redo", *_SAVED)
# Options of `ftdrive calibrate`.
_MODES: Final[Sequence[Mode]] = ("step", "manual", "listen", "sweep", "passive")
_AS_GIVEN: Final = ("runs", "sets", "dry_run", "fast", "plan", "output", "png", "resume", "redo", "yes")
_EXCLUDE_ONE_ANOTHER: Final = (
    tuple(f"--{mode}" for mode in _MODES),
    ("--quick", "--minimal", "--set", "--plan", "--resume", "--sweep", "--passive"),
    ("--from", "--set"),
    *(("--method", other) for other in ("--from", "--resume", "--sweep", "--passive")),
    *(
        ("--load", other)
        for other in ("--quick", "--minimal", "--set", "--method", "--from", "--sweep", "--passive", "--resume")
    ),
    ("--at", "--gripped"),
    ("--fast", "--sweep", "--passive"),
    ("--from", "--resume", "--passive"),
    *((f"--{hand}", option) for hand in _BY_HAND for option in ("--quick", "--minimal", "--set", *_SAVED)),
    *(("--simulate", described) for described in ("--config", "--robot", "--tool")),
)


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Options of a session, as the operator gave them."""

    runs: Path
    name: str = "calibrate"
    poses: int = 24
    sets: str | None = None
    """Sets of Yu's Fig. 6 instead of that many poses, such as A+E."""
    method: Method = "ml"
    """Method that solves the poses of a calibration."""
    mode: Mode = "auto"
    """With `resume`, "auto" means the mode of that run."""
    dry_run: bool = False
    fast: bool = False
    """Move at the plan's speeds if it has run to its end slowly before."""
    plan: Path | None = None
    output: Path | None = None
    """Save the plan as a new file."""
    png: Path | None = None
    """Draw it."""
    watch: Callable[[Certifier, RangeGuard], Guard] | None = None
    """Called before any question; the guard that it returns looks on beside the others, and never trips."""
    resume: Path | None = None
    redo: tuple[int, ...] = ()
    real: bool = True
    """Whether a real arm moves. An emulated cell needs no typed word and no slow first run."""
    questions: bool = True
    yes: bool = False
    """Answer the safety questions automatically, never the first motion."""
    seconds: float = 20.0
    """Duration of a sweep at the planned speed; the longest of a passive calibration."""
    description: Mapping[str, Any] = field(default_factory=dict)
    """Goes into run.json."""
    load: Load | None = None
    """A weighed load on the tool, or what the resumed run has."""

    @classmethod
    def of_calibration(cls, given: Mapping[str, Any]) -> Self:
        """Return what the options of `ftdrive calibrate` mean, by name. Raises `ConfigError`."""
        earlier, load = given["earlier"], given["load"]
        poses = 6 if given["minimal"] or given["gripped"] else 24 if earlier is None else 4
        return cls(
            poses=12 if given["quick"] else poses,
            method=method_of_poses(given["method"]),
            mode=next((name for name in _MODES if given[name]), "auto"),
            seconds=given["seconds"] or (600.0 if given["passive"] else 20.0),
            description={} if earlier is None else {"earlier": read_calibration(earlier).to_dict()},
            load=None if load is None else Load.of(load, given["at"], gripped=given["gripped"]),
            **{name: given[name] for name in _AS_GIVEN},
        )

    @property
    def by_hand(self) -> bool:
        """Whether the operator or a program on the pendant moves the arm."""
        return self.mode in _BY_HAND

    def with_recorded_mode(self) -> "SessionOptions":
        """Return options with the mode of the resumed run; raises `ConfigError` for options that exclude each other."""
        begun = self.mode if self.resume is None else Run(self.resume).mode
        if self.resume is not None and begun == "sweep":
            raise ConfigError(f"{self.resume} is a sweep, which is not continued: start again with --sweep")
        if self.mode != "auto" and (begun in _BY_HAND) != self.by_hand:
            way = f"with --{begun}" if begun in _BY_HAND else "along a plan"
            raise ConfigError(f"{self.resume} was started {way} and only continues so: leave out --{self.mode}")
        options = replace(self, mode=begun if self.mode == "auto" else self.mode)
        if options.redo and options.resume is None:
            raise ConfigError("--redo needs a run: name the run with --resume RUN")
        if not options.by_hand:
            return options
        if wrong := [name for name in _OF_MOTION if getattr(options, name[2:].replace("-", "_"))]:
            raise ConfigError(f"with --{options.mode} ftdrive neither plans nor moves: leave out {' and '.join(wrong)}")
        return options


def refuse_contradictions(given: Mapping[str, Any]) -> None:
    """Raise `ConfigError` for options of `ftdrive calibrate` that exclude one another; their values by name."""
    if "--load" not in given and (place := [option for option in ("--at", "--gripped") if option in given]):
        raise ConfigError(f"{place[0]} goes with --load MASS: give the mass of the load in kg")
    for group in _EXCLUDE_ONE_ANOTHER:
        both = [option for option in group if option in given]
        if len(both) > 1:
            raise ConfigError(f"{both[0]} and {both[1]} exclude one another: leave one of them out")
    if "--manual" in given and (method := given.get("--method")) in SPECIAL:
        words = f"--manual ends before the 24 orientations that {method} needs"
        raise ConfigError(f"{words}: leave it out, or choose --method lrom")
    seconds = given.get("--seconds")
    if seconds is not None and (seconds > _LONGEST_SWEEP_S if "--sweep" in given else "--passive" not in given):
        raise ConfigError(f"--seconds {seconds:g} goes with --passive, or up to {_LONGEST_SWEEP_S} with --sweep")


def method_of_poses(name: str) -> Method:
    """Return a method by its name, if poses suffice for it. Raises `ConfigError`."""
    if name not in get_args(Method):
        raise ConfigError(f"there is no method '{name}': choose one of {', '.join(get_args(Method))}")
    if name == "carlson-cayley":
        raise ConfigError(
            "carlson-cayley needs the mass on the sensor: take the poses without --method, then "
            "`ftdrive solve RUN --method carlson-cayley --mass-kg KG`"
        )
    return cast(Method, name)
