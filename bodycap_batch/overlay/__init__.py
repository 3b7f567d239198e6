"""The solved body and the map's points as a camera sees them, and both drawn into its picture."""

from bodycap_batch.overlay.body import Body, Bones, body_of
from bodycap_batch.overlay.drawing import draw_overlay
from bodycap_batch.overlay.projection import BoneLine, bone_lines
from bodycap_batch.overlay.views import CameraView, SeenPoints, camera_views

__all__ = [
    "Body",
    "BoneLine",
    "Bones",
    "CameraView",
    "SeenPoints",
    "body_of",
    "bone_lines",
    "camera_views",
    "draw_overlay",
]
