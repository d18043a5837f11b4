"""The compensated stream of an emulated cell over its real wires: a push, a moving arm, an interruption."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from ftcalib.model import Array
from ftdrive.cell.emulated import Station
from ftdrive.stream.samples import Axes, Stages, WrenchFrame
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Stream
from ftdrivers.errors import DeviceTimeout
from tests.unit.ftdrive.stream.simulated import calibrated_from

OPTIONS = ("--time-scale", "1", "--sensor-origin", "0,0,0.03", "--inertia", "0,0,0,0,0,0", "--imperfections", "none")


def read(stream: Stream, seconds: float) -> Array:
    end_s = stream.clock.now_s() + seconds
    wrenches = []
    while stream.clock.now_s() < end_s:
        wrenches.append(stream.read().wrench)
    return np.concatenate(wrenches)


@pytest.mark.slow
def test_a_push_a_swing_and_an_interruption() -> None:
    with Station("serial", OPTIONS) as station:
        config = replace(station.cell, sensor=replace(station.cell.sensor, height_mm=30.0))
        calibration = calibrated_from(station.truth)
        with Stream(CellSource(config, calibration), frame=WrenchFrame("base", "flange")) as stream:
            noise = read(stream, 2.0)[7000:].std(axis=0)
            assert stream.read().sigma == pytest.approx(noise, rel=0.5)
            station.control(do="push", wrench=[10.0, 0, 0, 0, 0, 0], axes="base")
            R_axes_base = {
                "sensor": (stream.read().R_base_flange[-1] @ calibration.R_flange_sensor).T,
                "flange": stream.read().R_base_flange[-1].T,
                "base": np.eye(3),
            }
            read(stream, 0.3)
            for axes, R in R_axes_base.items():
                assert axes in get_args(Axes)
                stream.frame = WrenchFrame(axes)  # type: ignore[arg-type]  # checked above
                error_N = read(stream, 0.3).mean(axis=0)[:3] - R @ [10.0, 0, 0]
                sigma_N = stream.read().sigma[:3]
                assert (np.abs(error_N) < 4 * sigma_N).all(), "the sensor's own errors are in it"
                assert np.linalg.norm(sigma_N) < 0.5
            station.control(do="push", wrench=[0.0] * 6)
            read(stream, 0.5)
            assert "contact" in [event.kind for event in stream.take_events()]

            station.control(do="swing", seconds=60)
            stream.stages = Stages(inertia=True)
            for _ in range(50):  # a starved cell shows less of the motion
                if stream.status().delay_sigma_s < 1e-3:
                    break
                read(stream, 1.0)
            assert 0 < stream.status().delay_sigma_s < 1e-3
            dynamic = read(stream, 2.0).std(axis=0)
            stream.stages = Stages()
            static = read(stream, 2.0).std(axis=0)
            # of all axes, because two seconds need not move each of them
            assert np.linalg.norm(dynamic[:3]) < 0.5 * np.linalg.norm(static[:3])

            station.control(do="sensor-faults", stall=True)
            with pytest.raises(DeviceTimeout):
                read(stream, 5.0)
            station.control(do="sensor-faults", stall=False)
            for _ in range(30):
                try:
                    stream.read()
                    break
                except DeviceTimeout:
                    continue
            read(stream, 0.1)
            kinds = [event.kind for event in stream.take_events()]
            assert kinds.count("stale") == kinds.count("recovered") == 1
