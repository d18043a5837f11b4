"""Which registers a client of the program may own; tests/wire has the rest."""

import pytest

from ftdrivers.ur.rtde import ProgramRegisters


@pytest.mark.parametrize(("first", "doubles"), [(23, 15), (34, 15), (27, 22)])
def test_registers_of_others_are_refused_before_a_connection(first: int, doubles: int) -> None:
    with pytest.raises(ValueError, match="not within 24 to 47"):
        ProgramRegisters("256.0.0.1", first, 6, doubles, timeout_s=0.1)
