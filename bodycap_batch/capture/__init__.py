"""The videos of a capture: cameras, timestamps, frame decoding."""

from bodycap_batch.capture.cameras import Capture, CaptureCamera, rolling_shutter_delay_s
from bodycap_batch.capture.kept import FrameKeeper, KeptFrames, Shot
from bodycap_batch.capture.opening import open_camera, open_capture

__all__ = [
    "Capture",
    "CaptureCamera",
    "FrameKeeper",
    "KeptFrames",
    "Shot",
    "open_camera",
    "open_capture",
    "rolling_shutter_delay_s",
]
