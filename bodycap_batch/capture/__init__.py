"""The videos of a capture: cameras, frame times and decoded frames."""

from bodycap_batch.capture.cameras import Capture, CaptureCamera
from bodycap_batch.capture.kept import FrameCandidate, FrameKeeper, KeptFrames
from bodycap_batch.capture.opening import open_camera, open_capture

__all__ = [
    "Capture",
    "CaptureCamera",
    "FrameCandidate",
    "FrameKeeper",
    "KeptFrames",
    "open_camera",
    "open_capture",
]
