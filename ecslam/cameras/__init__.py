"""Cameras that are on: one file a kind, opened by ``open_camera``; what they bring is recorded while it is used."""

from .camera import Camera, Shot
from .kinds import is_camera, open_camera, recording_name
from .live import LiveRecording

__all__ = ["Camera", "LiveRecording", "Shot", "is_camera", "open_camera", "recording_name"]
