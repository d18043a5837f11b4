"""An emulated cell as a child process; the real drivers reach it over real wires."""

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

# The emulated arm moves this many times faster; nothing else differs from a real cell.
TIME_SCALE = 20
# Options of a cell whose arm is recorded in motion.
REAL_PACE = ("--time-scale", "1")
_PERFECT = ("--gain", "0", "--cross-talk", "0")

# Sensors an emulated cell can have: `Station(NAME)`, or the address emulated://NAME for one without an arm.
SENSORS = {name: text for kind in sensors.SENSORS.values() for name, text in kind.emulated.items()}
EMULATED = "emulated://"
# How the emulated arm moves in modes in which the session does not move it: the request to the cell, and words.
MOVED_BY: Mapping[str, tuple[Mapping[str, Any], str]] = {
    "manual": ({"do": "hand-guide"}, "its arm is guided by hand from orientation to orientation"),
    "passive": ({"do": "production"}, "a production program picks, places and touches"),
    "listen": ({"do": "pendant-program"}, "a program is started on its pendant, which turns the wrist"),
}

TOOL_MM = (0.0, 200.0, 100.0)


class Station:
    """One `mocks` process, ended by leaving its `with` block or by the end of ours.

    Its `with` block raises `ConfigError` on another system than Linux. `sensor` is one of `SENSORS`, "both" (can and
    serial) or "none"; `options` are more of `python -m ftmocks station`; `control_path` is as `[robot] control`.
    `values` of the configuration, by key such as "tool.name", replace those of the usual emulated cell.
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
        """The cell's own, once it has started."""
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
        """Describe the station that a run or a calibration names as its `station`; not started.

        Without one it is that of the configuration if `[robot] simulate` is true there, else the usual one. An address
        emulated://NAME in `sensor` replaces its sensor, and `control_path` its control path; `options` come after its
        own.
        """
        made_by = made_by or _configured(sensor)
        name = sensor_name(sensor) if sensor else made_by.get("sensor", sensor_name(None))
        path = control_path or made_by.get("control_path", "auto")
        values = {key: check_value("the run", key, value) for key, value in made_by.get("values", {}).items()}
        own = tuple(made_by.get("options", ()))
        # Emulated sensors were perfect by default before.
        if "truth" in made_by and not any(map(any, made_by["truth"].get("sensor_error", ()))):
            own = (*_PERFECT, *own)
        return cls(name, (*own, *options), control_path=path, values=values)

    def __enter__(self) -> Self:
        if sys.platform != "linux":
            raise ConfigError(
                f"an emulated cell needs Linux, and this is {platform.system()}: use recorded data, without --simulate"
            )
        from ftdrive.cell.emulated_clock import EmulatedClock

        command = [sys.executable, "-P", "-m", "ftmocks", "station", "--sensor", self.sensor]
        command += ["--time-scale", str(TIME_SCALE), *self.options]
        # A session of its own: Ctrl-C in the terminal is for us, not for the emulated cell.
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
            process.communicate(timeout=3)  # closes its stdin, which ends it
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()

    @property
    def truth(self) -> Mapping[str, Any]:
        """The values that a perfect calibration of this cell finds."""
        truth: Mapping[str, Any] = self.endpoints["truth"]
        return truth

    @property
    def description(self) -> dict[str, Any]:
        """What run.json contains about it; `of` describes the same station again."""
        made_by = {"sensor": self.sensor, "options": self.options, "control_path": self.control_path}
        return {"station": {**made_by, "values": self.values, "truth": self.truth}}

    @property
    def pid(self) -> int:
        """Process number while the station lives."""
        return self._process.pid if self._process else 0

    def control(self, **request: Any) -> Mapping[str, Any]:
        """Send one request, such as `do="unplug", device="sensor"`, and return the answer."""
        if self._process and self._process.stdin:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def start_mover(self, mode: str, say: Callable[[str], object]) -> None:
        """Let the cell move its arm, in a mode in which the session does not move it; `say` takes a sentence."""
        if mover := MOVED_BY.get(mode):
            request, words = mover
            self.control(**request)
            say(f"The cell is emulated: {words}.")

    def _answer(self) -> Mapping[str, Any]:
        line = self._process.stdout.readline() if self._process and self._process.stdout else ""
        if not line:
            raise ConnectError("the emulated cell has ended: read its message above")
        answer: Mapping[str, Any] = json.loads(line)
        return answer

    @property
    def mounting(self) -> str:
        """As set by its options."""
        return self.options[self.options.index("--mount") + 1] if "--mount" in self.options else "floor"

    @property
    def cell(self) -> CellConfig:
        """Configuration that reaches this station as it would reach a real cell."""
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


# What an emulated cell takes from a configuration, beside the truth that `_options` sets.
_OF_FILE = (
    *("robot.speed_deg_s", "tool.name", "tool.cylinders_mm", "tool.mass_kg"),
    *("workcell.mounting", "workcell.planes_mm", "workcell.boxes_mm"),
)


def _configured(sensor: str | None) -> Mapping[str, Any]:
    """Return the station that the configuration describes, as a run names it; nothing if its cell is not emulated."""
    found = settings()
    if not found["robot.simulate"].value:
        return {}
    values = {key: one.value for key, one in found.items() if one.value is not None}
    name = sensor_name(sensor or values.get("sensor.url"))
    chosen = {key: values[key] for key in _OF_FILE if key in values}
    return {"sensor": name, "options": _options(values, name), "values": chosen}


def _options(values: Mapping[str, Any], sensor: str) -> tuple[str, ...]:
    """Return the options that give a station the masses, the height and the mounting of a configuration."""
    options = list[str]()
    if "tool.mass_kg" in values:
        options += ["--mass", str(values["tool.mass_kg"])]
    if "sensor.height_mm" in values:
        options += ["--sensor-origin", f"0,0,{values['sensor.height_mm'] / 1e3}"]
    if "sensor.mass_kg" in values and sensor != "ur-ft":  # that one is part of the arm
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
    """Return address and clock for a driver: for emulated://NAME those of a sensor, which is started once.

    Its orientation is constant; emulated:// alone is an ATI sensor on CAN. Any other address keeps the given clock.
    Raises `ConfigError` for an unknown name.
    """
    if not url.startswith(EMULATED):
        return url, clock
    cell = emulated_cell(url)
    return cell.sensor.url, cell.clock


def emulated_cell(url: str) -> CellConfig:
    """Return the cell of emulated://NAME, which lives as long as this process. Raises `ConfigError`."""
    return _emulated_alone(sensor_name(url))


def sensor_name(url: str | None) -> str:
    """Return the name in emulated://NAME, by default the first one. Raises `ConfigError`."""
    name = (url or EMULATED).removeprefix(EMULATED) or next(iter(SENSORS))
    if name not in SENSORS:
        known = ", ".join(EMULATED + name for name in SENSORS)
        real = (
            "" if (url or "").startswith(EMULATED) else f"; a real one is shown by\nftdrive live --sensor {url} --raw"
        )
        raise ConfigError(f"{url} is not an emulated sensor: leave --sensor out, or give one of {known}{real}")
    return name


@cache
def _emulated_alone(name: str) -> CellConfig:
    """Start a cell whose arm rests, for the life of this process."""
    station = Station(name, ["--time-scale", "1"])
    atexit.register(station.__exit__)
    return station.__enter__().cell
