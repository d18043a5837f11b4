"""A moving cell over its wires: the wrench is that of the payload's motion, at the time of the joints and the delays.

The motion is taken from the joints that RTDE reports, by differences, and the payload is Newton's: force from the
second derivative of the path of its centre of mass, torque from the derivative of its angular momentum.
"""

import mmap
import os
import select
import socket
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.kinematics import MODELS, forward
from ftmocks.sensors.netft import RECORD, NetFtBox
from tests.wire.station_process import StationProcess
from tests.wire.waiting import LIMIT_S

Array = NDArray[np.float64]

DURATION_S = 5.0
RTDE_STEP_S, SENSOR_STEP_S = 0.002, 0.001


@dataclass
class Link:
    """Packages of one link, and when each came, in the cell's time (s)."""

    packages: list[bytes] = field(default_factory=list)
    came_s: list[float] = field(default_factory=list)

    def times_s(self, steps_s: Array) -> Array:
        """Put device times on the cell's time: no package comes before it was sent."""
        shifted: Array = steps_s + np.min(np.array(self.came_s) - steps_s)
        return shifted


def collected(station: StationProcess) -> tuple[Link, Link]:
    """Read the sensor and the arm for `DURATION_S`, while the arm swings."""
    with Path(station.hello["clock"]).open("rb") as file:
        clock = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)).cast("q")
    sensor, arm, rest = Link(), Link(), b""
    where = station.hello["sensors"]["netft"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as samples, station.connect(30004) as rtde:
        samples.connect((where["host"], where["rdt_port"]))
        setup = struct.pack(">d", 1 / RTDE_STEP_S) + b"timestamp,actual_q"
        rtde.sendall(struct.pack(">HB", 3 + len(setup), ord("O")) + setup + b"\x00\x03S")
        samples.send(struct.pack(">HHI", 0x1234, 2, 0))
        end_s = clock[1] * 1e-9 + DURATION_S
        now_s = 0.0
        while now_s < end_s:
            ready = select.select([samples, rtde], [], [], LIMIT_S)[0]
            now_s = clock[1] * 1e-9
            if samples in ready:
                sensor.packages.append(samples.recv(36))
                sensor.came_s.append(now_s)
            if rtde in ready:
                rest += os.read(rtde.fileno(), 1 << 16)
                while len(rest) > 3 and len(rest) >= (size := struct.unpack(">H", rest[:2])[0]):
                    if rest[2:3] == b"U":
                        arm.packages.append(rest[4:size])
                        arm.came_s.append(now_s)
                    rest = rest[size:]
    return sensor, arm


def derivative(values: Array) -> Array:
    return np.asarray(np.gradient(values, RTDE_STEP_S, axis=0))


def loads(q_rad: Array, truth: dict[str, object]) -> tuple[Array, Array]:
    """Wrench of a moved and of a still payload, (n, 6) each, sensor axes, with bias."""
    true = {name: np.array(value) for name, value in truth.items()}
    X = np.array([forward(MODELS["UR5e"], q) for q in q_rad.tolist()])
    R = X[:, :3, :3] @ true["R_flange_sensor"]
    com = X[:, :3, 3] + X[:, :3, :3] @ true["p_flange_sensor_m"] + R @ true["p_sensor_com_m"]
    spin = derivative(R) @ R.swapaxes(1, 2)
    omega = np.stack((spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1])) / 2
    momentum = np.einsum("nij,jk,nlk,ln->ni", R, true["inertia_kg_m2"], R, omega)
    wrenches = []
    for pull, twist in (
        (true["gravity_force_base_N"] - true["mass_kg"] * derivative(derivative(com)), derivative(momentum)),
        (np.tile(true["gravity_force_base_N"], (len(R), 1)), np.zeros((len(R), 3))),
    ):
        force, turn = np.einsum("nji,nj->ni", R, pull), np.einsum("nji,nj->ni", R, twist)
        wrenches.append(
            np.hstack(
                (force + true["force_bias_N"], np.cross(true["p_sensor_com_m"], force) - turn + true["torque_bias_Nm"])
            )
        )
    return wrenches[0], wrenches[1]


@pytest.mark.slow
@pytest.mark.parametrize(("sensor_ms", "rtde_ms"), [(12, 3), (0, 20)])
def test_the_wrench_is_that_of_the_motion_and_the_links_are_late_by_their_delays(sensor_ms: int, rtde_ms: int) -> None:
    delays = ("--sensor-delay-ms", str(sensor_ms), "--rtde-delay-ms", str(rtde_ms))
    with StationProcess("--sensor", "netft", "--seed", "2", "--sensor-origin", "0.01,0,0.05", *delays) as station:
        station.ask("swing", seconds=60)
        sensor, arm = collected(station)
        truth = station.hello["truth"]
    records = np.frombuffer(b"".join(sensor.packages), RECORD)
    readings = records["counts"] / NetFtBox(lambda n: np.zeros((n, 6))).calibration.counts_per_SI
    sensor_s = sensor.times_s(records["rdt"] * SENSOR_STEP_S)
    stamps_s, q_rad = np.split(np.array([struct.unpack(">7d", package) for package in arm.packages]), [1], axis=1)
    arm_s = arm.times_s(stamps_s[:, 0])
    assert (np.diff(records["rdt"]) == 1).all()
    np.testing.assert_allclose(np.diff(stamps_s[:, 0]), RTDE_STEP_S, atol=1e-12)

    sigma = np.repeat([truth["noise_force_N"], truth["noise_torque_Nm"]], 3)
    moved, still = loads(q_rad, truth)
    used = (sensor_s > arm_s[0] + 0.8) & (sensor_s < arm_s[-1] - 0.05)  # swinging, and known

    def residual(model: Array, delay_s: float) -> Array:
        """In sigmas of the noise, (6,)."""
        expected = [np.interp(sensor_s[used] - delay_s, arm_s, column) for column in model.T]
        return np.asarray(np.sqrt(np.mean(((readings[used] - np.transpose(expected)) / sigma) ** 2, axis=0)))

    tried_s = 1e-3 * np.arange(-30, 30, 0.25)
    found_s = tried_s[np.argmin([np.sum(residual(moved, delay_s) ** 2) for delay_s in tried_s])]
    assert found_s == pytest.approx(1e-3 * (sensor_ms - rtde_ms), abs=11e-3), "a busy computer adds the clock's lead"
    assert residual(moved, found_s) == pytest.approx(np.ones(6), abs=6 / np.sqrt(2 * used.sum()))
    assert residual(still, found_s).min() > 3.0, "inertia is no trifle here"
