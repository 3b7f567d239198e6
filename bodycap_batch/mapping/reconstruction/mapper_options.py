"""Set the options of COLMAP's incremental mapper."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from bodycap_batch.config import MapOptions

if TYPE_CHECKING:
    import pycolmap

MIN_MODEL_KEYFRAMES = 3
"""Minimum number of keyframes of a model. Evidence: none."""
_ADJUSTMENT_TOLERANCE = 1e-5
"""Relative change of the cost at which a bundle adjustment ends. With COLMAP's default of 0, every adjustment
uses the maximum number of iterations. Evidence: docs/decisions/mapping.md."""
_GLOBAL_GROWTH = 1.4
"""Growth of the map at which it is adjusted globally again: ratio of the number of frames to the number of
frames at the last global adjustment. The same ratio is used for points. COLMAP's default is 1.1.
Evidence: docs/decisions/mapping.md."""
_GLOBAL_REFINEMENTS = 2
"""Maximum number of rounds of a global adjustment. COLMAP's default is 5.
Evidence: docs/decisions/mapping.md."""
_LOCAL_REFINEMENTS = 1
"""Maximum number of rounds of a local adjustment. COLMAP's default is 2.
Evidence: docs/decisions/mapping.md."""
MIN_RESECTION_INLIERS = 20
"""Minimum number of map points that must agree with the pose of a keyframe to register the keyframe. COLMAP's
default is 30. Evidence: docs/decisions/mapping.md."""
_MAX_RESECTION_ERROR_PX = 4.0
"""Maximum reprojection error of a map point that agrees with the pose of a keyframe when the keyframe is
registered, px of an image with a long side of 640 px. Origin: the maximum error of a match. COLMAP's default
of 12 is for larger images; here, 12 px also accept a wall of bricks that is shifted by a row.
Evidence: docs/decisions/mapping.md."""
_MAX_EXTRA_PARAM = 1e3
"""Maximum absolute value of an accepted distortion parameter. COLMAP's default of 1 rejects cameras with
k3 > 1 without a message, but a given calibration must be accepted."""


def make_mapper_options(
    options: MapOptions, calibrated_ids: Collection[int], scale: float
) -> pycolmap.IncrementalPipelineOptions:
    """Return mapper options that give reproducible maps and keep calibrated intrinsics constant.

    The mapper uses one thread. With several threads, the residuals would be added in another order in each
    run, so the map would differ from run to run.

    Args:
        options: The stage's options.
        calibrated_ids: Database ids of the calibrated cameras.
        scale: Factor that multiplies all pixel thresholds.
    """
    import pycolmap

    settings = pycolmap.IncrementalPipelineOptions()
    settings.random_seed = options.seed
    settings.num_threads = 1
    settings.ba_min_num_residuals_for_cpu_multi_threading = 2**31 - 1
    settings.ba_local_function_tolerance = _ADJUSTMENT_TOLERANCE
    settings.ba_global_function_tolerance = _ADJUSTMENT_TOLERANCE
    settings.ba_global_frames_ratio = settings.ba_global_points_ratio = _GLOBAL_GROWTH
    settings.ba_global_max_refinements = _GLOBAL_REFINEMENTS
    settings.ba_local_max_refinements = _LOCAL_REFINEMENTS
    settings.extract_colors = False
    settings.min_model_size = MIN_MODEL_KEYFRAMES
    settings.constant_cameras = set(calibrated_ids)
    settings.ba_refine_sensor_from_rig = False
    for part in (settings, settings.mapper, settings.triangulation):
        part.max_extra_param = _MAX_EXTRA_PARAM
    settings.mapper.abs_pose_min_num_inliers = MIN_RESECTION_INLIERS
    settings.mapper.abs_pose_max_error = _MAX_RESECTION_ERROR_PX * scale
    settings.mapper.init_max_error *= scale
    settings.mapper.filter_max_reproj_error *= scale
    return settings
