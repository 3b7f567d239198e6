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
"""Relative change of the cost that ends an adjustment with a robust loss, which converges slowly.
Evidence: docs/decisions/mapping.md."""

_MAX_DIRECT_TRACK_LENGTH = 14.0
"""Mean track length, in keyframes, above which the robust adjustment uses conjugate gradients. Eliminating
the points costs the square of the track length; conjugate gradients cost the track length. Evidence:
docs/decisions/mapping.md."""

_STEP_ACCURACY = 1e-3
"""Relative error at which conjugate gradients end; COLMAP: 0.1. Evidence: docs/decisions/mapping.md."""

_MIN_LOSS_PX = 0.05
"""Smallest width of the robust loss, px, for models without residuals. Evidence: none."""


def adjust_and_filter(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """Adjust a model with a squared loss and remove outliers; arguments and errors as `bundle_adjust`."""
    bundle_adjust(model, settings, calibrated_ids, only=only)
    _filter_points(model, settings)


def adjust_robustly(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """Adjust a finished model with a robust loss and remove outliers; arguments as `bundle_adjust`.

    Keypoints are accurate to a quarter of a pixel, but one in ten is off by four times that or more: large
    and blurred ones above all. With a squared loss these bend the map. The loss is Cauchy's. Its width is the
    median absolute residual along an axis, which is its most likely width given the residuals. If all noise
    were Gaussian, it would cost 1.4 times the error. Evidence: docs/decisions/mapping.md.

    Raises:
        EstimationError: The adjustment failed.

    Source: Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting", 1997, for
        the loss; its width is the maximum-likelihood scale of a Cauchy distribution.
    """
    width_px = max(_MIN_LOSS_PX, median_residual_px(model))
    bundle_adjust(model, settings, calibrated_ids, loss_px=width_px, only=only)
    _filter_points(model, settings)


def _mean_track_length(model: Any) -> float:
    """Return the length of a point's track, as the mean over all observations."""
    length = np.array([model.point3D(point).track.length() for point in model.point3D_ids()], dtype=float)
    return float((length**2).sum() / max(1.0, length.sum()))


def _filter_points(model: Any, settings: pycolmap.IncrementalPipelineOptions) -> None:
    """Remove observations with large residuals and points with small angles, in place."""
    import pycolmap

    pycolmap.ObservationManager(model).filter_all_points3D(
        settings.mapper.filter_max_reproj_error, settings.mapper.filter_min_tri_angle
    )
    model.update_point_3d_errors()


def sub_model(model: Any, image_ids: Collection[int]) -> Any:
    """Return a copy of a model with only some of its registered images."""
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
    """Adjust a model once, with every pose free; the gauge moves.

    If `only` is given, all intrinsics, all other poses and the points that other images observe are constant.

    Args:
        model: A reconstruction, changed in place.
        settings: The mapper's options.
        calibrated_ids: Ids of the calibrated cameras.
        iterations: Largest number of iterations; that of the options by default.
        loss_px: Width of a Cauchy loss, px; a squared loss by default.
        only: Ids of the images to adjust; all by default.

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
        # COLMAP uses conjugate gradients above these numbers of images; these are the least it accepts.
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
        # A fixed gauge makes blocks of different sizes, which slow conjugate gradients down.
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    if not summary.is_solution_usable():
        raise EstimationError(
            f"the map of {model.num_reg_images()} keyframes could not be refined: {summary.brief_report()}",
            hint="set registration: {rounds: 0} to keep the map as it was first built",
        )
