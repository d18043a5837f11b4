"""The state of a tour as a value: which poses are left, where the arm is, what the operator asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a tour between two steps; every method returns the next state.

    A stop counts from 1 to `poses + 1`, the return to the first pose. An index counts the poses of the plan from 0.
    """

    poses: int
    todo: tuple[int, ...] = ()
    """Stops left, in order."""
    stood_at: int | None = None
    """Index of the pose where the arm stood last; None where it was moved from there by something else."""
    standing: bool = False
    """Whether the arm still stands there."""
    under_way: int | None = None
    """Stop that the arm moves to or measures."""
    back: tuple[int, str] | None = None
    """Index of the pose to return to, and what stopped the arm."""
    confirmed: bool = False
    """Whether the operator has typed the word for the first motion."""
    taken_last: int | None = None
    """Stop of the newest pose."""
    again: bool = False
    """Whether the newest pose is to be taken again."""
    skipped: frozenset[int] = frozenset()
    """Indices of postures that the arm should avoid."""
    reopened: frozenset[int] = frozenset()
    """Stops at which the sensor was reopened."""
    driven: frozenset[int] = frozenset()
    """Indices of poses whose move to the next pose was completed."""
    payload_kg: float | None = None
    """Payload reported by the controller when it was last compared."""

    @property
    def stops(self) -> int:
        """Number of stops, the return included."""
        return self.poses + 1

    @property
    def at(self) -> int | None:
        """Index of the pose where the arm stands; None between poses."""
        return self.stood_at if self.standing else None

    @property
    def moving(self) -> bool:
        """Whether the arm is on its way to a stop."""
        return self.under_way is not None and not self.standing

    @property
    def came_from(self) -> int | None:
        """Index of the pose to which the arm can return, where it was stopped on its way to another."""
        gone = {self.index(self.todo[0]), *self.skipped}
        return None if self.standing or self.stood_at in gone else self.stood_at

    @property
    def undriven(self) -> list[int]:
        """Poses, from 1, whose planned move to the next pose was replaced by an approach or left out."""
        return [index + 1 for index in range(self.poses) if index not in self.driven]

    def index(self, stop: int) -> int:
        """Index of the pose of a stop."""
        return (stop - 1) % self.poses

    def start_move(self) -> "Progress":
        """Leave the pose."""
        return replace(self, standing=False)

    def lose_place(self) -> "Progress":
        """Forget where the arm stood: something else has moved it."""
        return replace(self, standing=False, stood_at=None)

    def arrive(self, index: int, *, driven_from: int | None = None) -> "Progress":
        """Stand at a pose; `driven_from` is the index where its planned move began."""
        driven = self.driven if driven_from is None else self.driven | {driven_from}
        return replace(self, stood_at=index, standing=True, driven=driven)

    def finish(self) -> "Progress":
        """Take the first stop off the list."""
        return replace(self, todo=self.todo[1:])

    def redo(self, stop: int) -> "Progress":
        """Put a stop that was taken in front of the others."""
        return replace(self, again=False, todo=(stop, *self.todo), skipped=self.skipped - {self.index(stop)})

    def skip(self) -> tuple["Progress", Sequence[int]]:
        """Leave out the next pose, and the return to it; return the dropped stops too."""
        index = self.index(self.todo[0])
        dropped = [stop for stop in self.todo if self.index(stop) == index]
        left = tuple(stop for stop in self.todo if stop not in dropped)
        return replace(self, todo=left, skipped=self.skipped | {index}), dropped
