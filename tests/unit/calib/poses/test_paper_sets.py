"""The sets of Yu's Fig. 6: their counts, where their tools point, and that they are always the same."""

import numpy as np
import pytest

from ftcalib.poses.selection import COUNTS, EVERY_SET, names_of, numbers_of, paper_set

CEILING = np.array([0.0, 0.0, 1.0])


def test_the_sets_are_those_of_the_figure_each_time() -> None:
    for name, count in COUNTS.items():
        R = paper_set(name)
        assert R.shape == (count, 3, 3)
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
        np.testing.assert_array_equal(R, paper_set(name))
    np.testing.assert_array_equal(paper_set("H"), paper_set("E")[:12])
    apart = {name: paper_set(name)[0].tobytes() for name in "ABCDEFG"}
    assert len(set(apart.values())) == 7


def test_spare_orientations_follow_the_set() -> None:
    for name in "BDEF":
        np.testing.assert_array_equal(paper_set(name, spare=30)[: COUNTS[name]], paper_set(name))
        assert len(paper_set(name, spare=30)) == COUNTS[name] + 30


@pytest.mark.parametrize("down", [-CEILING, CEILING, np.array([1.0, 0.0, 0.0])])
def test_e_and_f_are_on_opposite_sides_and_never_point_up(down: np.ndarray) -> None:
    axis = {name: paper_set(name, down_base=down)[:, :, 2] for name in "EFGH"}
    forwards = np.eye(3)[2 if down[0] else 0]
    for name, side in (("E", 1), ("F", -1), ("G", 1), ("H", 1)):
        middle = (down + side * forwards) / np.sqrt(2)
        assert (axis[name] @ middle).min() >= 0.5
        assert (axis[name] @ middle).min() < 0.7  # they fill their cone of 60 degrees


def test_numbers_are_those_of_the_paper_for_a_and_unique_for_all() -> None:
    assert numbers_of("A").tolist() == list(range(1, 25))
    every = np.concatenate([numbers_of(name) for name in EVERY_SET.split("+")])
    assert len(np.unique(every)) == len(every) == 294
    assert set(numbers_of("H")) < set(numbers_of("E"))


@pytest.mark.parametrize(
    ("sets", "words"), [("A+X", "no set 'X'"), ("", "no set ''"), ("A+A", "a set twice"), ("E+H", "half of E")]
)
def test_names_that_are_no_sets_are_refused(sets: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        names_of(sets)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(ValueError, match="no set Z"):
        paper_set("Z")
