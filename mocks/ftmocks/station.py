"""A robot cell in one process: a UR controller and a wrist sensor that share one physical world.

The process prints one JSON line when all servers listen, then one JSON line for each line of standard input.
"""

import contextlib
import json
import math
import os
import selectors
import signal
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ftmocks import factory_kinematics
from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.imperfections import WRIST_DRIFT_N, Imperfections
from ftmocks.inertia import inertia_tensor
from ftmocks.kinematics import MODELS, Dh, Vector6, rotation, vector3, vector6
from ftmocks.recording import RecordedArm, RecordedWorld, Recording
from ftmocks.sensor_errors import CROSS_TALK_PERCENT, GAIN_PERCENT, PERFECT, SensorErrors
from ftmocks.sensors.catalogue import KINDS, WRIST, Sensor, parse_settings
from ftmocks.ur.operator import Operator
from ftmocks.ur.robot import INSTALLED_G_M_S2, Robot, RobotSettings
from ftmocks.ur.server import API_PORT, UrServer
from ftmocks.workcell import Workcell
from ftmocks.world import MOUNTS_RAD, Truth, World, up_of

FORMAT = "mocks.station/1"
HOST_TRIALS = 20
LONGEST_DELAY_MS = 1000
WITHOUT_EFFECT_ON_A_RECORDING = {
    *("payload-shift", "hang", "grip", "unhang"),
    *("push-joint", "hand-guide", "slider", "speed-scaling"),
}

START_Q_DEG = (45.0, -100.0, 60.0, -50.0, 90.0, 45.0)
"""Default start posture, near the first pose of the tour: q4 = -90° - q2 - q3."""

SENSOR_MASS_KG = 0.25
"""Default mass of a sensor with its adapter."""

START_SCATTER_DEG = 5.0
"""Largest random offset of the wrist at the start, which makes the arm move to the first pose."""


VECTORS = {
    "com": "p_sensor_com_m",
    "sensor_origin": "p_flange_sensor_m",
    "force_bias": "force_bias_N",
    "torque_bias": "torque_bias_Nm",
    "force_drift": "force_drift_N_min",
    "torque_drift": "torque_drift_Nm_min",
}
"""Names of the command-line options for the vectors of the true parameters."""


def truth_from(options: Namespace) -> Truth:
    """Draw the true quantities from the seed, then replace those that are given on the command line."""
    truth = Truth.drawn(options.seed, options.mount)
    if options.sensor == WRIST:
        truth = truth.with_wrist_sensor(options.seed)
    elif options.sensor in KINDS:
        force_scale, torque_scale = KINDS[options.sensor].bias_scale
        truth = replace(
            truth, force_bias_N=force_scale * truth.force_bias_N, torque_bias_Nm=torque_scale * truth.torque_bias_Nm
        )
    if options.recording is not None:  # a recording already contains bias and noise
        nothing = np.zeros(3)
        truth = replace(truth, force_bias_N=nothing, torque_bias_Nm=nothing, noise_force_N=0.0, noise_torque_Nm=0.0)
    given = {name: getattr(options, option) for option, name in VECTORS.items()}
    changes: dict[str, Any] = {name: np.array(vector) for name, vector in given.items() if vector is not None}
    if options.mass is not None:
        changes["mass_kg"] = options.mass
    if options.sensor_rotvec_deg is not None:
        changes["R_flange_sensor"] = rotation(np.radians(options.sensor_rotvec_deg))
    if options.tilt_deg is not None:
        alpha, beta = np.radians(options.tilt_deg).tolist()
        changes["tilt_alpha_rad"] = alpha
        changes["tilt_beta_rad"] = math.remainder(MOUNTS_RAD[options.mount] + beta, 2 * math.pi)
    if options.inertia is not None:
        changes["gyration_m2"] = _gyration(options.inertia, changes.get("mass_kg", truth.mass_kg))
    changes["sensor_mass_kg"] = _sensor_mass_kg(options)
    if options.noise is not None:
        changes["noise_force_N"], changes["noise_torque_Nm"] = options.noise
    if options.sensor == WRIST and options.sensor_rotvec_deg is not None:
        raise ValueError(f"the axes of {WRIST} are those of the flange: leave --sensor-rotvec-deg out")
    return replace(truth, **changes, sensor_errors=_sensor_errors(options))


def _sensor_errors(options: Namespace) -> SensorErrors:
    """Draw the errors of the sensor. The readings of a recording contain the errors of its sensor already."""
    gain, cross_talk, nonlinear = options.gain, options.cross_talk, options.nonlinear
    if options.recording is not None:
        if gain or cross_talk or nonlinear:
            raise ValueError("--recording has the errors of its sensor: leave --gain, --cross-talk, --nonlinear out")
        return PERFECT
    gain = GAIN_PERCENT if gain is None else gain
    cross_talk = CROSS_TALK_PERCENT if cross_talk is None else cross_talk
    sizes = [1e-2 * percent for percent in (gain, cross_talk, nonlinear)]
    return SensorErrors.drawn(options.seed, *sizes) if any(sizes) else PERFECT


def _gyration(inertia: str, mass_kg: float) -> Array | None:
    """Return the inertia tensor per mass according to --inertia; None for "none"."""
    if inertia == "none":
        return None
    tensor = inertia_tensor(parse_vector(inertia, 6))
    if tensor.any() and not mass_kg > 0.0:
        raise ValueError(f"--inertia: a payload of {mass_kg} kg has no inertia tensor: set --mass too")
    return tensor / (mass_kg or 1.0)


def _sensor_mass_kg(options: Namespace) -> float:
    """Return the mass of sensor and adapter, which is 0 for the sensor in the arm's wrist."""
    if options.sensor == WRIST:
        if options.sensor_mass_kg:
            raise ValueError(f"the sensor {WRIST} is part of the arm: leave --sensor-mass-kg out")
        return 0.0
    return SENSOR_MASS_KG if options.sensor_mass_kg is None else float(options.sensor_mass_kg)


def _recording(options: Namespace) -> Recording | None:
    if options.recording is None:
        if options.pace is not None:
            raise ValueError("--pace needs --recording")
        return None
    if options.time_scale != 1.0 or options.start_q_deg is not None:
        raise ValueError("--recording provides time and joints: leave --time-scale and --start-q-deg out")
    try:
        return Recording.read(options.recording)
    except OSError as error:
        raise ValueError(f"cannot read the recording: {error}") from None


def kinematics_from(options: Namespace) -> Dh:
    """Return the real arm according to --kinematics: drawn from the seed, nominal, or from a file."""
    model = options.model or ("UR5" if options.polyscope[0] <= 3 else "UR5e")
    if options.kinematics == "drawn":
        return factory_kinematics.drawn(model, options.seed)
    if options.kinematics == "ideal":
        return MODELS[model]
    dh = factory_kinematics.read(Path(options.kinematics))
    if options.model not in (None, dh.model):
        raise ValueError(f"--model {options.model}: the arm in {options.kinematics} is a {dh.model}")
    return dh


def start_posture(options: Namespace) -> Vector6:
    """Return joint angles at power-up, rad: as given, or near the first pose of the tour with a random wrist."""
    if options.start_q_deg is not None:
        return vector6(np.radians(options.start_q_deg))
    scatter = np.random.default_rng([options.seed, 3]).uniform(-START_SCATTER_DEG, START_SCATTER_DEG, 3)
    return vector6(np.radians(np.add(START_Q_DEG, [0.0, 0.0, 0.0, *scatter])))


def free_hosts() -> Iterator[str]:
    """Yield loopback addresses to try, which differ between processes."""
    rng = np.random.default_rng([os.getpid(), 4])
    yield f"127.{64 + os.getpid() // 64516 % 64}.{1 + os.getpid() // 254 % 254}.{1 + os.getpid() % 254}"
    for _ in range(HOST_TRIALS):
        a, b, c = rng.integers(1, 255, 3).tolist()
        yield f"127.{128 + a % 100}.{b}.{c}"


class Station:
    """The cell: world, controller, sensors, and the control channel.

    Parameters
    ----------
    options
        Parsed command line, see `ftmocks.__main__`.
    clock
        Clock of the cell; None creates one.
    """

    def __init__(self, options: Namespace, clock: CellClock | None = None) -> None:
        self._options = options
        self._sensor_options = parse_settings(options.sensor, options.sensor_setting)
        self._clock = clock or CellClock()
        dh = kinematics_from(options)
        options.model = dh.model
        truth = truth_from(options)
        self._recording = recording = _recording(options)
        if recording is None:
            usual = Imperfections(wrist_drift_N=WRIST_DRIFT_N) if options.sensor == WRIST else Imperfections()
            imperfections = usual.changed(options.imperfections)
            self.world = World(truth, dh, start_posture(options), options.seed, self._clock, imperfections)
        else:
            self.world = RecordedWorld(recording, truth, dh, options.seed, self._clock)
        self.robot = Robot(
            self.world,
            RobotSettings(
                model=options.model,
                polyscope=options.polyscope,
                serial_number=options.serial_number,
                tcp=vector6(options.tcp),
                payload_kg=truth.payload_kg if options.payload is None else options.payload,
                payload_cog_m=vector3(truth.payload_cog_m if options.payload_cog is None else options.payload_cog),
                gravity_m_s2=vector3(INSTALLED_G_M_S2 * up_of(0.0, MOUNTS_RAD[options.mount])),
                joint_limit_rad=math.radians(options.joint_limit_deg),
                plane=options.plane,
                unknown_outputs=frozenset({"tcp_offset"} if options.no_tcp_offset else ()),
                time_scale=options.time_scale,
            ),
            None if recording is None else RecordedArm(dh, recording),
        )
        if options.kinematics_message != "true":
            other = factory_kinematics.drawn(dh.model, options.seed + 1)
            self.robot.reported_dh = {"none": None, "wrong": other}[options.kinematics_message]
        self._selector = selectors.SelectSelector()  # other selectors cannot wait for less than 1 ms
        self.server = self._listen()
        self._sensors: dict[str, Sensor] = {}
        self._ended = False
        self._line = bytearray()
        self._verbs: dict[str, Callable[[dict[str, Any]], dict[str, Any] | None]] = {
            "state": self._state,
            "delay": self._delay,
            **Workcell(self.world, self._sensors, options.swing).verbs,
            **Operator(self.robot, self.server).verbs,
        }
        if recording is not None:
            self._verbs = {verb: do for verb, do in self._verbs.items() if verb not in WITHOUT_EFFECT_ON_A_RECORDING}
            self._verbs["recording"] = lambda request: self._play(recording, request)

    def run(self) -> int:
        """Serve until standard input closes or SIGTERM arrives; return the exit code."""
        sys.setswitchinterval(0.0005)  # the sensors' threads must not delay a control cycle
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        try:
            self._start_sensors()
            for request in (*self._delays(), *self._loads(), *self._options.do):
                if "error" in (answer := self._answer(request.encode())):
                    sys.stderr.write(f"--do {request}: {answer['error']}\n")
                    return 2
            if self._recording is not None:
                pace = 1.0 if self._options.pace is None else self._options.pace
                self._recording.play(self._clock.now_s(), 0.0, pace)
            self._selector.register(sys.stdin.fileno(), selectors.EVENT_READ, self._on_stdin)
            self._print(self._hello())
            self.server.run(lambda: self._ended)
        finally:
            for sensor in self._sensors.values():
                sensor.stop()
            self.server.close()
            self._clock.close()
        return 0

    def _on_signal(self, _number: int, _frame: object) -> None:
        self._ended = True

    def _listen(self) -> UrServer:
        if self._options.host is not None:
            return UrServer(self.robot, self._options.host, self._selector)
        for host in free_hosts():
            with contextlib.suppress(OSError):
                return UrServer(self.robot, host, self._selector)
        raise OSError(f"no free loopback address in {HOST_TRIALS} trials: is something listening on 0.0.0.0:30004?")

    def _start_sensors(self) -> None:
        wanted = {"both": ("can", "serial"), "none": ()}.get(self._options.sensor, (self._options.sensor,))
        if WRIST in wanted:
            robot = self.robot
            self.world.wrist_error = robot.wrist_error
            robot.wrist_sensor = lambda n: self.world.measure_at(np.full(n, robot.cycle_s))
        for name in wanted:
            self._sensors[name] = Sensor(
                name,
                self.world.measure_at,
                seed=self._options.seed,
                host=self.server.host,
                clock=self._clock,
                options=self._sensor_options,
            )

    def _hello(self) -> dict[str, Any]:
        sensors = {name: sensor.endpoint for name, sensor in self._sensors.items()}
        return {
            "format": FORMAT,
            "clock": self._clock.path,
            "arm": {
                "host": self.server.host,
                **({"api_port": API_PORT} if API_PORT in self.server.ports else {}),
                "model": self._options.model,
                "serial_number": self._options.serial_number,
                "kinematics": {name: getattr(self.world.dh, name) for name in ("theta", "a", "d", "alpha")},
            },
            "sensors": sensors,
            **self._content(),
        }

    def _content(self) -> dict[str, Any]:
        """Return the true parameters of the emulated cell, or the recording that it plays, with unknown parameters."""
        recording = self._recording
        if recording is None:
            return {"truth": self.world.truth.to_json(), "imperfections": asdict(self.world.imperfections)}
        played = {"file": str(self._options.recording), "samples": len(recording), "duration_s": recording.duration_s}
        return {"truth": None, "recording": played}

    def _print(self, message: dict[str, Any]) -> None:
        try:
            sys.stdout.write(json.dumps(message) + "\n")
            sys.stdout.flush()
        except BrokenPipeError:
            self._ended = True

    def _on_stdin(self) -> None:
        data = os.read(sys.stdin.fileno(), 65536)
        if not data:
            self._ended = True
            return
        *lines, rest = (bytes(self._line) + data).split(b"\n")
        self._line = bytearray(rest)
        for line in lines:
            if line.strip():
                self._print(self._answer(line))

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            verb = self._verbs[name := request["do"].replace("_", "-")]
        except (ValueError, TypeError, KeyError, AttributeError):
            known = ", ".join(self._verbs)
            return {"error": f'not understood: {line.decode("utf-8", "replace")}; send {{"do": …}} with {known}'}
        try:
            return {"done": name, **(verb(request) or {})}
        except (ValueError, TypeError, KeyError, OSError) as error:
            return {"error": f"{request['do']}: {error!r}"}

    def _delays(self) -> list[str]:
        """Return the control request that sets the delays given on the command line; none without such options."""
        delays = {"sensor_ms": self._options.sensor_delay_ms, "rtde_ms": self._options.rtde_delay_ms}
        given = {link: delay_ms for link, delay_ms in delays.items() if delay_ms is not None}
        return [json.dumps({"do": "delay", **given})] if given else []

    def _loads(self) -> list[str]:
        """Return the control request that hangs the load of the option --load; none without this option."""
        return [] if self._options.load is None else [json.dumps({"do": "hang", **self._options.load})]

    def _delay(self, request: dict[str, Any]) -> None:
        """Execute the request "delay": set the delays from measuring to sending of sensors and RTDE."""
        given = {link: float(request[link]) for link in ("sensor_ms", "rtde_ms") if link in request}
        if not given:
            raise KeyError("sensor_ms")
        if not all(0.0 <= delay_ms <= LONGEST_DELAY_MS for delay_ms in given.values()):
            raise ValueError(f"a delay is 0 to {LONGEST_DELAY_MS} ms, not {given}")
        if "sensor_ms" in given:
            emulators = [sensor.emulator for sensor in self._sensors.values()]
            if not emulators:
                raise ValueError("this station has no sensor")
            for emulator in emulators:
                emulator.faults.delay_s = 1e-3 * given["sensor_ms"]
        self.server.rtde.delay_s = 1e-3 * given.get("rtde_ms", 1e3 * self.server.rtde.delay_s)
        self.robot.note("network", "delay", why=json.dumps(given))

    def _play(self, recording: Recording, request: dict[str, Any]) -> dict[str, Any]:
        """Execute the request "play": continue the recording at another time or at another pace."""
        now_s = self._clock.now_s()
        at_s = float(request.get("at_s", recording.at_s(now_s)))
        recording.play(now_s, at_s, float(request.get("pace", recording.pace)))
        return {"at_s": at_s, "pace": recording.pace}

    def _state(self, request: dict[str, Any]) -> dict[str, Any]:
        robot, arm = self.robot, self.robot.arm
        return {
            "q_rad": list(arm.actual_q),
            "target_q_rad": list(arm.q),
            "moving": not arm.at_rest,
            "steady": robot.steady,
            "runtime_state": robot.runtime.name,
            "program": robot.program_name,
            "popup": robot.popup,
            "robot_mode": robot.robot_mode.name,
            "safety_mode": robot.safety_mode.name,
            "remote_control": robot.remote_control,
            "tcp_offset": list(robot.tcp_offset),
            "payload_kg": robot.payload_kg,
            "payload_cog_m": list(robot.payload_cog_m),
            "target_gravity_m_s2": list(robot.target_gravity_m_s2),
            "speed_fraction": arm.speed_fraction,
            "speed_scaling": arm.pace,
            **({} if self._recording is None else {"recording_s": self._recording.at_s(self._clock.now_s())}),
            "true_wrench": self.world.true_wrench().tolist(),
            "swing_deg": None if self.world.hung is None else self.world.hung.swing_deg,
            "bad_inputs": [
                *self.server.rtde.bad_inputs,
                *(doubt for event in robot.events for doubt in event.detail.get("doubts", ())),
            ],
            "t_host_ns": self._clock.now_ns(),
            "events": [event.to_json() for event in robot.events[int(request.get("since", 0)) :]],
        }


def parse_vector(text: str, length: int) -> Array:
    """Read numbers separated by commas.

    Raises
    ------
    ValueError
        The text does not contain exactly `length` finite numbers.
    """
    values = np.array([float(part) for part in text.split(",")])
    if values.shape != (length,) or not np.isfinite(values).all():
        raise ValueError(f"expected {length} numbers separated by commas, got {text!r}")
    return values
