"""A guided session: README.md has the states, the guards and the checks."""

from ftdrive.runs.outcome import Outcome, dataset_of, solve_records

__all__ = ["Outcome", "dataset_of", "solve_records"]
