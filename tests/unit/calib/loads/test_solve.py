from dataclasses import replace

import numpy as np
import pytest

from ftcalib import NotObservable
from ftcalib.loads.check import check_hung_load
from ftcalib.loads.model import KnownLoad, LoadModel, LoadRun, Mistake
from ftcalib.loads.solve import LoadSolution, solve_loads
from ftcalib.sensor_matrix import SensorMatrix
from ftcalib.solver import solve
from tests.loaded_sensor import LEVER_M, PROTOCOLS, SIDE_M, TIP_M, TOOL, TOOL_COM_M, TOOL_KG, LoadedSensor, with_load

USUAL = SensorMatrix.usual(lever_m=LEVER_M)


def solved(sensor: LoadedSensor, runs: list[LoadRun]) -> LoadSolution:
    return solve_loads(runs, USUAL, tool_mass_kg=sensor.weighed_tool_kg())


@pytest.mark.slow
def test_contacts_are_decoded_within_their_sigma() -> None:
    sensor = LoadedSensor(7)
    runs = sensor.runs(PROTOCOLS["bar, gripped twice"])
    solution = solved(sensor, runs)
    assert solution.verdict == "good", solution.findings
    result = solve(runs[0].dataset)
    contact = solution.sensor.contact_response(result.parameters, result.shown_response)
    true, read = sensor.contacts(60)
    R = result.R_flange_sensor
    wanted = np.concatenate([half @ R for half in np.split(true, 2, axis=1)], axis=1)
    e = contact.decode(read) - wanted
    sigma = np.sqrt(np.diagonal(contact.covariance(contact.decode(read)), axis1=1, axis2=2))
    assert 0.3 < np.sqrt(np.mean((e / sigma) ** 2)) < 2.2
    assert np.linalg.norm(e[:, :3]) < 0.3 * np.linalg.norm((read - wanted)[:, :3])


def test_the_gradient_of_the_likelihood_is_right() -> None:
    sensor = LoadedSensor(2)
    runs = sensor.runs([replace(TOOL, poses=6), replace(PROTOCOLS["hung, tip"][1], poses=4)])
    start = np.eye(3), (1.3, np.array([0.0, 0, 0.06]))
    gravity = np.array([0, 0, -9.81])
    model = LoadModel(runs, USUAL, *start, p_flange_sensor_m=np.zeros(3), gravity_base_m_s2=gravity)
    model = model.with_mistake(Mistake("place", 1))
    linear, y = model.linear(), np.linspace(-0.4, 0.5, 8)
    steps = 1e-4 * np.eye(8)
    costs = [(model.evaluate(y + d, linear).cost - model.evaluate(y - d, linear).cost) / 2e-4 for d in steps]
    np.testing.assert_allclose(model.evaluate(y, linear).gradient, costs, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "row", "changed"),
    [
        ("load_in_pounds", 2, {"mass_kg": 4.409, "mass_sigma_kg": 0.004}),
        ("load_place", 1, {"p_flange_m": (0.1, 0.04, 0.05)}),
    ],
)
def test_a_wrong_declaration_is_named_first(code: str, row: int, changed: dict[str, object]) -> None:
    sensor = LoadedSensor(9)
    solution = solved(sensor, with_load(sensor.runs(PROTOCOLS["hung, side and tip"]), row, **changed))
    assert solution.findings[0].code == code
    assert solution.verdict == "rejected"


@pytest.mark.slow
def test_exchanged_places_are_named() -> None:
    sensor = LoadedSensor(10)
    few = [replace(one, poses=n) for one, n in zip(PROTOCOLS["hung, side and tip"], (10, 6, 6), strict=True)]
    runs = sensor.runs(few)
    runs = with_load(with_load(runs, 1, p_flange_m=tuple(TIP_M)), 2, p_flange_m=tuple(SIDE_M))
    assert [one.code for one in solved(sensor, runs).findings] == ["loads_swapped"]


@pytest.mark.slow
def test_a_touch_in_two_poses_is_named_with_the_poses() -> None:
    sensor = LoadedSensor(11)
    runs = sensor.runs(PROTOCOLS["hung, side and tip"])
    wrench = np.array(runs[1].dataset.wrench)
    wrench[[3, 8]] += [[1.0, -0.5, 0.8, 0.05, 0.08, 0.02], [-0.6, 1.0, 0.3, 0.06, -0.05, 0.03]]
    runs[1] = replace(runs[1], dataset=replace(runs[1].dataset, wrench=wrench))
    (finding,) = solved(sensor, runs).findings
    assert (finding.code, finding.values["poses"]) == ("load_touched", [4, 9])


def test_a_sensor_that_is_not_linear_is_refused() -> None:
    sensor = LoadedSensor(12, not_linear=1.5)
    codes = {one.code for one in solved(sensor, sensor.runs(PROTOCOLS["hung, side and tip"])).findings}
    assert "sensor_not_linear" in codes


def test_a_run_with_a_load_is_needed() -> None:
    with pytest.raises(NotObservable, match="--load"):
        solve_loads(LoadedSensor(1).runs([TOOL]))


@pytest.mark.parametrize("poses", [1, 4])
def test_one_weight_on_a_string_shows_the_scale_and_its_line(poses: int) -> None:
    sensor = LoadedSensor(13, gain=0.0)
    sensor.E = 0.03 * np.eye(6)
    tool, tip = sensor.runs([TOOL, replace(PROTOCOLS["hung, tip"][1], mass_kg=1.0, poses=poses)])
    result = solve(tool.dataset)
    assert tip.dataset.wrench_cov is not None
    # The bias of another run is that of the tool after a tare.
    wrench = tip.dataset.wrench - tip_bias(sensor, tip, result.parameters.bias)
    found = check_hung_load(
        result,
        result,
        KnownLoad("tip", 1.0, 0.001, tuple(TIP_M)),
        (tip.dataset.R_base_flange, wrench, tip.dataset.wrench_cov),
        drift=np.zeros(6),
        p_flange_sensor_m=np.zeros(3),
    )
    assert found.scale_sigma < 0.01
    assert abs(found.scale_error - 0.03) < 3 * found.scale_sigma
    assert found.is_significant
    assert found.off_m < 0.008
    assert found.off_vertical_rad < 0.02


def tip_bias(sensor: LoadedSensor, run: LoadRun, wanted: np.ndarray) -> np.ndarray:
    """Return by how much the bias of a run differs from that of the tool."""
    u = sensor.gravity @ run.dataset.R_base_flange
    s = TOOL_KG * TOOL_COM_M + TIP_M
    w = np.concatenate([(TOOL_KG + 1.0) * u, np.cross(s, u)], axis=1)
    return np.asarray((run.dataset.wrench - sensor.read(w)).mean(axis=0) - wanted)
