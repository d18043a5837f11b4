"""`serve-load` on an emulated cell: rate and age of the wrench in the registers, and many cycles of pick and place.

    uv run python -m tests.benchmarks.program_service [--seconds 10] [--cycles 50]

The exported URScript is run by the emulated controller: zero, grasp, weigh, carry, touch, release, weigh. The bias
drifts by 1 N an hour. A second RTDE client reads the registers. Age: from the measurement of a sample to its writing.
Exit code: 1 if a target is missed.
"""

import argparse
import re
import sys
import threading
from collections import Counter
from contextlib import suppress
from typing import Any

import click
import numpy as np

from ftcalib.after.weighing import drift_since
from ftdrive.errors import ConfigError
from ftdrive.exports.program_functions import functions
from ftdrive.live.samples import Block
from ftdrive.servers.program import ProgramService
from ftdrivers.errors import DeviceError
from ftdrivers.ur.rtde import Subscription
from tests.wire.conftest import Station
from tests.wire.load_service import opened, service_on

OPTIONS = ("--sensor", "robotous-serial", "--sensor-origin", "0,0,0.04", "--time-scale", "1", "--seed", "3")
DRIFT_N_H = np.array([0.6, -0.6, 0.53])
HOURS = 10
LIVE, WRENCH = "input_int_register_28", tuple(f"input_double_register_{24 + i}" for i in range(6))

CYCLES = """
def cycles():
{functions}
  def weigh():
    local tries = 0
    local w = ftd_weigh()
    while tries < 3 and w[0] > 0 and w[0] < 4:
      w = ftd_weigh()
      tries = tries + 1
    end
    return w
  end
  local home = get_actual_joint_positions()
  local side = [home[0] + 0.5, home[1], home[2], home[3] + 0.4, home[4], home[5] + 0.6]
  local k = 0
  while k < {cycles}:
    sleep(0.6)
    textmsg("zero ", ftd_zero())
    textmsg("grasp ", k)
    sleep(0.6)
    textmsg("held ", ftd_wrench())
    textmsg("request ", k)
    textmsg("weight ", weigh())
    movej(side, a=2.0, v=1.0)
    sleep(0.6)
    textmsg("carried ", ftd_wrench())
    textmsg("touch ", k)
    sleep(0.6)
    textmsg("touched ", ftd_wrench())
    textmsg("release ", k)
    sleep(0.6)
    textmsg("empty ", weigh())
    movej(home, a=2.0, v=1.0)
    k = k + 1
  end
end
"""


class Bench:
    """A station with the service in a thread of this process."""

    def __init__(self, station: Station, service: ProgramService, stream: Any) -> None:
        self.station, self.service, self.stream = station, service, stream
        self.ages_s: list[float] = []
        self.written: dict[int, Any] = {}
        service.on_block = self._note
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with suppress(DeviceError, ConfigError):  # at its end the station is gone
            self.service.run()

    def _note(self, block: Block) -> None:
        self.ages_s.append((self.stream.clock.now_ns() - int(block.t_host_ns[-1])) * 1e-9)
        self.written[self.service._live] = block.wrench[-1]

    def registers(self, seconds: float) -> dict[str, float]:
        """Read the registers as the controller has them."""
        self.ages_s.clear()
        self.stream.clock.sleep(seconds)  # the client below shares a processor with the service
        ages_s = list(self.ages_s)
        outputs = {LIVE: "INT32"} | dict.fromkeys(WRENCH, "DOUBLE")
        link = Subscription(self.station.host, outputs, 500.0, timeout_s=5.0, clock=self.stream.clock)
        end_s = self.stream.clock.now_s() + seconds
        seen: dict[int, Any] = {}
        while self.stream.clock.now_s() < end_s:
            values = link.decode(link.read(1.0))
            for row in range(len(values[LIVE])):
                seen[int(values[LIVE][row])] = [values[name][row] for name in WRENCH]
        link.close()
        differ = [np.abs(self.written[n] - seen[n]).max() for n in seen if n in self.written]
        return {
            "rate Hz": len(seen) / seconds,
            "written Hz": len(ages_s) / seconds,
            "age p50 ms": 1e3 * float(np.quantile(ages_s, 0.5)),
            "age p95 ms": 1e3 * float(np.quantile(ages_s, 0.95)),
            "largest difference to the stream": float(max(differ)),
            "compared": float(len(differ)),
        }

    def cycles(self, n: int, seed: int) -> dict[str, Any]:  # noqa: PLR0915 - one branch for each word of the program
        """Run the program, and do what the world does."""
        rng = np.random.default_rng(seed)
        truth = self.station.hello["truth"]
        tool_kg, tool_com_m = truth["mass_kg"], np.array(truth["p_sensor_com_m"])
        self.station.ask("drift", force_N=(HOURS * DRIFT_N_H).tolist(), seconds=HOURS * 3600)
        begin_ns = self.stream.clock.now_ns()
        text = "\n".join(f"  {line}" if line else "" for line in functions(24).splitlines())
        with self.station.connect(30003) as sock:
            sock.sendall(CYCLES.format(functions=text, cycles=n).encode("ascii"))
        since = len(self.station.ask("state")["events"])
        part_kg, asked_ns = 0.0, 0
        z, bias_z, answers_s = list[float](), list[float](), list[float]()
        words = Counter[str]()
        while True:
            state = self.station.ask("state")
            for event in state["events"][since:]:
                word, _, rest = event["why"].partition(" ")
                values = [float(x) for x in re.findall(r"-?\d[\d.]*(?:e-?\d+)?", rest)]
                if event["what"] != "textmsg":
                    continue
                if word == "zero":
                    words[f"zero {values[0]:.0f}"] += 1
                    reference, since_s = self.stream.reference()
                    hours = (self.stream.clock.now_ns() - begin_ns) / 3.6e12
                    error_N = reference.parameters.force_bias_N - (truth["force_bias_N"] + hours * DRIFT_N_H)
                    sigma_N = np.sqrt(np.diag(reference.covariance)[6:9] + drift_since(since_s)[:3] ** 2)
                    bias_z += (error_N / sigma_N).tolist()
                elif word == "grasp":
                    part_kg = float(rng.uniform(0.1, 3.0))
                    com_m = 2 * tool_com_m + rng.uniform(-0.02, 0.02, 3)
                    joined = (tool_kg * tool_com_m + part_kg * com_m) / (tool_kg + part_kg)
                    self.station.ask("payload-shift", mass_kg=tool_kg + part_kg, p_sensor_com_m=joined.tolist())
                elif word == "request":
                    asked_ns = event["t_host_ns"]
                elif word == "weight":
                    words[f"weight {values[0]:.0f}"] += 1
                    if values[0] == 0:
                        z.append((values[1] - part_kg) / values[2])
                        click.echo(
                            f"{part_kg:.4f} kg: {1e3 * (values[1] - part_kg):+.2f} g, {z[-1]:+.1f} sigma", err=True
                        )
                        answers_s.append((event["t_host_ns"] - asked_ns) * 1e-9)
                elif word == "touch":
                    push = rng.normal(size=3) * [1, 1, 0.2]
                    wrench = [*(8 * push / np.linalg.norm(push)).tolist(), 0.0, 0.0, 0.0]
                    self.station.ask("push", wrench=wrench, axes="base", seconds=0.9)
                elif word == "release":
                    self.station.ask("push", wrench=[0.0] * 6)
                    self.station.ask("payload-shift", mass_kg=tool_kg, p_sensor_com_m=tool_com_m.tolist())
                elif word in ("held", "carried", "touched"):
                    words[f"{word} {values[0]:.0f}"] += 1
                elif word == "empty":
                    words[f"empty {values[0]:.0f} {'nothing' if values[1] == 0 else 'something'}"] += 1
            since = len(state["events"])
            if state["runtime_state"] == "STOPPED" and words["zero 0"]:
                break
            self.stream.clock.sleep(0.05)
        return {
            "weighed": len(z),
            "worst error / sigma": float(np.abs(z).max()),
            "rms error / sigma": float(np.sqrt(np.mean(np.square(z)))),
            "answer s median, largest": (float(np.median(answers_s)), max(answers_s)),
            "bias worst / sigma": float(np.abs(bias_z).max()),
            "bias rms / sigma": float(np.sqrt(np.mean(np.square(bias_z)))),
            "events": dict(sorted(words.items())),
        }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--cycles", type=int, default=50)
    options = parser.parse_args()
    with Station(*OPTIONS) as station, opened(station.hello) as stream:
        bench = Bench(station, service_on(stream), stream)
        stream.clock.sleep(3.0)
        found = bench.registers(options.seconds)
        click.echo(found)
        good = found["rate Hz"] >= 125 and found["age p95 ms"] <= 8 and not found["largest difference to the stream"]
        if options.cycles:
            cycles = bench.cycles(options.cycles, 1)
            click.echo(cycles)
            n = options.cycles
            clean = {"zero 0": n, "weight 0": n, "held 2": n, "carried 0": n, "touched 1": n, "empty 0 nothing": n}
            good &= cycles["events"] == clean
            good &= cycles["worst error / sigma"] < 3 and cycles["bias worst / sigma"] < 3
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
