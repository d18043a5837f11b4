"""The state of a tour."""

from ftdrive.session.progress import Progress


def begun() -> Progress:
    return Progress(6, todo=[1, 2, 3, 4, 5, 6, 7])


def test_the_arm_stands_until_it_leaves_and_may_return_to_where_it_came_from() -> None:
    now = begun()
    now.arrive(0)
    del now.todo[0]
    now.under_way = 2
    assert (now.at, now.moving, now.came_from) == (0, False, None)
    now.standing = False
    assert (now.at, now.moving, now.came_from) == (None, True, 0)
    now.skip()
    assert now.came_from == 0
    now.skipped.add(0)
    assert now.came_from is None
    now.skipped.clear()
    now.lose_place()
    assert now.came_from is None


def test_a_skipped_first_pose_takes_its_return_along_and_a_redo_brings_it_back() -> None:
    now = begun()
    assert (now.skip(), now.todo, now.skipped) == ([1, 7], [2, 3, 4, 5, 6], {0})
    now.redo(1)
    assert (now.todo[0], now.skipped) == (1, set())


def test_a_move_counts_as_driven_only_along_the_plan() -> None:
    now = begun()
    now.arrive(3)
    now.arrive(4, driven_from=3)
    assert now.undriven == [1, 2, 3, 5, 6]
