"""Our program on the controller, as far as it may run there while no control path can end it."""

import logging
import threading

from ftdrivers.errors import DeviceError
from ftdrivers.ur.services import Services, ServicesOf
from ftdrivers.ur.timing import UrTiming

log = logging.getLogger(__name__)


class OwnProgram:
    """Remembers whether a program of ours may run, and ends it through the services of the controller."""

    def __init__(self, timing: UrTiming) -> None:
        self._timing = timing
        self._services: ServicesOf | None = None
        self._starting = False  # it was sent and has not been seen to play: it may still start after a stop
        self._stops_itself = False
        self._stop_wanted = threading.Event()  # by an attempt in the background
        self.left_behind = False
        """Whether a program of ours may run on the controller."""

    def is_sent(self, services: ServicesOf, *, stops_itself: bool) -> None:
        """Note that a program is on its way to the controller; `services` can end it."""
        self._services, self._stops_itself = services, stops_itself
        self.left_behind = self._starting = True

    def has_started(self) -> None:
        """Note that it runs."""
        self._starting = False

    def is_stopped(self) -> None:
        """Note that no program runs: one that runs later is not ours, unless ours is still to start."""
        self.left_behind = self._starting

    def is_gone(self) -> None:
        """Note that it was not taken, has ended or was replaced."""
        self.left_behind = self._starting = False

    def cancel_stop(self) -> None:
        """Let no attempt in the background stop the next program."""
        self._stop_wanted.clear()

    def stop(self, *, silent: bool = False) -> None:
        """End it; an attempt that takes longer than its limit goes on in the background. Never raises `DeviceError`."""

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
                log.info("the control program stops the arm by itself: %s", error)
            else:
                host = self._services.host
                log.warning("%s did not receive the stop; press the emergency stop if it moves: %s", host, error)
