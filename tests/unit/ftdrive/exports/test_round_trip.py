"""Exported files, compensated by the targets' own formulas, against `CalibrationResult.compensate`.

`tests/target_formulas.py` was written from the sources of the targets, without sight of the exporters. What a target
knows beside its file is what the export prints: `elsewhere`, and the mounting in the robot model. The calibrations have
all that a format declares to express and to subtract, and the limit is then zero, so that a wrong declaration fails.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Parameters
from ftcalib.compensation import Compensator
from ftcalib.model import Array
from ftcalib.sensor_matrix import SIZE, Response, SensorMatrix, ranges
from ftdrive.errors import NotAccepted
from ftdrive.exports.formats import FORMATS, Property
from ftdrive.exports.registry import Exported, Settings, export_calibration
from tests.target_formulas import evaluate, mujoco_plugin, tool0_from, world_from_base

ALL: tuple[Property, ...] = ("tilt", "rotation", "response")
TOLERANCE = 1e-9
"""Of the largest value that is read."""
FRAMES = [("base", "tool0"), ("base_link", "tool0"), ("base", "flange"), ("ur5e_base_link", "ur5e_flange")]
G_NOT_PUBLIC = ("franka", "xarm")
"""The firmware's gravity is taken to be that of the calibration."""
OWN_READING = ("franka", "ur-payload", "urdf", "mujoco")
"""The sensor in the arm or in the simulation is ideal: gain and cross-talk of ours do not matter."""
AXES_OF_THE_FLANGE = ("xarm",)
"""Has no place for the mounting. Others have it in the file, look it up in the robot model, or have no sensor axes."""
ONLY_THE_MOUNTING = ("static-transform",)
"""The load comes from the context, so that a wrong place of the sensor shows."""
MATRIX_UNITS = ranges(0.067)[:, None] / ranges(0.067)
DECODES = ("json", "yaml")
"""Multiply the wrench without the free tool by a matrix."""
LOSSES = [(name, lost) for name, one in FORMATS.items() if one.subtracts for lost in ALL if lost not in one.expresses]


def arbitrary(rng: np.random.Generator, has: tuple[Property, ...]) -> CalibrationResult:
    """Any mounting, any direction of gravity, any gain within a few percent: those of the three that it `has`."""
    direction = rng.normal(size=3) if "tilt" in has else np.array([0.0, 0.0, -1.0])
    gravity_N = rng.uniform(1, 60) * direction / np.linalg.norm(direction)
    R = Rotation.random(rng=rng).as_matrix() if "rotation" in has else np.eye(3)
    response = Response(0.03 * rng.normal(size=SIZE), np.zeros((15 + SIZE, 15 + SIZE))) if "response" in has else None
    return CalibrationResult(
        parameters=Parameters(R, gravity_N, *(rng.normal(size=3) * size for size in (20, 0.1, 1))),
        covariance=np.eye(15) * 1e-6,
        residuals=np.zeros((24, 6)),
        chi2=129.0,
        dof=129,
        noise_source="measured",
        g_m_s2=rng.uniform(9.78, 9.84),
        method="ml",
        findings=(),
        response=response,
    )


def settings_of(rng: np.random.Generator, base_frame: str = "base", flange_frame: str = "tool0") -> Settings:
    return Settings(
        base_frame=base_frame,
        flange_frame=flange_frame,
        height_mm=rng.uniform(0, 80),
        sensor_mass_kg=rng.uniform(0.1, 1),
        sensor_com_mm=tuple(rng.uniform(-20, 20, 3)),
    )


def gravity_m_s2(name: str, made: Exported, calibration: CalibrationResult) -> Array | None:
    """(3,) in the controller's base, as the target gets it from `elsewhere`; fails where this reads not all of it."""
    e: dict[str, Any] = dict(made.elsewhere)
    frame, gravity = "base", None
    match name:
        case "kth":
            frame, gravity = e.pop("imu header.frame_id"), np.negative(e.pop("imu linear_acceleration"))
        case "ft-tools" | "ros2-message":
            frame, gravity = (e.pop(f"calibration.{x}") for x in ("reference_frame.id", "gravity_in_reference_frame"))
            assert e.pop("calibration.sensor_frame.id") == "ft_sensor"
        case "xarm":
            gravity = np.multiply(e.pop("set_gravity_direction"), calibration.g_m_s2)
        case "ur-payload":
            gravity = np.negative(e.pop("set_gravity"))
        case "urdf" | "mujoco":
            (note,) = (note for note in made.notes if note.startswith("Gravity is given in the axes of "))
            frame = note.removeprefix("Gravity is given in the axes of ").partition(",")[0]
            gravity = e.pop("gravity of the simulation" if name == "urdf" else "option gravity")
    assert not e
    return None if gravity is None else np.asarray(world_from_base(frame).T @ gravity)


def compensated(
    name: str, made: Exported, calibration: CalibrationResult, settings: Settings, R_base_flange: Array, wrench: Array
) -> Array:
    given = calibration.parameters
    assert settings.sensor_com_mm is not None
    context: dict[str, Any] = {
        "R_flange_sensor": np.eye(3) if name in AXES_OF_THE_FLANGE else given.R_flange_sensor,
        "p_flange_sensor_m": np.array([0.0, 0.0, settings.height_mm or 0.0]) / 1e3,
        "R_flange_parent": tool0_from(settings.flange_frame),
        "sensor_mass_kg": settings.sensor_mass_kg,
        "p_flange_sensor_com_m": np.array(settings.sensor_com_mm) / 1e3,
        "force_bias_N": np.zeros(3),
        "torque_bias_Nm": np.zeros(3),
        "g_m_s2": calibration.g_m_s2 if name in G_NOT_PUBLIC else np.nan,
    }
    if name in ONLY_THE_MOUNTING:
        context |= {"p_sensor_com_m": given.p_sensor_com_m, "gravity_force_base_N": given.gravity_force_base_N}
    if (gravity := gravity_m_s2(name, made, calibration)) is not None:
        context["gravity_m_s2"] = gravity
    if name == "mujoco":
        by_plugin = mujoco_plugin(made.text, R_base_flange, wrench, context)
        in_model = evaluate(name, attached(made.text, settings), R_base_flange, wrench, context)
        np.testing.assert_allclose(by_plugin, in_model, rtol=0, atol=TOLERANCE * np.abs(wrench).max())
        return by_plugin
    return evaluate(name, made.text, R_base_flange, wrench, context)


def attached(text: str, settings: Settings) -> str:
    """Put the exported body into that of the flange, as its note says."""
    assert f"Attach the body tool to {settings.flange_frame}." in text
    inside = text.replace("<worldbody>", f'<worldbody><body name="{settings.flange_frame}">')
    return inside.replace("</worldbody>", "</body></worldbody>")


def expected(name: str, calibration: CalibrationResult, R_base_flange: Array, wrench: Array) -> Array:
    """Our result, plus what the target declares not to subtract; decoded where the target can."""
    target, given = FORMATS[name], calibration.parameters
    response = None if name in OWN_READING else calibration.response
    decoder = calibration.contact.decoder if name in DECODES else None
    ours: Array = np.asarray(Compensator(given, response=response, decoder=decoder)(wrench, R_base_flange))
    bias = np.concatenate([given.force_bias_N, given.torque_bias_Nm])
    if "weight" not in target.subtracts and name not in ONLY_THE_MOUNTING:
        ours = wrench - bias
    return ours if "bias" in target.subtracts else ours + bias


def data(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    return Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 6)) * ([60] * 3 + [6] * 3)


@pytest.mark.parametrize(("base_frame", "flange_frame"), FRAMES)
@pytest.mark.parametrize("name", FORMATS)
def test_a_target_compensates_as_we_do(name: str, base_frame: str, flange_frame: str) -> None:
    rng = np.random.default_rng(16)
    for _ in range(2):
        calibration, settings = arbitrary(rng, FORMATS[name].expresses), settings_of(rng, base_frame, flange_frame)
        made = export_calibration(calibration, name, settings, max_force_error_N=0.0)
        R, wrench = data(rng, 50)
        found = compensated(name, made, calibration, settings, R, wrench)
        wanted = expected(name, calibration, R, wrench)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=TOLERANCE * np.abs(wrench).max())
        assert made.max_force_error_N == made.max_torque_error_Nm == 0.0
        assert FORMATS[name].has_own_reading == (name in OWN_READING)
        assert bool(FORMATS[name].subtracts) == (name not in ONLY_THE_MOUNTING)


@pytest.mark.parametrize(("name", "lost"), LOSSES)
def test_what_a_target_cannot_express_costs_what_the_export_says(name: str, lost: Property) -> None:
    rng = np.random.default_rng(4)
    calibration, settings = arbitrary(rng, (*FORMATS[name].expresses, lost)), settings_of(rng)
    made = export_calibration(calibration, name, settings, max_force_error_N=np.inf)
    R, wrench = data(rng, 4000)
    wanted = expected(name, calibration, R, wrench)
    difference = compensated(name, made, calibration, settings, R, wrench) - wanted
    seen = np.array([np.linalg.norm(part, axis=1).max() for part in (difference[:, :3], difference[:, 3:])])
    stated = np.array([made.max_force_error_N, made.max_torque_error_Nm])
    assert (seen <= stated * (1 + TOLERANCE)).all()
    assert (seen >= 0.97 * stated).all()
    words = {"tilt": "base tilt", "rotation": "sensor turned by", "response": "gain and cross-talk"}[lost]
    assert re.search(rf"cannot express .*{words}.*{stated[0]:.3g} N and {stated[1]:.3g} N·m", made.notes[0])
    with pytest.raises(NotAccepted, match=words):
        export_calibration(calibration, name, settings, max_force_error_N=0.999 * stated[0])
    assert export_calibration(calibration, name, settings, max_force_error_N=1.001 * stated[0]).text == made.text


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ONLY_THE_MOUNTING])
def test_a_sensor_known_by_loads_is_decoded_or_its_largest_error_is_named(name: str) -> None:
    rng = np.random.default_rng(3)
    sensor = replace(SensorMatrix.usual(), source="loads", error=0.02 * rng.normal(size=(6, 6)) * MATRIX_UNITS)
    calibration = replace(arbitrary(rng, ()), sensor=sensor)
    settings = settings_of(rng)
    made = export_calibration(calibration, name, settings, max_force_error_N=0.0)
    R, wrench = data(rng, 50)
    decoder, p = calibration.contact.decoder, calibration.p_sensor_com_m
    assert decoder is not None
    if name in DECODES:
        found = compensated(name, made, calibration, settings, R, wrench)
        np.testing.assert_allclose(found, calibration.compensate(wrench, R), rtol=0, atol=1e-7)
        assert np.abs(found - Compensator(calibration.parameters)(wrench, R)).max() > 0.1
        return
    notes = [note for note in made.notes if "cannot decode contacts" in note]
    assert len(notes) == (name not in OWN_READING)
    if notes:
        stated = re.search(r"up to (\S+) %", notes[0])
        assert stated
        force = rng.normal(size=(2000, 3))
        force /= np.linalg.norm(force, axis=1)[:, None]
        true = np.concatenate([force, np.cross(p, force)], axis=1)
        error = np.linalg.norm((true @ np.linalg.inv(decoder).T - true)[:, :3], axis=1)
        assert 100 * error.max() == pytest.approx(float(stated[1]), rel=0.06)


@pytest.mark.parametrize(("base_frame", "flange_frame"), FRAMES)
def test_the_note_turns_the_sensor_of_the_robot_model(base_frame: str, flange_frame: str) -> None:
    rng = np.random.default_rng(2)
    calibration = arbitrary(rng, ("rotation",))
    (note,) = export_calibration(calibration, "kth", settings_of(rng, base_frame, flange_frame)).notes[-3:-2]
    rpy = re.search(rf"ft_sensor must be rotated from {flange_frame} by roll, pitch, yaw = \(([^)]*)\) rad", note)
    assert rpy
    R_frame_sensor = Rotation.from_euler("xyz", [float(x) for x in rpy[1].split(",")]).as_matrix()
    assert np.allclose(tool0_from(flange_frame) @ R_frame_sensor, calibration.R_flange_sensor, atol=1e-5)
    assert ("turned by 180°" in note) == base_frame.endswith("base_link")
