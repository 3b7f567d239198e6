"""Bundle adjustment of a model, by squares or with a robust loss."""

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
"""The same for the last adjustment, whose loss converges slowly. Half the time of 1e-5, keyframes as exact
(walk12 0.30 and 0.30 cm, room12 0.71 and 0.73, violent arms 1.30 and 1.30); 1e-3 costs them up to 5 %."""

_MAX_DIRECT_TRACK_LENGTH = 14.0
"""Keyframes that see an observation's point, on average over the observations. Taking the points out of the
equations costs the square of a track, conjugate gradients on what is left only the track. The last
adjustment of walk131 (285 keyframes, 23) takes 3.15 CPU seconds with them instead of 5.4, tum_fr1_xyz (23)
0.50 instead of 0.59, room12 (16) 0.54 instead of 0.61, room131 (12) 0.94 instead of 0.81."""

_STEP_ACCURACY = 1e-3
"""Relative error at which these end. With COLMAP's 0.1 walk131's keyframes are off by 0.314 cm instead of
0.304, with this by 0.304 (room12 0.71 cm, tum_fr1_xyz 0.74, both as with the direct solver)."""

_MIN_LOSS_PX = 0.05
"""Where all residuals vanish."""


def adjust_and_filter(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    constant_cameras: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """One bundle adjustment by squares, outliers taken out. Arguments and errors are those of `bundle_adjust`."""
    bundle_adjust(model, settings, constant_cameras, only=only)
    _filter_points(model, settings)


def adjust_robustly(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    constant_cameras: Collection[int],
    only: Collection[int] | None = None,
) -> None:
    """The last adjustment of a model that stands: what lies off by more than is usual hardly pulls.

    Keypoints are exact to a quarter of a pixel, but one in ten lies off by four times that and more, large
    and blurred ones above all. A square lets those bend the map. The loss is Cauchy's, as wide as the median
    residual along an axis: the width that the residuals themselves make most likely. All frames, with squares
    and with it: walk12 0.38, 0.32 cm, room12 0.66, 0.55, tum_fr1_xyz 0.29, 0.28, a rendered brown-lens walk
    0.67, 0.29, two with sleeves in view 0.93, 0.66 and 0.53, 0.41; with three times the width half as much is
    won. Were all noise Gaussian, it would cost 1.4 times the error.

    Raises:
        EstimationError: The adjustment failed.

    Source: Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting", 1997, for
        the loss; its width is the most likely scale of a Cauchy distribution.
    """
    width_px = max(_MIN_LOSS_PX, median_residual_px(model))
    bundle_adjust(model, settings, constant_cameras, loss_px=width_px, only=only)
    _filter_points(model, settings)


def _mean_track_length(model: Any) -> float:
    """How many keyframes see the point of an observation, on average over the observations."""
    length = np.array([model.point3D(point).track.length() for point in model.point3D_ids()], dtype=float)
    return float((length**2).sum() / max(1.0, length.sum()))


def _filter_points(model: Any, settings: pycolmap.IncrementalPipelineOptions) -> None:
    import pycolmap

    pycolmap.ObservationManager(model).filter_all_points3D(
        settings.mapper.filter_max_reproj_error, settings.mapper.filter_min_tri_angle
    )
    model.update_point_3d_errors()


def sub_model(model: Any, image_ids: Collection[int]) -> Any:
    """A copy of a model with only these of its registered images."""
    part = copy.deepcopy(model)
    for image_id in part.reg_image_ids():
        if image_id not in image_ids:
            part.deregister_frame(part.image(image_id).frame_id)
    return part


def bundle_adjust(
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    constant_cameras: Collection[int],
    iterations: int | None = None,
    loss_px: float | None = None,
    only: Collection[int] | None = None,
) -> None:
    """One bundle adjustment over the whole model, every pose free; the gauge moves.

    Of some keyframes alone: all other poses stay, and so do the points that others see and the lenses.

    Args:
        model: A reconstruction, changed in place.
        settings: The mapper's settings.
        constant_cameras: Ids of calibrated cameras.
        iterations: At most so many; the settings' own number by default.
        loss_px: Width of a Cauchy loss; squares by default.
        only: Ids of the images that are adjusted; all by default.

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
        # By the least numbers that COLMAP accepts, everything beyond which is solved that way.
        adjustment.ceres.max_num_images_direct_dense_cpu_solver = 1
        adjustment.ceres.max_num_images_direct_sparse_cpu_solver = 2
        adjustment.ceres.solver_options.eta = _STEP_ACCURACY
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids() if only is None else sorted(only):
        config.add_image(image_id)
    for camera_id in constant_cameras if only is None else sorted(model.cameras):
        if model.exists_camera(camera_id):
            config.set_constant_cam_intrinsics(camera_id)
    if not iterative:
        # Held coordinates make blocks of unlike sizes, which cost conjugate gradients more than they save.
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    if not summary.is_solution_usable():
        raise EstimationError(
            f"the map of {model.num_reg_images()} keyframes could not be refined: {summary.brief_report()}",
            hint="set registration: {rounds: 0} to keep the map as it was first built",
        )
