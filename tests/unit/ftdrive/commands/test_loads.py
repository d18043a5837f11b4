import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, solve
from ftcalib.loads.model import LoadRun
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cli import cli
from ftdrive.commands.options import SourceOptions
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.runs.calibration import next_sensor_file, read_calibration, sensor_files
from ftdrive.stream.samples import Paired
from ftdrive.stream.stream import Stream
from tests.loaded_sensor import PROTOCOLS, LoadedSensor, with_load
from tests.unit.ftdrive.stream.simulated import calibrated, info, replayed
from tests.unit.ftdrive.stream.test_weighing import POSE, part, rests, stream


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["loads", *arguments])


def save(runs: list[LoadRun], serial: str = "FT1") -> None:
    for one in runs:
        meta: dict[str, object] = {"devices": {"sensor": {"serial": serial}}}
        if one.load is not None and one.load.p_flange_m is not None:
            meta["load"] = {
                "name": one.load.name,
                "mass_kg": one.load.mass_kg,
                "mass_sigma_kg": one.load.mass_sigma_kg,
                "p_flange_mm": [1e3 * x for x in one.load.p_flange_m],
                "place_sigma_mm": 0.5,
                "gripped": False,
            }
        replace(one.dataset, meta=meta).save(f"{one.name}.json")


@pytest.fixture
def sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LoadedSensor:
    monkeypatch.chdir(tmp_path)
    return LoadedSensor(3)


@pytest.mark.slow
def test_a_matrix_is_saved_beside_the_cell_and_used_for_its_sensor_alone(sensor: LoadedSensor) -> None:
    runs = sensor.runs(PROTOCOLS["hung, side and tip"])
    save(runs)
    found = run("solve", "tool.json", "side.json", "tip.json", "--json")
    assert found.exception is None, found.output
    document = json.loads(found.stdout)
    assert (document["verdict"], document["saved"]) == ("good", "sensor.json")
    assert [one["name"] for one in document["loads"]] == ["side", "tip"]

    def calibration(serial: str) -> CalibrationResult:
        path = Path(f"{serial}.calibration.json")
        solve(runs[0].dataset, provenance={"devices": {"sensor": {"serial": serial}}}).save(path)
        return read_calibration(path)

    of_it, of_other = calibration("FT1"), calibration("FT2")
    assert of_it.sensor is not None
    np.testing.assert_array_equal(of_it.sensor.error, document["sensor"]["error"])
    assert of_other.sensor is None
    assert of_it.id == of_other.id
    contact, R = np.array([0, 0, 80.0, 2, 0, 0]), np.eye(3)
    assert (of_it.contact_sigma(contact, R)[:3] < 0.5 * of_other.contact_sigma(contact, R)[:3]).all()
    assert "sensor FT1" in run("show").output


@pytest.mark.slow
def test_later_loads_begin_with_the_earlier_matrix_and_can_be_dropped(sensor: LoadedSensor) -> None:
    save(sensor.runs(PROTOCOLS["hung, tip"]))
    assert run("solve", "tool.json", "tip.json").exception is None
    tool, side, _ = sensor.runs(PROTOCOLS["hung, side and tip"])
    save([replace(tool, name="again"), side])
    assert "Starting from sensor.json" in run("solve", "again.json", "side.json").output
    assert [path.name for path in sensor_files()] == ["sensor.json", "sensor-2.json"]
    assert next_sensor_file().name == "sensor-3.json"
    assert "Deleted sensor-2.json" in run("drop", "--yes").output
    assert [path.name for path in sensor_files()] == ["sensor.json"]


@pytest.mark.slow
def test_nothing_is_saved_if_the_runs_do_not_agree(sensor: LoadedSensor) -> None:
    save(with_load(sensor.runs(PROTOCOLS["hung, tip"]), 1, mass_kg=4.4, mass_sigma_kg=0.001))
    found = run("solve", "tool.json", "tip.json", "--tool-mass", "1.300±0.002")
    assert isinstance(found.exception, NotAccepted)
    assert "lb" in found.output
    assert not sensor_files()


def test_runs_of_two_sensors_are_refused(sensor: LoadedSensor) -> None:
    tool, tip = sensor.runs(PROTOCOLS["hung, tip"])
    save([tool])
    save([tip], "FT2")
    found = run("solve", "tool.json", "tip.json")
    assert isinstance(found.exception, ConfigError)
    assert "FT2" in str(found.exception)


@pytest.mark.parametrize("free_s", [0.0, 2.0])
def test_a_recording_is_tared_where_the_tool_is_free_before_the_load(
    free_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drift, elsewhere = np.array([0.2, -0.1, 0.3, 0.003, 0, 0]), Rotation.from_euler("x", 90, degrees=True).as_matrix()
    load = drift + 1.09 * part(POSE, 1.0)
    free = [rests((elsewhere, drift), (POSE, drift), seconds=free_s / 2)] if free_s else []
    rows = Paired.concatenate([*free, rests((POSE, load), (POSE, drift), seconds=1.5)])
    rows = replace(rows, t_host_ns=np.arange(len(rows)) * 1_000_000, seq=np.arange(len(rows)))
    known = info(replace(calibrated(), sensor=SensorMatrix.usual(0.02)))
    monkeypatch.setattr("ftdrive.commands.loads.open_replay", lambda *_, **__: replayed(known, rows, speed=np.inf))
    found = run("check", "1.000", "--replay", str(tmp_path), "--json")
    answer = json.loads(found.stdout)
    assert answer["scale_error"] == pytest.approx(0.09, abs=4 * answer["scale_sigma"])
    assert answer["tared"] is bool(free_s)
    assert (answer["scale_sigma"] < 0.005) is bool(free_s)
    # 9 % off is hidden by the drift, and only by that.
    assert answer["is_within"] is not bool(free_s)
    assert ("hang the load" in found.stderr) is not bool(free_s)


def test_an_emulated_cell_hangs_the_load_itself_also_without_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    cell, hung = stream(rests((POSE, part(POSE, 1.0)), seconds=2.0)), list[dict[str, object]]()
    station = SimpleNamespace(control=lambda **request: hung.append(request))
    monkeypatch.setattr(Stream, "station", station)
    monkeypatch.setattr(SourceOptions, "open", lambda *_: cell)
    found = run("check", "1.000", "--simulate", "--json")
    assert found.exception is None, found.output
    assert [(one["do"], one["mass_kg"], one["at_mm"]) for one in hung] == [("hang", 1.0, (0.0, 0.0, 200.0))]


@pytest.mark.slow
def test_a_load_that_hangs_nowhere_is_named_after_an_unsteady_second(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = np.zeros(6)
    touched = [(POSE, sign * part(POSE, 0.2)) for sign in (1, -1)]
    rows = Paired.concatenate([rests(*touched, seconds=0.1), rests((POSE, nothing), seconds=4.0)])
    rows = replace(rows, t_host_ns=np.arange(len(rows)) * 1_000_000, seq=np.arange(len(rows)))
    monkeypatch.setattr(SourceOptions, "open", lambda *_: stream(rows))
    found = run("check", "1.000", "--tool", "gripper", "--wait", "3")
    assert isinstance(found.exception, ConfigError)
    assert "no load of about 1 kg" in str(found.exception)


@pytest.mark.parametrize(("mass", "at"), [("two", None), ("-1", None), ("1", "tip=0,0")])
def test_a_wrong_load_is_named_with_the_form_to_type(mass: str, at: str | None) -> None:
    found = run("check", *([] if at is None else ["--at", at]), "--simulate", "--", mass)
    assert isinstance(found.exception, ConfigError)
    assert (
        "2.0±0.002" in str(found.exception)
        or "0,0,200" in str(found.exception)
        or "0 to 100 kg" in str(found.exception)
    )
