"""Taking control of an arm: checks, control path, and the control program."""

import logging
import platform
import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import Diagnosis
from ftdrivers.ur import control_process, primary, script_control
from ftdrivers.ur.control import Control, ControlPath, ControlSetting, ProgramRefused
from ftdrivers.ur.control_process import ControlProcess
from ftdrivers.ur.primary import find_program_port
from ftdrivers.ur.reading import Reader
from ftdrivers.ur.rtde import registers_in_use, registers_taken
from ftdrivers.ur.sample import PROGRAM_STOPPED
from ftdrivers.ur.script_control import ScriptControl
from ftdrivers.ur.services import POLYSCOPE_X, Services, ServicesOf
from ftdrivers.ur.timing import UrTiming

log = logging.getLogger(__name__)


class OwnProgram:
    """Record of whether the control program may still run; ends it through dashboard server or Robot API."""

    def __init__(self, timing: UrTiming) -> None:
        self._timing = timing
        self._services: ServicesOf | None = None
        self._starting = False  # true after sending, until it has started: a stop may come before the start
        self._stops_itself = False
        self._stop_wanted = threading.Event()  # set while an attempt to stop runs in the background
        self.left_behind = False
        """Whether the control program of this object may still run on the controller."""

    def is_sent(self, services: ServicesOf, *, stops_itself: bool) -> None:
        """Remember that the program was sent to the controller, where `services` can end it."""
        self._services, self._stops_itself = services, stops_itself
        self.left_behind = self._starting = True

    def has_started(self) -> None:
        """Remember that the control program has started to run."""
        self._starting = False

    def is_stopped(self) -> None:
        """Remember that no program runs. A later one is that of another client, unless ours has not started yet."""
        self.left_behind = self._starting

    def is_gone(self) -> None:
        """Remember that the program was rejected, has ended or was replaced."""
        self.left_behind = self._starting = False

    def cancel_stop(self) -> None:
        """Cancel attempts in the background to stop the program, which would stop the next one."""
        self._stop_wanted.clear()

    def stop(self, *, silent: bool = False) -> None:
        """End the program. After a time-out the attempt continues in the background. Never raises `DeviceError`."""

        def stop(services: Services) -> None:
            if self._stop_wanted.is_set():
                services.stop()

        if self._services is None:
            return
        self._stop_wanted.set()
        limit_s = self._timing.stop_silent_s if silent else self._timing.stop_s
        try:
            self._services.ask(stop, timeout_s=limit_s, connect_s=self._timing.reach_s)
            self.left_behind = self._starting
        except DeviceError as error:
            if self._stops_itself:
                log.info("the stop was not sent, but the control program stops the arm without it: %s", error)
            else:
                host = self._services.host
                log.warning("%s did not receive the stop; press the emergency stop if it moves: %s", host, error)


SIMULATORS: Final = ("localhost", "127.0.0.1", "192.168.56.101")
"""Addresses of URSim, for which ur_rtde does not require remote control."""
# Oldest minor version of each major version that has what a path needs: ur_rtde's script, or registers and Robot API.
_LEAST: Final[dict[ControlPath, dict[int, int]]] = {"ur-rtde": {3: 4, 5: 4}, "script": {3: 9, 5: 3, POLYSCOPE_X: 11}}
_LOCAL: Final = (
    "press Local, Remote Control at the top right of the pendant (enable it first under Settings, System, Remote "
    "Control)"
)
_LOCAL_X: Final = "set Control mode to Remote in the Safety overview of the pendant"


def path_for(setting: ControlSetting, version: tuple[int, ...]) -> tuple[ControlPath, str]:
    """Return the control path and the reason for the choice."""
    # The path ur-rtde needs a dashboard server, which PolyScope X does not have.
    if setting != "auto":
        return setting, "as configured"
    if version[0] >= POLYSCOPE_X:
        return "script", "PolyScope X has no dashboard server, which ur_rtde needs"
    if find_spec("rtde_control") is None:
        return "script", "ur_rtde is not installed"
    return "ur-rtde", "ur_rtde is installed"


@dataclass(frozen=True, slots=True)
class Opening:
    """Takes control of the arm that `reader` reads: checks, then start of the control program."""

    host: str
    setting: ControlSetting
    reader: Reader
    program: OwnProgram
    stop_rad_s2: float
    clock: Clock
    timing: UrTiming

    @property
    def path(self) -> ControlPath:
        """Name of the control path of this arm: "ur-rtde" or "script"."""
        return path_for(self.setting, self.reader.version)[0]

    def open(self) -> Control:
        """Start the control program. Another program is never stopped, unless the same object started it.

        Raises `ConnectError` if the start fails, for example in a safety stop, and the exceptions of the reader.
        """
        self._look_out()
        path, why = path_for(self.setting, self.reader.version)
        log.info("%s is controlled through %s: %s", self.host, path, why)
        self.require_path()
        self.require_version()
        self.require_port()
        self.require_registers()
        self.program.cancel_stop()  # a pending background stop would end the new program
        self.reader.services.ask(self._prepare, timeout_s=self.timing.connect_s)
        self._require_no_program()
        control = self._start(path)
        self.program.is_sent(self.reader.services, stops_itself=control.stops_itself)
        try:
            control.wait_until_ready(self._look_out)
        except ProgramRefused:
            control.kill()
            self.program.is_gone()
            self._look_out()  # the controller may report the reason, which the control path seldom knows
            raise
        except (StreamBroken, DeviceTimeout) as error:
            control.kill()
            self._look_out()
            raise _refusal(self.host, path, error) from error
        except BaseException:
            control.kill()
            raise
        self.program.has_started()
        return control

    def diagnose(self) -> list[Diagnosis]:
        """Check the requirements of control, without changing anything."""

        def diagnosis(name: str, require: Callable[[], None], found: str) -> Diagnosis:
            try:
                require()
            except DeviceError as error:
                return Diagnosis(name, False, error.found, error.fix)
            return Diagnosis(name, True, found)

        path, why = path_for(self.setting, self.reader.version)
        stops = (
            "; its program begins to brake within 0.3 s if the computer or the network fails"
            if path == "script"
            else "; if the computer or the network fails, the arm finishes its current move"
        )
        version = "PolyScope {}.{} can be controlled".format(*self.reader.version)
        free = "the RTDE registers are free: no other client controls the arm"
        return [
            diagnosis("control", self.require_path, f"control path {path}: {why}{stops}"),
            diagnosis("version", self.require_version, version),
            diagnosis("registers", self.require_registers, free),
            diagnosis("programs", self.require_port, f"port {self._port}, which accepts programs, is open"),
        ]

    def require_path(self) -> None:
        """Raise `ConnectError` if ur_rtde is configured but cannot be used."""
        if self.path != "ur-rtde":
            return
        if self.reader.version[0] >= POLYSCOPE_X:
            raise ConnectError(
                f"{self.host} runs PolyScope X, which has no dashboard server, and ur_rtde needs one",
                "select the control path script or auto",
            )
        if find_spec("rtde_control") is None:
            raise ConnectError(
                f"ur_rtde is not installed for Python {platform.python_version()} on {platform.system()} "
                f"{platform.machine()}",
                "select the control path script or auto, or use CPython 3.11 or 3.12 on 64-bit x86 Linux, for which "
                "ur_rtde has wheels",
            )

    def require_version(self) -> None:
        """Raise `ConnectError` for a version of PolyScope that can be read but not controlled."""
        major, minor = self.reader.version[:2]
        least = _LEAST[self.path].get(major, 0)
        if minor < least:
            raise ConnectError(
                f"{self.host} runs PolyScope {major}.{minor}, which cannot be controlled through {self.path}",
                f"update it to {major}.{least} or later",
            )

    def require_port(self) -> None:
        """Raise `ConnectError` if the port that accepts programs is closed."""
        find_program_port(self.host, self._port, timeout_s=self.timing.connect_s)

    def require_registers(self) -> None:
        """Raise `ConnectError` if another client owns the registers. It is called before any program is stopped."""
        inputs = control_process.INPUTS if self.path == "ur-rtde" else tuple(script_control.INPUTS)
        deadline_s = self.clock.now_s() + self.timing.release_s
        while taken := registers_in_use(self.host, inputs, timeout_s=self.timing.connect_s, clock=self.clock):
            if self.clock.now_s() > deadline_s:
                raise registers_taken(self.host, taken)
            self.clock.sleep(0.05)

    @property
    def _port(self) -> int:
        return control_process.PROGRAM_PORT if self.path == "ur-rtde" else primary.PORT

    def _start(self, path: ControlPath) -> Control:
        if path == "script":
            return ScriptControl(self.host, self.reader.version, self.stop_rad_s2, clock=self.clock, timing=self.timing)
        return ControlProcess(self.host, self.stop_rad_s2, clock=self.clock, timing=self.timing)

    def _look_out(self) -> None:
        if fault := self.reader.look().safety_fault():
            raise ConnectError(f"the arm at {self.host} cannot move: {fault.found}", fault.fix)

    def _prepare(self, services: Services) -> None:
        """Check that the controller accepts programs, and end a control program that this object has left there."""
        version = self.reader.version
        asks = version[:2] >= (5, 6) and self.host not in SIMULATORS
        if asks and services.in_remote_control() is False:
            fix = _LOCAL_X if version[0] >= POLYSCOPE_X else _LOCAL
            raise ConnectError(f"{self.host} is not in remote control", fix)
        if self.program.left_behind and self.reader.look().program_state != PROGRAM_STOPPED:
            log.warning("%s is still running our earlier control program; stopping it", self.host)
            services.stop()

    def _require_no_program(self) -> None:
        """Raise `ConnectError` if a program stays on the controller, which the control program would replace."""
        # A control program whose process was killed cannot be distinguished from a program of another client, which
        # could react to its registers. Therefore no program is stopped here.
        deadline_s = self.clock.now_s() + self.timing.release_s
        while self.reader.look().program_state != PROGRAM_STOPPED:
            if self.clock.now_s() > deadline_s:
                program = self.reader.reported_program()
                raise ConnectError(
                    f"another program is active on {self.host}{f' ({program})' if program else ''} and is not stopped "
                    "automatically",
                    "stop it on the pendant, then start again",
                )


def _refusal(host: str, path: ControlPath, error: DeviceError) -> ConnectError:
    """Return the error to raise if a control path did not start, with a fix."""
    return ConnectError(
        f"{path} cannot control {host}: {error.found}",
        "check on the pendant that it is in remote control, that no dialog is open, and that no other program starts "
        "automatically or uses the RTDE registers, such as EtherNet/IP",
    )
