"""Check calibrated intrinsics against the map, and select camera models for uncalibrated cameras."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import evenly_spaced
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import DATABASE_NAME
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap

if TYPE_CHECKING:
    import pycolmap

_MAX_KEYFRAMES = 40
"""Maximum number of keyframes in an adjustment of a check. The keyframes are evenly spaced in the model.
Evidence: none."""
_ITERATIONS = 40
"""Maximum number of iterations of an adjustment in a check. Evidence: none."""
_MIN_KEYFRAMES = 10
"""Minimum number of keyframes for a check. Evidence: none."""
_TOLERANCE = 1e-4
"""Relative change of the cost at which an adjustment in a check ends. Evidence: none."""
_LOSS_PX = 1.0
"""Width (px) of the Cauchy loss of an adjustment in a check. Evidence: none."""
_MAX_FOCAL_CHANGE = 0.06
"""Maximum relative change from the given focal length to the focal length that fits the map. With a larger
change, the given calibration is a misfit: it does not fit the images.
Evidence: docs/decisions/mapping.md."""
_MAX_CENTRE_CHANGE = 0.03
"""Maximum distance from the given principal point to the principal point that fits the map, as a fraction of
the image's long side. With a larger distance, the given calibration is a misfit.
Evidence: docs/decisions/mapping.md."""
_MIN_REDUCTION_MISFIT = 0.05
"""Minimum relative reduction of the cost if focal lengths and principal points are free. With a smaller
reduction, no calibration is treated as a misfit. Evidence: docs/decisions/mapping.md."""
_FISHEYE, _FISHEYE_TWO_TERMS = "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"
"""The fisheye model with one radial term, and the fisheye model with two radial terms. The model with two
terms is tried only if the model with one term was selected. Evidence: docs/decisions/mapping.md."""
_CANDIDATES = ("RADIAL", _FISHEYE)
"""Camera models that are tried for uncalibrated cameras instead of the model with one radial term."""
_MIN_REDUCTION_MODEL = 0.15
"""Minimum relative reduction of the cost if another camera model is used. With a smaller reduction, the
camera model is not changed. Evidence: docs/decisions/mapping.md."""
_PRINCIPAL_POINT, _PIXEL_ASPECT = "decentred", "stretched"
"""Names of two more candidates. "decentred" has a free principal point, for cropped images. "stretched" has a
separate focal length for each axis, for pixels that are not square."""
_MIN_ASPECT_CHANGE = 0.02
"""Minimum relative difference between the two focal lengths of a camera. With a smaller difference, the
pixels are treated as square. A lower cost is not sufficient evidence for pixels that are not square: the
model with two focal lengths also has further distortion parameters (for example tangential distortion), which
may be the cause of the lower cost.
Evidence: docs/decisions/mapping.md."""
_OBSERVATIONS_PER_PARAMETER = 10
"""Minimum ratio of a camera's number of observations to the number of parameters of its camera model. With
fewer observations, the pixels are treated as square. Evidence: none."""
_MIN_REDUCTION_CENTRE = 0.05
"""Minimum relative reduction of the cost if the principal point is free. With a smaller reduction, the
principal point stays in the image's centre. Evidence: docs/decisions/mapping.md."""
_MIN_REDUCTION_RECENTRED = 0.005
"""Minimum relative reduction of the cost if the principal point is refined a second time. This threshold is
smaller than `_MIN_REDUCTION_CENTRE`, because the second map determines the principal point better.
Evidence: docs/decisions/mapping.md."""
_TANGENT_CUBIC = 1.0 / 3.0
"""Cubic coefficient of the tangent's Taylor series."""


def find_misfit_intrinsics(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, calibrated: Mapping[int, str]
) -> dict[str, float]:
    """Find the calibrated cameras whose given intrinsics contradict the map.

    A part of the map is adjusted twice: with constant intrinsics, and with free focal lengths and principal
    points.

    Args:
        model: The reconstruction; not changed.
        settings: The mapper's options.
        calibrated: Names of the calibrated cameras by database id.

    Returns:
        By camera name, the ratio of the focal length that fits the map to the given focal length. The result
        holds only the cameras with a large change of the focal length or of the principal point.

    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    part = _subsample(model)
    calibrated = {number: name for number, name in calibrated.items() if part.exists_camera(number)}
    if not calibrated or part.num_reg_images() < _MIN_KEYFRAMES:
        return {}
    given = {number: copy.deepcopy(part.camera(number)) for number in calibrated}
    held_cost = _adjustment_cost(part, settings, free=False)
    free_cost = _adjustment_cost(part, settings, free=True, centre=True)
    if held_cost is None or free_cost is None or free_cost > (1.0 - _MIN_REDUCTION_MISFIT) * held_cost:
        return {}
    factors = {
        number: part.camera(number).mean_focal_length() / given[number].mean_focal_length()
        for number in calibrated
    }
    return {
        calibrated[number]: round(factor, 3)
        for number, factor in factors.items()
        if abs(factor - 1.0) > _MAX_FOCAL_CHANGE
        or _principal_point_distance(given[number], part.camera(number)) > _MAX_CENTRE_CHANGE
    }


def _principal_point_distance(one: Any, other: Any) -> float:
    """Return the distance between two principal points, as a fraction of the image's long side."""
    offset = np.subtract(
        [one.principal_point_x, one.principal_point_y], [other.principal_point_x, other.principal_point_y]
    )
    return float(np.hypot(*offset)) / float(max(one.width, one.height))


def select_camera_models(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, uncalibrated: Collection[int]
) -> tuple[dict[int, pycolmap.Camera], frozenset[int]]:
    """Select camera models that fit the images of uncalibrated cameras much better than the current model.

    The current camera model has one radial term and a centred principal point. A part of the map is adjusted
    with each candidate, for all uncalibrated cameras at once. The candidates are first other distortion
    models, then a free principal point, then pixels that are not square.

    Args:
        model: The reconstruction; not changed.
        settings: The mapper's options.
        uncalibrated: Database ids of the uncalibrated cameras.

    Returns:
        Adjusted intrinsics by camera id, for the cameras that need another camera model or principal point;
        the ids of the cameras whose principal point moved.
    """
    import pycolmap

    part = _subsample(model)
    out: dict[int, pycolmap.Camera] = {}
    decentred: frozenset[int] = frozenset()
    numbers = [number for number in sorted(uncalibrated) if part.exists_camera(number)]
    if not numbers or part.num_reg_images() < _MIN_KEYFRAMES:
        return out, decentred
    constant = set(part.cameras) - set(numbers)
    best = _adjustment_cost(part, settings, free=True, distortion=True, constant=constant)
    plain = chosen = part
    for name in (*_CANDIDATES, _FISHEYE_TWO_TERMS, _PRINCIPAL_POINT, _PIXEL_ASPECT):
        centre = name == _PRINCIPAL_POINT
        if name == _FISHEYE_TWO_TERMS and chosen.camera(numbers[0]).model_name != _FISHEYE:
            continue
        # The models of all cameras change at once. If one camera kept a wrong model, the map would stay
        # deformed, and correct models of the other cameras would not fit the deformed map.
        trial = copy.deepcopy(plain if name in _CANDIDATES else chosen)
        for number in numbers:
            _change_model(trial.camera(number), name)
        cost = _adjustment_cost(trial, settings, free=True, distortion=True, centre=centre, constant=constant)
        reduction = _MIN_REDUCTION_CENTRE if centre else _MIN_REDUCTION_MODEL
        if best is None or cost is None or cost >= (1.0 - reduction) * best:
            continue
        taken = [
            number for number in numbers if name != _PIXEL_ASPECT or _has_unequal_focal_lengths(trial, number)
        ]
        out |= {number: pycolmap.Camera(trial.camera(number).todict()) for number in taken}
        best, chosen = cost, trial
        decentred = frozenset(numbers) if centre else decentred
    return out, decentred


def _has_unequal_focal_lengths(part: Any, number: int) -> bool:
    """Return whether the two focal lengths of a camera differ and are determined by enough observations."""
    camera = part.camera(number)
    images = (image for image in map(part.image, part.reg_image_ids()) if image.camera_id == number)
    observations = sum(int(image.num_points3D) for image in images)
    aspect = camera.focal_length_x / camera.focal_length_y
    enough = observations >= _OBSERVATIONS_PER_PARAMETER * len(camera.params)
    return bool(abs(aspect - 1.0) > _MIN_ASPECT_CHANGE and enough)


def refine_principal_points(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, decentred: Collection[int]
) -> dict[int, pycolmap.Camera]:
    """Refine principal points a second time, in a map that was built with their first estimates.

    The first estimates come from a map with wrong principal points. The points of that map fit the wrong
    principal points, so the first estimates move by too little. Evidence: docs/decisions/mapping.md.

    Args:
        model: The reconstruction that was built with the first estimates; not changed.
        settings: The mapper's options.
        decentred: Database ids of the cameras whose principal point moved (`select_camera_models`).

    Returns:
        Adjusted intrinsics by camera id; empty if the reduction of the cost is too small.
    """
    import pycolmap

    part = _subsample(model)
    numbers = [number for number in sorted(decentred) if part.exists_camera(number)]
    constant = set(part.cameras) - set(numbers)
    best = (
        _adjustment_cost(part, settings, free=True, distortion=True, constant=constant) if numbers else None
    )
    if best is None:
        return {}
    cost = _adjustment_cost(part, settings, free=True, distortion=True, centre=True, constant=constant)
    if cost is None or cost >= (1.0 - _MIN_REDUCTION_RECENTRED) * best:
        return {}
    return {number: pycolmap.Camera(part.camera(number).todict()) for number in numbers}


def update_camera_models(
    workspace: Path,
    models: Sequence[Any],
    settings: pycolmap.IncrementalPipelineOptions,
    uncalibrated: Mapping[int, str],
    decentred: Collection[int] | None = None,
) -> tuple[dict[str, CameraIntrinsics], Collection[int]]:
    """Find better intrinsics for uncalibrated cameras and write them to the database.

    The first call selects camera models. The second call only refines principal points, in models that were
    built with the intrinsics that the first call wrote.

    Args:
        workspace: Folder of the database.
        models: Reconstructions, the most reliable first; not changed.
        settings: The mapper's options.
        uncalibrated: Names of the uncalibrated cameras by database id.
        decentred: Database ids of the cameras whose principal point moved, as the first call returned them;
            None in the first call.

    Returns:
        The intrinsics that were written, by camera name; the ids of the cameras whose principal point moved.
    """
    import pycolmap

    cameras: dict[int, pycolmap.Camera] = {}
    if models and decentred is not None:
        cameras = refine_principal_points(models[0], settings, decentred)
    elif models:
        cameras, decentred = select_camera_models(models[0], settings, uncalibrated)
    if cameras:
        with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
            for camera in cameras.values():
                # COLMAP searches an initial pair only among fisheye cameras with a prior focal length.
                camera.has_prior_focal_length = True
                database.update_camera(camera)
    written = {
        uncalibrated[number]: CameraIntrinsics(camera_from_pycolmap(camera), calibrated=False)
        for number, camera in sorted(cameras.items())
    }
    return written, decentred or ()


def _change_model(camera: Any, name: str) -> None:
    """Change the model of a camera in place; the projection near the image's centre stays the same.

    Args:
        camera: The camera. A model with two focal lengths, of an anamorphic lens, stays as it is.
        name: The candidate: a camera model, `_PRINCIPAL_POINT` or `_PIXEL_ASPECT`.
    """
    import pycolmap

    if name == _PRINCIPAL_POINT or len(camera.focal_length_idxs()) > 1:
        return
    focal, centre_x, centre_y, *radial = camera.params.tolist()
    if name == _PIXEL_ASPECT:
        fisheye = camera.model_name.endswith("FISHEYE")
        camera.model = getattr(pycolmap.CameraModelId, "OPENCV_FISHEYE" if fisheye else "OPENCV")
        camera.params = [focal, focal, centre_x, centre_y, *[*radial, 0.0][:2], 0.0, 0.0]
        return
    cubic = radial[0] if radial else 0.0
    if camera.model_name.endswith("FISHEYE") != name.endswith("FISHEYE"):
        # For small θ, tan θ is approximately θ + θ³/3. So a pinhole model without distortion corresponds to a
        # fisheye model with a cubic term of 1/3.
        cubic += _TANGENT_CUBIC if name.endswith("FISHEYE") else -_TANGENT_CUBIC
    extra = [cubic, 0.0] if name.startswith("RADIAL") else [cubic]
    camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = [focal, centre_x, centre_y, *extra]


def misfit_note(camera: str, factor: float, *, freed: bool = False) -> str:
    """Return the note for the user on a calibration that does not fit the map: likely cause and remedy.

    Args:
        camera: Camera name.
        factor: Ratio of the focal length that fits the map to the given focal length.
        freed: True if refined intrinsics were used instead of the given intrinsics.
    """
    instead = "; therefore the lens was estimated together with the map" if freed else ""
    if abs(factor - 1.0) > _MAX_FOCAL_CHANGE:
        longer = "longer" if factor > 1.0 else "shorter"
        fits = f"a focal length {round(100 * abs(factor - 1.0))} % {longer} than"
        cause = (
            "stabilisation or digital zoom was on, or the calibration was made with another lens mode or "
            "picture size. Film without stabilisation and digital zoom"
        )
    else:
        # Refined intrinsics may also have another distortion. The check does not refine the distortion.
        fits = "another image centre or another distortion than" if freed else "another image centre than"
        cause = (
            "the camera cropped the picture, or the calibration was made with another lens mode or "
            "picture size. Film the whole picture"
        )
    return (
        f"{camera}: the pictures fit {fits} the calibration says{instead}. Possible causes: {cause}, "
        "calibrate the camera in the same video mode, or use `calibration: auto`"
    )


def _subsample(model: Any) -> Any:
    """Return a copy of a model with at most `_MAX_KEYFRAMES` evenly spaced keyframes."""
    images = sorted(model.reg_image_ids())
    return sub_model(model, {images[row] for row in evenly_spaced(len(images), _MAX_KEYFRAMES)})


def _adjustment_cost(
    part: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    *,
    free: bool,
    distortion: bool = False,
    centre: bool = False,
    constant: Collection[int] = (),
) -> float | None:
    """Adjust a model with free or constant intrinsics.

    Args:
        part: The model to adjust, changed in place.
        settings: The mapper's options.
        free: Whether focal lengths are free.
        distortion: Whether distortion parameters are free.
        centre: Whether principal points are free.
        constant: Database ids of the cameras whose intrinsics always stay constant.

    Returns:
        The final cost; None if the adjustment failed.
    """
    import pycolmap

    options = settings.get_global_bundle_adjustment()
    options.refine_focal_length = free
    options.refine_principal_point, options.refine_extra_params = centre, distortion
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_PX
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in part.reg_image_ids():
        config.add_image(image_id)
    for number in sorted(constant):
        config.set_constant_cam_intrinsics(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, part).solve()
    return float(summary.ceres_summary.final_cost) if summary.is_solution_usable() else None
