"""Fleets of cells: states, findings across cells, metrics, and the re-solving of many runs."""
