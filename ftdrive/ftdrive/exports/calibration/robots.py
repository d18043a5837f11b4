"""Targets that are controllers of arms."""

import numpy as np

from ftcalib import CalibrationResult
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.shared import (
    R_frame_sensor,
    gravity_m_s2,
    inertia_note,
    payload_inertia_kg_m2,
    rpy_rad,
)
from ftdrive.exports.calibration.text import Exported, numbers, yaml_text

MC_RTC_G_M_S2 = 9.80665
"""mc_rtc/constants.h."""


def mc_rtc(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the 13 numbers of calib_data.NAME, one a line.

    Reader: jrl-umi3218/mc_rtc, src/mc_rbdyn/ForceSensor.cpp, master; Robot.cpp gives it the gravity of constants.h. The
    order is mass, rpy, com, offset. `rpy` turns the sensor of the model into the real one, here that of a model whose
    sensor has the axes of the flange. `com` is in the axes of the sensor's parent body, from its origin: here the
    flange. The offset has the couple first. With g = 9.80665 m/s2 along -z of the world, and p the place of the sensor
    in the flange:

        force = raw - offset[3:] - mass g          couple = raw - offset[:3] - (com - p) x (mass g), in sensor axes

    White space must follow the last number. The reader stops there.
    """
    origin_m, R = settings.p_frame_sensor_m("mc-rtc"), R_frame_sensor(calibration, settings)
    values = [
        calibration.weight_N / MC_RTC_G_M_S2,
        *rpy_rad(R),
        *numbers(origin_m + R @ calibration.p_sensor_com_m),
        *numbers(calibration.torque_bias_Nm),
        *numbers(calibration.force_bias_N),
    ]
    notes = (
        f"The parent body of the force sensor must be the flange ({settings.flange_frame}), with the sensor at "
        f"({', '.join(map(str, numbers(origin_m)))}) m and its axes. World z must point up.",
        f"mass is weight / {MC_RTC_G_M_S2:g} m/s2, because mc_rtc multiplies it by that. Old versions have 9.81.",
    )
    return Exported("".join(f"{value!r}\n" for value in values), notes)


def xarm(calibration: CalibrationResult, _: Settings) -> Exported:
    """Write the list for `XArmAPI.ft_sensor_cali_load`.

    Reader: xArm-Developer/xArm-Python-SDK, xarm/x3/ft_sensor.py, 1.11 or newer: mass (kg), centre of mass (mm), offsets
    of force (N) and torque (N·m). The origin of `com` is that of the sensor: with `association_setting_tcp_load`, the
    SDK adds 32 mm to reach the flange. The formula of the firmware is not public. It is taken to be

        force = raw - offset[:3] - mass g          torque = raw - offset[3:] - com x (mass g)

    with g of the calibration, and a sensor that has the axes of the flange.
    """
    ten = [
        calibration.mass_kg,
        *numbers(1e3 * calibration.p_sensor_com_m),
        *numbers(calibration.force_bias_N),
        *numbers(calibration.torque_bias_Nm),
    ]
    notes = (
        "The centre of mass is in mm. An SDK before 1.11 takes metres.",
        "The formula of the firmware and the sign of the offsets are not public. Read the sensor without contact in "
        "two poses before you use them.",
    )
    down = gravity_m_s2(calibration)
    elsewhere = {"set_gravity_direction": numbers(down / np.linalg.norm(down))}
    return Exported(yaml_text(ten), notes, elsewhere)


def franka(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the arguments of `franka::Robot::setLoad`, which are those of the service SetLoad of franka_ros.

    Reader: frankarobotics/libfranka, include/franka/robot.h, 0.8 or newer: mass (kg), centre of mass in flange axes
    from the flange (m), inertia about the centre of mass (kg m2, column by column). The load is all that the flange
    carries:

        force on the flange = mass g               torque about the flange = F_x_Cload x (mass g)

    with g along -z of the base, which cannot be changed. The formula of the firmware is not public, nor is its g.
    """
    mass_kg, com_m = settings.payload("franka", calibration)
    document = {"mass": mass_kg, "F_x_Cload": numbers(com_m), "load_inertia": [0.0] * 9}
    notes = (
        *settings.assumed,
        "The inertia was not identified: zeros stand for a point mass. Put values of the CAD model there.",
        "Franka names the centre of mass F_x_center_load in ROS 1 and center_of_mass in ROS 2.",
        "The load has no bias. How the controller uses the load is not public: compare O_F_ext_hat_K without "
        "contact in two poses.",
    )
    return Exported(yaml_text(document), notes)


def ur_payload(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write one statement of URScript that sets the payload.

    Reader: Universal Robots controller, URScript manual 5.10 or newer, set_target_payload(m, cog, inertia): kg, and m
    in flange axes from the flange. The payload is all that the flange carries:

        force on the flange = m g                  torque about the flange = cog x (m g)

    with g that of `set_gravity`. The formula of the controller is not public. The statement zeroes the sensor of an
    e-Series arm.
    """
    mass_kg, com_m = settings.payload("ur-payload", calibration)
    cog = ", ".join(_fixed(x) for x in com_m)
    J = payload_inertia_kg_m2(calibration, mass_kg, np.asarray(com_m), settings.p_flange_sensor_m("ur-payload"))
    inertia = "0, 0, 0, 0, 0, 0" if J is None else ", ".join(map(_fixed, J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]))
    text = f"set_target_payload({_fixed(mass_kg)}, [{cog}], [{inertia}])\n"
    notes = (
        *settings.assumed,
        "The controller zeroes its own force sensor when this runs: keep the tool free and the arm still.",
        f"{inertia_note(calibration)} Needs PolyScope 5.10; set_payload before that.",
        "The payload has no bias. How the controller uses it is not public: compare get_tcp_force() without contact in "
        "two poses.",
        "set_gravity takes the acceleration away from the earth, in base axes. The mounting in PolyScope sets it too.",
    )
    return Exported(text, notes, {"set_gravity": numbers(-gravity_m_s2(calibration))})


def _fixed(value: float) -> str:
    """Write a number without exponent, which the URScript manual does not mention."""
    return f"{float(value) + 0.0:.12f}"
