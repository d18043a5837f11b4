"""The report of a calibration: facts first, then the same facts as a page or as JSON."""
