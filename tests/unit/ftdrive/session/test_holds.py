"""What happens while the arm is held, on the fake cell: a person says no, or an emergency stop is pressed meanwhile."""

from ftdrive.errors import Declined
from ftdrive.session.events import Key
from ftdrivers.errors import ConnectError
from tests.unit.ftdrive.fake_cell import Lab
from tests.unit.ftdrive.session.scenarios import (
    Action,
    Case,
    cases,
    once,
    press,
    press_and_release,
    push,
    status,
)

QUESTIONS = ("Is the tool free", "Is the space within", "Is the emergency stop within reach")
PAUSE = {"move 4": press(Key.PAUSE)}
PAUSED = (4, "paused by the operator")
UNCONFIRMED = (4, "not confirmed: Approach")


def asked(times: int) -> dict[str, int]:
    return dict.fromkeys(QUESTIONS, times)


def out_of_sight(lab: Lab) -> None:
    def unseen() -> None:
        raise ConnectError("the arm is not open")

    lab.arm.at_look = unseen
    lab.clock.sleep(1.1)
    lab.arm.at_look = lambda: None


def on_the_way(action: Action) -> Action:
    return lambda lab: action(lab) if lab.arm.moves else None


A_PERSON_SAYS_NO = {
    "a way that is not confirmed leads back to the hold": Case(
        PAUSE, ("resume", "resume"), {"Approach to pose 4": ("no",)}, holds=(PAUSED, UNCONFIRMED)
    ),
    "the way back that is not confirmed is not gone but offered again": Case(
        {"move 4": push(), "hold": push(0.0)},
        ("back", "resume"),
        {"Approach back to pose 3": ("no",)},
        rows=(14,),
        holds=((4, "unexpected contact"), (4, "not confirmed: Approach back")),
    ),
    "a tour that may not begin yet is held at its first pose": Case(
        {}, ("resume",), {"Begin?": ("no",)}, holds=((1, "not confirmed: The arm is at"),)
    ),
    **{
        f"a no to {words!r} before the first motion ends the session": Case(
            {}, answers={words: ("no",)}, ends=".", error=Declined, taken=(), moves=0
        )
        for words in (QUESTIONS[0], "Type MOVE")
    },
}

AN_EMERGENCY_STOP_IS_PRESSED = {
    **{
        f"a {mode} that is pressed in a hold brings the questions again": Case(
            {**PAUSE, "asked resume:": once(press_and_release(mode))},
            ("resume",),
            rows=(11,),
            holds=(PAUSED,),
            moves=8,
            asked=asked(2),
        )
        for mode in ("robot emergency stop", "safeguard stop")
    },
    "a protective stop in a hold brings no questions": Case(
        {**PAUSE, "asked resume:": once(press_and_release("protective stop"))},
        ("resume",),
        holds=(PAUSED,),
        moves=8,
        asked=asked(1),
    ),
    "the questions come until they are all answered with yes": Case(
        {**PAUSE, "asked resume:": once(press_and_release())},
        ("resume", "resume"),
        {QUESTIONS[2]: ("yes", "no")},
        rows=(11,),
        holds=(PAUSED,),
        noted={"not yet: not confirmed": 1},
        asked=asked(3),
    ),
    "an emergency stop that is still pressed is refused": Case(
        {**PAUSE, "asked resume:": once(status("robot emergency stop")), "noted not yet": status()},
        ("resume", "resume"),
        rows=(11,),
        holds=(PAUSED,),
        moves=8,
        noted={"not yet": 1, "safety: robot emergency stop": 1},
        asked=asked(2),
    ),
    **{
        f"an emergency stop that is pressed at {words!r} counts too": Case(
            {
                "move 4": status("safeguard stop"),
                "asked resume:": status(),
                f"asked {words}": on_the_way(once(press_and_release())),
            },
            ("resume", "resume"),
            rows=(11, 11),
            holds=((4, "safeguard stop"), *more),
            asked=asked(3),
        )
        for words, more in ((QUESTIONS[0], ()), ("Approach to pose 4", ((4, "robot emergency stop"),)))
    },
    "an emergency stop between two steps holds the arm where it stands": Case(
        {"asked Pose 4 of 7": once(press_and_release())},
        ("resume",),
        mode="step",
        rows=(11,),
        holds=((3, "the arm stopped: robot emergency stop"),),
        asked=asked(2),
    ),
    "an emergency stop at the first questions brings them again": Case(
        {f"asked {QUESTIONS[1]}": once(press_and_release())},
        ("resume",),
        rows=(11,),
        holds=((0, "robot emergency stop"),),
        asked=asked(2),
    ),
    "an arm that was out of sight is resumed after a new question": Case(
        {**PAUSE, "asked resume:": once(out_of_sight)},
        ("resume",),
        holds=(PAUSED,),
        noted={"no status of the arm": 1},
        asked=asked(2),
    ),
}


@cases(A_PERSON_SAYS_NO | AN_EMERGENCY_STOP_IS_PRESSED)
def test_in_a_hold(case: Case, lab: Lab) -> None:
    case.play(lab)
