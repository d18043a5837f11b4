"""The walks of the page for contributors exist in the code."""

import pytest

from tests.house import walks


@pytest.mark.parametrize("title", walks.WALKS)
def test_each_step_of_a_walk_exists_and_is_called_by_one_above(title: str) -> None:
    assert len(walks.steps_of(walks.WALKS[title])) > 10


def test_a_step_that_is_gone_is_named() -> None:
    gone = "ftcalib.solver  solve  x\nftcalib.solver  solved  x"
    with pytest.raises(LookupError, match=r"ftcalib\.solver has no solved"):
        walks.steps_of(gone)


def test_a_step_that_is_not_called_is_named() -> None:
    backwards = "ftcalib.likelihood.fit  fit  x\nftcalib.solver  solve  x"
    with pytest.raises(LookupError, match=r"ftcalib\.solver\.solve: no row above calls it"):
        walks.steps_of(backwards)


def test_the_page_is_that_of_the_code() -> None:
    old = [path.name for path, text in walks.files().items() if path.read_text(encoding="utf-8") != text]
    assert old == [], "run `uv run python tests/house/walks.py`"
