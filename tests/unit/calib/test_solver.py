"""Solving: exact without noise, honest with it, invariant, and unwilling where the data do not suffice."""

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Finding, NotObservable, Parameters, Setup, solve
from ftcalib.compare import compare
from ftcalib.errors import BadDataset
from ftcalib.known import Known
from ftcalib.likelihood.fit import fit
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array, SPECIAL_R_flange_base, jacobian, predict
from ftcalib.published.methods import BASELINES, CARLSON, PUBLISHED, published
from ftcalib.published.yu import lrom
from ftcalib.result import Method
from ftdrive import read_dataset
from tests.known_cells import SIGMA, white
from tests.known_cells import UPSIDE_DOWN as TRUTH

METHODS: tuple[Method, ...] = ("ml", "srom", "lrom")
R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)


@pytest.fixture(autouse=True)
def few_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """The uncertainty of closed forms is simulated: a few runs are enough where it is not judged."""
    monkeypatch.setattr("ftcalib.solver.SIMULATIONS", 20)


def dataset(R_base_flange: Array, wrench: Array, cov: Array | None = None) -> CalibrationDataset:
    n = len(wrench)
    return CalibrationDataset(R_base_flange, wrench, cov, np.zeros(n, np.int64), np.full(n, np.nan))


def uneven(rng: np.random.Generator, n: int) -> Array:
    """Covariances with correlated channels, different in every pose."""
    A = rng.normal(size=(n, 6, 12))
    C = A @ np.swapaxes(A, 1, 2)
    d = np.sqrt(np.einsum("nii->ni", C))
    s = SIGMA * np.exp(0.4 * rng.normal(size=(n, 1)))
    return np.asarray(C / d[:, :, None] / d[:, None, :] * s[:, :, None] * s[:, None, :])


def noisy(rng: np.random.Generator, R_base_flange: Array, cov: Array) -> Array:
    L = np.linalg.cholesky(cov)
    return np.asarray(predict(TRUTH, R_base_flange) + (L @ rng.normal(size=(len(cov), 6, 1)))[..., 0])


# Yu 2021, Table I: angles of s_eR = Rz Ry Rx in degrees, F_b, P, F0, T0.
TABLE_I = [
    ((0, 7, 3), (0, 0, -10), (0, 0, 2), (0, 0, 0), (0, 0, 0)),
    ((0, 7, 3), (0, 0, 10), (0, 0, 2), (0, 0, 0), (87, 45, 6)),
    ((0, 7, 3), (0, 0, -10), (0, 0, 2), (63, 5, 21), (87, 45, 6)),
    ((0, 7, 3), (0, 0, -10), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
    ((45, 7, 3), (1, 3, -40), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
    ((70, 15, 13), (1, 3, -40), (0.1, 0.1, 1), (63, 5, 21), (87, 45, 6)),
]


@pytest.mark.parametrize(
    ("method", "measured", "setup"),
    [
        *(("ml", True, setup) for setup in TABLE_I),
        *((method, True, setup) for method in ("srom", "lrom") for setup in (TABLE_I[0], TABLE_I[-1])),
        *((method, False, TABLE_I[-1]) for method in METHODS),
    ],
)
def test_yu_table_1_is_exact_without_noise(method: Method, measured: bool, setup: tuple[Any, ...]) -> None:
    angles, F_b, P, F0, T0 = setup
    s_eR = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    truth = Parameters(s_eR.T, *(np.array(v, dtype=float) for v in (F_b, F0, P, T0)))
    result = solve(dataset(R24, predict(truth, R24), white(24) if measured else None), method)
    assert np.abs(truth.difference(result.parameters)).max() < 1e-12

    rng = np.random.default_rng(0)
    R = Rotation.random(200, rng=rng).as_matrix()
    push = rng.normal(size=(2, 200, 3))
    push /= np.linalg.norm(push, axis=2, keepdims=True)
    contact = np.concatenate([1.0 * push[0], 0.5 * push[1]], axis=1)
    error = result.compensate(predict(truth, R) + contact, R) - contact
    assert np.abs(error).max() < 2e-12  # 1.0e-12 with NumPy 2.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("orientations", "seed", "runs"),
    [
        ("24", 1, 40),
        pytest.param("7", 2, 80, marks=pytest.mark.slow),
    ],
)
def test_the_covariance_is_honest(orientations: str, seed: int, runs: int) -> None:
    rng = np.random.default_rng(seed)
    R = R24 if orientations == "24" else Rotation.random(7, rng=rng).as_matrix()
    cov = uneven(rng, len(R))
    distance, chi2, squared, stated = [], [], np.zeros(15), np.zeros(15)
    for _ in range(runs):
        result = fit(R, noisy(rng, R, cov), cov, gain_sigma=0.0)
        error = result.parameters.difference(TRUTH)
        distance.append(error @ np.linalg.solve(result.covariance, error))
        chi2.append(result.measured_chi2)
        squared += error**2 / runs
        stated += np.diag(result.covariance) / runs
    assert np.mean(distance) == pytest.approx(15, abs=2.5 * np.sqrt(30 / runs))
    assert np.mean(chi2) == pytest.approx(result.dof, abs=2.5 * np.sqrt(2 * result.dof / runs))
    assert stats.kstest(distance, "chi2", args=(15,)).pvalue > 1e-3
    assert stats.kstest(chi2, "chi2", args=(result.dof,)).pvalue > 1e-3
    # Efficient: the mean square error of every block is the Cramer-Rao bound at the truth.
    J = np.linalg.inv(np.linalg.cholesky(cov)) @ jacobian(TRUTH, R)
    bound = np.diag(np.linalg.inv(np.einsum("nki,nkj->ij", J, J))).reshape(5, 3).sum(axis=1)
    np.testing.assert_allclose(squared.reshape(5, 3).sum(axis=1) / bound, 1, atol=3 * np.sqrt(2 / 3 / runs))
    # One of 14 sets of seven poses seems to show more than the measured noise, which widens what is stated: over four
    # sets of orientations by 6 to 9 % in the mean, with a standard error of 4 % here.
    # And 2 % of all sets seem to drift, so that their biases are those of the last pose.
    widened = np.where(np.isin(range(5), [2, 4]), 0.15, 0.06 if orientations == "24" else 0.15)
    assert (np.abs(stated.reshape(5, 3).sum(axis=1) / bound - 1) < widened).all()


def test_a_closed_form_takes_its_residuals_as_the_noise_that_was_not_measured() -> None:
    wrench = noisy(np.random.default_rng(6), R24, white(24))
    result = solve(dataset(R24, wrench), "srom")
    assert result.chi2 == pytest.approx(result.dof)
    assert (result.dof, result.noise_source, result.drift) == (6 * 24 - 15, "residuals", None)


@pytest.mark.parametrize("method", METHODS)
def test_turning_base_or_sensor_or_shuffling_rows_turns_and_shuffles_the_answer(method: Method) -> None:
    rng = np.random.default_rng(5)
    wrench = noisy(rng, R24, white(24))
    result = solve(dataset(R24, wrench, white(24)), method)
    Y, S = Rotation.random(2, rng=rng).as_matrix()
    tolerance = 1e-9
    if method != "srom":  # which numbers its 24 orientations by the base axes
        base = solve(dataset(Y @ R24, wrench, white(24)), method)
        np.testing.assert_allclose(base.gravity_force_base_N, Y @ result.gravity_force_base_N, atol=tolerance)
        np.testing.assert_allclose(base.R_flange_sensor, result.R_flange_sensor, atol=tolerance)

    sensor = solve(dataset(R24, np.concatenate([wrench[:, :3] @ S, wrench[:, 3:] @ S], axis=1), white(24)), method)
    np.testing.assert_allclose(sensor.R_flange_sensor, result.R_flange_sensor @ S, atol=tolerance)
    np.testing.assert_allclose(sensor.gravity_force_base_N, result.gravity_force_base_N, atol=tolerance)
    np.testing.assert_allclose(sensor.p_sensor_com_m, S.T @ result.p_sensor_com_m, atol=tolerance)

    order = rng.permutation(24)
    shuffled = solve(dataset(R24[order], wrench[order], white(24)), method)
    assert np.abs(result.parameters.difference(shuffled.parameters)).max() < tolerance
    np.testing.assert_allclose(shuffled.residuals, result.residuals[order], atol=tolerance)


def spin(axis: str, tilt_deg: float, n: int = 8) -> Array:
    about = Rotation.from_euler(axis, np.arange(n)[:, None] * 360.0 / n, degrees=True)
    return np.asarray((Rotation.from_euler("y", tilt_deg, degrees=True) * about).as_matrix())


@pytest.mark.parametrize(
    ("R", "method", "words"),
    [
        (R24[:3], "ml", "3 poses are too few.* 4 .* add 1"),
        (R24[:4], "lrom", "4 poses are too few.* 5 .* add 1"),
        (np.tile(R24[:1], (9, 1, 1)), "ml", "9 poses have the same orientation"),
        (np.tile(R24[:3], (3, 1, 1)), "ml", "9 poses have only 3 different"),
        (spin("z", 150.0), "ml", "the last joint .* cannot be separated"),
        (spin("x", 0.0), "ml", "about the flange's x axis only: .* cannot be separated"),
        (R24[:23], "srom", "24 orientations .*: missing 24. Use LROM"),
    ],
)
def test_unobservable_parameters_are_named(R: Array, method: Method, words: str) -> None:
    wrench = noisy(np.random.default_rng(7), R, white(len(R)))
    with pytest.raises(NotObservable, match=words):
        solve(dataset(R, wrench, white(len(R))), method)


def test_a_sensor_that_feels_nothing_is_rejected() -> None:
    with pytest.raises(NotObservable, match="force is the same"):
        solve(dataset(R24, np.tile([1.0, 2, 3, 0, 0, 0], (24, 1))))
    with pytest.raises(NotObservable, match="force is the same"):
        solve(dataset(R24, 1e-160 * predict(TRUTH, R24)))


@pytest.mark.parametrize("n", [4, 8])
def test_exact_data_are_known_exactly(n: int) -> None:
    R = Rotation.random(n, rng=3).as_matrix()
    result = solve(dataset(R, predict(TRUTH, R)))
    assert result.predicted_error()[0] < 1e-9
    assert result.p_wrong < 1e-9
    assert result.verdict == ("good" if n >= 6 else "usable")


def test_known_mountings_are_methods() -> None:
    rng = np.random.default_rng(11)
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    for method, R_flange_sensor in (("known-rotation", np.eye(3)), ("yaw-only", turn)):
        p = Parameters(R_flange_sensor, *(getattr(TRUTH, f.name) for f in fields(Parameters)[1:]))
        data = dataset(R24[:6], predict(p, R24[:6]) + rng.normal(size=(6, 6)) * SIGMA, white(6))
        result = solve(data, method)  # type: ignore[arg-type]  # literals in a loop
        assert result.method == method
        error = p.difference(result.parameters)
        assert np.linalg.norm(error[:2]) < 1e-12
        assert (np.abs(error) < 4 * np.sqrt(np.diag(result.covariance)) + 1e-12).all()
        assert result.dof == 36 - (12 if method == "known-rotation" else 13)
        sigma = result.sigma["R_flange_sensor"]
        assert np.flatnonzero(np.asarray(sigma) > 1e-12).tolist() == ([] if method == "known-rotation" else [2])
        assert CalibrationResult.from_dict(result.to_dict()).to_dict() == result.to_dict()


R48 = np.concatenate([R24, Rotation.random(24, rng=1).as_matrix()])
LEVEL = replace(TRUTH, gravity_force_base_N=np.array([0.0, 0.0, -20.0]))
NO_BIAS = replace(LEVEL, force_bias_N=np.zeros(3), torque_bias_Nm=np.zeros(3))


def given(method: Method) -> Known | None:
    """What a method needs to know about `LEVEL`."""
    if method in BASELINES:
        return Known(R_flange_sensor=LEVEL.R_flange_sensor)
    return Known(mass_kg=20 / STANDARD_GRAVITY_M_S2) if method == "carlson-cayley" else None


@pytest.mark.parametrize(
    ("method", "as_published", "sigma_N"),
    [*((method, False, None) for method in PUBLISHED), (CARLSON[0], True, None), ("srom", False, 1e-5)],
)
def test_published_methods_are_good_without_noise(method: Method, as_published: bool, sigma_N: float | None) -> None:
    R, truth = R24 if method == "srom" else R48, NO_BIAS if as_published else LEVEL
    cov = None if sigma_N is None else white(len(R), sigma_N * SIGMA / SIGMA[0])
    wrench = predict(truth, R)
    if sigma_N is not None:  # residuals that are exactly 0 are tested without a covariance
        wrench += 1e-9 * np.random.default_rng(0).normal(size=wrench.shape)
    result = solve(dataset(R, wrench, cov), method, known=given(method), as_published=as_published)
    assert np.abs(truth.difference(result.parameters)).max() < (1e-9 if sigma_N is None else 1e-7)
    assert result.verdict == "good"
    document = result.to_dict()
    assert document["provenance"].get("as_published", False) is as_published
    assert CalibrationResult.from_dict(document).to_dict() == document


@pytest.mark.slow
def test_carlsons_printed_form_is_judged_by_the_bias_that_it_leaves_out() -> None:
    data = dataset(R48, noisy(np.random.default_rng(2), R48, white(48)), white(48))
    assert solve(data, "carlson-nullspace").verdict == "good"
    printed = solve(data, "carlson-nullspace", as_published=True)
    assert printed.verdict == "rejected"
    np.testing.assert_array_equal(printed.sigma["force_bias_N"], 0)
    for method, words in (("srom", "srom runs as published already"), ("ml", "ml is not a published method")):
        with pytest.raises(ValueError, match=words):
            solve(data, method, as_published=True)  # type: ignore[arg-type]  # literals in a loop


YAWED = Known(R_flange_sensor=Rotation.from_rotvec([0, 0, 0.1]).as_matrix() @ LEVEL.R_flange_sensor)
EXACT = Known(R_flange_sensor=LEVEL.R_flange_sensor)
LEANING = replace(LEVEL, gravity_force_base_N=Rotation.from_rotvec([0.05, 0, 0]).apply([0, 0, -20.0]))
UP = Setup(up_in_base=(-LEANING.gravity_force_base_N).tolist())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "known", "truth", "setup", "code"),
    [
        ("wang", YAWED, LEVEL, Setup(), "known_mounting"),
        ("yang", YAWED, LEVEL, Setup(), None),
        ("vougioukas", EXACT, LEANING, Setup(), "known_gravity_direction"),
        ("wang", EXACT, LEANING, Setup(), None),
        ("vougioukas", EXACT, LEANING, UP, None),
    ],
)
def test_a_wrong_assumption_of_a_baseline_is_named(
    method: Method, known: Known, truth: Parameters, setup: Setup, code: str | None
) -> None:
    wrench = predict(truth, R48) + np.random.default_rng(3).normal(size=(48, 6)) * SIGMA
    result = solve(dataset(R48, wrench, white(48)), method, known=known, setup=setup)
    assert (result.verdict == "good") == (code is None)
    assert code is None or code in {one.code for one in result.findings}
    assert np.abs(result.covariance[:2, :2]).max() < 1e-30


def test_baselines_take_the_mounting_and_nothing_else() -> None:
    data = dataset(R48, predict(LEVEL, R48))
    known = Known(R_flange_sensor=LEVEL.R_flange_sensor, mass_kg=2.0, gravity_direction_base=[0, 0, -1])
    with pytest.raises(ValueError, match="vougioukas cannot use a known mass: leave it out"):
        solve(data, "vougioukas", known=known)
    for method in ("wang", "yang"):
        with pytest.raises(ValueError, match=f"{method} cannot use a known mass or direction of gravity"):
            solve(data, method, known=known)


@pytest.mark.parametrize("method", BASELINES)
def test_baselines_solve_three_poses(method: Method) -> None:
    R = Rotation.random(3, rng=1).as_matrix()
    result = solve(dataset(R, predict(LEVEL, R)), method, known=given(method))
    assert np.abs(LEVEL.difference(result.parameters)).max() < 1e-9
    with pytest.raises(NotObservable, match="2 poses are too few, at least 3"):
        solve(dataset(R[:2], predict(LEVEL, R[:2])), method, known=given(method))


@pytest.mark.parametrize("method", ["srom", "mixed"])
def test_deviations_from_the_special_orientations_are_named_with_their_error(method: Method) -> None:
    rng = np.random.default_rng(4)
    for most_deg, expected in ((0.02, False), (0.3, True)):
        turns = rng.normal(size=(24, 3))
        turns *= np.deg2rad(most_deg) / np.linalg.norm(turns, axis=1, keepdims=True)
        R = Rotation.from_rotvec(turns).as_matrix() @ R24
        R = R if method == "srom" else np.concatenate([R, R48[24:]])
        result = solve(dataset(R, noisy(rng, R, white(len(R))), white(len(R))), method)
        notes = [one for one in result.findings if one.code == "orientations_deviate"]
        assert bool(notes) is expected
        for note in notes:
            assert note.severity == "note"
            assert note.values["off_deg"] == pytest.approx(0.3, abs=0.15)
            estimate = published(method, R, gravity_direction_base=-UP_IN_BASE)
            without_noise = estimate(predict(TRUTH, R)).gravity_force_base_N - TRUTH.gravity_force_base_N
            assert note.values["force_N"] == pytest.approx(np.linalg.norm(without_noise), rel=0.5)


@pytest.mark.slow
def test_the_sigma_of_srom_includes_the_deviation_of_its_orientations(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = 6
    monkeypatch.setattr("ftcalib.solver.SIMULATIONS", 50)
    rng, cov = np.random.default_rng(5), white(24, SIGMA / 20)  # so that the deviation matters
    squared = np.zeros(15)
    for _ in range(runs):
        R = Rotation.from_rotvec(np.deg2rad(0.3) * rng.normal(size=(24, 3)) / np.sqrt(3)).as_matrix() @ R24
        wrench = predict(LEVEL, R) + rng.normal(size=(24, 6)) * SIGMA / 20
        result = solve(dataset(R, wrench, cov), "srom", drift="none")
        squared += (result.parameters.difference(LEVEL) ** 2 / np.diag(result.covariance)) / runs
    rms = np.sqrt(squared.reshape(5, 3).mean(axis=1))
    assert (rms > 0.7).all()
    assert (rms < 1.3).all()


@pytest.mark.slow
def test_knowledge_makes_poor_poses_enough() -> None:
    R = spin("z", 150.0)
    wrench = noisy(np.random.default_rng(12), R, white(8))
    data = dataset(R, wrench, white(8))
    known = Known(
        gravity_direction_base=TRUTH.gravity_force_base_N,
        mass_kg=float(np.linalg.norm(TRUTH.gravity_force_base_N)) / 9.80665,
    )
    error = solve(data, known=known).parameters.difference(TRUTH)
    assert np.linalg.norm(error[:3]) < 0.05
    with pytest.raises(NotObservable, match="do not determine 1 of 12"):
        solve(data, known=Known(R_flange_sensor=TRUTH.R_flange_sensor))
    with pytest.raises(ValueError, match="lrom cannot use"):
        solve(data, "lrom", known=known)


def test_a_bumped_pose_is_named_by_its_row() -> None:
    wrench = noisy(np.random.default_rng(14), R24, white(24))
    wrench[6, :3] += [3.0, 0, 1]
    result = solve(dataset(R24, wrench, white(24)))
    assert result.rejected_poses == (7,)
    assert result.dof == 6 * 23 - 15
    assert result.noise_factor < 1.3
    assert result.to_dict()["rejected_poses"] == [7]


def test_unknown_methods_and_gravity_are_rejected() -> None:
    data = dataset(R24, predict(TRUTH, R24))
    with pytest.raises(ValueError, match="method is 'yu'"):
        solve(data, "yu")  # type: ignore[arg-type]  # the point of the test
    with pytest.raises(ValueError, match="g_m_s2 is 0"):
        solve(data, g_m_s2=0)


def verdict_of(wrench: Array, R: Array = R24, cov: Array | None = None) -> tuple[str, dict[str, Finding]]:
    result = solve(dataset(R, wrench, cov))
    return result.verdict, {one.code: one for one in result.findings}


def test_nothing_on_the_sensor_is_never_a_calibration() -> None:
    rng = np.random.default_rng(10)
    R = Rotation.random(12, rng=rng).as_matrix()
    verdict, found = verdict_of(rng.normal(size=(12, 6)) * SIGMA + [1, 2, 3, 0, 0, 0], R, white(12))
    assert verdict == "rejected"
    assert "weight_insignificant" in found


def test_what_is_known_to_be_down_depends_on_the_mounting(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = replace(TRUTH, gravity_force_base_N=np.array([0, 0, 20.0]))  # under a ceiling
    poses = dataset(R24[::3], predict(truth, R24[::3]), white(8))
    known, ceiling = Known(mass_kg=20 / STANDARD_GRAVITY_M_S2), Setup(up_in_base=(0, 0, -1))
    result = solve(poses, "carlson-cayley", known=known, setup=ceiling)
    assert np.abs(result.residuals).max() < 1e-6
    assert result.verdict == "good"
    with pytest.raises(BadDataset, match="point against the given gravity"):
        solve(poses, "carlson-cayley", known=known)
    monkeypatch.setattr("ftcalib.compare.get_args", lambda _: ["carlson-cayley"])
    (compared,) = compare(poses, known=known, setup=ceiling, default=result)
    assert compared.force_rms_N < 1e-6


def test_a_comparison_predicts_each_pose_from_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    R = Rotation.random(8, rng=rng).as_matrix()
    wrench = predict(TRUTH, R) + rng.normal(0, SIGMA, (8, 6))
    result = solve(dataset(R, wrench), "lrom")
    monkeypatch.setattr("ftcalib.compare.get_args", lambda _: ["lrom"])
    (compared,) = compare(dataset(R, wrench), default=result)
    fitted = wrench - predict(result.parameters, R)
    others = [lrom(np.delete(R, i, 0), np.delete(wrench, i, 0)) for i in range(8)]
    left_out = [wrench[i] - predict(others[i], R[i]) for i in range(8)]
    for residuals, force_N, torque_Nm in (
        (fitted, compared.force_rms_N, compared.torque_rms_Nm),
        (np.array(left_out), compared.cv_force_rms_N, compared.cv_torque_rms_Nm),
    ):
        assert force_N == pytest.approx(np.sqrt((residuals[:, :3] ** 2).sum() / 8))
        assert torque_Nm == pytest.approx(np.sqrt((residuals[:, 3:] ** 2).sum() / 8))


def codes(result: CalibrationResult) -> set[str]:
    return {one.code for one in result.findings}


def real(name: str) -> CalibrationDataset:
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    if not folder:
        pytest.skip("FTDRIVE_REAL_DATA is not set")
    return read_dataset(Path(folder) / name / "poses.csv", "R_flange_base")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ml", "lrom"])
def test_a_real_session_gives_the_published_answer(method: Method) -> None:
    result = solve(real("agimus_mini45_b"), method)
    assert result.mass_kg == pytest.approx(0.788, abs=0.004)
    # The authors give s_eR, flange to sensor: ours is its transpose.
    published_R_sensor_flange = np.array(
        [
            [-0.26004919774285107, 0.965594118602976, 0.0015533424096047077],
            [0.9654435503243104, 0.2599794490217805, 0.01815040560214672],
            [0.017122087795900184, 0.006219662826343693, -0.9998340611840727],
        ]
    )
    angle = Rotation.from_matrix(result.R_flange_sensor @ published_R_sensor_flange).magnitude()
    assert angle < np.deg2rad(0.7)
    summary = result.residual_summary()
    assert summary["force_rms_N"] < 0.25
    assert summary["torque_rms_Nm"] < (0.007 if method == "ml" else 0.009)
    np.testing.assert_allclose(result.force_bias_N, [0.121, -0.269, 7.788], atol=0.4)
    np.testing.assert_allclose(result.torque_bias_Nm, [0.048, -0.037, -0.003], atol=0.006)
    np.testing.assert_allclose(result.p_sensor_com_m, [0.004, 0.006, -0.050], atol=1.5e-3)
    assert result.verdict in ("good", "usable")
    assert not {"orientations_inverted", "axes_disagree", "weight_upwards"} & codes(result)
    assert ("force_error" in codes(result)) == (method == "lrom")


@pytest.mark.slow
def test_a_real_session_with_drift_is_not_called_good() -> None:
    result: CalibrationResult = solve(real("foamcutting_2013_06_12"))
    assert result.verdict == "rejected"
    assert "force_error" in codes(result)
    assert not {"orientations_inverted", "axes_disagree", "weight_upwards"} & codes(result)
    assert result.drift is not None
    assert result.components["walk_force_N"] > 0.1
    assert result.drift.change[2] > 3 * result.drift.sigma[2]  # z: 1.4 N in the session
    # Another identification of the same tool gives 0.470.
    assert abs(result.mass_kg - 0.470) < 2.5 * result.sigma["mass_kg"]


@pytest.mark.slow
def test_a_sensor_with_an_arbitrary_zero_may_have_any_bias() -> None:
    truth = Parameters(
        np.eye(3), np.array([0, 0, -9.0]), np.array([0, 0, 25_400.0]), np.array([0, 0, 0.1]), np.zeros(3)
    )
    R = Rotation.create_group("O").as_matrix()
    noise = np.random.default_rng(5).normal(0, [0.02] * 3 + [0.001] * 3, (24, 6))
    counts = CalibrationDataset.of(R, predict(truth, R) + noise)
    assert solve(counts).findings[0].code == "bias_implausible"
    facts = {"devices": {"sensor": {"facts": {"zero": {"value": "arbitrary"}}}}}
    for known in (
        solve(counts, setup=Setup(sensor_has_arbitrary_zero=True)),
        solve(CalibrationDataset.of(R, counts.wrench, meta=facts)),
    ):
        assert known.verdict == "good"


@pytest.mark.parametrize("measured", [False, True])
def test_a_three_axis_sensor_is_named(measured: bool) -> None:
    R = Rotation.random(12, rng=3).as_matrix()
    wrench = predict(TRUTH, R)
    wrench[:, 3:] = 0
    with pytest.raises(BadDataset, match="three-axis sensor"):
        solve(dataset(R, wrench, white(12) if measured else None))


def test_raw_counts_beside_standard_errors_in_newtons_are_named(recwarn: pytest.WarningsRecorder) -> None:
    R = Rotation.random(12, rng=3).as_matrix()
    counts = np.round(predict(TRUTH, R) * 1e6)
    with pytest.raises(BadDataset, match=r"looks like raw counts, up to .* with standard errors of"):
        solve(dataset(R, counts, white(12)))
    solve(dataset(R, np.round(predict(TRUTH, R) * 1e3), None))  # counts without standard errors are solved
    assert not recwarn.list


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lrom", "carlson-polynomial"])
def test_a_gain_is_named_and_no_second_solution(method: Method) -> None:
    """Sensors whose gains differ by 3 %: their minima lie 180° apart and far from each other."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        R = Rotation.random(24, rng=rng).as_matrix()
        wrench = predict(TRUTH, R)
        wrench[:, :3] = (wrench[:, :3] - TRUTH.force_bias_N) * rng.normal(1, 0.03, 3) + TRUTH.force_bias_N
        result = solve(dataset(R, wrench + rng.normal(size=(24, 6)) * SIGMA, white(24)), method)
        codes = [one.code for one in result.findings]
        assert "second_solution" not in codes
        assert result.verdict != "rejected", codes
