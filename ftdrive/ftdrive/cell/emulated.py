"""An emulated cell as a child process, with which the real drivers communicate over real interfaces."""

import atexit
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Self

from ftcalib.sampling import Sampling
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig, check_value, settings
from ftdrive.errors import ConfigError
from ftdrivers import sensors
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError

# The emulated arm is this many times faster than a real one, which is the only difference from a real cell.
TIME_SCALE = 20
# Options of an emulated cell whose arm moves at real speed, as a recording in motion needs.
REAL_PACE = ("--time-scale", "1")
_PERFECT = ("--gain", "0", "--cross-talk", "0")

# Sensors of an emulated cell, for `Station(NAME)`, or with the address emulated://NAME for a sensor alone.
SENSORS = {name: text for kind in sensors.SENSORS.values() for name, text in kind.emulated.items()}
EMULATED = "emulated://"
# By mode in which a session does not move the arm: the request that lets an emulated arm move, and its description.
MOVED_BY: Mapping[str, tuple[Mapping[str, Any], str]] = {
    "manual": ({"do": "hand-guide"}, "its arm is guided by hand to several orientations"),
    "passive": ({"do": "production"}, "a production program picks up, places and touches objects"),
    "listen": ({"do": "pendant-program"}, "a program on its pendant turns the wrist"),
}

TOOL_MM = (0.0, 200.0, 100.0)


class Station:
    """A process of `mocks`, which ends with its `with` block or with this process.

    Entering the block raises `ConfigError` on a system other than Linux. `sensor` is one of `SENSORS`, "both" (can and
    serial) or "none"; `options` are further options of `python -m ftmocks station`; `control_path` is as in
    `[robot] control`. The `values`, by key such as "tool.name", replace those of the default emulated cell.
    """

    def __init__(
        self,
        sensor: str = "can",
        options: Sequence[str] = (),
        *,
        control_path: str = "auto",
        values: Mapping[str, Any] = {},
    ) -> None:
        self.sensor = sensor
        self.options = tuple(options)
        self.control_path = control_path
        self.values = dict(values)
        self.endpoints: Mapping[str, Any] = {}
        self.clock: Clock = REAL
        """Clock of the emulated cell once it has started; before that, the computer's clock."""
        self._process: subprocess.Popen[str] | None = None

    @classmethod
    def of(
        cls,
        made_by: Mapping[str, Any] | None,
        sensor: str | None = None,
        options: Sequence[str] = (),
        *,
        control_path: str | None = None,
    ) -> Self:
        """Return the station that a run or a calibration records as its `station`, not started.

        If `made_by` is None, the station is that of the configuration if `[robot] simulate` is true there, else the
        default one. An address emulated://NAME in `sensor` replaces its sensor, and `control_path` its control path;
        `options` are appended to its options.
        """
        made_by = made_by or _configured(sensor)
        name = sensor_name(sensor) if sensor else made_by.get("sensor", sensor_name(None))
        path = control_path or made_by.get("control_path", "auto")
        values = {key: check_value("the run", key, value) for key, value in made_by.get("values", {}).items()}
        own = tuple(made_by.get("options", ()))
        # A record without sensor errors is from an earlier version, whose emulated sensors were perfect by default.
        if "truth" in made_by and not any(map(any, made_by["truth"].get("sensor_error", ()))):
            own = (*_PERFECT, *own)
        return cls(name, (*own, *options), control_path=path, values=values)

    def __enter__(self) -> Self:
        if sys.platform != "linux":
            raise ConfigError(
                f"an emulated cell needs Linux, but this is {platform.system()}: leave --simulate out and use "
                "recorded data"
            )
        from ftdrive.cell.emulated_clock import EmulatedClock

        command = [sys.executable, "-P", "-m", "ftmocks", "station", "--sensor", self.sensor]
        command += ["--time-scale", str(TIME_SCALE), *self.options]
        # In a new session, so that Ctrl-C in the terminal does not reach the emulated cell.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self.endpoints = self._answer()
        self.clock = EmulatedClock(self.endpoints["clock"])
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is None:
            return
        process, self._process = self._process, None
        try:
            process.communicate(timeout=3)  # closes its stdin, which ends the process
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()

    @property
    def truth(self) -> Mapping[str, Any]:
        """True parameters of this emulated cell, which a calibration estimates."""
        truth: Mapping[str, Any] = self.endpoints["truth"]
        return truth

    @property
    def description(self) -> dict[str, Any]:
        """Entry of run.json about the station, from which `of` returns the same station."""
        made_by = {"sensor": self.sensor, "options": self.options, "control_path": self.control_path}
        return {"station": {**made_by, "values": self.values, "truth": self.truth}}

    @property
    def pid(self) -> int:
        """Process id of the station; 0 if it does not run."""
        return self._process.pid if self._process else 0

    def control(self, **request: Any) -> Mapping[str, Any]:
        """Send the emulated cell one request, such as `do="unplug", device="sensor"`, and return its answer."""
        if self._process and self._process.stdin:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def start_mover(self, mode: str, say: Callable[[str], object]) -> None:
        """Let the cell move its own arm in a mode without motion commands; `say` receives a sentence about it."""
        if mover := MOVED_BY.get(mode):
            request, words = mover
            self.control(**request)
            say(f"The cell is emulated: {words}.")

    def _answer(self) -> Mapping[str, Any]:
        line = self._process.stdout.readline() if self._process and self._process.stdout else ""
        if not line:
            raise ConnectError("the emulated cell has ended: read its last message above")
        answer: Mapping[str, Any] = json.loads(line)
        return answer

    @property
    def mounting(self) -> str:
        """Mounting of the base, as set by the options."""
        return self.options[self.options.index("--mount") + 1] if "--mount" in self.options else "floor"

    @property
    def cell(self) -> CellConfig:
        """Configuration with which drivers reach this station like a real cell."""
        arm = self.endpoints["arm"]
        url = next(iter(self.endpoints["sensors"].values()))["url"]
        truth = self.truth
        usual = CellConfig(
            robot=RobotConfig(
                arm["host"],
                arm["model"],
                speed_deg_s=60.0,
                acceleration_deg_s2=80.0,
                control=self.control_path,
                api_port=arm.get("api_port", 80),
            ),
            sensor=SensorConfig(url, height_mm=1e3 * truth["p_flange_sensor_m"][2], mass_kg=truth["sensor_mass_kg"]),
            tool=ToolConfig("emulated", (TOOL_MM,)),
            workcell=WorkcellConfig(self.mounting, measured=True),
            sampling=Sampling(average_s=0.4, noise_record_s=0.0),
            clock=self.clock,
        )
        return _with_values(usual, self.values)


# Keys that an emulated cell takes from a configuration, besides the true values that `_options` sets.
_OF_FILE = (
    *("robot.speed_deg_s", "tool.name", "tool.cylinders_mm", "tool.mass_kg"),
    *("workcell.mounting", "workcell.planes_mm", "workcell.boxes_mm"),
)


def _configured(sensor: str | None) -> Mapping[str, Any]:
    """Return the station of the configuration, as a run records it; empty if its cell is not emulated."""
    configured = settings()
    if not configured["robot.simulate"].value:
        return {}
    values = {key: setting.value for key, setting in configured.items() if setting.value is not None}
    name = sensor_name(sensor or values.get("sensor.url"))
    chosen = {key: values[key] for key in _OF_FILE if key in values}
    return {"sensor": name, "options": _options(values, name), "values": chosen}


def _options(values: Mapping[str, Any], sensor: str) -> tuple[str, ...]:
    """Return options with which an emulated cell has the masses, sensor height and mounting of a configuration."""
    options = list[str]()
    if "tool.mass_kg" in values:
        options += ["--mass", str(values["tool.mass_kg"])]
    if "sensor.height_mm" in values:
        options += ["--sensor-origin", f"0,0,{values['sensor.height_mm'] / 1e3}"]
    if "sensor.mass_kg" in values and sensor != "ur-ft":  # the sensor "ur-ft" is part of the arm
        options += ["--sensor-mass-kg", str(values["sensor.mass_kg"])]
    mounting = values.get("workcell.mounting", "floor")
    if mounting in {"floor", "wall", "ceiling"}:
        return (*options, "--mount", mounting)
    return (*options, "--mount", "floor", "--tilt-deg", f"0,{mounting}")


def _with_values(cell: CellConfig, values: Mapping[str, Any]) -> CellConfig:
    for key, value in values.items():
        section, name = key.split(".")
        cell = replace(cell, **{section: replace(getattr(cell, section), **{name: value})})
    return cell


def sensor_reached(url: str, clock: Clock = REAL) -> tuple[str, Clock]:
    """Return address and clock for a driver; for emulated://NAME those of an emulated sensor, which is started once.

    The orientation of the sensor is constant; emulated:// alone is an ATI sensor on CAN. Any other address is returned
    unchanged with the given clock. Raises `ConfigError` for an unknown name.
    """
    if not url.startswith(EMULATED):
        return url, clock
    cell = emulated_cell(url)
    return cell.sensor.url, cell.clock


def emulated_cell(url: str) -> CellConfig:
    """Return the cell of emulated://NAME, which ends with this process. Raises `ConfigError` for an unknown name."""
    return _emulated_alone(sensor_name(url))


def sensor_name(url: str | None) -> str:
    """Return the name in emulated://NAME, by default the first sensor. Raises `ConfigError` for an unknown name."""
    name = (url or EMULATED).removeprefix(EMULATED) or next(iter(SENSORS))
    if name not in SENSORS:
        known = ", ".join(EMULATED + name for name in SENSORS)
        real = (
            "" if (url or "").startswith(EMULATED) else f"; to show a real sensor:\nftdrive live --sensor {url} --raw"
        )
        raise ConfigError(f"{url} is not an emulated sensor: leave --sensor out, or give one of {known}{real}")
    return name


@cache
def _emulated_alone(name: str) -> CellConfig:
    """Start a cell with a resting arm, which ends with this process; return its configuration."""
    station = Station(name, ["--time-scale", "1"])
    atexit.register(station.__exit__)
    return station.__enter__().cell
