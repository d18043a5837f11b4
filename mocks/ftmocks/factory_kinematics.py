"""Calibrated kinematics of one arm: drawn from a seed, or read from a file.

An arm is drawn as a chain of transforms with small deviations, and converted to the Denavit-Hartenberg parameters that
the controller reports. The axes of joints 2, 3 and 4 are nearly parallel, so their common normals are far away:
the offsets d of these joints may be hundreds of metres long, and cancel each other.

Source: Universal Robots ROS 2 driver, package ur_calibration (README and calibration_consumer), which describes the
reported parameters, the reason for large values of d, and the chain of its output.
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import MODELS, Dh, Vector6, inverse_matrix, rotation, vector6


class Chain(NamedTuple):
    """Six values per link: ``X_i = Tx(a_i) Ry(pitch_i) Rx(roll_i) Tz(d_i) Rz(q_i)``, base to flange; m and rad."""

    a: Vector6
    pitch: Vector6
    roll: Vector6
    d: Vector6


# RMS deviations of 20 real arms, UR3 to UR16e, whose owners have published the output of ur_calibration.
DEVIATIONS = Chain(
    a=(0.0, 1.2e-4, 3.5e-4, 3.2e-4, 6e-5, 1.0e-4),
    pitch=(0.0, 0.0, 1.5e-3, 1.7e-3, 0.0, 0.0),
    roll=(0.0, 7.6e-4, 2.0e-3, 5.8e-3, 9.8e-4, 9.8e-4),
    d=(2.8e-4, 0.0, 0.0, 6.3e-4, 1.0e-4, 6.4e-4),
)
LARGEST_SIGMA = 2.3
"""Largest deviation of the 20 arms in standard deviations. Larger draws are repeated."""


def drawn(model: str, seed: int) -> Dh:
    """Return the random kinematics of one arm of a model, with the deviations of real arms."""
    rng = np.random.default_rng([seed, 6])
    noise = rng.standard_normal((4, 6))
    while (beyond := np.abs(noise) > LARGEST_SIGMA).any():
        noise[beyond] = rng.standard_normal(int(beyond.sum()))
    dh = MODELS[model]
    nominal = Chain(
        a=(0.0, 0.0, dh.a[1], dh.a[2], 0.0, 0.0),
        pitch=(0.0,) * 6,
        roll=(0.0, *dh.alpha[:5]),
        d=dh.d,
    )
    return to_dh(model, link_frames(Chain(*map(vector6, nominal + np.array(DEVIATIONS) * noise))))


def link_frames(chain: Chain) -> list[Array]:
    """Return the frames (4, 4) of links in the base at zero joint angles, with z on the joint axis, the flange last."""
    frames, X = [], np.eye(4)
    for a, pitch, roll, d in zip(*chain, strict=True):
        link = np.eye(4)
        link[:3, :3] = rotation([0.0, pitch, 0.0]) @ rotation([roll, 0.0, 0.0])
        link[:3, 3] = link[:3, 2] * d
        link[0, 3] += a
        X = X @ link
        frames.append(X)
    return frames


def to_dh(model: str, frames: list[Array]) -> Dh:
    """Convert the frames of a chain to Denavit-Hartenberg parameters. No two successive axes may be parallel.

    Each step starts from the frame that results from the rounded parameters before it, so rounding errors do not
    grow with d.
    """
    rows, X = [], np.eye(4)
    for axis in (*frames[1:], None):
        if axis is None:  # the flange is on the last axis
            last = inverse_matrix(X) @ frames[5]
            rows.append((math.atan2(last[1, 0], last[0, 0]), 0.0, last[2, 3], 0.0))
            break
        (zx, zy, zz), (px, py, pz) = (inverse_matrix(X) @ axis)[:3, 2:].T.tolist()
        theta = math.atan(-zx / zy)  # angle of the common normal; of two, that nearest to zero
        c, s = math.cos(theta), math.sin(theta)
        alpha = math.atan2(zx * s - zy * c, zz)
        a, d = px * c + py * s, pz + zz * (py * c - px * s) / math.sin(alpha)
        rows.append((theta, a, d, alpha))
        X = X @ _dh_matrix(*rows[-1])
    theta6, a6, d6, alpha6 = (vector6(column) for column in zip(*rows, strict=True))
    return Dh(model, theta6, a6, d6, alpha6, MODELS[model].max_speed)


def _dh_matrix(theta: float, a: float, d: float, alpha: float) -> Array:
    X = np.eye(4)
    R_z = rotation([0.0, 0.0, theta])
    X[:3, :3] = R_z @ rotation([alpha, 0.0, 0.0])
    X[:3, 3] = R_z @ [a, 0.0, d]
    return X


def read(path: Path) -> Dh:
    """Read an arm from a JSON object: ``model``, and ``theta``, ``a``, ``d``, ``alpha`` with six numbers each.

    Raises
    ------
    ValueError
        The file cannot be read, or it does not contain such an object.
    """
    try:
        arm: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        model = arm["model"]
        theta, a, d, alpha = (vector6(arm[name]) for name in ("theta", "a", "d", "alpha"))
        return Dh(model, theta, a, d, alpha, MODELS[model].max_speed)
    except (OSError, ValueError, KeyError, TypeError) as error:
        wanted = "give a JSON object with model, theta, a, d and alpha"
        raise ValueError(f"cannot read kinematics from {path}: {error!r}; {wanted}") from None
