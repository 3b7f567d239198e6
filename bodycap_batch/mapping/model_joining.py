"""Join models that contain the same keyframes.

The mapper can stop at a place that few keyframes of a model see, and start a further model behind it. If some
keyframes are registered in both models, they determine the similarity of the two models. So both models
become one, which is then adjusted.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.reconstruction.incremental_mapper import opened_mapper
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, registered_ids
from bodycap_batch.mapping.validation.epipolar_consistency import evaluate_pairs
from bodycap_batch.mapping.validation.repair import find_wrong_images
from bodycap_batch.mapping.validation.second_registration import observed_points

if TYPE_CHECKING:
    import pycolmap

MIN_COMMON_KEYFRAMES = 3
"""Minimum number of common keyframes that agree with the similarity of two models. Evidence: none."""
_MIN_COMMON_POINTS = 8
"""Minimum number of features of a common keyframe that have a point in both models, so that their depths give
the ratio of the scales. Evidence: none."""
_MIN_INLIER_RATIO = 0.5
"""Minimum fraction of the further model's points that a common keyframe sees in place, so that the keyframe
agrees with a similarity. Evidence: none."""
_ERROR_RATIO = 2.0
"""Maximum error of such a point, as a multiple of the mapper's maximum reprojection error: the models are not
adjusted together yet. Evidence: none."""


def join_models(models: Sequence[Any], context: MappingContext) -> tuple[list[Any], list[dict[str, object]]]:
    """Join each further model that has keyframes in common with the largest model.

    A joined model is used only if it has more correctly registered keyframes than the largest model, and no
    more misregistered ones than the two models have. The verified pairs between the two parts, and the points
    that their matches belong to, decide about that.

    Args:
        models: Reconstructions, the largest first; not changed.
        context: Workspace, mapper options.

    Returns:
        The models, the joined one first; one entry for the log for each model that was tried.
    """
    if not models:
        return [], []
    if not is_on(Mechanism.JOIN_MODELS):
        return list(models), []
    main, rest, log = models[0], list[Any](), list[dict[str, object]]()
    for further in models[1:]:
        common = keyframe_names(main) & keyframe_names(further)
        if len(common) < MIN_COMMON_KEYFRAMES:
            rest.append(further)
            continue
        entry: dict[str, object] = {
            "keyframes": [main.num_reg_images(), further.num_reg_images()],
            "common": sorted(common),
        }
        log.append(entry)
        joined = _joined(main, further, context)
        if joined is None:
            entry["failed"] = "no similarity fits the common keyframes"
            rest.append(further)
            continue
        sizes = [model.num_reg_images() for model in (main, further, joined)]
        wrong = [_misregistered(model, context) for model in (main, further, joined)]
        entry |= {"joined": sizes[2], "doubtful": wrong}
        if sizes[2] - wrong[2] <= sizes[0] - wrong[0] or wrong[2] > wrong[0] + wrong[1]:
            entry["failed"] = "the joined model contradicts its matches"
            rest.append(further)
        else:
            main = joined
            record_act(Mechanism.JOIN_MODELS)
    return [main, *rest], log


def _misregistered(model: Any, context: MappingContext) -> int:
    """Return the number of misregistered images of a model."""
    return len(find_wrong_images(context, model, evaluate_pairs(context.workspace, model, context.times_ns)))


def _joined(main: Any, further: Any, context: MappingContext) -> Any | None:
    """Return a copy of a model that contains a further model, too; None if no similarity fits."""
    options = context.mapper_options()
    main_from_further = common_similarity(
        main, further, _ERROR_RATIO * options.mapper.filter_max_reproj_error
    )
    if main_from_further is None:
        return None
    moved, joined = copy.deepcopy(further), copy.deepcopy(main)
    moved.transform(main_from_further)
    with opened_mapper(context.workspace, options, joined) as mapper:
        for number in sorted(registered_ids(moved) - registered_ids(joined)):
            image = moved.image(number)
            frame = joined.image(number).frame
            frame.set_cam_from_world(image.camera_id, image.cam_from_world())
            joined.register_frame(frame.frame_id)
        _add_points(mapper.observation_manager, joined, moved)
        if context.is_large(joined.num_reg_images()):
            mapper.complete_and_merge_tracks(options.get_triangulation())
        else:
            mapper.iterative_global_refinement(
                options.ba_global_max_refinements,
                options.ba_global_max_refinement_change,
                options.get_mapper(),
                options.get_global_bundle_adjustment(),
                options.get_triangulation(),
            )
    return joined


def _add_points(manager: pycolmap.ObservationManager, joined: Any, moved: Any) -> None:
    """Add the points of a model to a model that contains its keyframes, in place.

    An observation that belongs to a point already stays with it. If some observations of a point belong to a
    point already, the other observations are added to that point.
    """
    import pycolmap

    for number in sorted(moved.point3D_ids()):
        point = moved.point3D(number)
        free, known = list[Any](), list[int]()
        for element in point.track.elements:
            feature = joined.image(element.image_id).point2D(element.point2D_idx)
            if feature.has_point3D():
                known.append(feature.point3D_id)
            else:
                free.append(element)
        if known:
            unique, counts = np.unique(np.array(known), return_counts=True)
            same = int(unique[np.argmax(counts)])
            inside = {element.image_id for element in joined.point3D(same).track.elements}
            for element in free:
                if element.image_id not in inside:
                    manager.add_observation(same, element)
                    inside.add(element.image_id)
        elif len(free) > 1:
            track = pycolmap.Track()
            for element in free:
                track.add_element(element.image_id, element.point2D_idx)
            manager.add_point3D(point.xyz, track)


@dataclass(frozen=True, slots=True)
class _View:
    """The points that a keyframe observes in a model.

    Attributes:
        image: The image of the keyframe.
        features: (N,) indices of the features that have a point.
        points: (N,3) these points in the model.
    """

    image: Any
    features: IntArray
    points: FloatArray

    @staticmethod
    def of(model: Any, number: int) -> _View:
        """Return the view of an image of a model."""
        ids = observed_points(model, number)
        features = np.flatnonzero(ids >= 0)
        points = np.array([model.point3D(point).xyz for point in ids[features]], dtype=np.float64)
        return _View(model.image(number), features, points.reshape(-1, 3))

    def depths(self) -> FloatArray:
        """Return the depths (N,) of the points."""
        return np.asarray((self.image.cam_from_world() * self.points)[:, 2], dtype=np.float64)


def common_similarity(main: Any, further: Any, max_error_px: float) -> pycolmap.Sim3d | None:
    """Return the similarity from a further model to the main model that most common keyframes agree with.

    Each common keyframe gives one similarity: its two poses give rotation and place, and the depths of the
    features that have a point in both models give the scale. Camera centres alone do not give the scale if
    the common keyframes are near each other.

    Args:
        main: The main model.
        further: The further model.
        max_error_px: Maximum error (px) of a point of the further model in a common keyframe.

    Returns:
        The similarity; None if fewer than `MIN_COMMON_KEYFRAMES` keyframes agree with the best one.
    """
    common = sorted(registered_ids(main) & registered_ids(further))
    views = [(_View.of(main, number), _View.of(further, number)) for number in common]
    best, most = None, (0, 0)
    for one, other in views:
        found = _similarity(one, other)
        if found is None:
            continue
        seen = [_seen_in_place(*pair, found, max_error_px) for pair in views if len(pair[1].features)]
        score = sum(bool(inside.mean() >= _MIN_INLIER_RATIO) for inside in seen), sum(map(np.sum, seen))
        if score > most:
            best, most = found, score
    return best if most[0] >= MIN_COMMON_KEYFRAMES else None


def _similarity(one: _View, other: _View) -> pycolmap.Sim3d | None:
    """Return the similarity between two models from a common keyframe; None if it has too few points."""
    import pycolmap

    _, first, second = np.intersect1d(one.features, other.features, return_indices=True)
    depths, other_depths = one.depths()[first], other.depths()[second]
    front = (depths > 0.0) & (other_depths > 0.0)
    if front.sum() < _MIN_COMMON_POINTS:
        return None
    scale = float(np.median(depths[front] / other_depths[front]))
    rotation = one.image.cam_from_world().rotation.inverse() * other.image.cam_from_world().rotation
    shift = one.image.projection_center() - scale * (rotation * other.image.projection_center())
    return pycolmap.Sim3d(scale, rotation, shift)


def _seen_in_place(one: _View, other: _View, main_from_further: Any, max_error_px: float) -> FloatArray:
    """Return for each point of the further model (N,) whether a common keyframe sees it in place: 1 or 0."""
    in_cam = one.image.cam_from_world() * (main_from_further * other.points)
    seen_px = np.array([other.image.point2D(int(feature)).xy for feature in other.features])
    out = np.zeros(len(in_cam))
    front = np.flatnonzero(in_cam[:, 2] > 0.0)
    if len(front):
        off_px = np.linalg.norm(one.image.camera.img_from_cam(in_cam[front]) - seen_px[front], axis=1)
        out[front] = off_px <= max_error_px
    return out
