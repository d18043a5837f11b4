"""Recordings of a compensated stream: one definition, three file formats."""

from ftdrive.recording.files import RecordingReader, read_recording, write_recording
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import Header, Measured, Recording

__all__ = ["Header", "Measured", "Recorder", "Recording", "RecordingReader", "read_recording", "write_recording"]
