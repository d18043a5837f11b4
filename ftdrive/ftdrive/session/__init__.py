"""A guided session: README.md has the states, the guards and the checks."""
