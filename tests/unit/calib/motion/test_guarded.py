"""A motion that a contact guard has watched: bursts of noise are no contact, a touch is."""

import numpy as np

from ftcalib.motion.solve import solve_motion
from tests.moving_load import Truth, means_of, record, sweep

SECONDS = 15.0


def test_bursts_of_noise_are_no_contact_and_a_touch_is() -> None:
    bursts = {(2.0 + 1.5 * k, 2.8 + 1.5 * k): np.array([0.4, -0.3, 0.2, 0.02, 0.01, 0.0]) * (-1) ** k for k in range(8)}
    touch = {(6.0, 6.5): np.array([0.0, 6.0, 0.0, 0.4, 0.0, 0.0])}
    wrench, poses = means_of(record(Truth(), sweep(SECONDS), SECONDS, 3, contacts={**bursts, **touch}))
    found = solve_motion(wrench, poses, guarded=True)
    assert found.motion is not None
    assert "mostly_contact" not in [one.code for one in found.findings]
    assert [round(one["t_s"]) for one in found.motion.contacts] == [6]
    assert found.motion.used_share > 0.7  # the filter of .9 s and the touch
    assert abs(found.mass_kg - Truth().mass_kg) < 0.01
