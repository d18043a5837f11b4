"""The constant tour."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.tour import wrist_tour

# Yu et al., Fig. 3: rows of the 24 matrices base -> flange as signed axes.
PAPER = """
+x+y+z +x-y-z +x-z+y +x+z-y -x+y-z -x-y+z -x+z+y -x-z-y +y+x-z -y+x+z +z+x+y -z+x-y
+y-x+z -y-x-z -z-x+y +z-x-y +y+z+x -y-z+x -z+y+x +z-y+x +y-z-x -y+z-x +z+y-x -z-y-x
"""


def paper_matrix(number: int) -> NDArray[np.float64]:
    text = PAPER.split()[number - 1]
    rows = [np.eye(3)["xyz".index(text[i + 1])] * (1 if text[i] == "+" else -1) for i in (0, 2, 4)]
    return np.array(rows)


def flange_orientation(q: NDArray[np.float64]) -> NDArray[np.float64]:
    R = np.eye(3)
    for angle, alpha in zip(q, (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0), strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        R = R @ np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0, sa, ca]])
    return R


@pytest.mark.parametrize("pan_deg", [45.0, 0.0, -133.0])
def test_visits_every_orientation_of_the_paper_turned_by_the_pan(pan_deg: float) -> None:
    q = np.radians([pan_deg, -100, 60, -50, 90, 45])
    tour = wrist_tour(q)
    assert sorted(pose.number for pose in tour) == list(range(1, 25))
    pan = np.radians(pan_deg - 45)
    Y = np.array([[np.cos(pan), -np.sin(pan), 0], [np.sin(pan), np.cos(pan), 0], [0, 0, 1]])
    for pose in tour:
        np.testing.assert_allclose(flange_orientation(pose.q_rad), Y @ paper_matrix(pose.number).T, atol=1e-12)
        np.testing.assert_array_equal(pose.q_rad[:3], q[:3])


def test_every_move_turns_90_degrees_and_the_way_back_too() -> None:
    tour = wrist_tour(np.radians([45, -100, 60, -50, 90, 45]))
    path = [pose.q_rad for pose in (*tour, tour[0])]
    largest = [np.degrees(np.abs(b - a).max()) for a, b in pairwise(path)]
    np.testing.assert_allclose(largest, 90)


@pytest.mark.parametrize(("q2", "q3", "q4"), [(-100, 60, -50), (-100, 60, 310), (-60, -120, 200), (-170, 160, -300)])
def test_wrist_1_starts_near_where_it_stands_and_stays_in_its_range(q2: float, q3: float, q4: float) -> None:
    tour = wrist_tour(np.radians([45, q2, q3, q4, 90, 45]))
    wrist_1 = np.degrees([pose.q_rad[3] for pose in tour])
    assert np.abs(wrist_1).max() <= 360 + 1e-9
    others = [wrist_1[0] + turn for turn in (-360, 360) if np.abs(wrist_1 + turn).max() <= 360]
    assert all(abs(wrist_1[0] - q4) <= abs(other - q4) for other in others)
