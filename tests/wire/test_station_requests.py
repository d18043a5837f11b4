"""The control channel of a station: what happens to the tool, the sensor and the arm shows where it should."""

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ftmocks.__main__ import main
from tests.wire.station_process import StationProcess

pytestmark = pytest.mark.slow  # every test needs a process of its own

OPTIONS = ("--seed", "2", "--sensor", "bota")


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    with StationProcess(*OPTIONS) as station:
        yield station


def wrench(station: StationProcess) -> np.ndarray:
    return np.array(station.ask("state")["true_wrench"])


def test_a_bump_comes_and_goes_beside_a_push(station: StationProcess) -> None:
    before = wrench(station)
    station.ask("push", wrench=[0, 0, 3, 0, 0, 0])
    station.ask("bump", seconds=100)
    assert np.linalg.norm((wrench(station) - before)[:3] - [0, 0, 3]) == pytest.approx(15)
    station.ask("bump", seconds=0.1)
    station.wait_for(lambda s: np.allclose(np.array(s["true_wrench"]) - before, [0, 0, 3, 0, 0, 0]))
    station.ask("push", wrench=[0] * 6)
    np.testing.assert_allclose(wrench(station), before)


def test_cables_drift_and_payload(station: StationProcess) -> None:
    before = wrench(station)
    q6_deg = math.degrees(station.ask("state")["q_rad"][5])
    station.ask("cable", joint=6, beyond_deg=q6_deg - 10, force_N_deg=[0.5, 0, 0])
    assert np.linalg.norm((wrench(station) - before)[:3]) == pytest.approx(5.0)
    up = -np.sign(before[2] - station.hello["truth"]["force_bias_N"][2])  # 1 where the sensor's z axis points up
    station.ask("cable", towards=[0, 0, -up], within_deg=60, force_N=[8, 0, 0])
    np.testing.assert_allclose(wrench(station), before)
    station.ask("cable", towards=[0, 0, up], within_deg=60, force_N=[8, 0, 0])
    assert np.linalg.norm((wrench(station) - before)[:3]) == pytest.approx(8.0)
    station.ask("cable", on=False)
    station.ask("drift", force_N=[0, 0, 0.5], seconds=0.05)
    station.wait_for(lambda s: np.allclose(np.array(s["true_wrench"]) - before, [0, 0, 0.5, 0, 0, 0]))
    truth = station.ask("payload_shift", mass_kg=3.0)["truth"]
    assert (truth["mass_kg"], truth["p_sensor_com_m"]) == (3.0, station.hello["truth"]["p_sensor_com_m"])
    weight_N = wrench(station)[:3] - truth["force_bias_N"] - [0, 0, 0.5]
    assert np.linalg.norm(weight_N) == pytest.approx(3 * 9.80665)


def test_a_load_hangs_swings_and_is_taken_off(station: StationProcess) -> None:
    before = wrench(station)
    station.ask("hang", mass_kg=2.0, at_mm=[0, 0, 200], string_mm=250, swing_deg=0)
    assert np.linalg.norm((wrench(station) - before)[:3]) == pytest.approx(2 * 9.80665)
    station.ask("hang", mass_kg=2.0, at_mm=[0, 0, 200])
    assert 0.1 < station.ask("state")["swing_deg"] < 2.1
    station.ask("grip", mass_kg=2.0, at_mm=[0, 0, 200])
    assert station.ask("state")["swing_deg"] is None
    assert np.linalg.norm((wrench(station) - before)[:3]) == pytest.approx(2 * 9.80665)
    station.ask("unhang")
    np.testing.assert_allclose(wrench(station), before)


@pytest.mark.parametrize(
    ("verb", "how", "why"),
    [
        ("push", {"wrench": [1, 2, 3]}, "expected 6 numbers"),
        ("cable", {"joint": 7, "beyond_deg": 0, "force_N_deg": [1, 0, 0]}, "not 7"),
        ("grip", {"mass_kg": -2.0, "at_mm": [0, 0, 200]}, "load of -2.0 kg"),
        ("saturate", {"axis": 6}, "not 6"),
        ("sensor-faults", {"dropp": 1}, "unknown fault dropp"),
        ("hand-move", {"q_rad": [0] * 6, "speed_rad_s": 0}, "positive speed"),
        ("set-payload", {"payload_kg": -1}, "payload -1"),
        ("set-mounting", {"up": [0, 0, 0]}, "not a direction"),
        ("slider", {"fraction": 2}, "not between"),
        ("delay", {"sensor_ms": -1}, "0 to 1000 ms"),
        ("swing", {"seconds": 5, "speed_rad_s": 0}, "must be positive"),
        ("recording", {"pace": 1}, "not understood"),
    ],
)
def test_a_wrong_request_is_an_error_and_changes_nothing(
    station: StationProcess, verb: str, how: dict[str, Any], why: str
) -> None:
    before = wrench(station)
    assert why in station.refusal(verb, **how)
    np.testing.assert_allclose(wrench(station), before)


def test_a_pushed_joint_and_a_changed_payload(station: StationProcess) -> None:
    before = station.ask("state")
    station.ask("push-joint", joint=2, off_deg=3)
    pushed = station.wait_for(lambda s: s["q_rad"][1] - before["q_rad"][1] == pytest.approx(math.radians(3), abs=1e-6))
    assert pushed["target_q_rad"] == before["target_q_rad"]
    station.ask("push-joint", joint=2, off_deg=0)
    station.wait_for(lambda s: s["q_rad"] == pytest.approx(before["q_rad"], abs=1e-6))
    station.ask("set-payload", payload_kg=2.5, payload_cog_m=[0.01, 0, 0.05])
    station.ask("set-payload", payload_kg=2.6)  # its centre stays
    state = station.ask("state")
    assert (state["payload_kg"], state["payload_cog_m"]) == (2.6, [0.01, 0, 0.05])


def test_requests_to_begin_with() -> None:
    drift = {"do": "drift", "force_N": [0, 0, 0.5], "seconds": 0}
    with StationProcess(*OPTIONS, "--do", json.dumps(drift), "--do", '{"do": "slider", "fraction": 0.5}') as station:
        truth, state = station.hello["truth"], station.ask("state")
        weight_N = np.array(state["true_wrench"])[:3] - truth["force_bias_N"] - [0, 0, 0.5]
        assert np.linalg.norm(weight_N) == pytest.approx(truth["weight_N"])
        assert state["speed_fraction"] == 0.5


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--do", '{"do": "dance"}'], "not understood"),
        (["--sensor", "ur-ft", "--sensor-rotvec-deg", "0,0,30"], "leave --sensor-rotvec-deg out"),
        (["--inertia", "1,1,3,0,0,0"], "no body has"),
        (["--load", "2.0"], "KG@x,y,z"),
        (["--recording", "README.md", "--gain", "1"], "leave --gain"),
        (["--recording", "README.md", "--time-scale", "2"], "leave --time-scale"),
        (["--sensor", "ur-ft", "--sensor-delay-ms", "5"], "no wire of its own"),
    ],
)
def test_wrong_options_are_exit_code_2(
    options: list[str], why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["ftmocks", "station", *options])
    for setting in ("signal.signal", "sys.setswitchinterval"):  # of the whole process, so of all tests that follow
        monkeypatch.setattr(setting, lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        raise SystemExit(main())
    answer = capsys.readouterr()
    assert (ended.value.code, answer.out) == (2, "")
    assert why in answer.err
