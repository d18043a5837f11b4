"""What the figures show: the numbers of the facts, at the place and in the unit that the axes name."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import matplotlib.figure
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ftcalib.model import Array
from ftdrive.report.figures import WIDTH_IN, draw_figure
from ftdrivers.sweep import Sweep

Draw = Callable[[str, Mapping[str, Any]], Any]


@pytest.fixture(scope="module")
def drawn() -> Iterator[Draw]:
    """Draw a figure by its name, and return what matplotlib has; all its text is inside."""
    figures, checked = list[Any](), set[str]()

    class Unsaved(matplotlib.figure.Figure):
        def savefig(self, fname: Any, **_: Any) -> None:
            if name not in checked:  # it takes longer than the rest
                checked.add(name)
                box = self.get_tightbbox(FigureCanvasAgg(self).get_renderer())  # type: ignore[no-untyped-call]
                assert min(box.x0, box.y0) >= 0
                assert box.x1 <= WIDTH_IN
                assert box.y1 <= self.get_figheight()
            fname.write('<svg viewBox="0 0 1 1"></svg>')
            figures.append(self)

    name = ""

    def figure(of: str, facts: Mapping[str, Any]) -> Any:
        nonlocal name
        name = of
        draw_figure(name, facts)
        return figures.pop()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftdrive.report.figures.Figure", Unsaved)
        yield figure


def pose(row: int, **more: Any) -> dict[str, Any]:
    residual = [row, -row, 0.1 * row, 0.001 * row, -0.002 * row, 0.003 * row]
    known = {"row": row, "name": f"R{100 + row}", "t_s": 10.0 * (9 - row), "residual": residual, "force_N": float(row)}
    return {**known, "sigmas": 0.5 * row, "used": row != 3} | more


POSES = [pose(row) for row in range(1, 9)]


def names_at(axes: Any) -> list[str]:
    return [label.get_text() for label in axes.get_xticklabels()]


def levels(axes: Any) -> list[float]:
    """Heights of the lines across the whole figure."""
    return [float(line.get_ydata()[0]) for line in axes.lines if len(line.get_xdata()) == 2]


@pytest.mark.parametrize(
    ("apart_s", "motion", "x", "words"),
    [
        (28.0, None, 28.0, "time since the first pose, s"),
        (30.0, None, 0.5, "time since the first pose, min"),
        (None, None, 1, "pose, in the order of the rows"),
        (None, {"sweep": None}, 1, "part of the motion, in the order of time"),
    ],
)
def test_residuals_follow_one_another_in_time(
    apart_s: float | None, motion: Any, x: float, words: str, drawn: Draw
) -> None:
    poses = [pose(row, t_s=apart_s and apart_s * (9 - row)) for row in range(1, 9)]
    both = drawn("time_residuals", {"poses": poses, "motion": motion}).axes
    rows = np.arange(1, 9) if apart_s is None else np.arange(8, 0, -1)
    assert both[1].get_xlabel() == words
    for axes, unit, label, of_row in zip(both, ("N", "mN·m"), ("F", "T"), ((1, -1, 0.1), (1, -2, 3)), strict=True):
        assert axes.get_ylabel() == unit
        assert levels(axes) == [0]
        for line, axis, factor in zip(axes.lines[1:], "xyz", of_row, strict=True):
            assert line.get_label() == label + axis
            np.testing.assert_allclose(line.get_xdata(), x * np.arange(1, 9))
            np.testing.assert_allclose(line.get_ydata(), factor * rows)


def test_noise_is_drawn_in_millinewton_with_its_median(drawn: Draw) -> None:
    noise = {"force_N": [0.001 * k for k in range(1, 9)], "torque_Nm": [0.0001 * k for k in range(1, 9)]}
    for axes, scale, unit in zip(
        drawn("noise", {"poses": POSES, "noise": noise}).axes, (1, 0.1), ("mN", "mN·m"), strict=True
    ):
        np.testing.assert_allclose([bar.get_height() for bar in axes.patches], scale * np.arange(1, 9))
        np.testing.assert_allclose(levels(axes), [4.5 * scale])
        assert axes.get_ylabel() == unit
    assert names_at(axes)[0] == "R101"


def test_the_sigma_of_a_contact_is_drawn_with_and_without_loads(drawn: Draw) -> None:
    facts = {"source": "loads", "force_N": [0, 50, 100], "sigma_N": [0.1, 0.2, 0.4], "without_loads_N": [0.1, 1, 2]}
    (axes,) = drawn("contact", {"contact": facts}).axes
    assert [line.get_ydata().tolist() for line in axes.lines] == [[0.1, 1, 2], [0.1, 0.2, 0.4]]
    (axes,) = drawn("contact", {"contact": facts | {"without_loads_N": None}}).axes
    assert [line.get_ydata().tolist() for line in axes.lines] == [[0.1, 0.2, 0.4]]
    assert axes.get_ylim()[0] == 0


def test_a_sweep_is_drawn_from_rest_to_rest(drawn: Draw) -> None:
    sweep = Sweep(
        [0, -1, 1, 0.1, 0.2, 0.3], [[1, 0.5], [0.8, 0.2], [0.3, 0.3]], [[1, 2], [1, 3], [2, 1]], [[0, 1]] * 3, 20.0, 3.0
    )
    (axes,) = drawn("sweep", {"motion": {"sweep": sweep.to_dict()}}).axes
    assert axes.get_xlim() == (0, 20)
    for line, joint in zip(axes.lines, (3, 4, 5), strict=True):
        t_s, q_deg = line.get_data()
        assert (t_s[0], t_s[-1]) == (0, 20)
        np.testing.assert_allclose(q_deg, np.degrees(sweep.at(t_s))[:, joint])
        assert line.get_label() == f"wrist {joint - 2}"


TOOL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])


def directions(x: Any, y: Any) -> Array:
    """Directions (n, 3) at places on a Hammer map, by the inverse formulae of Snyder 1987."""
    x, y = np.asarray(x), np.asarray(y)
    z = np.sqrt(np.clip(1 - (x / 4) ** 2 - (y / 2) ** 2, 0, None))
    azimuth, elevation = 2 * np.arctan2(z * x, 2 * (2 * z**2 - 1)), np.arcsin(np.clip(z * y, -1, 1))
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )


def dots_of(axes: Any) -> list[Array]:
    return [
        directions(*one.get_offsets().T) for one in axes.collections if len(one.get_offsets()) and one.get_zorder() == 3
    ]


@pytest.mark.parametrize(("name", "key", "words", "coverage"), [
    ("force_map", "force_N", "predicted force error, mN, 1 sigma", {"tool_in_base": TOOL}),
    ("torque_map", "torque_Nm", "predicted torque error, mN·m, 1 sigma", None),
])  # fmt: skip
def test_the_map_of_errors_is_highest_where_the_error_is(
    name: str, key: str, words: str, coverage: Any, drawn: Draw
) -> None:
    elevation, azimuth = np.meshgrid(np.arange(-90, 91, 10.0), np.arange(-180, 181, 10.0), indexing="ij")
    e, a = np.radians(elevation), np.radians(azimuth)
    worst = np.array([np.cos(0.5) * np.cos(1.0), np.cos(0.5) * np.sin(1.0), np.sin(0.5)])
    towards = np.cos(e) * np.cos(a) * worst[0] + np.cos(e) * np.sin(a) * worst[1] + np.sin(e) * worst[2]
    error = {"map": (0.01 + 0.02 * np.clip(towards, 0, 1)).tolist(), "worst_direction": worst.tolist()}
    grid = {"elevation_deg": elevation[:, 0], "azimuth_deg": azimuth[0]}
    axes, bar = drawn(name, {"error_map": {**grid, key: error}, "coverage": coverage}).axes
    dots = dots_of(axes)
    np.testing.assert_allclose(np.concatenate(dots), [*(TOOL if coverage else ()), worst], atol=1e-6)
    filled = next(one for one in axes.collections if hasattr(one, "levels"))
    assert filled.levels[0] == 0
    assert filled.levels[-2] < 30 <= filled.levels[-1]  # in thousandths
    highest = max((path for path in filled.get_paths() if len(path.vertices)), key=filled.get_paths().index)
    middle = directions(*highest.vertices.T).mean(axis=0)
    assert middle @ worst / np.linalg.norm(middle) > np.cos(0.2)
    assert bar.get_xlabel() == words
    assert bar.get_xticks().tolist() == filled.levels[::2].tolist()
