"""What the sections about a fit print of its facts."""

from ftdrive.report.fit_sections import drift


def test_a_drift_is_listed_in_newton_and_millinewton_metre() -> None:
    found = {"change": [0.4, -0.2, 0.0, 0.012, -0.003, 0.0], "sigma": [0.02] * 3 + [0.001] * 3}
    seen = {"in_fit": found, "first_pose_again": None, "lag1": None, "components": ["linear_force"], "in_use": None}
    (table,) = drift({"drift": seen}).tables
    assert [row[0] for row in table.rows][::3] == ["Fx, N", "Tx, mN·m"]
    assert [row[1] for row in table.rows][::3] == ["+0.400", "+12.0"]
    assert [row[3] for row in table.rows][:4] == ["+20.0", "-10.0", "+0.0", "+12.0"]
