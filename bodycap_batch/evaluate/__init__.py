"""Compare results with ground truth: trajectories, relative camera poses, motions and covariances."""

from bodycap_batch.evaluate.motion import MotionOptions, MotionReport, evaluate_motion, score_motion
from bodycap_batch.evaluate.relative_cameras import (
    RelativeCameraError,
    normalised_errors,
    relative_camera_error,
)
from bodycap_batch.evaluate.trajectories import (
    CameraScore,
    ErrorSummary,
    TrajectoryOptions,
    TrajectoryReport,
    evaluate_trajectories,
    score_trajectories,
)

__all__ = [
    "CameraScore",
    "ErrorSummary",
    "MotionOptions",
    "MotionReport",
    "RelativeCameraError",
    "TrajectoryOptions",
    "TrajectoryReport",
    "evaluate_motion",
    "evaluate_trajectories",
    "normalised_errors",
    "relative_camera_error",
    "score_motion",
    "score_trajectories",
]
