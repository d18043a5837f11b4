"""The report on a calibration: facts, and their presentation as a page or as JSON."""
