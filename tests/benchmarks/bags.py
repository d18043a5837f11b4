"""Time to solve and compensate a bag: 10 minutes at 1 kHz, poses at 500 Hz. `python -m tests.benchmarks.bags`."""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from ftdrive.live.ros2 import pack_pose_numbers, pack_wrenches
from tests.ros2.seven_joints import TRUTH, flange, sway, wrench
from tests.unit.ftdrive.recording.test_bag import STORE, T0_NS, TOPICS

_SECONDS, _LIMIT_S = 600.0, 30.0


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    t_wrench, t_pose = np.arange(0, _SECONDS, 1e-3), np.arange(0, _SECONDS, 2e-3)
    measured = wrench(t_wrench, sway) + np.random.default_rng(1).normal(size=(len(t_wrench), 6)) * TRUTH["noise"]
    R, p = flange(sway(t_pose))
    times = [T0_NS + np.rint(1e9 * t_s).astype(np.int64) for t_s in (t_wrench, t_pose)]
    poses = np.hstack([p, Rotation.from_matrix(R).as_quat()])
    messages = [pack_wrenches(times[0], measured, "ft").tolist(), pack_pose_numbers(times[1], poses).tolist()]
    with tempfile.TemporaryDirectory() as folder:
        for plugin in StoragePlugin:
            path = Path(folder) / plugin.name
            with Writer(path, version=9, storage_plugin=plugin) as writer:
                for topic, t_ns, some in zip(("/ft", "/pose"), times, messages, strict=True):
                    connection = writer.add_connection(topic, TOPICS[topic], typestore=STORE)
                    for at, one in zip(t_ns.tolist(), some, strict=True):
                        writer.write(connection, at, one)
            result = Path(folder) / f"{plugin.name}.json"
            for command in (
                ["solve", str(path), "-o", str(result)],
                ["compensate", str(path), "--calibration", str(result)],
            ):
                begin_s, cpu_s = time.monotonic(), _children_s()
                subprocess.run([sys.executable, "-m", "ftdrive", *command], check=True, stdout=subprocess.DEVNULL)
                taken_s = time.monotonic() - begin_s
                cpu_s = _children_s() - cpu_s
                sys.stdout.write(
                    f"{plugin.name:8} {command[0]:11} {taken_s:6.1f} s, {taken_s / _LIMIT_S:.2f} of {_LIMIT_S:g} s; "
                    f"CPU {cpu_s:.1f} s, {cpu_s / _LIMIT_S:.2f}\n"
                )
                sys.stdout.flush()


if __name__ == "__main__":
    main()
