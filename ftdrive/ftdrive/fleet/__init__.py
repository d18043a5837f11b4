"""Many cells: their state, findings across them, solving again, metrics."""
