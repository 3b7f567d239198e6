"""The mapper's loop: register the next keyframe, adjust around it, adjust everything as the map grows."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.mapping.matching.database import DATABASE_NAME

if TYPE_CHECKING:
    import pycolmap

_INITIAL_PAIR_RELAXATIONS = 2
"""How often COLMAP eases its demands on the initial pair before it gives up."""


def register_images(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    model: pycolmap.Reconstruction,
    tick: Callable[[], None],
    *,
    whole: bool = True,
) -> bool:
    """Put the database's keyframes into a model, which may be empty, until no further one finds a place.

    COLMAP's pipeline, but for its end: where no further keyframe finds a place it adjusts everything, tries
    once more, and then adjusts everything again although nothing was added. Without that walk131 takes 17.5
    instead of 22.9 CPU seconds, and its keyframes are as exact (0.304 cm both).

    Args:
        workspace: Folder of the database.
        settings: The mapper's settings; the initial pair is theirs where the model is empty.
        model: What there is, changed in place.
        tick: Called after each keyframe; what it raises ends the run.
        whole: False: what stands is left as it is, only what comes to it is adjusted.

    Returns:
        False where the model was empty and there is no initial pair, or it does not hold.

    Source: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016, as COLMAP has it.
    """
    mapper = _open_mapper(workspace, settings)
    mapper.begin_reconstruction(model)
    run = _MapperRun(mapper, settings, whole=whole)
    if not model.num_reg_frames() and not run.start():
        mapper.end_reconstruction(True)
        return False
    tick()
    run.to_the_end(tick)
    model.update_point_3d_errors()
    mapper.end_reconstruction(False)
    return True


def resect_images(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    model: pycolmap.Reconstruction,
    wanted: Collection[int],
    tick: Callable[[], None],
) -> set[int]:
    """Put keyframes into a model that shows what they see: nothing is adjusted, its poses stay.

    Args:
        workspace: Folder of the database.
        settings: The mapper's settings.
        model: What there is, changed in place: poses and observations are added, points where they see more.
        wanted: Ids of the keyframes' images; who matches none has no place.
        tick: Called after each keyframe that found a place; what it raises ends the run.

    Returns:
        Ids of those that found a place.
    """
    mapper = _open_mapper(workspace, settings)
    mapper.begin_reconstruction(model)
    options, triangulation = settings.get_mapper(), settings.get_triangulation()
    placed = set[int]()
    for image_id in sorted(number for number in wanted if model.exists_image(number)):
        if mapper.register_next_image(options, image_id):
            mapper.triangulate_image(triangulation, image_id)
            placed.add(image_id)
            tick()
    model.update_point_3d_errors()
    mapper.end_reconstruction(False)
    return placed


def _open_mapper(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions
) -> pycolmap.IncrementalMapper:
    import pycolmap

    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches, options.image_names = settings.min_num_matches, set(settings.image_names)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        cache = pycolmap.DatabaseCache.create(database, options)
    return pycolmap.IncrementalMapper(cache)


def _relaxed_options(options: Any) -> Iterator[Any]:
    """Demands on the initial pair, eased as COLMAP does: half the inliers, then half the angle, twice."""
    eased = copy.deepcopy(options)
    yield eased
    for _ in range(_INITIAL_PAIR_RELAXATIONS):
        eased.init_min_num_inliers //= 2
        yield eased
        eased.init_min_tri_angle /= 2
        yield eased


class _MapperRun:
    """One model's growth."""

    def __init__(
        self,
        mapper: pycolmap.IncrementalMapper,
        settings: pycolmap.IncrementalPipelineOptions,
        *,
        whole: bool = True,
    ) -> None:
        self._whole = whole
        self._mapper = mapper
        self._settings = settings
        self._model: Any = mapper.reconstruction
        self._options = settings.get_mapper()
        self._triangulation = settings.get_triangulation()
        self._local = settings.get_local_bundle_adjustment()
        self._global = settings.get_global_bundle_adjustment()

    def start(self) -> bool:
        """Begin with the settings' initial pair; False where there is none, or it does not hold."""
        pair = (self._settings.init_image_id1, self._settings.init_image_id2)
        if min(pair) < 0:  # none was chosen
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

    def to_the_end(self, tick: Callable[[], None]) -> None:
        """Add keyframes until none finds a place, not even after everything was adjusted."""
        adjusted, last_try = self._size(), False
        while True:
            image_id = self._next()
            if image_id is not None:
                last_try = False
                self._place(image_id)
                if self._has_grown(adjusted):
                    self._adjust_all()
                    adjusted = self._size()
                tick()
            elif last_try or self._size() == adjusted:
                return
            else:
                self._adjust_all()
                adjusted, last_try = self._size(), True

    def _next(self) -> int | None:
        """Register the keyframe that sees most of the map; None where none can be."""
        for image_id in self._mapper.find_next_images(self._options, structure_less=False):
            if self._mapper.register_next_image(self._options, image_id):
                return int(image_id)
        if not self._settings.structure_less_registration_fallback:
            return None
        for image_id in self._mapper.find_next_images(self._options, structure_less=True):
            if self._mapper.register_next_structure_less_image(self._options, image_id):
                return int(image_id)
        return None

    def _place(self, image_id: int) -> None:
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
        return self._model.num_reg_frames(), self._model.num_points3D()

    def _has_grown(self, adjusted: tuple[int, int]) -> bool:
        frames, points = self._size()
        return bool(
            frames >= self._settings.ba_global_frames_ratio * adjusted[0]
            or frames >= self._settings.ba_global_frames_freq + adjusted[0]
            or points >= self._settings.ba_global_points_ratio * adjusted[1]
            or points >= self._settings.ba_global_points_freq + adjusted[1]
        )

    def _adjust_all(self) -> None:
        if not self._whole:
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
