"""The errors of the drivers: their parts, which survive copies and conversions."""

import copy
import pickle
from collections.abc import Callable

import pytest

from ftdrivers import errors
from ftdrivers.errors import DeviceError, DeviceTimeout

KINDS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, DeviceError)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fix", ["check supply; try again", ""])
@pytest.mark.parametrize("via", [copy.copy, copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))])
def test_an_error_keeps_its_parts(kind: type[DeviceError], fix: str, via: Callable[[DeviceError], DeviceError]) -> None:
    error = via(kind("silent for 0.4 s (a; b)", fix))
    assert type(error) is kind
    assert (error.found, error.fix) == ("silent for 0.4 s (a; b)", fix)
    assert str(error) == ("silent for 0.4 s (a; b); check supply; try again" if fix else "silent for 0.4 s (a; b)")


def test_a_silent_device_is_not_taken_for_an_error_of_a_file() -> None:
    assert not isinstance(DeviceTimeout("silent", "check supply"), OSError)
