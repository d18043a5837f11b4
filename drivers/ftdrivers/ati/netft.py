"""ATI Net F/T, Ethernet Axia and OnRobot HEX force/torque sensors over Ethernet (RDT), through pynetft.

Ref: ATI, "Net F/T User Manual" 9620-05-Net FT, and "Ethernet Axia" 9610-05-Ethernet Axia: RDT and netftapi2.xml, as in
public drivers and a public page of a live box; tool transformation as in ATI's DAQ F/T C library (ftconfig.c, TTM);
OptoForce, "Ethernet Converter" manual, version 2.0.
Checked on hardware: no. Verified against: tests/unit/drivers/test_netft.py and the emulator (tests/wire).

pynetft reads the scale and the samples, and reports why a stream has ended. The driver never uses its bias command.
"""

import http.client
import logging
import math
import re
from contextlib import closing
from dataclasses import replace
from typing import Self

import numpy as np
import pynetft
from scipy.spatial.transform import Rotation

from ftdrivers.ati.codec import FORCE_UNITS_N, TORQUE_UNITS_NM
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import UNUSABLE, ConnectError, DeviceFault, ProtocolError, StreamBroken
from ftdrivers.interfaces import NOT_REPORTED, Array, DeviceInfo, Fact, FtSamples, Health
from ftdrivers.registry import Options
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, StreamLimits, scale_facts
from ftdrivers.wires.framing import describe_status

log = logging.getLogger(__name__)

# A longer silence ends the stream. Sensors that are set to less than 10 Hz are too slow for this driver.
_SILENCE_S = 0.3
# Number of start requests: a request is a datagram, which can be lost.
_STARTS = 5
_HTTP_S = 1.0
# Delay of pynetft's reconnecting mode, without which one duplicate or late datagram ends the stream. It is so long that
# this driver always detects a lost connection first.
_NEVER_S = 3600.0
# Time-outs, s of real time: for the first sample of a block, and for each further one.
_WAIT_S, _BATCH_S = 0.05, 0.002
# Samples in the queue of pynetft, more than 2 s at 7 kHz. A full queue drops the oldest sample, which leaves a gap.
_QUEUE = 16_384
# Counts per N and per N·m, fixed by the manual, because an OnRobot converter does not report them.
_ONROBOT_COUNTS = (10_000, 100_000)
_DISTANCES_M = {"in": 0.0254, "ft": 0.3048, "mm": 0.001, "cm": 0.01, "m": 1.0}

# pynetft ends the stream for any other status, so the Axia's warning of a gauge near its limit is a fault too.
MONITOR_LATCHED = 0x80010000
"""Status after a monitored threshold was crossed. The data are valid."""

NET_FT_BITS = {
    1: "HTTP",
    2: "temperature",
    3: "reference voltage",
    4: "no data from the transducer",
    5: "supply too low",
    6: "supply too high",
    7: "artificial analog ground",
    8: "excitation current low",
    9: "excitation current high",
    10: "analog watchdog",
    11: "flash",
    12: "EEPROM",
    13: "stack",
    14: "watchdog",
    16: "monitor condition latched",
    17: "transducer saturated or A/D error",
    18: "DeviceNet",
    19: "EtherNet/IP",
    20: "RDT",
    21: "CAN",
    22: "network",
    23: "configuration does not match the calibration",
    24: "settings invalid",
    25: "halted by a configuration error",
    26: "program memory",
    27: "link to the transducer",
    28: "analog board",
    29: "digital board",
    30: "CPU or RAM",
    31: "any error",
}
AXIA_BITS = {
    0: "temperature",
    1: "supply voltage",
    2: "broken gauge",
    3: "busy",
    5: "hardware",
    16: "monitor condition latched",
    26: "gauge near its limit",
    27: "gauge out of range",
    28: "simulated error",
    29: "calibration checksum",
    30: "force or torque out of range",
    31: "any error",
}
ONROBOT_BITS = {
    3: "several sensors failed",
    4: "overload Fx",
    5: "overload Fy",
    6: "overload Fz",
    7: "overload Tx",
    8: "overload Ty",
    9: "overload Tz",
    10: "sensor not detected",
    11: "sensor failure",
    12: "sensor temperature",
    13: "converter failure",
    14: "converter communication",
    15: "converter error",
}


def text_in(page: bytes, element: str) -> str:
    """Return the text of an element in a page of the sensor; empty if the element is missing."""
    match = re.search(rf"<{element}>\s*([\x20-\x3b\x3d-\x7e]{{1,200}}?)\s*</{element}>".encode(), page)
    return match[1].decode("ascii") if match else ""


def numbers_in(page: bytes, element: str) -> list[float]:
    """Return the numbers of an element, such as ``130;130;400;10;10;10``; empty if it holds other text."""
    try:
        numbers = [float(number) for number in text_in(page, element).split(";")]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def transformation_in(page: bytes) -> Array:
    """Return the inverse (6, 6) of the tool transformation in ``netftapi2.xml``; the identity if there is none.

    The device sends the wrench in the axes and about the origin of its tool frame. This frame is displaced from the
    transducer frame, then rotated about x, y and z.

    Raises `ProtocolError` if the number of values is wrong, or a unit is unknown.
    """
    undo = np.eye(6)
    values, distance, angle = numbers_in(page, "cfgtfx"), text_in(page, "scfgtdu"), text_in(page, "scfgtau")
    if b"<cfgtfx>" not in page or values == [0.0] * 6:
        return undo
    if len(values) != 6 or distance not in _DISTANCES_M or angle not in {"degrees", "radians"}:
        raise ProtocolError(
            f"the tool transformation '{text_in(page, 'cfgtfx')}' in '{distance}' and '{angle}' cannot be undone",
            "set it to zero on the configurations page of the sensor",
        )
    x, y, z = _DISTANCES_M[distance] * np.array(values[:3])
    R = Rotation.from_euler("XYZ", values[3:], degrees=angle == "degrees").as_matrix()
    undo[:3, :3] = undo[3:, 3:] = R
    undo[3:, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    return undo


class NetFtSensor(StreamingSensor):
    """A sensor with ATI's RDT protocol.

    `counts` are the six values as sent, `seq` is the RDT sequence number, `t_device_s` is NaN: records carry no time.
    `wrench` is in the axes and about the origin of the transducer: the driver undoes the tool transformation. The
    device subtracts its software bias. Both are in `DeviceInfo.facts`, so the driver rejects a sensor that has changed
    them after a reconnection. Nominal rate and range are known if the configuration page contains them. Any status
    except a latched monitor condition raises `DeviceFault`.

    Parameters
    ----------
    host : str
        Address of the sensor; ATI's factory setting is 192.168.1.1.
    onrobot : bool
        True for an OnRobot HEX or OptoForce converter, which has its own scale and status bits.
    rdt_port, http_port : int
        Ports of RDT (UDP) and of the configuration pages.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(
        self,
        host: str,
        *,
        onrobot: bool = False,
        rdt_port: int = 49152,
        http_port: int = 80,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        name = f"{'OnRobot' if onrobot else 'ATI'} Ethernet sensor at {host}"
        # UDP does not report a broken cable: a silence ends the stream before the stream would be stale
        super().__init__(name, sign=sign, clock=clock, limits=StreamLimits(stale_s=_SILENCE_S + 0.15))
        self._http_s = clock.patience_s(_HTTP_S)
        self._host = host
        self._onrobot = onrobot
        self._rdt_port = rdt_port
        self._http_port = http_port
        self._client: pynetft.Client | None = None

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``ati-netft://192.168.1.1?onrobot=0&rdt_port=49152``."""
        return cls(
            address,
            onrobot=bool(options.integer("onrobot", 0, 0, 1)),
            rdt_port=options.integer("rdt_port", 49152, 1, 65535),
            http_port=options.integer("http_port", 80, 1, 65535),
            sign=sign,
            clock=clock,
        )

    def _connect(self) -> DeviceInfo:
        # an OnRobot converter has no configuration pages
        page = b"" if self._onrobot else self._read_page("/netftapi2.xml")
        rate_Hz, *_ = numbers_in(page, "comm?rdtrate") or [math.nan]  # two spellings of the element exist
        self._nominal_Hz = rate_Hz if rate_Hz > 0 else math.nan
        undo = transformation_in(page)
        override = None
        if self._onrobot:
            override = pynetft.Calibration(*_ONROBOT_COUNTS, pynetft.ForceUnit.NEWTON, pynetft.TorqueUnit.NEWTON_METER)
        config = pynetft.Config(
            sensor_host=self._host,
            rdt_port=self._rdt_port,
            http_port=self._http_port,
            receive_timeout=_NEVER_S,  # real time; silences are judged by this driver
            configuration_connect_timeout=self._http_s,
            configuration_timeout=self._http_s,
            deliver_samples_with_error_status=True,  # the status word names the fault
            # Without reconnecting, a duplicate or late datagram ends a stream. This driver notices any failure first.
            recovery_policy=pynetft.RecoveryPolicy.RECONNECT,
            reconnect_initial_delay=_NEVER_S,
            reconnect_max_delay=_NEVER_S,
            calibration_override=override,
        )
        self._warned = False
        self._newest_number: int | None = None
        try:
            self._client = pynetft.Client(config, queue_size=_QUEUE)
        except pynetft.NetFTError as exc:
            raise self._unread(exc) from exc
        configuration = self._start(self._client)
        scale = configuration.calibration
        if scale.force_unit.value not in FORCE_UNITS_N or scale.torque_unit.value not in TORQUE_UNITS_NM:
            raise ConnectError(
                f"{self.name}: the sensor measures in {scale.force_unit.value} and {scale.torque_unit.value}",
                "select N and Nm on its configuration page",
            )
        counts_per_N = scale.counts_per_force_unit / FORCE_UNITS_N[scale.force_unit.value]
        counts_per_Nm = scale.counts_per_torque_unit / TORQUE_UNITS_NM[scale.torque_unit.value]
        self._wrench_per_count = undo / np.repeat([counts_per_N, counts_per_Nm], 3)
        facts = scale_facts(counts_per_N, counts_per_Nm, "documented" if self._onrobot else "device")
        rating = numbers_in(page, "cfgmr")
        if len(rating) == 6 and min(rating) > 0:
            per_unit = np.repeat([FORCE_UNITS_N[scale.force_unit.value], TORQUE_UNITS_NM[scale.torque_unit.value]], 3)
            facts["range"] = Fact(tuple((per_unit * rating).tolist()), "device")
        if bias := numbers_in(page, "setbias"):
            facts["software_bias"] = Fact(tuple(bias), "device")
        if not np.array_equal(undo, np.eye(6)):
            units = f"{text_in(page, 'scfgtdu')}, {text_in(page, 'scfgtau')}"
            facts["tool_transformation"] = Fact(f"{text_in(page, 'cfgtfx')} ({units})", "device")
        return DeviceInfo(
            model="OnRobot HEX (Ethernet)" if self._onrobot else configuration.product_name or "ATI Net F/T",
            serial=text_in(page, "cfgcalsn") or NOT_REPORTED,
            firmware=text_in(page, "mfgdigver") or NOT_REPORTED,
            facts=facts,
        )

    def _read_block(self) -> FtSamples:
        samples = self._fetch()
        t_host_ns = self._clock.now_ns()
        if not samples:
            return NOTHING
        self._arrived_ns = t_host_ns
        numbers = [sample.rdt_sequence for sample in samples]
        before = numbers[0] - 1 if self._newest_number is None else self._newest_number
        self._lost += max(0, numbers[-1] - before - len(numbers))
        self._newest_number = numbers[-1]
        status = np.array([sample.status for sample in samples], np.uint32)
        self._judge(int(np.bitwise_or.reduce(status)))
        counts = np.array([sample.raw_wrench for sample in samples], np.int32)
        return FtSamples.of(t_host_ns, numbers, counts @ self._wrench_per_count.T, counts=counts, status=status)

    def _disconnect(self) -> None:
        with self._news:
            client, self._client = self._client, None
            if client is None:
                return
            counted = client.health()
            self._earlier_malformed += counted.malformed_count
            self._duplicated += counted.duplicate_count
            self._out_of_order += counted.out_of_order_count
        client.stop()

    def health(self) -> Health:
        """Return the statistics since `open`, including datagrams that pynetft has dropped."""
        with self._news:
            health, client = super().health(), self._client
            if client is None:
                return health
            counted = client.health()
        return replace(
            health,
            malformed=health.malformed + counted.malformed_count,
            duplicated=health.duplicated + counted.duplicate_count,
            out_of_order=health.out_of_order + counted.out_of_order_count,
        )

    def _start(self, client: pynetft.Client) -> pynetft.SensorConfiguration:
        """Request the stream repeatedly until it starts; return the configuration that the sensor reports."""
        for _ in range(_STARTS):
            try:
                client.start()
            except pynetft.NetFTError as exc:
                raise self._unread(exc) from exc
            looks = self._clock.looks(_SILENCE_S)
            arrived = any(client.wait_for_first_sample(min(left_s, self._clock.poll_s)) for left_s in looks)
            self._arrived_ns = self._clock.now_ns()
            health = client.health()
            if health.sensor_configuration is None:
                raise ConnectError(f"{self.name}: the sensor reports no scale", "open it again")
            is_axia = "Axia" in health.sensor_configuration.product_name
            self._bits = ONROBOT_BITS if self._onrobot else AXIA_BITS if is_axia else NET_FT_BITS
            self._judge(health.last_status)
            if arrived:
                return health.sensor_configuration
            client.stop()
        raise ConnectError(
            f"{self.name}: no sample after {_STARTS} requests",
            "check supply and cable, and enable RDT on its communications page",
        )

    def _fetch(self) -> list[pynetft.Sample]:
        """Return all samples that have arrived; wait 50 ms for the first one and 2 ms for each further one."""
        client = self._client
        if client is None:
            raise StreamBroken(f"{self.name}: closed")
        samples: list[pynetft.Sample] = []
        try:
            samples.append(next(client.samples(timeout=_WAIT_S)))
            self._clock.sleep(_BATCH_S)
            for sample in client.samples(timeout=0.0):
                samples.append(sample)
        except TimeoutError:
            pass
        except StopIteration:
            raise StreamBroken(f"{self.name}: closed") from None
        if not samples:
            health, silent_s = client.health(), (self._clock.now_ns() - self._arrived_ns) / 1e9
            has_failed = health.state is not pynetft.ClientState.STREAMING
            if has_failed:
                self._judge(health.last_status)
            if has_failed or silent_s > _SILENCE_S:
                why = health.last_error if has_failed else f"nothing arrived for {silent_s:.2f} s"
                raise StreamBroken(
                    f"{self.name}: the stream has ended ({why})", "check cable and supply, then open it again"
                )
        return samples

    def _judge(self, status: int) -> None:
        """Raise `DeviceFault` if the status word contains a fault; log a latched monitor condition once."""
        if status not in {0, MONITOR_LATCHED}:
            raise DeviceFault(f"{self.name}: status {describe_status(status, self._bits, 32)}", UNUSABLE)
        if status and not self._warned:
            log.warning("%s: status %s; measurement continues", self.name, describe_status(status, self._bits, 32))
            self._warned = True

    def _read_page(self, path: str) -> bytes:
        """Return a page of the sensor, which holds values that pynetft does not read, such as rate and range."""
        try:
            page = http.client.HTTPConnection(self._host, self._http_port, timeout=self._http_s)
            with self._clock.away(), closing(page) as connection:
                connection.request("GET", path)
                return connection.getresponse().read(65536)
        except (OSError, ValueError, http.client.HTTPException) as exc:
            raise self._unread(exc) from exc

    def _unread(self, exc: Exception) -> ConnectError:
        return ConnectError(f"{self.name}: its configuration cannot be read ({exc})", "check address, cable and supply")
