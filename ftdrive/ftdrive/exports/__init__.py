"""Exports to other programs: one module per target, each from an object of ftdrive to the text of a file."""
