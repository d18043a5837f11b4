"""The report of a calibration: facts, and their presentation as a page or as JSON."""
