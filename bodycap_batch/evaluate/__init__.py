"""Compare results with ground truth: trajectories, relative camera poses and motions."""

from bodycap_batch.evaluate.motion import MotionOptions, evaluate_motion, score_motion
from bodycap_batch.evaluate.trajectories import (
    Alignment,
    TrajectoryReport,
    relative_camera_error,
    score_trajectories,
)

__all__ = [
    "Alignment",
    "MotionOptions",
    "TrajectoryReport",
    "evaluate_motion",
    "relative_camera_error",
    "score_motion",
    "score_trajectories",
]
