import numpy as np
import pytest

from ftdrivers.ur.kinematics import MODELS, forward, model_named
from ftmocks import kinematics as emulator

# The constant tour: (number of the orientation, psi, q5, q6) in degrees, psi = q2 + q3 + q4.
TOUR = [
    (1, -90, 90, 45), (19, -180, 45, 90), (12, -180, -45, 90), (8, -180, -45, 0), (16, -180, -45, -90),
    (14, -90, -90, -135), (5, -90, -90, -45), (9, -90, -90, 45), (2, -90, -90, 135), (4, -180, -45, 180),
    (17, -180, 45, 180), (7, -180, 135, 180), (15, -180, 135, 90), (3, -180, 135, 0), (11, -180, 135, -90),
    (20, -180, 45, -90), (18, -180, 45, 0), (10, -90, 90, -45), (6, -90, 90, -135), (24, 0, 135, -90),
    (22, 0, 135, 0), (23, 0, 135, 90), (21, 0, 135, 180), (13, -90, 90, 135),
]  # fmt: skip


def tour_q_deg(psi: float, q5: float, q6: float, q2: float = -100, q3: float = 60) -> list[float]:
    return [45, q2, q3, psi - q2 - q3, q5, q6]


@pytest.mark.parametrize(
    ("model", "centre_m"),
    [("UR3e", (-0.01, -0.20, 0.56)), ("UR5e", (-0.09, -0.28, 0.87)), ("UR10e", (-0.14, -0.39, 1.19))],
)
def test_the_flange_circles_the_documented_centre(model: str, centre_m: tuple[float, float, float]) -> None:
    p = [forward(MODELS[model], np.radians(tour_q_deg(psi, q5, q6))).p_m for _, psi, q5, q6 in TOUR]
    assert np.abs(np.mean(p, axis=0) - centre_m).max() < 0.006  # the document rounds to 10 mm


def test_stretched_ur5e_by_hand() -> None:
    # All joints zero: the arm lies along -x, the wrist offset and the flange point to -y, wrist 2 hangs down.
    pose = forward(MODELS["UR5e"], [0.0] * 6)
    assert np.allclose(pose.p_m, [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], atol=1e-12)
    assert np.allclose(pose.R @ [0, 0, 1], [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(("long", "a2_a3_m"), [("UR8long", 1.6138), ("UR15", 1.1639), ("UR18", 0.8139)])
def test_stretched_arms_that_are_not_emulated(long: str, a2_a3_m: float) -> None:
    assert np.allclose(forward(MODELS[long], [0.0] * 6).p_m, [-a2_a3_m, -0.3258, 0.0825], atol=1e-12)


def test_every_model_agrees_with_the_emulator_written_apart() -> None:
    q = [0.3, -1.1, 0.7, -0.4, 1.2, 0.5]
    emulated = {**emulator.MODELS, "UR7e": emulator.MODELS["UR5e"], "UR12e": emulator.MODELS["UR10e"]}
    assert set(emulated) == set(MODELS) - {"UR8long", "UR15", "UR18"}
    for name, parameters in emulated.items():
        pose = forward(MODELS[name], q)
        assert np.allclose(np.column_stack([pose.R, pose.p_m]), emulator.forward(parameters, q)[:3], atol=1e-12), name


@pytest.mark.parametrize(
    ("reported", "major", "name"),
    [
        ("UR5", 5, "UR5e"),
        ("UR5", 3, "UR5"),
        ("ur5e", 5, "UR5e"),
        ("UR10 \n", 5, "UR10e"),
        ("UR30", 5, "UR30"),
        ("UR99", 5, None),
    ],
)
def test_model_names(reported: str, major: int, name: str | None) -> None:
    assert model_named(reported, major) == name
