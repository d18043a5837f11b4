"""Texts of results, sessions, streams and weighings: pure functions, and the view models of screens and pages."""
