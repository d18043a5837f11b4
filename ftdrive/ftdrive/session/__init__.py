"""A guided session: docs/explanation/safety.md has the states, the guards and the checks."""
