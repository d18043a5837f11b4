"""The reader of a Universal Robots arm: new samples, and a flange pose that does not depend on the active TCP.

One RTDE subscription carries all values. After a suspension of this process or a stall of the network, samples arrive
that are seconds old, although their time stamps advance normally. Therefore the controller's clock is compared with the
host's clock, and late samples are never used for a state or a status. These are updated at 125 Hz, which is enough for
a move and its guards. Followers receive every sample, 500 Hz from an e-Series arm. The TCP offset of a sample is
removed from its pose, and the resulting flange pose is checked against the arm's forward kinematics, with the
parameters that the controller sends over the primary interface, or nominal ones if it sends none.

Checked on hardware: no.
"""

import copy
import logging
import math
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from math import radians
from typing import Final

import numpy as np

from ftdrivers.clock import Clock, Follower
from ftdrivers.errors import (
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    ModelUnknown,
    NoDashboard,
    StreamBroken,
)
from ftdrivers.follow import Follow, Unread
from ftdrivers.interfaces import NOT_REPORTED, ArmState, ArmStates, ArmStatus, Array, DeviceInfo, Fact
from ftdrivers.ur.kinematics import MODELS, Kinematics, Pose, flange_poses, forward, kinematics_of, model_named
from ftdrivers.ur.primary import read_arm
from ftdrivers.ur.rtde import Subscription
from ftdrivers.ur.sample import MEASURING, OPTIONAL, OUTPUTS, Sample
from ftdrivers.ur.services import ROBOT_API_PORT as API_PORT
from ftdrivers.ur.services import Services, ServicesOf
from ftdrivers.ur.timing import Patience, UrTiming

log = logging.getLogger(__name__)

STATES_HZ: Final = 125.0
"""Rate before the first `follow()`, Hz: the full rate of the CB3 generation, a quarter of that of the e-Series."""
# Largest number of samples in the queue of one follower, 33 minutes at 500 Hz.
_MOST_UNREAD: Final = 1_000_000
Received = tuple[int, list[bytes]]
"""Time of receipt `t_host_ns` of one read, and the undecoded samples of this read."""
# If more than this time passes between two turns, the reader was suspended or got no CPU time.
_PAUSE_S: Final = 0.1
# Layout of the time stamp: the first output in a package, after the number of the recipe.
_TIMESTAMP: Final = struct.Struct(">xd")
_QUICKEST_OF_S: Final = 0.5
_MODEL_M: Final = 0.020
# None of 30 real arms differs from its nominal model by more than 7.5 mm and 1.32 degrees. The flange poses of two
# similar models differ by at least 8.5 mm in every posture, and real arms are always nearest to their own model.
_MODEL_RAD: Final = radians(3.0)
_OWN_M: Final = 0.001
# Tolerances for the parameters that the controller sends, with which it computes its pose.
_OWN_RAD: Final = radians(0.1)
# Joint angles and pose of one sample may differ by one control cycle, of which that of a CB3 is the longest.
_LAG_S: Final = 0.008
# Interval between two checks of followed poses. A check takes as long as reading ten samples.
_CHECK_S: Final = 0.1


def _apart(one: Pose, other: Pose) -> tuple[float, float]:
    return float(np.linalg.norm(one.p_m - other.p_m)), one.angle_to_rad(other)


def _apart_as_share(one: Pose, other: Pose) -> float:
    """Return the difference between two poses, as a fraction of the tolerance for a real arm of the model."""
    distance_m, angle_rad = _apart(one, other)
    return max(distance_m / _MODEL_M, angle_rad / _MODEL_RAD)


class _Lateness:
    """Estimates the delay of samples from the controller's clock, relative to the fastest sample of the last second.

    A clock that is up to 4 % slow, such as that of a simulator, causes no delay. After a clock has stood still, samples
    are late for 1 s at most.
    """

    def __init__(self) -> None:
        self._quickest_s, self._quickest_before_s = -math.inf, -math.inf
        self._since_s: float | None = None

    def late_s(self, t_device_s: float, heard_s: float) -> float:
        """Return the delay of a sample, s, that was received at `heard_s`. The epochs of the clocks may differ."""
        lead_s = t_device_s - heard_s
        if self._since_s is None or heard_s - self._since_s > _QUICKEST_OF_S:
            self._quickest_before_s, self._quickest_s, self._since_s = self._quickest_s, lead_s, heard_s
        self._quickest_s = max(self._quickest_s, lead_s)
        return max(self._quickest_s, self._quickest_before_s) - lead_s


class Reader:
    """Reads one arm, and is connected while it exists.

    Raises `ConnectError` if the arm cannot be reached, or if it is not a `model`, a key of `MODELS`.
    """

    def __init__(
        self,
        host: str,
        model: str | None,
        *,
        clock: Clock,
        timing: UrTiming,
        rate_Hz: float = STATES_HZ,
        api_port: int = API_PORT,
    ) -> None:
        self._host = host
        self._clock = clock
        self._timing = timing
        self._changed = threading.Condition()
        # `t_host_ns` of the newest sample for a state or a status, and the sample.
        self._live: tuple[int, bytes] | None = None
        # Number of samples received after the one in `_live`.
        self._since_live = 0
        # Times of the last read, of the last read that gave a sample, and of the read that gave the sample in `_live`.
        self._turn_s = self._read_s = self._live_s = clock.awake_s()
        self._t_device_s = math.nan
        self._lateness, self._late_s = _Lateness(), 0.0
        self._followers: list[Unread[Received]] = []
        # Time at which the next pose of a follower is checked against the kinematics.
        self._check_s = -math.inf
        # Whether any flange pose has agreed with the kinematics of this arm so far.
        self._fits = False
        self._failure: DeviceError | None = None
        self.silent = False
        """Whether `DeviceTimeout` was raised and no sample has arrived since then."""
        self._stream = Subscription(host, OUTPUTS, rate_Hz, timeout_s=timing.connect_s, clock=clock)
        self.version = self._stream.version
        """Version of the controller: major, minor, bugfix, build."""
        self.services = ServicesOf(host, self.version, clock, api_port)
        missing = set(self._stream.missing)
        self.reports_tcp = "tcp_offset" not in missing
        """Whether the controller reports its TCP offset over RTDE, which old ones do not."""
        self._thread = Follower(clock, self._run, "ur-reader")
        try:
            self._thread.start()
            self.info = self._identify(model, missing - OPTIONAL)
        except BaseException:
            self.close()
            raise

    @property
    def reads_all(self) -> bool:
        """Whether samples are read at the full rate of the controller."""
        return self._stream.is_full_rate

    @cached_property
    def kinematics(self) -> Kinematics | None:
        """The measured kinematics that the controller sends; None if it sends none."""
        return kinematics_of(self.info)

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self._end(StreamBroken(f"the arm at {self._host} was closed", "open it again"))
        self._stream.close()
        self._thread.join(timeout=1.0)

    def look(self, *, limit_s: float | None = None) -> Sample:
        """Wait for a sample taken after this call.

        Raises `StreamBroken` if the connection was lost, and `DeviceTimeout` if no sample arrives for `limit_s`, by
        default `UrTiming.stale_s`.
        """
        before = self._live
        return self._wait(lambda: self._live is not before, self._timing.stale_s if limit_s is None else limit_s)

    def status(self) -> ArmStatus:
        """Return modes and settings of a sample that is at most `UrTiming.status_s` old. Raises as `look` does."""
        oldest_s = self._clock.awake_s() - self._timing.status_s
        return self._wait(lambda: self._live_s >= oldest_s, self._timing.stale_s).status()

    def state(self, ask_tcp: Callable[[], Sequence[float]]) -> ArmState:
        """Read a state; `ask_tcp` returns the TCP offset (6,) if samples lack it. Raises as `UrArm.state` does."""
        sample, tcp_offset = self._look_with_tcp(ask_tcp)
        self._check_measures(sample)
        flange = sample.flange(tcp_offset)
        self._check_pose(sample.q_rad, flange, sample.qd_rad_s)
        return ArmState(
            t_host_ns=sample.t_host_ns,
            t_device_s=sample.t_device_s,
            q_rad=np.array(sample.q_rad),
            qd_rad_s=np.array(sample.qd_rad_s),
            R_base_flange=flange.R,
            p_base_flange_m=flange.p_m,
        )

    @contextmanager
    def follow(self) -> Iterator[Follow[ArmStates]]:
        """Read every sample from now on, including late ones. The controller must report its TCP."""
        unread: Unread[Received] = Unread(self._host, _MOST_UNREAD)
        with self._changed:
            self._raise_failure()
            self._followers.append(unread)
        try:
            yield Follow(partial(self._read_on, unread))
        finally:
            with self._changed:
                self._followers.remove(unread)

    def _read_on(self, unread: Unread[Received], timeout_s: float) -> ArmStates:
        with self._changed:
            for left_s in self._clock.looks(timeout_s):
                if received := unread.take():
                    break
                self._raise_failure()
                age_s = self._clock.awake_s() - self._read_s
                if age_s > self._timing.stale_s:
                    raise self._silence(age_s)
                self._clock.wait(self._changed, min(left_s, self._timing.stale_s - age_s + 1e-3))
            else:
                received = unread.take()
        return self._states(received)

    def _states(self, received: list[Received]) -> ArmStates:
        """Convert samples to flange poses. Samples of an arm without power are left out."""
        outputs = self._stream.decode([sample for _, samples in received for sample in samples])
        t_host_ns = [t_ns for t_ns, samples in received for _ in samples]
        R_base_flange, p_base_flange_m = flange_poses(outputs["actual_TCP_pose"], outputs["tcp_offset"])
        states = ArmStates(
            t_host_ns=np.array(t_host_ns, np.int64),
            t_device_s=outputs["timestamp"],
            q_rad=outputs["actual_q"],
            qd_rad_s=outputs["actual_qd"],
            R_base_flange=R_base_flange,
            p_base_flange_m=p_base_flange_m,
        )
        if not received:
            return states
        measured = (outputs["robot_mode"] >= MEASURING[0]) & (outputs["robot_mode"] <= MEASURING[1])
        if not measured.any():
            self._check_measures(Sample.of(t_host_ns[-1], outputs))
        if not measured.all():
            states = states.rows(measured)
        if (now_s := self._clock.now_s()) >= self._check_s:
            flange = Pose(states.R_base_flange[-1], states.p_base_flange_m[-1])
            self._check_pose(states.q_rad[-1], flange, states.qd_rad_s[-1])
            self._check_s = now_s + _CHECK_S
        return states

    def _check_measures(self, sample: Sample) -> None:
        if not sample.measures and (fault := sample.safety_fault()):
            raise DeviceFault(f"{self._host} does not measure its joints: {fault.found}", fault.fix)

    def _look_with_tcp(self, ask_tcp: Callable[[], Sequence[float]]) -> tuple[Sample, Sequence[float]]:
        for _ in range(5):
            before = None if self.reports_tcp else tuple(ask_tcp())
            sample = self.look()
            if sample.tcp_offset is not None:
                return sample, sample.tcp_offset
            if before is not None and before == tuple(ask_tcp()):  # unchanged, so active at the sample
                return sample, before
        raise DeviceFault(f"the TCP of {self._host} changes repeatedly", "stop the program or client that sets it")

    def _check_pose(self, q_rad: Sequence[float] | Array, flange: Pose, qd_rad_s: Sequence[float] | Array) -> None:
        """Raise `DeviceFault` unless the flange pose agrees with the kinematics of this arm."""
        model, own = self.info.model, self.kinematics
        lag_rad = float(np.abs(qd_rad_s).sum()) * _LAG_S
        distance_m, angle_rad = _apart(flange, forward(own or MODELS[model], q_rad))
        limit_m, limit_rad = (_MODEL_M, _MODEL_RAD) if own is None else (_OWN_M, _OWN_RAD)
        reach_m = float(np.linalg.norm(flange.p_m))
        fits = distance_m <= limit_m + lag_rad * reach_m and angle_rad <= limit_rad + lag_rad
        if fits and self._fits:
            return
        off = f"the flange of {self._host} is {1e3 * distance_m:.1f} mm and {math.degrees(angle_rad):.2f} degrees"
        if self._fits:
            raise DeviceFault(
                f"{off} from its last pose: the active TCP changes", "stop whatever sets the TCP, then read again"
            )
        shares = {name: _apart_as_share(flange, forward(nominal, q_rad)) for name, nominal in MODELS.items()}
        nearest = min(shares, key=shares.__getitem__)
        if shares[nearest] > 1:
            raise DeviceFault(
                f"{off} from the pose of a {model}, and no known model is near: the TCP changes or is not reported",
                "check model and TCP, then read again",
            )
        if MODELS[nearest] != MODELS[model]:
            raise DeviceFault(
                f"{off} from the pose of a {model}: the arm is another model, probably a {nearest}",
                f"set the model {nearest}, or check the address",
            )
        if not fits:
            raise DeviceFault(
                f"{off} from the pose that follows from the kinematics sent by the controller: the two disagree",
                "restart the controller; if that does not help, have the arm calibrated again",
            )
        self._fits = True

    def reported_program(self) -> str | None:
        """Return state and name of the program on the controller; None if the controller does not answer."""
        try:
            return self.services.ask(lambda services: services.program(), timeout_s=self._timing.connect_s)
        except DeviceError as error:
            log.info("%s does not report its program: %s", self._host, error)
            return None

    def _identify(self, model: str | None, lacking: set[str]) -> DeviceInfo:
        if lacking:
            raise ConnectError(
                f"{self._host} does not report {', '.join(sorted(lacking))} over RTDE", "update its PolyScope"
            )

        def ask(services: Services) -> tuple[str | None, str | None, str | None]:
            return services.model(), services.serial(), services.polyscope()

        try:
            reported, serial, polyscope = self.services.ask(ask, timeout_s=self._timing.connect_s)
        except NoDashboard as error:
            if not self.services.has_api:
                raise
            log.info("%s", error)  # the first versions of PolyScope X have no Robot API, which reading does not need
            reported = serial = polyscope = None
        named, kinematics = read_arm(self._host, timeout_s=self._timing.connect_s, clock=self._clock)
        if reported is None and self.services.has_api:
            reported = named
        known = None if reported is None else model_named(reported, self.version[0])
        if model is None and known is None:
            found = f"reports the unknown model {reported!r}"
            if reported is None:
                found = "does not report its model, as CB3 before 3.12 and e-Series before 5.6"
            raise ModelUnknown(f"{self._host} {found}", "set the model of the arm")
        if model is not None and known is not None and MODELS[known] != MODELS[model]:
            raise ConnectError(f"{self._host} is a {known}, not a {model}", "check the address and the model")
        return DeviceInfo(
            model=model or known or NOT_REPORTED,
            serial=serial or NOT_REPORTED,
            firmware=polyscope or ".".join(map(str, self.version[:3])),
            facts={} if kinematics is None else {"kinematics": Fact(kinematics.numbers, "device")},
        )

    # ------------------------------------------------------------------ following the stream

    def _wait(self, is_new: Callable[[], bool], limit_s: float) -> Sample:
        patience = Patience(self._clock, limit_s)
        with self._changed:
            while True:
                self._raise_failure()
                if self._live is not None and is_new():
                    t_host_ns, sample = self._live
                    return Sample.of(t_host_ns, self._stream.decode([sample]))
                if patience.is_over:
                    self.silent = True
                    raise self._silence(limit_s)
                patience.wait(self._changed)

    def _raise_failure(self) -> None:
        if self._failure:
            raise copy.copy(self._failure) from self._failure

    def _silence(self, silent_s: float) -> DeviceTimeout:
        if self._clock.awake_s() - self._turn_s > _PAUSE_S:
            return DeviceTimeout(
                f"no sample of {self._host} was read for {silent_s:.2f} s, because this program or computer was "
                "suspended or too busy",
                "reduce the load on this computer, then try again; press the emergency stop if the arm moves",
            )
        if self._late_s > self._timing.late_s and self._clock.awake_s() - self._read_s < silent_s:
            return DeviceTimeout(
                f"samples of {self._host} arrive {self._late_s:.2f} s late by the controller's clock",
                "check the network and the load on the controller, and press the emergency stop if the arm moves",
            )
        at = "" if math.isnan(self._t_device_s) else f" at {self._t_device_s:.3f} s"
        return DeviceTimeout(
            f"the clock of {self._host} has been stuck{at} for {silent_s:.2f} s",
            "check the robot and the network, and press the emergency stop if the arm moves",
        )

    def _run(self) -> None:
        while self._follow():
            pass

    def _follow(self) -> bool:
        """Read the samples that have arrived; return whether to continue. An error is raised by the next call."""
        # Followers also receive late samples, which a recording must not miss. `state` and `status` never use them.
        try:
            samples = self._stream.read(self._clock.poll_s)
        except TimeoutError:
            self._clock.now_ns()  # an emulated cell waits for this thread
            self._turn_s = self._clock.awake_s()
            return True
        except (OSError, StreamBroken) as error:
            failure: DeviceError = StreamBroken(
                f"the RTDE connection to {self._host} was lost ({error})",
                "check the robot and the cable, then open the arm again",
            )
        except DeviceError as error:
            failure = error
        else:
            self._turn_s = self._read_s = self._clock.awake_s()
            t_host_ns = self._clock.now_ns()
            before_s = self._t_device_s
            (self._t_device_s,) = _TIMESTAMP.unpack_from(samples[-1])
            self._late_s = self._lateness.late_s(self._t_device_s, self._read_s)
            with self._changed:
                self.silent = False
                for unread in self._followers:
                    unread.put((t_host_ns, samples), len(samples))
                self._since_live += len(samples)
                due = self._since_live >= self._stream.rate_Hz / STATES_HZ
                advances = self._t_device_s != before_s  # a repeated sample is not a new one
                if due and advances and self._late_s <= self._timing.late_s:
                    self._live, self._live_s, self._since_live = (t_host_ns, samples[-1]), self._read_s, 0
                if self._followers or not self._since_live:
                    self._changed.notify_all()
            return True
        self._end(failure)
        return False

    def _end(self, failure: DeviceError) -> None:
        """End the stream: every later call raises this failure, or the first failure if there was an earlier one."""
        with self._changed:
            self._failure = self._failure or failure
            self._changed.notify_all()
