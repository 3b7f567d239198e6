"""Run COLMAP's incremental mapper step by step: register images, adjust locally, adjust globally."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME

if TYPE_CHECKING:
    import pycolmap

_INITIAL_PAIR_RELAXATIONS = 2
"""Number of times that each of two thresholds for an initial pair is halved before the pair is rejected.
COLMAP uses the same number."""
_MIN_REGISTERED_RATIO = 0.5
"""Minimum ratio of the images of a camera that are registered. If there are fewer, an image of this camera is
also registered from its matches alone. Evidence: docs/decisions/mapping.md."""


def progress_counter(
    context: StageContext, total: int, stop: Callable[[], None], done: int = 0
) -> Callable[[], None]:
    """Return a function that reports progress: each call adds one keyframe to the reported number.

    Args:
        context: Progress and cancellation.
        total: Number of all keyframes.
        stop: Function that is called if the work is cancelled.
        done: Number of keyframes in the map before the first call.
    """

    def count_one() -> None:
        nonlocal done
        done += 1
        context.progress(min(done, total), total, "keyframes")
        if context.cancelled():
            stop()

    return count_one


def register_images(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    model: pycolmap.Reconstruction,
    count_one: Callable[[], None],
    *,
    adjust_globally: bool = True,
) -> bool:
    """Register images of the database in a model, until no further image fits the model.

    The model may be empty. If no further image fits, the whole model is adjusted and the function tries once
    more, like COLMAP's pipeline. If the last try adds no image, COLMAP adjusts the whole model once more.
    This function omits that adjustment. Evidence: docs/decisions/mapping.md.

    Args:
        workspace: Folder of the database.
        settings: The mapper's options. They name the initial pair for an empty model.
        model: The model so far, changed in place.
        count_one: Function that is called after each registered image. If it raises an exception, the
            registration ends.
        adjust_globally: True: the whole model is adjusted each time it has grown enough. False: only the map
            around each new image is adjusted.

    Returns:
        False if the model is empty and has no usable initial pair, else True.

    Source: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016, as implemented in COLMAP.
    """
    mapper = _open_mapper(workspace, settings)
    mapper.begin_reconstruction(model)
    run = _MapperRun(mapper, settings, adjust_globally=adjust_globally)
    if not model.num_reg_frames():
        if not run.initialise():
            mapper.end_reconstruction(True)
            return False
        for _ in range(model.num_reg_images()):
            count_one()
    run.register_all(count_one)
    model.update_point_3d_errors()
    mapper.end_reconstruction(False)
    return True


def with_new_images(
    workspace: Path,
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
    *,
    adjust_globally: bool,
) -> Any:
    """Return a copy of a model in which further images of the database are registered.

    The poses of the images that are already registered do not change.

    Args:
        workspace: Folder of the database.
        model: A reconstruction; not changed.
        settings: The mapper's options; changed in place.
        context: Progress and cancellation.
        total: Number of all keyframes, for the progress.
        adjust_globally: Whether global adjustments are made after the model has grown
            (`register_images`).
    """
    settings.fix_existing_frames = True
    extended = copy.deepcopy(model)
    count_one = progress_counter(context, total, context.check_cancelled, extended.num_reg_images())
    register_images(workspace, settings, extended, count_one, adjust_globally=adjust_globally)
    return extended


def resect_images(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    model: pycolmap.Reconstruction,
    image_ids: Collection[int],
    count_one: Callable[[], None],
) -> set[int]:
    """Register images in a model without any adjustment.

    An image can only be registered if the model already contains the part of the room that the image shows.

    Args:
        workspace: Folder of the database.
        settings: The mapper's options.
        model: The model so far, changed in place: poses, observations and new points are added, and existing
            poses do not change.
        image_ids: Ids of the images to register. Images without matches are skipped.
        count_one: Function that is called after each registered image. If it raises an exception, the
            registration ends.

    Returns:
        Ids of the images that were registered.
    """
    mapper = _open_mapper(workspace, settings)
    mapper.begin_reconstruction(model)
    options, triangulation = settings.get_mapper(), settings.get_triangulation()
    registered = set[int]()
    for image_id in sorted(number for number in image_ids if model.exists_image(number)):
        if mapper.register_next_image(options, image_id):
            mapper.triangulate_image(triangulation, image_id)
            registered.add(image_id)
            count_one()
    model.update_point_3d_errors()
    mapper.end_reconstruction(False)
    return registered


def _open_mapper(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions
) -> pycolmap.IncrementalMapper:
    """Return a COLMAP mapper for the database of a workspace."""
    import pycolmap

    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches, options.image_names = settings.min_num_matches, set(settings.image_names)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        cache = pycolmap.DatabaseCache.create(database, options)
    return pycolmap.IncrementalMapper(cache)


def _relaxed_options(options: Any) -> Iterator[Any]:
    """Yield mapper options in which the thresholds for the initial pair become less strict, as in COLMAP.

    In each step, either the minimum number of inliers or the minimum angle is halved, alternately.
    """
    relaxed = copy.deepcopy(options)
    yield relaxed
    for _ in range(_INITIAL_PAIR_RELAXATIONS):
        relaxed.init_min_num_inliers //= 2
        yield relaxed
        relaxed.init_min_tri_angle /= 2
        yield relaxed


class _MapperRun:
    """One run of COLMAP's mapper: extends one model, image by image."""

    def __init__(
        self,
        mapper: pycolmap.IncrementalMapper,
        settings: pycolmap.IncrementalPipelineOptions,
        *,
        adjust_globally: bool = True,
    ) -> None:
        self._adjust_globally = adjust_globally
        self._mapper = mapper
        self._settings = settings
        self._model: Any = mapper.reconstruction
        self._options = settings.get_mapper()
        self._triangulation = settings.get_triangulation()
        self._local = settings.get_local_bundle_adjustment()
        self._global = settings.get_global_bundle_adjustment()
        self._given = {
            number: camera.params.copy()
            for number, camera in self._model.cameras.items()
            if number in settings.constant_cameras
        }

    def initialise(self) -> bool:
        """Start the model with the initial pair from the options.

        Return False if the options hold no initial pair or if no model can start from the pair.
        """
        pair = (self._settings.init_image_id1, self._settings.init_image_id2)
        if min(pair) < 0:  # In COLMAP, a negative id means that no initial pair is given.
            return False
        for options in _relaxed_options(self._options):
            geometry = self._mapper.estimate_initial_two_view_geometry(options, *pair)
            if geometry is not None:
                break
        else:
            return False
        self._mapper.register_initial_image_pair(options, *pair, geometry)
        first = self._settings.get_triangulation()
        first.min_angle = options.init_min_tri_angle
        for image_id in pair:
            self._triangulate(first, image_id)
        self._mapper.adjust_global_bundle(self._options, self._global)
        self._model.normalize()
        self._mapper.filter_points(self._options)
        self._mapper.filter_frames(self._options)
        return bool(self._model.num_reg_frames() and self._model.num_points3D())

    def register_all(self, count_one: Callable[[], None]) -> None:
        """Register images until no further image fits, even after a global adjustment."""
        adjusted, last_try = self._size(), False
        while True:
            image_id = self._register_next()
            if image_id is not None:
                last_try = False
                self._extend_from(image_id)
                if self._needs_global_adjustment(adjusted):
                    self._adjust_all()
                    adjusted = self._size()
                count_one()
            elif last_try or self._size() == adjusted:
                return
            else:
                self._adjust_all()
                adjusted, last_try = self._size(), True

    def _register_next(self) -> int | None:
        """Register one more image and return its id; return None if no image fits.

        Among the images that fit, the image that observes most of the map is registered. If none fits, an
        image is registered from its matches alone. This takes seconds, so it is done only to connect a camera
        of which the map lacks most images with another camera. Single images can be found later, when all
        frames are registered.
        """
        for image_id in self._mapper.find_next_images(self._options, structure_less=False):
            if self._mapper.register_next_image(self._options, image_id):
                return int(image_id)
        if not self._settings.structure_less_registration_fallback:
            return None
        missing = self._missing_cameras()
        for image_id in self._mapper.find_next_images(self._options, structure_less=True):
            if self._model.image(image_id).camera_id not in missing:
                continue
            if self._mapper.register_next_structure_less_image(self._options, image_id):
                self._restore_intrinsics()
                return int(image_id)
        return None

    def _missing_cameras(self) -> set[int]:
        """Return the ids of the cameras that another camera may connect: most of their images are missing."""
        images = self._model.images.values()
        every = Counter(image.camera_id for image in images)
        registered = Counter(image.camera_id for image in images if image.has_pose)
        return {
            number
            for number, count in every.items()
            if registered[number] < _MIN_REGISTERED_RATIO * count and registered.keys() != {number}
        }

    def _restore_intrinsics(self) -> None:
        """Restore the intrinsics of the constant cameras.

        COLMAP refines them if the first image of a camera is registered without points of the map.
        """
        for number, params in self._given.items():
            self._model.camera(number).params = params

    def _extend_from(self, image_id: int) -> None:
        """Triangulate the points of a new image and adjust the map around it."""
        self._triangulate(self._triangulation, image_id)
        self._mapper.iterative_local_refinement(
            self._settings.ba_local_max_refinements,
            self._settings.ba_local_max_refinement_change,
            self._options,
            self._local,
            self._triangulation,
            image_id,
        )

    def _triangulate(self, options: pycolmap.IncrementalTriangulatorOptions, image_id: int) -> None:
        for item in self._model.image(image_id).frame.image_ids:
            self._mapper.triangulate_image(options, item.id)

    def _size(self) -> tuple[int, int]:
        """Return the model's number of registered frames and its number of points."""
        return self._model.num_reg_frames(), self._model.num_points3D()

    def _needs_global_adjustment(self, adjusted: tuple[int, int]) -> bool:
        """Return whether the model has grown enough for a global adjustment, by COLMAP's test.

        Args:
            adjusted: Numbers of frames and points (`_size`) at the last global adjustment.
        """
        frames, points = self._size()
        return bool(
            frames >= self._settings.ba_global_frames_ratio * adjusted[0]
            or frames >= self._settings.ba_global_frames_freq + adjusted[0]
            or points >= self._settings.ba_global_points_ratio * adjusted[1]
            or points >= self._settings.ba_global_points_freq + adjusted[1]
        )

    def _adjust_all(self) -> None:
        """Adjust the whole model if global adjustments are permitted."""
        if not self._adjust_globally:
            return
        self._mapper.iterative_global_refinement(
            self._settings.ba_global_max_refinements,
            self._settings.ba_global_max_refinement_change,
            self._options,
            self._global,
            self._triangulation,
            normalize_reconstruction=not self._settings.fix_existing_frames,
        )
        self._mapper.filter_frames(self._options)
