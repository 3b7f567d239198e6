"""Stage 3: every frame's pose, by tracking the map's points into it."""

from bodycap_batch.registration.poses.rig_members import RigCamera
from bodycap_batch.registration.recovery.recover import recover_lost
from bodycap_batch.registration.stage import register_frames, register_in_rig, settled, without_contradicted

__all__ = [
    "RigCamera",
    "recover_lost",
    "register_frames",
    "register_in_rig",
    "settled",
    "without_contradicted",
]
