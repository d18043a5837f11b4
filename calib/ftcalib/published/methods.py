"""The published methods by name, all of one shape: the wrenches of the poses in, the parameters out."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from ftcalib.errors import NotObservable
from ftcalib.model import Array, Parameters
from ftcalib.published import baselines, carlson, carlson_known
from ftcalib.published.carlson import ForceFit
from ftcalib.published.yu import com_and_torque_bias, lrom, mixed, special_numbers, srom

Estimator = Callable[[Array], Parameters]
"""Takes the mean wrenches (n, 6) of fixed poses, returns the parameters."""

_GRAVITY_UNKNOWN: Mapping[str, Callable[..., ForceFit]] = {
    "carlson-eigen": carlson.eigen,
    "carlson-nullspace": carlson.nullspace,
    "carlson-iterative": carlson.iterative,
    "carlson-polynomial": carlson.polynomial,
}

CARLSON = ("carlson-relaxation", "carlson-cayley", *_GRAVITY_UNKNOWN)
SPECIAL = ("srom", "mixed")
"""Those that take the gravity force from the 24 special orientations."""
BASELINES = ("vougioukas", "wang", "yang")
PUBLISHED = (*SPECIAL, "lrom", *CARLSON, *BASELINES)


def published(
    method: str,
    R_base_flange: Array,
    *,
    gravity_direction_base: Array,
    weight_N: float | None = None,
    R_flange_sensor: Array | None = None,
    as_published: bool = False,
) -> Estimator:
    """Prepare a published method for a set of poses.

    Yu's methods and Vougioukas' are complete. Those of Wang and Yang leave the torques to Yu's torque step (eqs 43-45).
    Carlson's run in their form with bias and the same torque step, or as published without bias.

    Parameters
    ----------
    method : str
        One of `PUBLISHED`.
    R_base_flange : array, shape (n, 3, 3)
    gravity_direction_base : array, shape (3,)
        For carlson-relaxation, carlson-cayley and vougioukas.
    weight_N : float, optional
        For carlson-cayley.
    R_flange_sensor : array, shape (3, 3), optional
        Known mounting for vougioukas, wang and, up to a turn about flange z, yang. Default: the identity.
    as_published : bool
        Run one of `CARLSON` in its printed form: biases of force and torque are zero, the centre of mass follows from
        his eqs 4-5, and the Cayley transform is applied once.

    Raises
    ------
    NotObservable
        The method needs other poses, or a weight.
    ValueError
        `as_published` for a method that has one form only.
    """
    if as_published:
        require_printed_form(method)
    mounting = np.eye(3) if R_flange_sensor is None else R_flange_sensor
    if method == "srom":
        return partial(srom, R_base_flange, numbered=special_numbers(R_base_flange))
    if method == "mixed":
        return partial(mixed, R_base_flange, numbered=special_numbers(R_base_flange, others=True))
    if method == "lrom":
        return partial(lrom, R_base_flange)
    if method == "vougioukas":
        known = {"R_flange_sensor": mounting, "gravity_direction_base": gravity_direction_base}
        return partial(baselines.vougioukas, R_base_flange, **known)
    if method in ("wang", "yang"):
        return _with_torques(partial(getattr(baselines, method), R_flange_sensor=mounting), R_base_flange)
    forces = partial(_carlson(method, gravity_direction_base, weight_N, as_published), bias=not as_published)
    return _with_torques(forces, R_base_flange, as_published=as_published)


def _carlson(
    method: str, gravity_direction_base: Array, weight_N: float | None, as_published: bool
) -> Callable[..., ForceFit]:
    if method == "carlson-relaxation":
        return partial(carlson_known.relaxation, gravity_direction_base=gravity_direction_base)
    if method != "carlson-cayley":
        return _GRAVITY_UNKNOWN[method]
    if weight_N is None:
        raise NotObservable("the weight is unknown, and the method needs it: give the mass on the sensor (--mass-kg).")
    gravity_N = weight_N * gravity_direction_base / np.linalg.norm(gravity_direction_base)
    return partial(carlson_known.cayley, gravity_force_base_N=gravity_N, as_published=as_published)


def require_printed_form(method: str) -> None:
    """Raise `ValueError` if a method has no printed form of its own: only Carlson's methods are extended here."""
    if method in CARLSON:
        return
    reason = "runs as published already" if method in PUBLISHED else "is no published method"
    raise ValueError(f"{method} {reason}: use as_published with one of {', '.join(CARLSON)}")


def _with_torques(forces: Callable[..., ForceFit], R_base_flange: Array, *, as_published: bool = False) -> Estimator:
    def estimate(wrench: Array) -> Parameters:
        fit = forces(R_base_flange, wrench[:, :3])
        if as_published:
            com_m, torque_bias_Nm = carlson_known.centre_of_mass(R_base_flange, wrench[:, 3:], fit), np.zeros(3)
        else:
            com_m, torque_bias_Nm = com_and_torque_bias(wrench[:, :3] - fit.force_bias_N, wrench[:, 3:])
        return Parameters(fit.R_flange_sensor, fit.gravity_force_base_N, fit.force_bias_N, com_m, torque_bias_Nm)

    return estimate
