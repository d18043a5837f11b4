"""The base of every sensor driver; see "A driver in another package" in README.md."""

from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, StreamLimits, scale_facts

__all__ = ["NOTHING", "StreamLimits", "StreamingSensor", "scale_facts"]
