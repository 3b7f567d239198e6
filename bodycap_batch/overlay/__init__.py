"""Project the solved body and the map points into each camera's images, and draw them."""

from bodycap_batch.overlay.bones import BoneLine, BoneMotion, Bones, bones_from_motion, project_bones
from bodycap_batch.overlay.camera_views import CameraView, ObservedPoints, make_camera_views
from bodycap_batch.overlay.drawing import Colour, RgbImage, draw_overlay

__all__ = [
    "BoneLine",
    "BoneMotion",
    "Bones",
    "CameraView",
    "Colour",
    "ObservedPoints",
    "RgbImage",
    "bones_from_motion",
    "draw_overlay",
    "make_camera_views",
    "project_bones",
]
