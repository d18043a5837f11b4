"""Fleets of cells: states, findings across cells, metrics, and solving of many runs again."""
