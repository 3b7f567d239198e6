"""Bundle adjustment of a model, with a squared or a robust loss."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.reconstruction.reprojection import median_residual_px

if TYPE_CHECKING:
    import pycolmap

_ROBUST_TOLERANCE = 1e-4
"""Relative change of the cost at which an adjustment with a robust loss ends. Such an adjustment converges
slowly. Evidence: docs/decisions/mapping.md."""

_MAX_DIRECT_TRACK_LENGTH = 14.0
"""Maximum mean track length (keyframes) for a direct solver in the robust adjustment. For longer tracks,
conjugate gradients are used, because the time of the direct solver grows with the square of the track length.
The time of conjugate gradients grows linearly. Evidence: docs/decisions/mapping.md."""

_STEP_ACCURACY = 1e-3
"""Relative error of a step at which conjugate gradients end. COLMAP's default is 0.1.
Evidence: docs/decisions/mapping.md."""

_MIN_LOSS_PX = 0.05
"""Minimum width (px) of the robust loss, for models whose residuals are almost zero. Evidence: none."""


def adjust_and_filter(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """Adjust a model with a squared loss and remove outliers, in place.

    The arguments and errors are the same as in `bundle_adjust`.
    """
    bundle_adjust(model, settings, calibrated_ids, only=only)
    _filter_points(model, settings)


def adjust_robustly(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """Adjust a finished model with a robust loss and remove outliers, in place.

    The arguments are the same as in `bundle_adjust`. Most keypoints have an error of a quarter of a pixel,
    but one keypoint in ten has an error of a pixel or more; most of these keypoints are large or blurred.
    With a squared loss, these keypoints deform the map. So a Cauchy loss is used. Its width is the median
    absolute residual along an image axis: the most likely width, given the residuals. The disadvantage of
    this loss: if all noise were Gaussian, the error of the map would be 1.4 times as large as with a squared
    loss. Evidence: docs/decisions/mapping.md.

    Raises:
        EstimationError: The adjustment failed.

    Source: Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting", 1997, for
        the loss. The width is the maximum-likelihood scale of a Cauchy distribution.
    """
    width_px = max(_MIN_LOSS_PX, median_residual_px(model))
    bundle_adjust(model, settings, calibrated_ids, loss_px=width_px, only=only)
    _filter_points(model, settings)


def _mean_track_length(model: Any) -> float:
    """Return the mean track length, in which the weight of each track is its number of observations."""
    length = np.array([model.point3D(point).track.length() for point in model.point3D_ids()], dtype=float)
    return float((length**2).sum() / max(1.0, length.sum()))


def _filter_points(model: Any, settings: pycolmap.IncrementalPipelineOptions) -> None:
    """Remove observations with large residuals and points with small triangulation angles, in place."""
    import pycolmap

    pycolmap.ObservationManager(model).filter_all_points3D(
        settings.mapper.filter_max_reproj_error, settings.mapper.filter_min_tri_angle
    )
    model.update_point_3d_errors()


def sub_model(model: Any, image_ids: Collection[int]) -> Any:
    """Return a copy of a model in which only the images `image_ids` stay registered."""
    part = copy.deepcopy(model)
    for image_id in part.reg_image_ids():
        if image_id not in image_ids:
            part.deregister_frame(part.image(image_id).frame_id)
    return part


def bundle_adjust(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Collection[int],
    iterations: int | None = None,
    loss_px: float | None = None,
    only: Collection[int] | None = None,
) -> None:
    """Adjust a model once.

    By default, all poses are adjusted and the model gets a new gauge. If an adjustment leads to an impossible
    lens, it is made again with the lens that the camera had. If `only` is given, all intrinsics are
    constant, and only two things are adjusted: the poses of the images in `only`, and the points that only
    these images observe.

    Args:
        model: A reconstruction, changed in place.
        settings: The mapper's options.
        calibrated_ids: Database ids of the calibrated cameras. The intrinsics of these cameras are constant.
        iterations: Maximum number of iterations; None: the number in the mapper's options.
        loss_px: Width (px) of a Cauchy loss; None: a squared loss.
        only: Ids of the images to adjust; None: all images.

    Raises:
        EstimationError: The adjustment failed.

    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    import pycolmap

    adjustment = settings.get_global_bundle_adjustment()
    if iterations is not None:
        adjustment.ceres.solver_options.max_num_iterations = iterations
    if loss_px is not None:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = loss_px
        adjustment.ceres.solver_options.function_tolerance = _ROBUST_TOLERANCE
    iterative = only is not None or (
        loss_px is not None and _mean_track_length(model) > _MAX_DIRECT_TRACK_LENGTH
    )
    if iterative:
        # COLMAP uses conjugate gradients if more images than these two limits are adjusted. To get conjugate
        # gradients here, the limits are set to the smallest values that COLMAP accepts.
        adjustment.ceres.max_num_images_direct_dense_cpu_solver = 1
        adjustment.ceres.max_num_images_direct_sparse_cpu_solver = 2
        adjustment.ceres.solver_options.eta = _STEP_ACCURACY
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids() if only is None else sorted(only):
        config.add_image(image_id)
    for camera_id in calibrated_ids if only is None else sorted(model.cameras):
        if model.exists_camera(camera_id):
            config.set_constant_cam_intrinsics(camera_id)
    if not iterative:
        # For conjugate gradients, the gauge stays free: a fixed gauge makes the matrix blocks unequal in
        # size, and with unequal blocks conjugate gradients are slow.
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    free = set(model.cameras) - set(calibrated_ids) if only is None else set()
    before = copy.deepcopy(model) if free else None
    summary = pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    limits = settings.mapper
    impossible = {
        camera_id
        for camera_id in free
        if model.camera(camera_id).has_bogus_params(
            limits.min_focal_length_ratio, limits.max_focal_length_ratio, limits.max_extra_param
        )
    }
    if impossible:
        restore(model, before)
        bundle_adjust(model, settings, {*calibrated_ids, *impossible}, iterations, loss_px, only)
        return
    if not summary.is_solution_usable():
        raise EstimationError(
            f"the map of {model.num_reg_images()} keyframes could not be refined: {summary.brief_report()}",
            hint="set `registration: {rounds: 0}` to use the map as it was first built",
        )


def restore(model: Any, before: Any) -> None:
    """Give a model the poses, points and lenses of an earlier copy of it, in place.

    Points that were removed since stay removed.
    """
    for frame_id in before.reg_frame_ids():
        model.frame(frame_id).rig_from_world = before.frame(frame_id).rig_from_world
    for point_id in model.point3D_ids():
        model.point3D(point_id).xyz = before.point3D(point_id).xyz
    for camera_id, camera in before.cameras.items():
        model.camera(camera_id).params = camera.params
