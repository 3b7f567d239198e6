"""Register inconsistent keyframes a second time, from points that only other keyframes determine.

The matches of a keyframe may contradict the points of a map for two reasons: the keyframe is misplaced, or
its picture is blurred or shows the wearer, so that many of its features are wrong. A second registration
decides. It uses the points that the consistent keyframes determine, and does not start from the first
pose. If both poses agree, the keyframe is in the right place.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, runs
from bodycap_batch.mapping.matching.database import DATABASE_NAME

if TYPE_CHECKING:
    import pycolmap

_MAX_SHIFT = 0.02
"""Maximum distance between the two positions of a confirmed keyframe, as a fraction of the median depth of
its points. Evidence: docs/decisions/mapping.md."""
_MIN_INLIERS = 15
"""Minimum number of matches that agree with the second pose. Origin: the mapper's minimum number for the
registration of a keyframe in a hard capture. Evidence: none."""
_MIN_INLIER_RATIO = 0.5
"""Minimum fraction of the matches that agree with the second pose. Evidence: none."""
_MIN_OBSERVATIONS = 2
"""Minimum number of consistent keyframes that determine a point: two lines of sight."""
_MAX_POINT_SIGMA = 0.05
"""Maximum standard deviation of a point, for lines of sight with an error of one pixel, as a fraction of its
distance from the keyframe. Evidence: none."""
_NEIGHBOURS = 4
"""Number of inconsistent keyframes before and after a keyframe that decide with it. Evidence:
docs/decisions/mapping.md."""
_MIN_CONFIRMED_RATIO = 0.5
"""Minimum fraction of these keyframes, with the keyframe itself, that a second registration finds in the same
place. One keyframe in a misplaced block may agree by chance. Evidence: docs/decisions/mapping.md."""
_MIN_CONFIRMED = 2
"""Minimum number of these keyframes. A single inconsistent keyframe is never confirmed. Evidence:
docs/decisions/mapping.md."""
_SEED = 0
"""Seed of RANSAC."""


@dataclass(frozen=True, slots=True)
class _SightLines:
    """The lines of sight from keyframes to the points of a model.

    A point is triangulated as the position with the smallest weighted squared distance from its lines.

    Attributes:
        image: (M,) id of the image that each line starts from.
        row: (M,) row of the observed point.
        information: (M,3,3) information of each line about its point, for an error of one pixel.
        vector: (M,3) information times the camera centre.
        rows: Row of each point, by point id.
    """

    image: IntArray
    row: IntArray
    information: FloatArray
    vector: FloatArray
    rows: Mapping[int, int]

    @staticmethod
    def create(model: pycolmap.Reconstruction, observed: Mapping[int, IntArray]) -> _SightLines:
        """Return the lines of sight of all registered images.

        Args:
            model: The model.
            observed: For each image, the point id of each feature; −1 without a point.
        """
        rows = {int(number): row for row, number in enumerate(sorted(model.point3D_ids()))}
        points = np.array([model.point3D(number).xyz for number in rows]).reshape(-1, 3)
        images, owners, information, vectors = [], [], [], []
        for number, ids in observed.items():
            features = np.flatnonzero(ids >= 0)
            image = model.image(number)
            camera = model.camera(image.camera_id)
            own = np.array([rows[int(point)] for point in ids[features]], dtype=np.int64)
            pose = image.cam_from_world().inverse().matrix()
            rays = np.column_stack([camera.cam_from_img(_features_px(image)[features]), np.ones(len(own))])
            # Some lenses have no line of sight for pixels near the border.
            own, rays = own[np.isfinite(rays).all(axis=1)], rays[np.isfinite(rays).all(axis=1)]
            rays = rays @ pose[:, :3].T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            distance = np.linalg.norm(points[own] - pose[:, 3], axis=1)
            weight = (camera.mean_focal_length() / np.maximum(distance, 1e-12)) ** 2
            across = weight[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
            images.append(np.full(len(own), number))
            owners.append(own)
            information.append(across)
            vectors.append(across @ pose[:, 3])
        return _SightLines(
            image=np.concatenate(images),
            row=np.concatenate(owners),
            information=np.concatenate(information),
            vector=np.concatenate(vectors),
            rows=rows,
        )

    def triangulate(self, image_ids: Collection[int]) -> tuple[FloatArray, FloatArray]:
        """Triangulate all points from some images.

        Returns:
            The points (P,3) and the largest standard deviation (P,) of each for an error of one pixel; NaN
            for points that these images do not determine.
        """
        chosen = np.flatnonzero(np.isin(self.image, sorted(image_ids)))
        count = len(self.rows)
        information, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(information, self.row[chosen], self.information[chosen])
        np.add.at(vector, self.row[chosen], self.vector[chosen])
        smallest, largest = np.linalg.eigvalsh(information)[:, [0, 2]].T
        usable = np.bincount(self.row[chosen], minlength=count) >= _MIN_OBSERVATIONS
        usable &= smallest > 1e-9 * largest
        points, sigma = np.full((count, 3), np.nan), np.full(count, np.nan)
        points[usable] = np.linalg.solve(information[usable], vector[usable][:, :, None])[:, :, 0]
        sigma[usable] = 1.0 / np.sqrt(smallest[usable])
        return points, sigma


def confirm_images(
    workspace: Path,
    model: pycolmap.Reconstruction,
    inconsistent: Collection[int],
    sequences: Sequence[Sequence[int]],
    max_error_px: float,
) -> set[int]:
    """Return the inconsistent images whose pose a second registration confirms.

    An image is confirmed if the second registration finds it in the same place, and also at least half of the
    inconsistent images next to it. A single inconsistent image is not confirmed.

    Args:
        workspace: Folder of the database with verified matches.
        model: The model.
        inconsistent: Ids of registered images. The points are triangulated without them.
        sequences: For each camera, the ids of its registered images in the order of time.
        max_error_px: Maximum reprojection error of a match that agrees with a pose, pixels.
    """
    found = _images_found_again(workspace, model, inconsistent, max_error_px)
    out = set()
    for sequence in sequences:
        for start, stop in runs(np.isin(sequence, sorted(inconsistent))):
            agrees = np.isin(sequence[start:stop], sorted(found))
            for place in np.flatnonzero(agrees).tolist():
                near = agrees[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]
                if near.sum() >= max(_MIN_CONFIRMED, _MIN_CONFIRMED_RATIO * len(near)):
                    out.add(sequence[start + place])
    return out


def _images_found_again(
    workspace: Path, model: pycolmap.Reconstruction, inconsistent: Collection[int], max_error_px: float
) -> set[int]:
    """Return the inconsistent images that a second registration finds in the same place."""
    sound = {int(number) for number in model.reg_image_ids()} - set(inconsistent)
    if not inconsistent or not sound or not model.num_points3D():
        return set()
    observed = {int(number): observed_points(model, int(number)) for number in model.reg_image_ids()}
    lines = _SightLines.create(model, observed)
    points, sigma = lines.triangulate(sound)
    out = set()
    for number, (features, ids) in _matched_points(workspace, set(inconsistent), sound, observed).items():
        rows = np.array([lines.rows[int(point)] for point in ids], dtype=np.int64)
        if _is_confirmed(model.image(number), model, features, points[rows], sigma[rows], max_error_px):
            out.add(number)
    return out


def observed_points(model: pycolmap.Reconstruction, image_id: int) -> IntArray:
    """Return the id (N,) of the point that each feature of an image observes; −1 without a point."""
    image = model.image(image_id)
    out = np.full(image.num_points2D(), -1, dtype=np.int64)
    for feature in image.get_observation_point2D_idxs():
        out[feature] = image.point2D(feature).point3D_id
    return out


def _matched_points(
    workspace: Path, inconsistent: set[int], sound: set[int], observed: Mapping[int, IntArray]
) -> dict[int, tuple[IntArray, IntArray]]:
    """Return for each inconsistent image its features (K,) and the points (K,) that their matches observe.

    Only matches with sound images count.
    """
    import pycolmap

    found: dict[int, list[IntArray]] = {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            first, second = map(int, pycolmap.pair_id_to_image_pair(pair))
            matches = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
            for one, other, columns in ((first, second, (0, 1)), (second, first, (1, 0))):
                if one in inconsistent and other in sound:
                    features, partners = matches[:, columns].T
                    ids = observed[other][partners]
                    found.setdefault(one, []).append(np.column_stack([features, ids])[ids >= 0])
    unique = {number: np.unique(np.concatenate(parts), axis=0) for number, parts in sorted(found.items())}
    return {number: (rows[:, 0], rows[:, 1]) for number, rows in unique.items()}


def _is_confirmed(
    image: Any,
    model: pycolmap.Reconstruction,
    features: IntArray,
    points: FloatArray,
    sigma: FloatArray,
    max_error_px: float,
) -> bool:
    """Return whether the pose of an image from points (K,3) at features (K,) agrees with its pose.

    Args:
        image: The image.
        model: The model.
        features: (K,) observed features.
        points: (K,3) points that other images determine; NaN for others.
        sigma: (K,) standard deviations of the points.
        max_error_px: Maximum reprojection error of a match that agrees with a pose, pixels.
    """
    import pycolmap

    centre = image.projection_center()
    with np.errstate(invalid="ignore"):
        usable = np.flatnonzero(sigma < _MAX_POINT_SIGMA * np.linalg.norm(points - centre, axis=1))
    if len(usable) < _MIN_INLIERS:
        return False
    px, points = _features_px(image)[features[usable]], points[usable]
    camera = model.camera(image.camera_id)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = _SEED
    found = pycolmap.estimate_absolute_pose(px, points, camera, estimation)
    if found is None or found["num_inliers"] < max(_MIN_INLIERS, _MIN_INLIER_RATIO * len(px)):
        return False
    mask = np.asarray(found["inlier_mask"], dtype=np.bool_)
    refined = pycolmap.refine_absolute_pose(found["cam_from_world"], px, points, mask, camera)
    if refined is None:
        return False
    second = refined["cam_from_world"]
    depth = float(np.median((points[mask] @ second.matrix()[:, :3].T + second.matrix()[:, 3])[:, 2]))
    shift = float(np.linalg.norm(second.inverse().translation - centre))
    return bool(shift <= _MAX_SHIFT * depth)


def _features_px(image: Any) -> FloatArray:
    """Return the pixels (N,2) of an image's features."""
    return np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
