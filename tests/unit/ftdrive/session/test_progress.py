"""The state of a tour as a value."""

from dataclasses import replace

from ftdrive.session.progress import Progress

BEGUN = Progress(6, todo=(1, 2, 3, 4, 5, 6, 7))


def test_the_arm_stands_until_it_leaves_and_may_return_to_where_it_came_from() -> None:
    standing = replace(BEGUN.arrive(0).finish(), under_way=2)
    assert (standing.at, standing.moving, standing.came_from) == (0, False, None)
    moving = standing.start_move()
    assert (moving.at, moving.moving, moving.came_from) == (None, True, 0)
    assert moving.lose_place().came_from is None
    assert moving.skip()[0].came_from == 0
    assert replace(moving, skipped=frozenset({0})).came_from is None


def test_a_skipped_first_pose_takes_its_return_along_and_a_redo_brings_it_back() -> None:
    left, dropped = BEGUN.skip()
    assert (left.todo, list(dropped), left.skipped) == ((2, 3, 4, 5, 6), [1, 7], frozenset({0}))
    again = replace(left, again=True).redo(1)
    assert (again.todo[0], again.skipped, again.again) == (1, frozenset(), False)


def test_a_move_counts_as_driven_only_along_the_plan() -> None:
    assert BEGUN.arrive(3).arrive(4, driven_from=3).undriven == [1, 2, 3, 5, 6]
