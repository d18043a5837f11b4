"""The report of a calibration: facts first, then the same facts as a page, as Markdown or as JSON."""
