"""The published methods by name, all of one shape: the wrenches of the poses in, the parameters out."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from ftcalib.errors import NotObservable
from ftcalib.model import Array, Parameters
from ftcalib.published import carlson, carlson_known
from ftcalib.published.carlson import ForceFit
from ftcalib.published.yu import com_and_torque_bias, lrom, special_numbers, srom

Estimator = Callable[[Array], Parameters]
"""Takes the mean wrenches (n, 6) of fixed poses, returns the parameters."""

_GRAVITY_UNKNOWN: Mapping[str, Callable[..., ForceFit]] = {
    "carlson-eigen": carlson.eigen,
    "carlson-nullspace": carlson.nullspace,
    "carlson-iterative": carlson.iterative,
    "carlson-polynomial": carlson.polynomial,
}

PUBLISHED = ("srom", "lrom", "carlson-relaxation", "carlson-cayley", *_GRAVITY_UNKNOWN)


def published(
    method: str, R_base_flange: Array, *, gravity_direction_base: Array, weight_N: float | None = None
) -> Estimator:
    """Prepare a published method for a set of poses.

    Yu's methods are complete. Carlson's know forces only: they run in their form with bias, and centre of mass and
    torque bias follow by Yu's torque step (eqs 43-45).

    Parameters
    ----------
    method : str
        One of `PUBLISHED`.
    R_base_flange : array, shape (n, 3, 3)
    gravity_direction_base : array, shape (3,)
        For carlson-relaxation and carlson-cayley.
    weight_N : float, optional
        For carlson-cayley.

    Raises
    ------
    NotObservable
        The method needs other poses, or a weight.
    """
    if method == "srom":
        return partial(srom, R_base_flange, numbered=special_numbers(R_base_flange))
    if method == "lrom":
        return partial(lrom, R_base_flange)
    if method == "carlson-relaxation":
        return _with_torques(
            partial(carlson_known.relaxation, gravity_direction_base=gravity_direction_base), R_base_flange
        )
    if method == "carlson-cayley":
        if weight_N is None:
            raise NotObservable(
                "the weight is unknown, and the method needs it: give the mass on the sensor (--mass-kg)."
            )
        gravity_N = weight_N * gravity_direction_base / np.linalg.norm(gravity_direction_base)
        return _with_torques(partial(carlson_known.cayley, gravity_force_base_N=gravity_N), R_base_flange)
    return _with_torques(_GRAVITY_UNKNOWN[method], R_base_flange)


def _with_torques(method: Callable[..., ForceFit], R_base_flange: Array) -> Estimator:
    def estimate(wrench: Array) -> Parameters:
        fit = method(R_base_flange, wrench[:, :3], bias=True)
        com_m, torque_bias_Nm = com_and_torque_bias(wrench[:, :3] - fit.force_bias_N, wrench[:, 3:])
        return Parameters(fit.R_flange_sensor, fit.gravity_force_base_N, fit.force_bias_N, com_m, torque_bias_Nm)

    return estimate
