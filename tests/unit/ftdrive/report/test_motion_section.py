"""What the section about motion prints of its facts."""

import numpy as np

from ftdrive.report.sections import motion

MOMENTS = np.array([[2.0, 0.1, -0.2], [0.1, 2.4, 0.3], [-0.2, 0.3, 1.4]]) * 1e-3
SIGMA = {"inertia_kg_m2": np.arange(9).reshape(3, 3) * 1e-6, "delay_s": 1.2e-4, "height_m": 0.0006}
FOUND = {
    "inertia_kg_m2": MOMENTS,
    "sigma": SIGMA,
    "delay_s": 0.00321,
    "height_m": 0.0334,
    "used_share": 0.87,
    "contacts": [{"t_s": 12.34, "duration_s": 0.52, "force_N": 8.1, "torque_Nm": 0.42}],
    "sweep": {"duration_s": 19.6},
}


def test_what_only_motion_gives_is_listed() -> None:
    section = motion({"motion": FOUND})
    assert section.text[0].startswith("87 % of the recording was used.")
    assert section.text[1] == "Delay of the wrench after the pose: 3.21 ± 0.12 ms."
    assert "is 33.40 ± 0.60 mm above" in section.text[2]
    principal = ", ".join(f"{1e3 * one:.2f}" for one in np.linalg.eigvalsh(MOMENTS))
    assert f"centre of mass: {principal} g·m²" in section.text[3]
    inertia, contact = section.tables
    assert inertia.rows == [
        *(("xx", "2.000", "0.000"), ("yy", "2.400", "0.004"), ("zz", "1.400", "0.008")),
        *(("xy", "0.100", "0.001"), ("xz", "-0.200", "0.002"), ("yz", "0.300", "0.005")),
    ]
    assert contact.rows == [("12.3", "0.52", "8.1", "0.42")]
    assert "sweep of 20 s" in section.figures[0].alt


def test_no_contact_and_no_sweep_are_said_or_left_out() -> None:
    section = motion({"motion": {**FOUND, "contacts": [], "sweep": None}})
    assert section.text[-1] == "No contact was detected."
    assert (len(section.tables), section.figures) == (1, ())
