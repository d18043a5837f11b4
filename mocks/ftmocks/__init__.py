"""The far side of the wire: an emulated robot cell. Imports nothing of the other packages."""
