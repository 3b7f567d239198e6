"""Stage 3: every frame's pose, by tracking the map's points into it."""

from bodycap_batch.registration.poses.rig_members import RegisteredCamera
from bodycap_batch.registration.recovery.recover import find_lost_poses
from bodycap_batch.registration.stage import (
    prepare_recovery,
    register_frames,
    register_in_rig,
    remove_misplaced_keyframes,
)

__all__ = [
    "RegisteredCamera",
    "find_lost_poses",
    "prepare_recovery",
    "register_frames",
    "register_in_rig",
    "remove_misplaced_keyframes",
]
