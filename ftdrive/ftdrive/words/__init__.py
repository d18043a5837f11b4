"""Models in words: pure functions, and the view models of screens and pages."""
