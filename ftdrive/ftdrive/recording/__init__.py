"""Recordings of a compensated stream: one definition, three file formats."""

from ftdrive.recording.files import read_recording, write_recording
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import Header, Recording

__all__ = ["Header", "Recorder", "Recording", "read_recording", "write_recording"]
