"""The exported URScript, run by the emulated controller, against the real service on an emulated cell."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ftdrive.exports.urscript import functions
from ftdrivers.errors import ConnectError
from ftdrivers.ur.rtde import ProgramRegisters
from tests.wire.conftest import Station
from tests.wire.station_process import ROOT

OPTIONS = ("--sensor", "robotous-serial", "--sensor-origin", "0,0,0.04", "--time-scale", "1")
PART_KG, TOOL_FACTOR = 0.8, 2.0
LIMIT_NS = 100_000_000
NUMBER = r"-?[\d.]+(?:e-?\d+)?"

CYCLE = """
def cycle():
{functions}
  textmsg("status ", ftd_status())
  textmsg("zero ", ftd_zero())
  textmsg("grasp ", 0)
  sleep(1.0)
  textmsg("load ", ftd_wrench())
  textmsg("request ", 0)
  local weight = ftd_weigh()
  textmsg("weight ", weight)
  local payload = ftd_payload(weight, 1.0, [0.0, 0.0, 0.05])
  set_target_payload(payload[0], [payload[1], payload[2], payload[3]])
  sleep(0.3)
  textmsg("carried ", ftd_wrench())
  textmsg("bias ", ftd_bias())
  textmsg("unknown ", ftd_request(7))
  textmsg("watch ", 0)
  while ftd_alive():
    sync()
  end
  textmsg("lost ", 0)
  textmsg("gone ", ftd_wrench())
  textmsg("refused ", ftd_weigh())
end
"""


def program() -> str:
    indented = "\n".join(f"  {line}" if line else "" for line in functions(24).splitlines())
    return CYCLE.format(functions=indented)


class Service:
    """The service as a process on a station."""

    def __init__(self, station: Station) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.wire.load_service", json.dumps(station.hello)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "serving\n"

    def signal(self, number: int) -> None:
        os.kill(self._process.pid, number)

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    with Station(*OPTIONS) as station:
        yield station


def said(station: Station, word: str, since: int) -> dict[str, Any]:
    """Wait until the program writes something."""
    state = station.wait_for(lambda state: any(e["why"].startswith(f"{word} ") for e in state["events"][since:]))
    event: dict[str, Any] = next(e for e in state["events"][since:] if e["why"].startswith(f"{word} "))
    return event


def values(event: dict[str, Any]) -> list[float]:
    return [float(text) for text in re.findall(NUMBER, event["why"].partition(" ")[2])]


@pytest.mark.slow
@pytest.mark.parametrize("failure", ["kill", "cable", "sensor"])
def test_a_cycle_and_then_a_failure(station: Station, failure: str) -> None:
    truth = station.hello["truth"]
    tool = {"mass_kg": truth["mass_kg"], "p_sensor_com_m": truth["p_sensor_com_m"]}
    station.ask("payload-shift", **tool)
    service = Service(station)
    since = len(station.ask("state")["events"])
    try:
        with station.connect(30003) as sock:
            sock.sendall(program().encode("ascii"))
        assert values(said(station, "status", since)) == [0]
        assert values(said(station, "zero", since)) == [0]
        said(station, "grasp", since)
        com_m = [TOOL_FACTOR * x for x in truth["p_sensor_com_m"]]
        joined = [
            (truth["mass_kg"] * x + PART_KG * y) / (truth["mass_kg"] + PART_KG)
            for x, y in zip(truth["p_sensor_com_m"], com_m, strict=True)
        ]
        station.ask("payload-shift", mass_kg=truth["mass_kg"] + PART_KG, p_sensor_com_m=joined)
        load = values(said(station, "load", since))
        assert load[0] == 2, "a load that is not known"
        assert load[3] == pytest.approx(-PART_KG * 9.80665, abs=0.3), "base axes: it pulls down"
        weight = said(station, "weight", since)
        state, mass_kg, sigma_kg, least_kg = values(weight)[:4]
        assert state == 0
        assert mass_kg == pytest.approx(PART_KG, abs=4 * sigma_kg)
        assert least_kg < 0.01
        assert weight["t_host_ns"] - said(station, "request", since)["t_host_ns"] <= 600_000_000
        carried = values(said(station, "carried", since))
        assert carried[0] == 0, "the wrench is without the part"
        assert max(map(abs, carried[1:4])) < 0.3
        bias = np.abs(values(said(station, "bias", since)))
        assert (bias <= [0, 60, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1]).all(), "seen, and as calibrated"
        assert station.ask("state")["payload_kg"] == pytest.approx(1.0 + mass_kg)
        assert values(said(station, "unknown", since)) == [9]
        said(station, "watch", since)
        if failure == "kill":
            service.signal(signal.SIGKILL)
        elif failure == "cable":
            station.ask("silent", what="rtde", on=True)
        else:
            station.ask("sensor-faults", stall=True)
        begin_ns = station.clock.now_ns()  # a busy computer takes its time until the fault is there
        assert said(station, "lost", since)["t_host_ns"] - begin_ns <= LIMIT_NS
        assert values(said(station, "gone", since)) == [-1, 0, 0, 0, 0, 0, 0]
        assert values(said(station, "refused", since)) == [-1] + [0] * 9
    finally:
        service.end()
        station.ask("silent", what="rtde", on=False)
        station.ask("sensor-faults", stall=False)
        station.wait_for(lambda state: state["runtime_state"] == "STOPPED")


def test_registers_of_another_client_or_version_are_named(station: Station) -> None:
    with pytest.raises(ValueError, match="24 to 47"):
        ProgramRegisters(station.host, 20, 5, 15)
    first = ProgramRegisters(station.host, 24, 5, 15, clock=station.clock)
    try:
        with pytest.raises(ConnectError, match=r"another client controls .*input_int_register_28"):
            ProgramRegisters(station.host, 28, 5, 15, clock=station.clock)
    finally:
        first.close()
    station.ask("claim-registers", range="upper", on=True)
    with pytest.raises(ConnectError, match="fieldbuses"):
        ProgramRegisters(station.host, 24, 5, 15, clock=station.clock)
    station.ask("claim-registers", range="upper", on=False)
