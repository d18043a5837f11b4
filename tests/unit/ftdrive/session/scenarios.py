"""The runner of the tables of faults and keys: what happens when, what the session does, and how it ends."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from ftdrive.session.events import Event, GuardTripped, Key, Noted, PoseTaken, StateChanged
from ftdrivers.errors import DeviceFault, StreamBroken
from tests.unit.ftdrive.fake_cell import Lab

Action = Callable[[Lab], object]

ALL = (1, 2, 3, 4, 5, 6, 7)
PUSH_N = 150.0


def status(safety_mode: str = "normal", **different: Any) -> Action:
    """Return the action that gives the controller this status; a stop is also its fault."""
    if safety_mode.endswith(" stop"):
        different.setdefault("fault", DeviceFault(safety_mode, "…"))
    return lambda lab: lab.arm.set_status(safety_mode=safety_mode, **different)


def push(force_N: float = PUSH_N, torque_Nm: float = 0.0) -> Action:
    return lambda lab: setattr(lab.sensor, "push", np.array([force_N, 0, 0, 0, torque_Nm, 0]))


def press(*keys: Key) -> Action:
    return lambda lab: lab.operator.keys.extend(keys)


def turn(joint: int, angle_deg: float) -> Action:
    """Return the action that moves a joint of the arm, which no session has asked for."""
    return lambda lab: setattr(lab.arm, "q", lab.arm.q + np.radians(angle_deg) * (np.arange(1, 7) == joint))


def lose_sensor(lab: Lab) -> None:
    lab.sensor.failure = StreamBroken("a cable came off")


def end_guards(lab: Lab) -> None:
    """Let the guards' thread end with the next look, whatever it does."""

    def end() -> None:
        if lab.guards_look:
            raise SystemExit

    lab.arm.at_look = end


def press_and_release(mode: str = "robot emergency stop") -> Action:
    """Return the action that stops the arm for a tenth of a second, in which the guards look at it."""

    def do(lab: Lab) -> None:
        status(mode)(lab)
        lab.clock.sleep(0.1)
        status()(lab)
        lab.clock.sleep(0.1)

    return do


def both(*actions: Action) -> Action:
    return lambda lab: [action(lab) for action in actions]


def once(action: Action) -> Action:
    left = [action]
    return lambda lab: left.pop()(lab) if left else None


def moment_of(event: Event) -> str:
    match event:
        case StateChanged():
            return f"{event.state} {event.stop}"
        case PoseTaken():
            return f"taken {event.stop}"
        case Noted():
            return f"noted {event.words}"
    return ""


def at(lab: Lab, moment: str, action: Action) -> None:
    """Let something happen at "move 4", "sweep 1.0" (s), "measuring 4", "asked WORDS" or an event: see `moment_of`.

    While the fourth pose is measured it happens once, at the others each time."""
    kind, _, where = moment.partition(" ")
    if kind == "move":
        lab.arm.at_move[int(where)] = lambda: action(lab)
    elif kind == "sweep":
        lab.arm.at_sweep_s[1] = float(where), lambda: action(lab)
    elif kind == "asked":
        lab.operator.at_question.append((where, lambda: action(lab)))
    elif kind == "measuring":
        first = once(action)
        lab.sensor.collecting = lambda: first(lab) if len(lab.arm.moves) == int(where) else None
    else:
        before = lab.operator.on_event

        def on_event(event: Event) -> None:
            before(event)
            if moment_of(event).startswith(moment):
                action(lab)

        lab.operator.on_event = on_event


@dataclass(frozen=True)
class Case:
    """What happens in a session on the fake cell, and what the session does."""

    happens: Mapping[str, Action]
    """By the moment: see `at`."""
    resume: tuple[str, ...] = ()
    """Answers in a hold; if empty, there is no operator to resume."""
    answers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Answers to other questions, by words of theirs."""
    mode: str = "auto"
    ends: str = ""
    """Words of the error that ends the session; none: it comes to its end."""
    error: type[BaseException] = DeviceFault
    rows: tuple[int, ...] = ()
    """Of the hazard table, of each guard that trips."""
    holds: tuple[tuple[int, str], ...] = ()
    """Of each hold, the number of moves until then, and words of its reason."""
    taken: tuple[int, ...] = ALL
    moves: int | None = None
    noted: Mapping[str, int] = field(default_factory=dict)
    """How many notes have these words."""
    asked: Mapping[str, int] = field(default_factory=dict)
    """How many questions to a person have these words."""

    def play(self, lab: Lab) -> None:
        held: list[tuple[int, str]] = []
        for moment, action in self.happens.items():
            at(lab, moment, action)
        at(lab, "hold", lambda _: held.append((len(lab.arm.moves), lab.operator.of(StateChanged)[-1].words)))
        lab.operator.answers |= {words: [*answers] for words, answers in self.answers.items()}
        lab.operator.answers["resume:"] = [*self.resume]
        with pytest.raises(self.error, match=self.ends) if self.ends else nullcontext():
            if self.mode == "sweep":
                assert lab.sweep(real=False).in_motion
            else:
                assert lab.take_poses(mode=self.mode) is not None
        rows = tuple(int(trip.hazard) for trip in lab.operator.of(GuardTripped))
        assert rows == self.rows, rows
        assert [(moves, words in reason) for (moves, reason), (_, words) in zip(held, self.holds, strict=True)] == [
            (moves, True) for moves, _ in self.holds
        ], held
        assert tuple(lab.taken()) == self.taken, lab.taken()
        assert not self.taken or lab.stops() == sorted({*self.taken})
        assert self.moves in (None, len(lab.arm.moves))
        notes = [event.words for event in lab.operator.of(Noted)]
        assert {words: sum(words in note for note in notes) for words in self.noted} == self.noted
        people = [question.text for question in lab.operator.asked if question.assumed is None]
        assert {words: sum(words in text for text in people) for words in self.asked} == self.asked
        if self.ends and self.taken:
            assert lab.arm.halted.is_set() or not self.rows
            assert f"--resume {lab.run().folder}" in notes[-1]


def cases(table: Mapping[str, Case], slow: tuple[str, ...] = ()) -> pytest.MarkDecorator:
    """Return the mark that gives a test each case of a table, by its name."""
    rows = [
        pytest.param(case, id=name, marks=[pytest.mark.slow] if name in slow else []) for name, case in table.items()
    ]
    return pytest.mark.parametrize("case", rows)
