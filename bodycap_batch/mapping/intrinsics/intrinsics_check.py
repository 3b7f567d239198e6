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
"""Keyframes of the model that the checks adjust, evenly spaced. Evidence: none."""
_ITERATIONS = 40
"""Iterations of such an adjustment at most. Evidence: none."""
_MIN_KEYFRAMES = 10
"""Keyframes that a check needs. Evidence: none."""
_TOLERANCE = 1e-4
"""Relative change of the cost that ends such an adjustment. Evidence: none."""
_LOSS_PX = 1.0
"""Width of the Cauchy loss of such an adjustment, px. Evidence: none."""
_MAX_FOCAL_CHANGE = 0.06
"""Relative change of the focal length above which a given calibration is a misfit.
Evidence: docs/decisions/mapping.md."""
_MAX_CENTRE_CHANGE = 0.03
"""The same for the principal point, as a ratio of the image's long side. Evidence:
docs/decisions/mapping.md."""
_MIN_REDUCTION_MISFIT = 0.05
"""Relative reduction of the cost that free focal lengths and centres must give for a misfit.
Evidence: docs/decisions/mapping.md."""
_FISHEYE, _FISHEYE_TWO_TERMS = "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"
"""The fisheye candidate, and the same with a second radial term. The second term is tried only if the first
model was selected. Evidence: docs/decisions/mapping.md."""
_CANDIDATES = ("RADIAL", _FISHEYE)
"""Camera models that are tried for uncalibrated cameras instead of one radial term."""
_MIN_REDUCTION_MODEL = 0.15
"""Relative reduction of the cost that another camera model must give. Evidence: docs/decisions/mapping.md."""
_PRINCIPAL_POINT, _PIXEL_ASPECT = "decentred", "stretched"
"""Two more candidates: a free principal point, for a cropped picture, and a focal length for each axis, for
pixels that are not square."""
_MIN_ASPECT_CHANGE = 0.02
"""Relative difference of two focal lengths above which pixels are not square. The model with two focal
lengths also has tangential distortion, so a lower cost alone is no evidence. Evidence:
docs/decisions/mapping.md."""
_OBSERVATIONS_PER_PARAMETER = 10
"""Observations of a camera for each of its parameters, at least, to decide on its pixel aspect. Evidence:
none."""
_MIN_REDUCTION_CENTRE = 0.05
"""Relative reduction of the cost that a free principal point must give. Evidence:
docs/decisions/mapping.md."""
_MIN_REDUCTION_RECENTRED = 0.005
"""The same for a principal point that was moved before: a second map shows its position better.
Evidence: docs/decisions/mapping.md."""
_TANGENT_CUBIC = 1.0 / 3.0
"""Cubic coefficient of the tangent's Taylor series."""


def find_misfit_intrinsics(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, calibrated: Mapping[int, str]
) -> dict[str, float]:
    """Return the calibrated cameras whose given intrinsics the map contradicts.

    A part of the map is adjusted twice: with the intrinsics held constant, and with free focal lengths and
    principal points.

    Args:
        model: The reconstruction; not changed.
        settings: The mapper's options.
        calibrated: Names of the calibrated cameras by id.

    Returns:
        By camera name, the ratio of the focal length that fits to the given one. Only cameras are named of
        which the focal length or the principal point changes much.

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
    """Return the distance of two principal points of the same picture, as a ratio of its long side."""
    offset = np.subtract(
        [one.principal_point_x, one.principal_point_y], [other.principal_point_x, other.principal_point_y]
    )
    return float(np.hypot(*offset)) / float(max(one.width, one.height))


def select_camera_models(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, uncalibrated: Collection[int]
) -> tuple[dict[int, pycolmap.Camera], frozenset[int]]:
    """Select camera models that explain the pictures of uncalibrated cameras much better.

    The current model has one radial term and a centred principal point. A part of the map is adjusted with
    each candidate in turn, for all uncalibrated cameras at once: another distortion model, then a free
    principal point, then pixels that are not square.

    Args:
        model: The reconstruction; not changed.
        settings: The mapper's options.
        uncalibrated: Ids of the uncalibrated cameras.

    Returns:
        Adjusted cameras by id, for those that need another model or centre; the ids of those whose principal
        point moved.
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
        # All cameras change at once: one wrong camera bends the map, and no other one fits a bent map.
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
    """Return whether a camera's two focal lengths differ and enough keypoints determine them."""
    camera = part.camera(number)
    images = (image for image in map(part.image, part.reg_image_ids()) if image.camera_id == number)
    observations = sum(int(image.num_points3D) for image in images)
    aspect = camera.focal_length_x / camera.focal_length_y
    enough = observations >= _OBSERVATIONS_PER_PARAMETER * len(camera.params)
    return bool(abs(aspect - 1.0) > _MIN_ASPECT_CHANGE and enough)


def refine_principal_points(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, decentred: Collection[int]
) -> dict[int, pycolmap.Camera]:
    """Refine principal points again, with a map that was built with their first estimates.

    The points of the first map fit its wrong principal points and hold the estimates back.
    Evidence: docs/decisions/mapping.md.

    Args:
        model: The reconstruction; not changed.
        settings: The mapper's options.
        decentred: Ids of the cameras whose principal point moved (`select_camera_models`).

    Returns:
        Adjusted cameras by id, if the cost falls enough.
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
    """Write better intrinsics of uncalibrated cameras into the database.

    Args:
        workspace: Folder of the database.
        models: Reconstructions, the most reliable first; not changed.
        settings: The mapper's options.
        uncalibrated: Names of the uncalibrated cameras by id.
        decentred: None at first. Afterwards the ids that an earlier call returned, with models that were
            built with what it wrote; then only their principal points are refined.

    Returns:
        By camera name, the intrinsics that were written; the ids of the cameras whose principal point moved.
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
                # COLMAP seeks no initial pair among fisheye cameras without a prior focal length.
                camera.has_prior_focal_length = True
                database.update_camera(camera)
    written = {
        uncalibrated[number]: CameraIntrinsics(camera_from_pycolmap(camera), calibrated=False)
        for number, camera in sorted(cameras.items())
    }
    return written, decentred or ()


def _change_model(camera: Any, name: str) -> None:
    """Change a camera with one focal length to a candidate model that agrees near the image's middle."""
    import pycolmap

    if name == _PRINCIPAL_POINT:
        return
    focal, centre_x, centre_y, *radial = camera.params.tolist()
    if name == _PIXEL_ASPECT:
        fisheye = camera.model_name.endswith("FISHEYE")
        camera.model = getattr(pycolmap.CameraModelId, "OPENCV_FISHEYE" if fisheye else "OPENCV")
        camera.params = [focal, focal, centre_x, centre_y, *[*radial, 0.0][:2], 0.0, 0.0]
        return
    cubic = radial[0] if radial else 0.0
    if camera.model_name.endswith("FISHEYE") != name.endswith("FISHEYE"):
        # tan θ = θ + θ³/3 + …: no distortion of a pinhole model is a cubic term of 1/3 in a fisheye model.
        cubic += _TANGENT_CUBIC if name.endswith("FISHEYE") else -_TANGENT_CUBIC
    extra = [cubic, 0.0] if name.startswith("RADIAL") else [cubic]
    camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = [focal, centre_x, centre_y, *extra]


def misfit_note(camera: str, factor: float, *, freed: bool = False) -> str:
    """Return the note for the user on a misfit: its likely cause and what to do.

    Args:
        camera: Camera name.
        factor: Focal length that fits, relative to the given one.
        freed: True if the fitting intrinsics were used instead of the given ones.
    """
    instead = "; what fits was used instead" if freed else ""
    if abs(factor - 1.0) > _MAX_FOCAL_CHANGE:
        longer = "longer" if factor > 1.0 else "shorter"
        fits = f"a focal length {round(100 * abs(factor - 1.0))} % {longer} than"
        cause = (
            "stabilisation or digital zoom on, or another lens mode or size calibrated? Film with these off"
        )
    else:
        # Refined intrinsics include distortion; otherwise the check frees the principal point alone.
        fits = "another centre or distortion than" if freed else "a centre that lies elsewhere than where"
        cause = "the picture cropped, or another lens mode or size calibrated? Film the whole picture"
    return (
        f"{camera}: the pictures fit {fits} the calibration says{instead}: was {cause}, calibrate in the "
        "same mode, or use calibration: auto"
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
    """Adjust a model with free or constant intrinsics and return the final cost; None if that fails.

    Args:
        part: The model; it is changed.
        settings: The mapper's options.
        free: Whether focal lengths are free.
        distortion: Whether distortion is free.
        centre: Whether principal points are free.
        constant: Ids of cameras whose intrinsics stay constant in any case.
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
