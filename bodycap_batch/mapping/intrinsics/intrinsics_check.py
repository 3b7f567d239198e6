"""Do the lenses fit the pictures? Cropped videos give themselves away; guessed lenses get a fitting model."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.mapping.matching.database import DATABASE_NAME
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.model.camera import Camera

if TYPE_CHECKING:
    import pycolmap

_MAX_KEYFRAMES = 40
_ITERATIONS = 40
_MIN_KEYFRAMES = 10
_TOLERANCE = 1e-4
_LOSS_PX = 1.0
_MAX_FOCAL_CHANGE = 0.06
_MIN_REDUCTION_MISFIT = 0.05
"""On four captures, real and rendered, a right lens was found again to 0.3 % (3 % with a rolling shutter
still in the map) and freeing it lowered the cost by 1 % at most; a lens 7 % off was found to be that to 0.5 %
(3 %), and the cost fell by 10 to 50 %."""
_MAX_CENTRE_CHANGE = 0.03
"""Right centres of six captures were found again to 0.5 % of the long side; one stated 9 % off was found to
half a percent (the cost fell by 51 %), and had put the cameras 16 cm off."""
_FISHEYE, _FISHEYE_TWO_TERMS = "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"
"""A second radial term, for what one finds to be a fisheye lens: the focal lengths of two made-up
ones were found to 0.1 and 0.4 % instead of 1.8 and 1.2."""
_CANDIDATES = ("RADIAL", _FISHEYE)
_MIN_REDUCTION_MODEL = 0.15
"""A fisheye lens guessed as a usual one: the cost falls by 75 % with the fisheye model (and the focal length
from 25 % wrong to 0.4 %), by 52 % with a second radial term. A usual lens: by 1 % at most, or it rises."""
_PRINCIPAL_POINT, _PIXEL_ASPECT = "decentred", "stretched"
"""A picture that was cropped off its centre, and one whose pixels are not square. Right centres of seven
guessed lenses, two of them real: the cost falls by 2 % at most with the principal point free, by 14 % with a
focal length for each axis (a fisheye lens's second radial term among it). Cropped to a corner, three videos:
by 9 to 51 % (the real one least), and their error from 2.0, 31 and 32 cm to 0.9, 0.5 and 0.9. Squeezed to 3/4
of its width, one: by 56 %."""
_MIN_ASPECT_CHANGE = 0.02
"""Its model bends in more ways than that: the cost falls for distortion that is not along the radius,
too, with focal lengths that agree to 0.1 %."""
_OBSERVATIONS_PER_PARAMETER = 10
"""Mapped keypoints of a lens for each of its parameters, at least."""
_MIN_REDUCTION_CENTRE = 0.05
_MIN_REDUCTION_RECENTRED = 0.005
"""Once it is known to be off, all that a second map tells is taken: 1.6 to 0.9 cm, for 0.9 % of the cost."""
_TANGENT_CUBIC = 1.0 / 3.0


def find_misfit_intrinsics(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, given: Mapping[int, str]
) -> dict[str, float]:
    """Given lenses that the map contradicts.

    A part of the map is adjusted twice, with the lenses as given and with focal lengths and centres free.

    Args:
        model: The reconstruction; stays as it is.
        settings: The mapper's settings.
        given: Names of the calibrated cameras by id.

    Returns:
        By camera name, the focal length that fits over the one that was given, where it differs or the
        principal point lies elsewhere.

    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    part = _subsample(model)
    given = {number: name for number, name in given.items() if part.exists_camera(number)}
    if not given or part.num_reg_images() < _MIN_KEYFRAMES:
        return {}
    stated = {number: copy.deepcopy(part.camera(number)) for number in given}
    held = _adjustment_cost(part, settings, free=False)
    freed = _adjustment_cost(part, settings, free=True, centre=True)
    if held is None or freed is None or freed > (1.0 - _MIN_REDUCTION_MISFIT) * held:
        return {}
    factors = {
        number: part.camera(number).mean_focal_length() / stated[number].mean_focal_length()
        for number in given
    }
    return {
        given[number]: round(value, 3)
        for number, value in factors.items()
        if abs(value - 1.0) > _MAX_FOCAL_CHANGE
        or _principal_point_distance(stated[number], part.camera(number)) > _MAX_CENTRE_CHANGE
    }


def _principal_point_distance(one: Any, other: Any) -> float:
    """How far the principal points of two lenses of one picture lie apart, as a share of its long side."""
    apart = np.subtract(
        [one.principal_point_x, one.principal_point_y], [other.principal_point_x, other.principal_point_y]
    )
    return float(np.hypot(*apart)) / float(max(one.width, one.height))


def select_camera_models(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, guessed: Collection[int]
) -> tuple[dict[int, pycolmap.Camera], frozenset[int]]:
    """Lenses that explain the pictures of guessed ones much better than one radial term about the centre.

    A part of the map is adjusted with each candidate in turn, for all guessed lenses alike: another model,
    then a principal point off the centre, then pixels that are not square.

    Args:
        model: The reconstruction; stays as it is.
        settings: The mapper's settings.
        guessed: Ids of the cameras whose lens was not given.

    Returns:
        Adjusted cameras by id, for those that need another model or centre; the ids of those whose principal
        point was found to lie off where it was.
    """
    import pycolmap

    part = _subsample(model)
    out: dict[int, pycolmap.Camera] = {}
    decentred: frozenset[int] = frozenset()
    wanted = [number for number in sorted(guessed) if part.exists_camera(number)]
    if not wanted or part.num_reg_images() < _MIN_KEYFRAMES:
        return out, decentred
    held = set(part.cameras) - set(wanted)
    best = _adjustment_cost(part, settings, free=True, distortion=True, held=held)
    plain = chosen = part
    for name in (*_CANDIDATES, _FISHEYE_TWO_TERMS, _PRINCIPAL_POINT, _PIXEL_ASPECT):
        centre = name == _PRINCIPAL_POINT
        if name == _FISHEYE_TWO_TERMS and chosen.camera(wanted[0]).model_name != _FISHEYE:
            continue
        # All at once: while one lens is wrong the map is bent, and no other fits it.
        trial = copy.deepcopy(plain if name in _CANDIDATES else chosen)
        for number in wanted:
            _change_model(trial.camera(number), name)
        cost = _adjustment_cost(trial, settings, free=True, distortion=True, centre=centre, held=held)
        worth = _MIN_REDUCTION_CENTRE if centre else _MIN_REDUCTION_MODEL
        if best is None or cost is None or cost >= (1.0 - worth) * best:
            continue
        taken = [
            number for number in wanted if name != _PIXEL_ASPECT or _has_unequal_focal_lengths(trial, number)
        ]
        out |= {number: pycolmap.Camera(trial.camera(number).todict()) for number in taken}
        best, chosen = cost, trial
        decentred = frozenset(wanted) if centre else decentred
    return out, decentred


def _has_unequal_focal_lengths(part: Any, number: int) -> bool:
    """Whether the two focal lengths of a camera differ, by keypoints enough to tell."""
    camera = part.camera(number)
    mine = (image for image in map(part.image, part.reg_image_ids()) if image.camera_id == number)
    seen = sum(int(image.num_points3D) for image in mine)
    aspect = camera.focal_length_x / camera.focal_length_y
    return bool(
        abs(aspect - 1.0) > _MIN_ASPECT_CHANGE and seen >= _OBSERVATIONS_PER_PARAMETER * len(camera.params)
    )


def refine_principal_points(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, decentred: Collection[int]
) -> dict[int, pycolmap.Camera]:
    """Lenses found off the centre of the picture, found anew where the map built with them tells more.

    Points that suited the first map held them back: 17 px off where the picture was cropped by a third,
    1 px the second time.

    Args:
        model: The reconstruction; stays as it is.
        settings: The mapper's settings.
        decentred: Ids of the cameras whose principal point was found off (`select_camera_models`).

    Returns:
        Adjusted cameras by id, where the cost falls.
    """
    import pycolmap

    part = _subsample(model)
    wanted = [number for number in sorted(decentred) if part.exists_camera(number)]
    held = set(part.cameras) - set(wanted)
    best = _adjustment_cost(part, settings, free=True, distortion=True, held=held) if wanted else None
    if best is None:
        return {}
    cost = _adjustment_cost(part, settings, free=True, distortion=True, centre=True, held=held)
    if cost is None or cost >= (1.0 - _MIN_REDUCTION_RECENTRED) * best:
        return {}
    return {number: pycolmap.Camera(part.camera(number).todict()) for number in wanted}


def update_camera_models(
    workspace: Path,
    models: Sequence[Any],
    settings: pycolmap.IncrementalPipelineOptions,
    guessed: Mapping[int, str],
    decentred: Collection[int] | None = None,
) -> tuple[dict[str, tuple[Camera, bool]], Collection[int]]:
    """Write the better lenses of guessed cameras into the database.

    Args:
        workspace: Folder of the database.
        models: Reconstructions, the one to tell from first; they stay as they are.
        settings: The mapper's settings.
        guessed: Names of the cameras whose lens was not given, by id.
        decentred: The models were built with what this found before, and these are the lenses it then found
            off the centre: only what is told better of them is of interest.

    Returns:
        By camera name the lens that was written, and that it is none that was given (`select_camera_models`); the
        ids of the lenses that were found off the centre.
    """
    import pycolmap

    lenses: dict[int, pycolmap.Camera] = {}
    if models and decentred is not None:
        lenses = refine_principal_points(models[0], settings, decentred)
    elif models:
        lenses, decentred = select_camera_models(models[0], settings, guessed)
    if lenses:
        with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
            for lens in lenses.values():
                # COLMAP looks for no initial pair among fisheye cameras whose focal length is a mere guess.
                lens.has_prior_focal_length = True
                database.update_camera(lens)
    found = {guessed[number]: (camera_from_pycolmap(lens), False) for number, lens in sorted(lenses.items())}
    return found, decentred or ()


def _change_model(camera: Any, name: str) -> None:
    """Give a camera with one focal length another model that agrees with it near the image's middle."""
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
        # tan θ = θ + θ³/3 + …: what is no distortion for one kind is a third for the other.
        cubic += _TANGENT_CUBIC if name.endswith("FISHEYE") else -_TANGENT_CUBIC
    extra = [cubic, 0.0] if name.startswith("RADIAL") else [cubic]
    camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = [focal, centre_x, centre_y, *extra]


def misfit_note(camera: str, factor: float, *, freed: bool = False) -> str:
    """What a misfit means and what to do; `freed`: what fits was used instead of what was given."""
    instead = "; what fits was used instead" if freed else ""
    if abs(factor - 1.0) > _MAX_FOCAL_CHANGE:
        longer = "longer" if factor > 1.0 else "shorter"
        fits = f"a focal length {round(100 * abs(factor - 1.0))} % {longer} than"
        cause = (
            "stabilisation or digital zoom on, or another lens mode or size calibrated? Film with these off"
        )
    else:
        # What was freed had its distortion found as well; else the centre alone can have told.
        fits = "another centre or distortion than" if freed else "a centre that lies elsewhere than where"
        cause = "the picture cropped, or another lens mode or size calibrated? Film the whole picture"
    return (
        f"{camera}: the pictures fit {fits} the calibration says{instead}: "
        f"was {cause}, calibrate in the same mode, or use calibration: auto"
    )


def _subsample(model: Any) -> Any:
    """A copy of the model with at most so many keyframes, evenly spread."""
    images = sorted(model.reg_image_ids())
    rows = np.linspace(0, len(images) - 1, min(_MAX_KEYFRAMES, len(images))).round().astype(int)
    return sub_model(model, {images[row] for row in rows})


def _adjustment_cost(
    part: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    *,
    free: bool,
    distortion: bool = False,
    centre: bool = False,
    held: Collection[int] = (),
) -> float | None:
    """Adjust a model with its lenses held or free; the cost that is left, None where that fails.

    Args:
        part: The model; it is changed.
        settings: The mapper's settings.
        free: Focal lengths.
        distortion: Distortion as well.
        centre: Principal points as well.
        held: Ids of cameras whose lenses stay as they are all the same.
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
    for number in sorted(held):
        config.set_constant_cam_intrinsics(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, part).solve()
    return float(summary.ceres_summary.final_cost) if summary.is_solution_usable() else None
