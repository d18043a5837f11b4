"""Fits from memory: the tests of the program solve the same readings again and again; those of the solver do not."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.judge.observability import second_minimum
from ftcalib.likelihood.fit import Fit, fit
from ftcalib.likelihood.rotation_minima import RotationMinimum
from ftcalib.model import Parameters

Array = NDArray[np.float64]

_fits: dict[tuple[object, ...], Fit] = {}
_second_minima: dict[bytes, tuple[float, RotationMinimum | None]] = {}


def fit_once(*arrays: Array | None, t_s: Array | None = None, **how: Any) -> Fit:
    """As `fit`, but the same readings are fitted once."""
    key = (*(None if array is None else array.tobytes() for array in (*arrays, t_s)), repr(how))
    if key not in _fits:
        _fits[key] = fit(*arrays, t_s=t_s, **how)  # type: ignore[arg-type]  # as they came
    return _fits[key]


def second_minimum_once(R_base_flange: Array, parameters: Parameters) -> tuple[float, RotationMinimum | None]:
    """As `second_minimum`: the tours of most tests have the same poses."""
    key = R_base_flange.tobytes() + b"".join(value.tobytes() for value in astuple(parameters))
    if key not in _second_minima:
        _second_minima[key] = second_minimum(R_base_flange, parameters)
    return _second_minima[key]


@contextmanager
def solved_once() -> Iterator[None]:
    """Solve from memory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftcalib.solver.fit", fit_once)
        patch.setattr("ftcalib.poses.information.second_minimum", second_minimum_once)
        yield
