"""Compare results with ground truth: trajectories, relative camera poses and motions."""

from bodycap_batch.evaluate.motion import MotionOptions, MotionReport, evaluate_motion, score_motion
from bodycap_batch.evaluate.trajectories import (
    Alignment,
    CameraScore,
    ErrorSummary,
    RelativeCameraError,
    TrajectoryReport,
    relative_camera_error,
    score_trajectories,
)

__all__ = [
    "Alignment",
    "CameraScore",
    "ErrorSummary",
    "MotionOptions",
    "MotionReport",
    "RelativeCameraError",
    "TrajectoryReport",
    "evaluate_motion",
    "relative_camera_error",
    "score_motion",
    "score_trajectories",
]
