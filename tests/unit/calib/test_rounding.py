"""A sigma has two significant digits, and its value ends at the same place."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftcalib.findings import Finding
from ftcalib.judge.described_cell import Lean
from ftcalib.rounding import to_place_of, with_sigma


@given(st.floats(-1e4, 1e4), st.floats(1e-6, 50))
def test_a_sigma_has_two_digits_and_its_value_as_many_decimals(value: float, sigma: float) -> None:
    shown, spread = with_sigma(value, sigma).split(" ± ")
    assert len(spread.replace(".", "").lstrip("0")) == 2
    assert [len(one.partition(".")[2]) for one in (shown, spread)] == [len(spread.partition(".")[2])] * 2
    assert float(spread) == pytest.approx(sigma, rel=0.051)


@pytest.mark.parametrize(
    ("value", "sigma", "words"),
    [
        (1.18652, 0.00108, "1.1865 ± 0.0011"),
        (0.5, 0.0996, "0.50 ± 0.10"),
        (46.9, 40.2, "47 ± 40"),
        (12345.6, 123.4, "12346 ± 123"),
        (1.0, 0.0, "1.0000 ± 0.0000"),  # fixed
        (1.0, np.inf, "1.0000 ± inf"),
    ],
)
def test_a_value_with_its_sigma(value: float, sigma: float, words: str) -> None:
    assert with_sigma(value, sigma) == words
    assert to_place_of(value, sigma, "+") == f"+{words.partition(' ')[0]}"


def test_no_finding_rounds_a_sigma_to_zero() -> None:
    lean = {"lean_deg": 1.9123, "sigma_deg": 0.00413, "side": "-y"}
    assert "the base leans 1.9123° (sigma 0.0041°) towards its -y from" in Finding.of("base_leans", **lean).words
    assert str(Lean(1.9123, 0.00413, "-y")) == "leans 1.9123° (sigma 0.0041°) towards its -y"
    mass = Finding.of("known_mass", "note", known_kg=1.0, mass_kg=1.18652, sigma_kg=0.00108, units=[])
    assert re.search(r"^the data give a mass of 1.1865 kg \(sigma 0.0011 kg\)", mass.words)
