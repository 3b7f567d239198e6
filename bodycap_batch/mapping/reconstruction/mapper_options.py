"""The options of COLMAP's incremental mapper."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from bodycap_batch.config import MapOptions

if TYPE_CHECKING:
    import pycolmap

MIN_MODEL_KEYFRAMES = 3
"""Keyframes of a model, at least. Evidence: none."""
_ADJUSTMENT_TOLERANCE = 1e-5
"""Relative change of the cost that ends a bundle adjustment. With COLMAP's 0, every adjustment runs to its
last iteration. Evidence: docs/decisions/mapping.md."""
_GLOBAL_GROWTH = 1.4
"""Growth factor of the map after which it is adjusted globally; COLMAP: 1.1.
Evidence: docs/decisions/mapping.md."""
_GLOBAL_REFINEMENTS = 2
"""Rounds of a global adjustment; COLMAP: 5. Evidence: docs/decisions/mapping.md."""
_LOCAL_REFINEMENTS = 1
"""Rounds of a local adjustment; COLMAP: 2. Evidence: docs/decisions/mapping.md."""
_MIN_RESECTION_INLIERS = 20
"""Map points that a keyframe must agree with to be registered; COLMAP: 30.
Evidence: docs/decisions/mapping.md."""
_MAX_EXTRA_PARAM = 1e3
"""Largest distortion parameter that is accepted. A given calibration is trusted: COLMAP's 1 silently drops
cameras with k3 > 1."""


def make_mapper_options(
    options: MapOptions, calibrated_ids: Collection[int], scale: float
) -> pycolmap.IncrementalPipelineOptions:
    """Return mapper options that are seeded and reproducible, with calibrated intrinsics held constant.

    The mapper gets one thread. Several threads add up residuals in an order that changes from run to run,
    and the map would change with it.

    Args:
        options: The stage's options.
        calibrated_ids: Database ids of the calibrated cameras.
        scale: Factor on pixel thresholds.
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
    settings.mapper.abs_pose_min_num_inliers = _MIN_RESECTION_INLIERS
    settings.mapper.abs_pose_max_error *= scale
    settings.mapper.init_max_error *= scale
    settings.mapper.filter_max_reproj_error *= scale
    return settings
