"""What a result is worth, in plain words."""

import numpy as np

from calib.result import CalibrationResult, Verdict

SIGNIFICANT_SIGMAS = 5.0
FARTHEST_COM_M = 0.5
NOISE_FACTOR = 3.0
USABLE_SHARE, REJECTED_SHARE = 0.02, 0.10
RECOMMENDED_POSES = 6
DISTINCT_CHI2 = 12.0  # a second solution this much worse was never the right one in 7361 simulated calibrations


def judge(result: CalibrationResult, second_chi2: float) -> tuple[Verdict, tuple[str, ...]]:
    """Judge a result.

    Parameters
    ----------
    result : CalibrationResult
        Its own verdict and reasons are not looked at.
    second_chi2 : float
        chi2 of the best other solution.

    Returns
    -------
    verdict : {"good", "usable", "rejected"}
    reasons : tuple of str
        What made it worse than good, then what else is worth knowing.
    """
    rejected: list[str] = []
    usable: list[str] = []
    notes: list[str] = []

    weight_N, sigma_N = result.weight_N, float(result.sigma["weight_N"])
    if not weight_N > SIGNIFICANT_SIGMAS * sigma_N:
        rejected.append(
            f"the weight, {weight_N:.3g} N, is not {SIGNIFICANT_SIGMAS:g} times its uncertainty of {sigma_N:.2g} N: "
            "hang something heavier on the sensor, or record longer and in more orientations"
        )
    com_m = float(np.linalg.norm(result.p_sensor_com_m))
    if com_m > FARTHEST_COM_M:
        rejected.append(
            f"the centre of mass lies {com_m:.2f} m from the sensor, farther than {FARTHEST_COM_M:g} m: "
            "check the units of force and torque"
        )
    noise_factor = float(np.sqrt(result.chi2 / result.dof))
    gap = (second_chi2 - result.chi2) / max(1.0, noise_factor**2)
    if gap < DISTINCT_CHI2:
        rejected.append(
            "a quite different mounting of the sensor explains the data almost as well: add poses with another "
            "angle between the tool and the vertical"
        )
    if result.noise_source == "measured" and noise_factor > NOISE_FACTOR:
        usable.append(
            f"residuals are {noise_factor:.1f} times the measured noise: drift, cables, contact or inexact "
            "orientations add to it, and the stated uncertainties do not include them"
        )
    shares = (
        ("the force residual", result.residual_summary()["force_rms_N"]),
        ("the expected force error over all orientations", result.predicted_error()[0]),
    )
    for what, force_N in shares:
        share = force_N / weight_N
        if share > USABLE_SHARE:
            limit = REJECTED_SHARE if share > REJECTED_SHARE else USABLE_SHARE
            (rejected if share > REJECTED_SHARE else usable).append(
                f"{what} is {100 * share:.1f} % of the weight ({force_N:.2g} N), more than {100 * limit:g} %"
            )
    if result.n_poses < RECOMMENDED_POSES:
        usable.append(
            f"there are only {result.n_poses} poses: {RECOMMENDED_POSES} or more can be checked against each other"
        )
    if result.noise_source == "residuals":
        notes.append("the noise was not measured but estimated from the residuals: chi2 says nothing about the fit")
    verdict: Verdict = "rejected" if rejected else "usable" if usable else "good"
    return verdict, (*rejected, *usable, *notes)
