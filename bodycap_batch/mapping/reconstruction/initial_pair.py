"""Rank the pairs of keyframes from which a reconstruction can start."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.percent import format_percent
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, read_image_ids
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import fit_rotation, unit_directions

if TYPE_CHECKING:
    import pycolmap

_MAX_CANDIDATES = 200
"""Maximum number of pairs whose parallax and coverage are measured. Evidence: none."""
_CANDIDATE_MATCHES = 50
"""Minimum number of matches of a candidate pair. The candidates are sorted by their number of matches, and
evenly spaced candidates are measured. It would be wrong to measure only the pairs with the most matches:
these are neighbours in time, and the camera hardly moved between them. Evidence: none."""
_ENOUGH_MATCHES = 100
"""Number of matches at which a pair gets the maximum score for matches. It is COLMAP's default minimum for
the initial pair."""
_ENOUGH_PARALLAX_RAD = float(np.radians(16.0))
"""Parallax (radians) at which a pair gets the maximum score for parallax. It is COLMAP's default minimum for
the initial pair. Evidence: docs/decisions/mapping.md."""
_GRID_CELLS = 4
"""Number of cells of the coverage grid along each axis of the image."""
_MIN_PARALLAX_RAD = float(np.radians(1.5))
"""Minimum parallax (radians) of a usable initial pair. Evidence: none."""
_MIN_COVERAGE = 0.3
"""Minimum coverage (fraction of the grid cells) of a usable initial pair. Evidence: none."""


@dataclass(frozen=True, slots=True)
class InitialPair:
    """Two keyframes from which a reconstruction can start.

    Attributes:
        ids: Database ids of the two images.
        names: Image names of the two images.
        matches: Number of verified matches.
        parallax_rad: Median angle (radians) between matched rays, after the rotation that fits best is
            removed.
        coverage: Fraction of the cells of a 4 x 4 grid in the image that contain matches. It is the mean of
            the fractions in the two images.
    """

    ids: tuple[int, int]
    names: tuple[str, str]
    matches: int
    parallax_rad: float
    coverage: float

    @property
    def score(self) -> float:
        """Score of the pair, from 0 to 1; a better pair has a larger score."""
        return (
            min(1.0, self.matches / _ENOUGH_MATCHES)
            * min(1.0, self.parallax_rad / _ENOUGH_PARALLAX_RAD)
            * self.coverage
        )

    @property
    def is_usable(self) -> bool:
        """Whether the parallax and the coverage are large enough for an initial pair."""
        return self.parallax_rad >= _MIN_PARALLAX_RAD and self.coverage >= _MIN_COVERAGE

    @property
    def rejection_reason(self) -> str:
        """The most likely reason why a reconstruction from this pair fails, for the log."""
        if self.parallax_rad < _MIN_PARALLAX_RAD:
            return (
                f"the two cameras are too close to each other ({np.degrees(self.parallax_rad):.1f} degrees "
                "of parallax)"
            )
        if self.coverage < _MIN_COVERAGE:
            return f"the matches cover only {format_percent(self.coverage)} of the images"
        return f"there were too few matches ({self.matches}), or their geometry was too weak"

    def to_log(self) -> dict[str, object]:
        """Return the entries for the log."""
        return {
            "pair": list(self.names),
            "matches": self.matches,
            "parallax_deg": round(float(np.degrees(self.parallax_rad)), 2),
            "spread": round(self.coverage, 2),
        }


def rank_initial_pairs(workspace: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> list[InitialPair]:
    """Return pairs of keyframes sorted by their score (`InitialPair.score`), the best pair first.

    Args:
        workspace: Folder of the database.
        intrinsics: Intrinsics by camera name.
    """
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
        order = np.argsort(-np.asarray(counts), kind="stable")
        candidates = order[: max(_MAX_CANDIDATES, int((np.asarray(counts) >= _CANDIDATE_MATCHES).sum()))]
        rows = candidates[evenly_spaced(len(candidates), _MAX_CANDIDATES)]
        ids = [pycolmap.pair_id_to_image_pair(pairs[row]) for row in rows]
        images: dict[int, _PairImage] = {}
        out = [_measure_pair(database, (int(a), int(b)), intrinsics, images) for a, b in ids]
    return sorted(out, key=lambda pair: (-pair.score, pair.ids))


def find_user_pair(
    workspace: Path,
    names: tuple[str, str],
    intrinsics: Mapping[str, CameraIntrinsics],
    frame_numbers: Mapping[str, IntArray],
) -> InitialPair | None:
    """Return the initial pair that a user names by two frames.

    For each frame ``camera:frame``, the nearest keyframe of the same camera is used.

    Args:
        workspace: Folder of the database.
        names: Two frames, each as ``camera:frame`` with the frame number in the camera's joined video.
        intrinsics: Intrinsics by camera name.
        frame_numbers: `CaptureCamera.frame_numbers` of each camera, by camera name, to convert the user's
            frame numbers to the frame indices in the database.

    Returns:
        The pair, or None if the two keyframes are not a verified pair.

    Raises:
        JobError: A camera has no keyframes, or one keyframe is nearest to both frames.
    """
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        image_ids = read_image_ids(database)
        ids = sorted(image_ids[_nearest_keyframe(name, image_ids, frame_numbers)] for name in names)
        if ids[0] == ids[1]:
            raise JobError(
                f"the frames {' and '.join(names)} have the same nearest keyframe",
                field="map.init_frames",
                hint="choose two frames that are farther apart in time",
            )
        if not database.exists_two_view_geometry(*ids):
            return None
        return _measure_pair(database, (ids[0], ids[1]), intrinsics, {})


def _nearest_keyframe(
    name: str, keyframes: Collection[ImageRef], frame_numbers: Mapping[str, IntArray]
) -> ImageRef:
    """Return the keyframe that is nearest in time to the frame ``camera:frame`` of the same camera."""
    camera, _, frame = name.rpartition(":")
    candidates = sorted(ref for ref in keyframes if ref.camera == camera)
    if not candidates:
        raise JobError(
            f"there are no keyframes of a camera {camera!r}",
            field="map.init_frames",
            hint=f"use one of the cameras {', '.join(sorted({ref.camera for ref in keyframes}))}",
        )
    return min(candidates, key=lambda ref: abs(int(frame_numbers[camera][ref.frame]) - int(frame)))


class _PairImage(NamedTuple):
    """An image of a pair.

    Attributes:
        name: Name of the image.
        camera: Its camera.
        px: (N,2) pixels of its features.
        directions: (N,3) unit directions of the features.
    """

    name: str
    camera: Camera
    px: FloatArray
    directions: FloatArray


def _read_image(
    database: pycolmap.Database, number: int, intrinsics: Mapping[str, CameraIntrinsics]
) -> _PairImage:
    """Read the features of an image."""
    name = database.read_image(number).name
    camera = intrinsics[ImageRef.parse(name).camera].camera
    px = np.asarray(database.read_keypoints(number), dtype=np.float64)[:, :2]
    return _PairImage(name, camera, px, unit_directions(camera.unproject(px)))


def _measure_pair(
    database: pycolmap.Database,
    ids: tuple[int, int],
    intrinsics: Mapping[str, CameraIntrinsics],
    images: dict[int, _PairImage],
) -> InitialPair:
    """Measure the number of matches, the parallax and the coverage of a pair of images.

    Args:
        database: The database of the features and matches.
        ids: Ids of the two images.
        intrinsics: Intrinsics by camera name.
        images: The images that were read so far, by id; the images of this pair are added.
    """
    matches = np.asarray(database.read_two_view_geometry(*ids).inlier_matches)
    for number in ids:
        if number not in images:
            images[number] = _read_image(database, number, intrinsics)
    sides = [images[number] for number in ids]
    names = (sides[0].name, sides[1].name)
    cameras = [image.camera for image in sides]
    pixels = [image.px[matches[:, side]] for side, image in enumerate(sides)]
    rays = [image.directions[matches[:, side]] for side, image in enumerate(sides)]
    finite = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    first, second = rays[0][finite], rays[1][finite]
    parallax, coverage = 0.0, 0.0
    if len(first):
        chord = np.linalg.norm(second - first @ fit_rotation(first, second).T, axis=1)
        parallax = float(2.0 * np.arcsin(np.clip(0.5 * np.median(chord), 0.0, 1.0)))
        coverage = float(
            np.mean([_grid_coverage(px, camera) for px, camera in zip(pixels, cameras, strict=True)])
        )
    return InitialPair(ids, names, len(first), parallax, coverage)


def _grid_coverage(px: FloatArray, camera: Camera) -> float:
    """Return the fraction of the image's grid cells that contain at least one of the pixels (N,2)."""
    size_px = (camera.width_px, camera.height_px)
    cells = np.clip((px / size_px * _GRID_CELLS).astype(int), 0, _GRID_CELLS - 1)
    return len(np.unique(cells @ (_GRID_CELLS, 1))) / _GRID_CELLS**2
