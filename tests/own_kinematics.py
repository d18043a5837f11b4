"""Kinematics of arms that differ from their nominal model: drawn ones, and those of real arms."""

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.ur.kinematics import MODELS, Kinematics
from tests.real_arms import RealArm, real_arms


def drawn(model: str, seed: int = 0) -> Kinematics:
    """Kinematics of an arm whose axes are off by about 0.1 to 0.3 degrees and 0.2 mm, as those of real arms."""
    rng, nominal = np.random.default_rng(seed), MODELS[model]
    links = np.tile(np.eye(4), (6, 1, 1))
    for joint in range(1, 6):
        a_m, d_m, alpha = nominal.a_m[joint - 1], nominal.d_m[joint - 1], nominal.alpha_rad[joint - 1]
        # The next joint begins where this link ends; its turn comes first, so that of the last link is the flange's.
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.003, 3)) * Rotation.from_rotvec([alpha, 0.0, 0.0])
        links[joint, :3, :3] = turn.as_matrix()
        links[joint, :3, 3] = np.array([a_m, 0.0, d_m]) + rng.normal(0.0, 2e-4, 3)
    arm = RealArm("drawn", model, links)
    dh = arm.dh()
    dh["d"][5] = nominal.d_m[5] + rng.normal(0.0, 2e-4)
    return of_dh(dh)


def of_dh(dh: dict[str, list[float]]) -> Kinematics:
    """Kinematics of the parameters that a controller reports."""
    return Kinematics.of([*dh["theta"], *dh["a"], *dh["d"], *dh["alpha"]])


def real() -> dict[str, tuple[str, Kinematics]]:
    """Model and kinematics of real arms, by their number; none without the real data."""
    return {arm.number: (arm.model, of_dh(arm.dh())) for arm in real_arms()}
