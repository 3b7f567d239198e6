"""Stage 3: estimate the pose of every frame by tracking map points from the keyframes."""

from bodycap_batch.registration.further_maps import localise_in_other_maps
from bodycap_batch.registration.poses.contradicted import withdraw_contradicted_poses
from bodycap_batch.registration.poses.registered_camera import RegisteredCamera
from bodycap_batch.registration.poses.turning_tracks import with_rotation
from bodycap_batch.registration.recovery.recover import RecoveryInputs, recover_lost_frames
from bodycap_batch.registration.stage import register_frames

__all__ = [
    "RecoveryInputs",
    "RegisteredCamera",
    "localise_in_other_maps",
    "recover_lost_frames",
    "register_frames",
    "with_rotation",
    "withdraw_contradicted_poses",
]
