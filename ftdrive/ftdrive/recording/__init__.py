"""Recordings of a compensated stream: one data model, three file formats."""

from ftdrive.recording.files import RecordingReader, load_recording, write_recording
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import Header, Measured, Recording

__all__ = ["Header", "Measured", "Recorder", "Recording", "RecordingReader", "load_recording", "write_recording"]
