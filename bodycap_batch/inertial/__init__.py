"""The use of inertial sensors with solved poses: alignment, gravity, and poses through lost frames."""

from bodycap_batch.inertial.alignment import align_sensor
from bodycap_batch.inertial.camera_rotation import camera_rotation
from bodycap_batch.inertial.camera_sensor import use_sensor
from bodycap_batch.inertial.force_windows import force_windows

__all__ = ["align_sensor", "camera_rotation", "force_windows", "use_sensor"]
