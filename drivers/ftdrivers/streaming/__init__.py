"""The base class of sensor drivers; docs/how-to/add-a-sensor.md shows a driver in another package."""

from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, StreamLimits, scale_facts

__all__ = ["NOTHING", "StreamLimits", "StreamingSensor", "scale_facts"]
