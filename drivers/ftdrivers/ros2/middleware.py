"""The way to rclpy: that of a sourced ROS 2, else the wheels of the extra `ros2`. Nothing else of ROS is used.

docs/decisions/0179-ros-2-through-rclpy-alone.md gives the reason.
"""

import importlib
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Final

from ftdrivers.errors import NoRos2

WAYS: Final = (
    "source a ROS 2 (`source /opt/ros/jazzy/setup.bash`, ftdrive in a venv with --system-site-packages and its "
    "Python), or install the extra on Linux x86-64: pip install 'ftdrive[ros2]'"
)
"""Both ways to rclpy."""
_PROFILES: Final = {"FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"}
"""Variables that name the user's profiles of Fast DDS; it also reads DEFAULT_FASTDDS_PROFILES.xml where it starts."""


def ros2_module(name: str) -> Any:
    """Import a module of ROS 2, such as "rclpy" or "geometry_msgs.msg". Raises `NoRos2`."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise NoRos2(f"Python cannot import {package} ({error}): {WAYS}") from error


def _stay_on_loopback() -> None:
    """Have Fast DDS bind its ports to loopback where ROS is configured for this computer alone.

    The range of discovery by itself leaves them open on all interfaces. A profile of the user goes first.
    """
    if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") != "LOCALHOST" or _PROFILES & os.environ.keys():
        return
    if not Path("DEFAULT_FASTDDS_PROFILES.xml").exists():
        os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_name("loopback.xml"))


class Node:
    """A node of ROS 2 with a context of its own; callbacks run in its thread between `spin` and `close`.

    Parameters
    ----------
    name : str
        Arguments may give another one.
    arguments : sequence of str
        After and with ``--ros-args``: remapping, parameters, namespace.

    Raises
    ------
    NoRos2
        rclpy is missing, or does not understand the arguments.
    """

    def __init__(self, name: str, arguments: Sequence[str] = ()) -> None:
        rclpy = ros2_module("rclpy")
        self._executors = ros2_module("rclpy.executors")
        _stay_on_loopback()
        self.context = rclpy.Context()
        try:
            rclpy.init(args=["ftdrive", *arguments], context=self.context)  # of a context: no signal handlers
            self.node = rclpy.create_node(name, context=self.context)
        except Exception as error:  # rclpy raises its own, some of them private
            with suppress(Exception):
                self.context.try_shutdown()
            first = next(iter(str(error).splitlines()), "")
            words = " ".join(arguments) or "none"
            raise NoRos2(f"ROS 2 does not start with the arguments {words}: {first}: correct them") from error
        self._executor = self._executors.SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread: Thread | None = None
        self._failure: Exception | None = None

    def spin(self) -> None:
        """Begin to call the callbacks."""
        self._thread = Thread(target=self._spin, name=f"ROS 2 of {self.node.get_name()}", daemon=True)
        self._thread.start()

    def spin_once(self, timeout_s: float) -> None:
        """Call one callback, if one is due within `timeout_s`; before `spin`."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (self._executors.ExternalShutdownException, self._executors.ShutdownException):
            pass  # it was closed
        except Exception as error:
            self._failure = error

    def check(self) -> None:
        """Raise what a callback has raised, because no callback is called since."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Leave the graph. Idempotent."""
        if self.context.ok():
            self._executor.shutdown()
            if self._thread is not None:
                self._thread.join(1.0)
            self.node.destroy_node()
            self.context.try_shutdown()
