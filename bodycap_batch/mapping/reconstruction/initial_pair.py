"""Which two keyframes to start a map from."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, read_image_ids
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import fit_rotation, unit_directions

if TYPE_CHECKING:
    import pycolmap

_MAX_CANDIDATES = 200
"""Pairs that are looked at closely."""
_CANDIDATE_MATCHES = 50
"""Pairs with so many are looked at, evenly from those with most to those with fewest: the most matches have
neighbours, which hardly moved apart."""
_ENOUGH_MATCHES = 100
_ENOUGH_PARALLAX_RAD = float(np.radians(16.0))
"""Beyond these more of the same makes a start no better. The first pair then has 16, 18, 8 and 21 degrees
between its rays (walk12, room12, tum_fr1_xyz, walk131); with 150 and 8 on tum_fr1_xyz 5."""
_GRID_CELLS = 4
_MIN_PARALLAX_RAD = float(np.radians(1.5))
_MIN_COVERAGE = 0.3


@dataclass(frozen=True, slots=True)
class InitialPair:
    """A pair to start from.

    Attributes:
        ids: Database ids of its images.
        names: Their names.
        matches: Verified matches.
        parallax_rad: Median angle between rays once the best rotation is taken out.
        spread: Share of a 4 x 4 grid over both images that holds matches.
    """

    ids: tuple[int, int]
    names: tuple[str, str]
    matches: int
    parallax_rad: float
    spread: float

    @property
    def score(self) -> float:
        """Larger is better, at most 1."""
        return (
            min(1.0, self.matches / _ENOUGH_MATCHES)
            * min(1.0, self.parallax_rad / _ENOUGH_PARALLAX_RAD)
            * self.spread
        )

    @property
    def usable(self) -> bool:
        """Whether its cameras moved apart and its matches are more than a patch of the images."""
        return self.parallax_rad >= _MIN_PARALLAX_RAD and self.spread >= _MIN_COVERAGE

    @property
    def doubt(self) -> str:
        """What speaks against it, for the log."""
        if self.parallax_rad < _MIN_PARALLAX_RAD:
            return f"the cameras hardly moved apart ({np.degrees(self.parallax_rad):.1f} degrees of parallax)"
        if self.spread < _MIN_COVERAGE:
            return f"the matches fill {self.spread:.0%} of the images"
        return f"{self.matches} matches were too few or their geometry too weak"

    def to_log(self) -> dict[str, object]:
        """JSON-able account."""
        return {
            "pair": list(self.names),
            "matches": self.matches,
            "parallax_deg": round(float(np.degrees(self.parallax_rad)), 2),
            "spread": round(self.spread, 2),
        }


def rank_initial_pairs(workspace: Path, lenses: Mapping[str, tuple[Camera, bool]]) -> list[InitialPair]:
    """Pairs of keyframes, the best to start from first, by parallax without rotation, matches and spread."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
        order = np.argsort(-np.asarray(counts), kind="stable")
        many = order[: max(_MAX_CANDIDATES, int((np.asarray(counts) >= _CANDIDATE_MATCHES).sum()))]
        even = np.linspace(0, len(many) - 1, min(_MAX_CANDIDATES, len(many))).round().astype(int)
        ids = [pycolmap.pair_id_to_image_pair(pairs[row]) for row in many[even]]
        out = [_measure_pair(database, (int(a), int(b)), lenses) for a, b in ids]
    return sorted(out, key=lambda start: (-start.score, start.ids))


def find_user_pair(
    workspace: Path,
    named: tuple[str, str],
    lenses: Mapping[str, tuple[Camera, bool]],
    numbers: Mapping[str, IntArray],
) -> InitialPair | None:
    """The start a user names as two ``camera:frame``: each camera's keyframe nearest to the frame.

    Args:
        workspace: Folder of the database.
        named: Frames by their number in the camera's joined video.
        lenses: Of each camera.
        numbers: `CaptureCamera.frame_numbers` of each camera: keyframes are known by their place among them.

    Returns:
        The pair, or None where its two keyframes share no verified matches.

    Raises:
        JobError: A camera has no keyframes, or both names lead to the same keyframe.
    """
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        known = read_image_ids(database)
        ids = sorted(known[_nearest_keyframe(name, known, numbers)] for name in named)
        if ids[0] == ids[1]:
            raise JobError(f"{' and '.join(named)} are one keyframe", field="map.init_frames")
        if not database.exists_two_view_geometry(*ids):
            return None
        return _measure_pair(database, (ids[0], ids[1]), lenses)


def _nearest_keyframe(name: str, known: Collection[ImageRef], numbers: Mapping[str, IntArray]) -> ImageRef:
    camera, _, frame = name.rpartition(":")
    mine = sorted(ref for ref in known if ref.camera == camera)
    if not mine:
        raise JobError(
            f"no keyframes of a camera {camera!r}",
            field="map.init_frames",
            hint=f"cameras: {', '.join(sorted({ref.camera for ref in known}))}",
        )
    return min(mine, key=lambda ref: abs(int(numbers[camera][ref.frame]) - int(frame)))


def _measure_pair(
    database: pycolmap.Database, ids: tuple[int, int], lenses: Mapping[str, tuple[Camera, bool]]
) -> InitialPair:
    matches = np.asarray(database.read_two_view_geometry(*ids).inlier_matches)
    names = (database.read_image(ids[0]).name, database.read_image(ids[1]).name)
    seen = [lenses[ImageRef.parse(name).camera][0] for name in names]
    pixels = [
        np.asarray(database.read_keypoints(number), dtype=np.float64)[matches[:, side], :2]
        for side, number in enumerate(ids)
    ]
    rays = [unit_directions(lens.unproject(px)) for lens, px in zip(seen, pixels, strict=True)]
    known = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    first, second = rays[0][known], rays[1][known]
    parallax, spread = 0.0, 0.0
    if len(first):
        apart = np.linalg.norm(second - first @ fit_rotation(first, second).T, axis=1)
        parallax = float(2.0 * np.arcsin(np.clip(0.5 * np.median(apart), 0.0, 1.0)))
        spread = float(np.mean([_grid_coverage(px, lens) for px, lens in zip(pixels, seen, strict=True)]))
    return InitialPair(ids, names, len(first), parallax, spread)


def _grid_coverage(px: FloatArray, lens: Camera) -> float:
    cells = np.clip((px / (lens.width_px, lens.height_px) * _GRID_CELLS).astype(int), 0, _GRID_CELLS - 1)
    return len(np.unique(cells @ (_GRID_CELLS, 1))) / _GRID_CELLS**2
