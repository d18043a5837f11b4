"""A guided session: README.md has the states, the guards and the checks."""

from ftdrive.session.outcome import Outcome, cell_of, dataset_of, sampling_of, solve_records

__all__ = ["Outcome", "cell_of", "dataset_of", "sampling_of", "solve_records"]
