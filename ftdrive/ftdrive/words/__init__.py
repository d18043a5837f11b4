"""Texts for results, sessions, streams and weighings: pure functions, and the view models for screens and pages."""
