"""Render ``preview.mp4``: the body in its room, next to the source videos with overlays of the results."""

from bodycap_batch.preview.preview_film import PreviewInputs, render_preview
from bodycap_batch.preview.undistorted_clip import UndistortedClip, write_undistorted_clip

__all__ = ["PreviewInputs", "UndistortedClip", "render_preview", "write_undistorted_clip"]
