"""What goes wrong on a wire, tried on every sensor: each fault has its outcome in time, and no value is ever wrong.

The emulated sensors measure a number that counts their samples. Every sample the reader thread hands out is compared
with it, also those a failed `collect` drops.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import FtSamples
from ftdrivers.registry import sensor_from_url
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor
from tests.wire.laboratory import STEPS, Laboratory, numbers_in
from tests.wire.sensor_kinds import KINDS

pytestmark = pytest.mark.slow  # `test_sensor_drivers.py` has a share of it


class Emulator:
    """One emulated sensor, behind a link that survives its being plugged in again."""

    def __init__(
        self,
        laboratory: Laboratory,
        scheme: str,
        link: Path,
        options: dict[str, Any] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.name, self.kind = scheme, KINDS[scheme]
        self._query, fast_options = self.kind.fast or (self.kind.query, self.kind.options)
        self.clock: Clock = clock or laboratory.clock
        self._laboratory = laboratory
        self._link = link
        self._options = fast_options | (options or {})
        self.plug_in()

    def plug_in(self) -> None:
        self._number, where = self._laboratory.request("start", self.name, self._options)
        ports: list[str] = []
        if isinstance(where, dict):
            self._options |= where
            self._address = where["host"]
            ports = [f"{key}={port}" for key, port in where.items() if key != "host"]
        else:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(where)
            self._address = str(self._link)
        self._ports = ports

    def sensor(self, options: str = "") -> StreamingSensor:
        query = "&".join(filter(None, [self._query, *self._ports, options]))
        sensor = sensor_from_url(f"{self.kind.scheme}://{self._address}?{query}".rstrip("?"), clock=self.clock)
        assert isinstance(sensor, StreamingSensor)
        return sensor

    def faults(self, **options: Any) -> None:
        self._laboratory.request("faults", self._number, options)

    def reset(self) -> None:
        self._laboratory.request("reset", self._number)

    def unplug(self) -> None:
        self._laboratory.request("unplug", self._number)

    def made(self) -> int:
        return int(self._laboratory.request("made", self._number))


@dataclass
class Watched:
    """Everything a sensor hands out from now on, of which the first `seconds` are waited for."""

    sensor: StreamingSensor
    seconds: float = 0.0
    blocks: list[FtSamples] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stack = ExitStack()  # never left, as the sensor may fail and be opened again
        self.follow = self.stack.enter_context(self.sensor.follow())
        if self.seconds:
            self.sensor.collect(self.seconds)

    def samples(self) -> FtSamples:
        with suppress(DeviceError):  # the failure is raised after the samples that came before it
            self.blocks.append(self.follow.read(0.0))
        return FtSamples.concatenate(self.blocks or [NOTHING])

    def wrong(self) -> int:
        """Count the samples that no sensor has measured."""
        return int((~numbers_in(self.samples().wrench)[1]).sum())

    def steps(self) -> NDArray[np.int64]:
        """By how much the numbers of right samples advance from one to the next."""
        number, right = numbers_in(self.samples().wrench)
        modulus = STEPS * STEPS
        return (np.diff(number[right]) + modulus // 2) % modulus - modulus // 2


@pytest.fixture(scope="module")
def laboratory() -> Iterator[Laboratory]:
    laboratory = Laboratory()
    yield laboratory
    laboratory.close()


@pytest.fixture(scope="module")
def emulator(
    request: pytest.FixtureRequest, laboratory: Laboratory, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Emulator]:
    """A healthy sensor, left as it was found."""
    emulator = Emulator(laboratory, request.param, tmp_path_factory.mktemp("dev") / "sensor")
    yield emulator
    emulator.unplug()


@pytest.fixture
def own(laboratory: Laboratory, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Callable[..., Emulator]]:
    """Sensors that a test may break."""
    running: list[Emulator] = []

    def start(**options: Any) -> Emulator:
        running.append(Emulator(laboratory, request.node.callspec.params["scheme"], tmp_path / "sensor", options))
        return running[-1]

    yield start
    for emulator in running:
        emulator.unplug()


SCRIPT: dict[str, dict[str, float]] = {
    "drop": {"drop": 0.05},
    "delay": {"delay_s": 0.02},
    "corrupt": {"corrupt": 0.05},
    "duplicate": {"duplicate": 0.1},
    "swap": {"swap": 0.1},
    "foreign": {"foreign": 0.2},
    "byte_slip": {"byte_slip": 0.1},
}
HEALTHY = dict.fromkeys([key for fault in SCRIPT.values() for key in fault], 0.0)


def chances(scheme: str, fault: str) -> dict[str, float]:
    """How often a fault strikes. It is rare where few in a row are a silence of 0.3 s, which is an error."""
    rare = {
        ("ati-serial", "byte_slip"): {"byte_slip": 0.001},  # a slip stops the stream for 40 ms
        ("ati-can", "drop"): {"drop": 0.02},  # after two polls the slot is selected again, with 0.1 s for each attempt
    }
    return rare.get((scheme, fault), SCRIPT[fault])


def applies(scheme: str, fault: str) -> bool:
    """Bytes on a serial line stay in order and have one sender; CAN and UDP frames are whole or not there.

    TCP carries everything, if late and in other pieces.
    """
    if scheme in {"ur-ft", "robotiq-urcap"}:
        return fault == "delay"
    packets = scheme.endswith("-can") or scheme == "ati-netft"
    return packets if fault in {"swap", "foreign"} else not packets if fault in {"corrupt", "byte_slip"} else True


def failure_of(sensor: StreamingSensor) -> str:
    try:
        sensor.check()
    except StreamBroken as failure:
        return str(failure)
    return ""


def suffer(sensor: StreamingSensor, clock: Clock, seconds: float) -> list[DeviceError]:
    """Use a sensor for a while as a program would; return its errors."""
    errors: list[DeviceError] = []
    end_s = clock.now_s() + seconds
    while clock.now_s() < end_s:
        try:
            sensor.collect(0.2)
            sensor.latest(timeout_s=0.1)
        except DeviceError as exc:
            errors.append(exc)
            if any(what.startswith("ended") for _, what in sensor.health().events):
                break
            clock.sleep(0.02)
    return errors


LATE = {"ur-ft", "robotiq-urcap", "ati-serial", "robotous-can"}
"""Delay is all that happens on TCP; of the other wires those without a clock and with the most bytes."""


def suffering() -> list[tuple[str, str]]:
    """Every fault on every wire it happens on."""
    return [
        (scheme, fault)
        for scheme in KINDS
        for fault in SCRIPT
        # samples that two neighbouring losses make are known by the time they come, and that of a starved cell is not
        if applies(scheme, fault) and (scheme, fault) != ("robotous-can", "drop")
        if fault != "delay" or scheme in LATE
    ]


@pytest.mark.parametrize(("emulator", "fault"), suffering(), indirect=["emulator"])
def test_no_fault_of_the_wire_delivers_a_wrong_value(emulator: Emulator, fault: str) -> None:
    scheme = emulator.kind.scheme
    with emulator.sensor() as sensor:
        watched = Watched(sensor)
        emulator.faults(**chances(scheme, fault))
        try:
            errors = suffer(sensor, emulator.clock, 0.7)
            health, samples, steps = sensor.health(), watched.samples(), watched.steps()
        finally:
            emulator.faults(**HEALTHY)
            emulator.clock.sleep(0.05)  # what was delayed belongs to this stream, not to the next one
    assert len(samples) >= 10
    assert watched.wrong() == 0
    assert (np.diff(samples.seq) >= 1).all()
    if fault == "duplicate" and not emulator.kind.numbered:
        assert (steps >= 0).all()
    elif watched.wrong() == 0:
        assert (steps >= 1).all()  # nothing twice, nothing late
    assert errors == []  # these faults are survived
    if fault in {"corrupt", "byte_slip"}:
        assert health.malformed > 0
    if fault == "drop" and emulator.kind.numbered and scheme != "ati-can":  # which is asked again
        assert health.lost >= (np.diff(samples.seq) - 1).sum() > 0
    if fault == "duplicate" and scheme in {"bota", "ati-netft"}:
        assert health.duplicated > 0


def stalled(emulator: Emulator, before_s: float) -> list[Watched]:
    """Stall in mid-stream: an error in time, and no value."""
    with emulator.sensor() as sensor:
        watched = Watched(sensor, before_s)
        emulator.faults(stall=True)
        try:
            with pytest.raises((DeviceTimeout, StreamBroken)):
                sensor.collect(60.0)
            with pytest.raises((DeviceTimeout, StreamBroken)):
                sensor.latest(timeout_s=0.05)
        finally:
            emulator.faults(stall=False)
    return [watched]


def reset(emulator: Emulator, before_s: float) -> list[Watched]:
    """Reset in mid-stream: silence or a broken stream, at once; a polled sensor is simply asked again."""
    with emulator.sensor() as sensor:
        watched = Watched(sensor, before_s)
        emulator.reset()
        errors = suffer(sensor, emulator.clock, 0.8)
        assert all(isinstance(exc, DeviceTimeout | StreamBroken) for exc in errors)
        quiet = emulator.kind.scheme == "ati-netft" or emulator.name == "robotiq-urcap"  # the box, the controller
        assert errors or sensor.health().lost or quiet
    return [watched]


def opened(emulator: Emulator, before_s: float) -> list[Watched]:
    """Open a sensor that streams already: its samples come in order, each once."""
    with emulator.sensor() as sensor:
        watched = Watched(sensor, before_s)
    assert (watched.steps() >= 1).all()
    return [watched]


def unplugged(emulator: Emulator, before_s: float) -> list[Watched]:
    """Unplug in mid-stream: broken, at once; plugged in again it can be opened again."""
    sensor = emulator.sensor()
    with sensor:
        first = Watched(sensor, before_s)
        emulator.unplug()
        with pytest.raises(StreamBroken, match="again"):
            sensor.collect(60.0)
        emulator.plug_in()
        sensor.open()
        second = Watched(sensor, 0.1)
    emulator.unplug()
    emulator.plug_in()
    with sensor:
        third = Watched(sensor, 0.1)
    return [first, second, third]


def reconnected(emulator: Emulator, before_s: float) -> list[Watched]:
    """Unplug in mid-stream and plug in again: reported at once, and reconnected where that was configured."""
    with emulator.sensor("recover=1") as sensor:
        watched = Watched(sensor, before_s)
        emulator.unplug()
        with pytest.raises(StreamBroken, match="reconnecting"):
            sensor.collect(60.0)
        emulator.plug_in()
        while failure := failure_of(sensor):  # it gives up by itself
            assert "reconnecting" in failure, emulator.kind.scheme
            emulator.clock.sleep(0.05)
        sensor.collect(0.1)
        health = sensor.health()
    assert health.reconnects >= 1
    assert [what for _, what in health.events][-1] == "reconnected"
    assert (np.diff(watched.samples().seq) >= 1).all()
    return [watched]


CYCLES: dict[str, Callable[[Emulator, float], list[Watched]]] = {
    "stall": stalled,
    "reset": reset,
    "already streaming": opened,
    "unplug": unplugged,
    "replug": reconnected,
}
"""Faults that end a stream: from opening to the outcome, `before_s` after it has begun."""


def starts(scheme: str, fault: str) -> dict[str, Any]:
    """Options of the emulator for a fault of `CYCLES`."""
    if fault != "already streaming":
        return {}
    return {"streaming_at_start": ("127.0.0.1", 9) if scheme == "ati-netft" else True}


ENDS = [(scheme, fault) for scheme in KINDS for fault in CYCLES]
UNASKED = [(scheme, "already streaming") for scheme in ("ati-can", "robotiq-urcap", "ur-ft")]
"""Nothing comes unasked."""


@pytest.mark.parametrize(("scheme", "fault"), [pair for pair in ENDS if pair not in UNASKED])
def test_faults_that_end_a_stream(own: Callable[..., Emulator], scheme: str, fault: str) -> None:
    for watched in CYCLES[fault](own(**starts(scheme, fault)), 0.05):
        assert len(watched.samples())
        assert watched.wrong() == 0
