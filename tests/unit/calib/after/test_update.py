"""Another payload and a new tare on an old calibration: exact without noise, honest with it, refused when needed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadDataset, CalibrationDataset, CalibrationResult, NotObservable, Parameters, SensorMatrix, solve
from ftcalib.after.state import BLOCKS, Update, apply_update, reestimate, tare
from ftcalib.model import Array, jacobian, predict
from tests.first_order import assert_same, propagated

NOISE = np.diag(np.repeat([0.05**2, (0.025 * 0.05) ** 2], 3))


def truth(weight_N: float = 20.0, seed: int = 0) -> Parameters:
    rng = np.random.default_rng(seed)
    gravity = weight_N * Rotation.from_euler("xy", [2, -1], degrees=True).apply([0, 0, -1])
    R = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    return Parameters(R, gravity, rng.normal(size=3) * 5, np.array([0.02, -0.01, 0.077]), rng.normal(size=3))


def calibration(parameters: Parameters, n: int = 24, seed: int = 1) -> Update:
    """A calibration from n poses with the noise above: the truth, moved by an error of its covariance."""
    rng = np.random.default_rng(seed)
    J = jacobian(parameters, Rotation.random(n, rng=rng).as_matrix())
    covariance = np.linalg.inv(np.einsum("nki,kl,nlj->ij", J, np.linalg.inv(NOISE), J))
    return Update(parameters.moved(rng.multivariate_normal(np.zeros(15), covariance)), covariance, 0.0, 0)


def exact(parameters: Parameters) -> Update:
    return Update(parameters, np.zeros((15, 15)), 0.0, 0)


def tilted(*degrees: float) -> Array:
    return np.array([Rotation.from_euler("x", 180 + d, degrees=True).as_matrix() for d in degrees])


def loaded(parameters: Parameters) -> Parameters:
    """The same sensor with 40 % more payload somewhere else."""
    return Parameters(
        parameters.R_flange_sensor,
        1.4 * parameters.gravity_force_base_N,
        parameters.force_bias_N,
        np.array([0.03, 0.04, 0.06]),
        parameters.torque_bias_Nm,
    )


def noise_of(n: int) -> Array:
    return np.tile(NOISE, (n, 1, 1))


def joint(n: int) -> Array:
    """Covariance of n poses together."""
    return np.asarray(np.kron(np.eye(n), NOISE))


def dwell(parameters: Parameters, R_base_flange: Array, rng: np.random.Generator, n: int = 200) -> Array:
    noise = rng.multivariate_normal(np.zeros(6), NOISE, size=n)
    return np.asarray(predict(parameters, R_base_flange) + noise)


def test_no_payload_and_a_reversed_sign_are_rejected() -> None:
    R, old = tilted(0, 60), truth()
    bare = Parameters(old.R_flange_sensor, np.zeros(3), old.force_bias_N, np.zeros(3), old.torque_bias_Nm)
    with pytest.raises(NotObservable, match="uncertainty"):
        reestimate(exact(old), R, predict(bare, R), joint(2), "payload")
    with pytest.raises(NotObservable, match="check the sign"):
        reestimate(exact(old), R, 2 * predict(bare, R) - predict(old, R), joint(2), "payload")
    with pytest.raises(NotObservable, match="direction of gravity is unknown"):
        reestimate(exact(bare), R, predict(old, R), joint(2), "payload")


def test_a_solved_calibration_can_be_updated() -> None:
    rng = np.random.default_rng(11)
    R = Rotation.random(12, rng=rng).as_matrix()
    wrench = predict(truth(), R) + rng.multivariate_normal(np.zeros(6), NOISE, size=12)
    result = solve(CalibrationDataset(R, wrench, noise_of(12), np.zeros(12, np.int64), np.full(12, np.nan)))
    new = loaded(truth())
    update = reestimate(result, tilted(0, 60), predict(new, tilted(0, 60)), joint(2), "payload")
    error = new.difference(update.parameters)
    assert error @ np.linalg.solve(update.covariance, error) < 40
    assert tare(result, R[:1], [dwell(truth(), R[0], rng)]).covariance.shape == (15, 15)


@pytest.mark.slow
def test_the_covariance_of_a_tare_covers_noise_and_the_old_errors() -> None:
    rng = np.random.default_rng(5)
    R = tilted(20, 70)
    for n in (1, 2):
        distances = []
        for seed in range(30):
            update = tare(calibration(truth(), seed=seed), R[:n], [dwell(truth(), R[i], rng, 40) for i in range(n)])
            error = truth().difference(update.parameters)
            distances.append(error @ np.linalg.solve(update.covariance, error))
        assert np.mean(distances) == pytest.approx(15, rel=0.2)  # covariances of 40 samples are themselves uncertain


@pytest.mark.parametrize("push", [[0, 0, 8, 0, 0, 0], [0, 0, 0, 0, 0.2, 0]])
def test_a_tare_under_load_is_rejected(push: list[float]) -> None:
    R = tilted(30)
    reading = dwell(truth(), R[0], np.random.default_rng(7)) + push
    with pytest.raises(BadDataset, match="more than drift explains"):
        tare(exact(truth()), R, [reading])


def test_a_tare_while_the_reading_moves_is_rejected() -> None:
    R = tilted(30, 60)
    still, moving = (dwell(truth(), R[i], np.random.default_rng(8 + i)) for i in range(2))
    moving[:, 0] += np.linspace(0, 0.2, len(moving))
    with pytest.raises(BadDataset, match="pose 2: the reading changes"):
        tare(exact(truth()), R, [still, moving])


def test_a_tare_with_another_payload_is_rejected_though_every_pose_could_be_drift() -> None:
    heavier = truth().moved(np.concatenate([np.zeros(3), 0.05 * truth().gravity_force_base_N, np.zeros(9)]))
    R = tilted(0, 90)
    with pytest.raises(BadDataset, match="do not agree"):
        tare(exact(truth()), R, [dwell(heavier, R[i], np.random.default_rng(10 + i)) for i in range(2)])


@pytest.mark.parametrize("kind", BLOCKS)
def test_every_kind_of_update_is_exact_without_noise(kind: str) -> None:
    old, rng = truth(), np.random.default_rng(14)
    R = Rotation.random(6, rng=rng).as_matrix()
    turned = Rotation.from_euler("xyz", [5, -8, 12], degrees=True)
    heavier = 1.3 if "weight" in BLOCKS[kind] else 1.0
    gravity = heavier * old.gravity_force_base_N
    now = Parameters(
        turned.as_matrix() @ old.R_flange_sensor if "mounting" in BLOCKS[kind] else old.R_flange_sensor,
        turned.apply(gravity) if "gravity direction" in BLOCKS[kind] else gravity,
        old.force_bias_N + 3.0 * ("bias" in BLOCKS[kind]),
        old.p_sensor_com_m + 0.02 * ("centre of mass" in BLOCKS[kind]),
        old.torque_bias_Nm - 0.1 * ("bias" in BLOCKS[kind]),
    )
    update = reestimate(exact(old), R, predict(now, R), joint(6), kind)
    np.testing.assert_allclose(now.difference(update.parameters), 0, atol=1e-9)
    assert update.chi2 < 1e-12


@pytest.mark.parametrize("kind", BLOCKS)
def test_the_covariance_is_that_of_first_order(kind: str) -> None:
    """Of readings and of the old calibration, whose errors are kept where nothing is estimated."""
    n = 4 if kind == "all" else 3
    R, start = Rotation.random(n, rng=np.random.default_rng(21)).as_matrix(), calibration(truth(), 6)
    C, now = start.covariance, start.parameters
    if "weight" in BLOCKS[kind]:
        now = replace(now, gravity_force_base_N=1.4 * now.gravity_force_base_N)
    if "centre of mass" in BLOCKS[kind]:
        now = replace(now, p_sensor_com_m=np.array([0.03, 0.04, 0.06]))
    y = predict(now, R)

    def updated_by(e: Array, shift: Array) -> Array:
        moved = Update(start.parameters.moved(e), C, 0.0, 0)
        new = reestimate(moved, R, y + shift.reshape(n, 6), joint(n), kind)
        return np.asarray(start.parameters.difference(new.parameters))

    found = reestimate(start, R, y, joint(n), kind)
    expected = propagated(lambda e: updated_by(e, np.zeros(6 * n)), C)
    expected += propagated(lambda e: updated_by(np.zeros(15), e), joint(n))
    assert_same(found.covariance, expected, 1e-3)


def test_poses_that_do_not_determine_the_parameters_are_rejected() -> None:
    R = tilted(0, 60)
    with pytest.raises(NotObservable, match="2 poses do not determine all: add poses"):
        reestimate(calibration(truth()), R, predict(truth(), R), joint(2), "all")
    R = tilted(0, 0)
    with pytest.raises(NotObservable, match="do not determine mounting"):
        reestimate(calibration(truth()), R, predict(truth(), R), joint(2), "mounting")


def test_an_update_makes_a_calibration_that_names_its_parent_and_survives_a_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(16)
    R = Rotation.random(12, rng=rng).as_matrix()
    wrench = predict(truth(), R) + rng.multivariate_normal(np.zeros(6), NOISE, size=12)
    parent = solve(CalibrationDataset(R, wrench, noise_of(12), np.zeros(12, np.int64), np.full(12, np.nan)))
    new = loaded(truth())
    readings = predict(new, tilted(0, 60)) + rng.multivariate_normal(np.zeros(6), NOISE, size=2)
    update = reestimate(parent, tilted(0, 60), readings, joint(2), "payload")
    child = apply_update(parent, update, {"parent": {"path": "old.json"}, "command": "verify"})
    assert child.provenance["parent"] == {"path": "old.json", "id": parent.id}
    assert (child.provenance["update"], child.provenance["command"]) == ("payload", "verify")
    assert child.id != parent.id
    assert child.findings[-1].values == {"kind": "payload", "n_poses": 2, "parent": parent.id}
    np.testing.assert_allclose(child.residuals, readings - predict(update.parameters, tilted(0, 60)), atol=1e-12)
    assert (child.chi2, child.dof, child.n_poses) == (update.chi2, 8, 2)
    child.save(tmp_path / "child.json")
    again = CalibrationResult.load(tmp_path / "child.json")
    assert again.id == child.id
    one = tare(parent, R[:1], [dwell(truth(), R[0], rng)])
    with pytest.raises(NotObservable, match="use 2 poses or more"):
        apply_update(parent, one)


def test_an_update_keeps_what_is_known_of_the_sensor_and_the_weighed_mass_of_the_same_tool() -> None:
    sensor, R = SensorMatrix.usual(0.005, source="data sheet"), Rotation.random(12, rng=1).as_matrix()
    solved = solve(CalibrationDataset.of(R, predict(truth(), R), wrench_cov=NOISE))
    parent = replace(solved, sensor=sensor, weighed_kg=(2.0, 0.001))
    for kind, weighed_kg in (("bias", (2.0, 0.001)), ("mounting", (2.0, 0.001)), ("payload", None), ("all", None)):
        child = apply_update(parent, reestimate(parent, R, predict(truth(), R), joint(12), kind))
        assert (child.sensor, child.weighed_kg) == (sensor, weighed_kg)
        assert child.contact.sigma_at(np.zeros(3))[0] < replace(child, sensor=None).contact.sigma_at(np.zeros(3))[0]


def test_shapes_that_do_not_fit_are_rejected() -> None:
    R = tilted(0, 60)
    with pytest.raises(BadDataset, match=r"R_base_flange .*\(1, 3, 3\).*\(2, 3, 3\)"):
        reestimate(exact(truth()), tilted(0), predict(truth(), R), joint(2), "payload")
    with pytest.raises(BadDataset, match="R_base_flange"):
        tare(exact(truth()), R, [dwell(truth(), R[0], np.random.default_rng(0))])
    with pytest.raises(BadDataset, match="no dwell was given"):
        tare(exact(truth()), R, [])
