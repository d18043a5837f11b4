"""Exports to other programs: functions that return the text of a file."""
