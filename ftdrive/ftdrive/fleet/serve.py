"""The server of a fleet: reads its state again and again, and passes it to the metrics."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Final

from ftdrive.errors import BadStore
from ftdrive.fleet.state import Fleet
from ftdrive.runs.verification import age_in_words
from ftdrivers.clock import Clock

# Time between two reads of the store.
EVERY_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class FleetReading:
    """The state of a fleet as it was read last."""

    fleet: Fleet
    read: datetime
    """When it was read from the store, UTC."""
    now: datetime
    """When it is passed on, UTC; later than `read` while the store cannot be read."""
    store_up: bool = True


def serve(
    fleet_at: Callable[[datetime], Fleet],
    update: Callable[[FleetReading], None],
    clock: Clock,
    *,
    say: Callable[[str], None],
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> None:
    """Read the state and pass it on until an exception ends it, such as `KeyboardInterrupt`.

    A store that cannot be read later than at the start ends nothing: the last state stays, with its age.

    Parameters
    ----------
    fleet_at : callable
        Reads the state at a time, UTC.
    update : callable
        Takes the newest reading, and returns at once.
    clock : Clock
        Times the period.
    say : callable
        Takes a sentence for the operator.

    Raises
    ------
    BadStore
        The store cannot be read at the start.
    """
    # A store that cannot be read at the start ends the server, so that a wrong address is noticed at once.
    time = now()
    reading = FleetReading(fleet_at(time), time, time)
    while True:
        update(reading)
        clock.sleep(EVERY_S)
        was_up, time = reading.store_up, now()
        try:
            reading = FleetReading(fleet_at(time), time, time)
        except BadStore as error:
            reading = replace(reading, now=time, store_up=False)
            if was_up:
                say(f"{error}. The last state is served meanwhile. It is {age_in_words(time - reading.read)} old.")
        else:
            if not was_up:
                say("The store can be read again.")
