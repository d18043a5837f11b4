"""The state of a tour: which poses are left, where the arm is, what the operator asked for."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Progress:
    """State of a tour between two steps.

    A stop counts from 1 to `poses + 1`, the return to the first pose. An index counts the poses of the plan from 0.
    """

    poses: int
    todo: list[int] = field(default_factory=list)
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
    skipped: set[int] = field(default_factory=set)
    """Indices of postures that the arm should avoid."""
    reopened: set[int] = field(default_factory=set)
    """Stops at which the sensor was reopened."""
    driven: set[int] = field(default_factory=set)
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

    def lose_place(self) -> None:
        """Forget where the arm stood: something else has moved it."""
        self.standing, self.stood_at = False, None

    def arrive(self, index: int, *, driven_from: int | None = None) -> None:
        """Stand at a pose; `driven_from` is the index where its planned move began."""
        self.stood_at, self.standing = index, True
        if driven_from is not None:
            self.driven.add(driven_from)

    def redo(self, stop: int) -> None:
        """Put a stop that was taken in front of the others."""
        self.todo.insert(0, stop)
        self.skipped.discard(self.index(stop))

    def skip(self) -> list[int]:
        """Leave out the next pose, and the return to it; return the dropped stops."""
        index = self.index(self.todo[0])
        dropped = [stop for stop in self.todo if self.index(stop) == index]
        self.todo = [stop for stop in self.todo if stop not in dropped]
        self.skipped.add(index)
        return dropped
