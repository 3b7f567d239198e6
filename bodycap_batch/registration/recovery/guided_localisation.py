"""Poses of single frames, from the map's points found where a pose nearby leads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.registration.poses.batched_pnp import Observations, make_observations, refine_poses
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, accept_poses, ransac_pose
from bodycap_batch.registration.recovery.motion_prior import PositionEstimate
from bodycap_batch.registration.recovery.patch_search import (
    KeyframePatches,
    PatchMatches,
    PredictedView,
    Pyramid,
    SearchLevel,
    match_patches,
    select_patches,
)

_LEVELS = (
    SearchLevel(level=2, side=15, radius=14, score=0.6, limit_px=12.0),
    SearchLevel(level=1, side=21, radius=8, score=0.7, limit_px=6.0),
    SearchLevel(level=0, side=31, radius=8, score=0.75, limit_px=4.0),
)
"""From far and coarse to near and fine. The last one at full size: errors of frames with known poses are a
quarter smaller than from half size."""
_POINT_VARIANCE = 6.0
"""As for tracks."""
_CELL_SIDE_PX = 40.0
_FULL_WEIGHT_PER_CELL = 2.0
"""Patches that overlap err together: so many count in a square of about a patch's side. Otherwise fifty
patches on one grating of a ceiling pass for a pose that is 60 cm off."""
_MIN_NOISE_PX = 1.0
"""Of patches found in blurred frames: fewer than twenty that happen to agree better tell nothing better."""
_MIN_MATCHES = 8
_SUFFICIENT_INLIERS, _SUFFICIENT_WEIGHT_RATIO = 25, 0.6
_TRUSTED = 0.6
"""As for tracks: beyond it sampling finds nothing better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseEstimate:
    """A pose from points found where they were looked for.

    Attributes:
        cam_from_map: (4,4).
        covariance: (6,6) as `Trajectory` has it.
        inliers: Points that agree.
        evidence: Their share of the weight of all that were found.
        error_px: Their mean residual.
        depth: Their median depth.
    """

    cam_from_map: FloatArray
    covariance: FloatArray
    inliers: int
    evidence: float
    error_px: float
    depth: float

    @staticmethod
    def of(path: Trajectory, frame: int) -> PoseEstimate:
        """A pose that tracking found; the depth of its points is not known any more."""
        return PoseEstimate(
            cam_from_map=invert(path.gauge_from_cam[frame]),
            covariance=path.covariance[frame],
            inliers=int(path.inliers[frame]),
            evidence=1.0,
            error_px=float(path.error_px[frame]),
            depth=np.inf,
        )

    @property
    def place(self) -> PositionEstimate:
        """Where the camera was."""
        turn = self.cam_from_map[:3, :3]
        return PositionEstimate(invert(self.cam_from_map)[:3, 3], turn.T @ self.covariance[3:, 3:] @ turn)

    def with_place(self, place: PositionEstimate) -> tuple[FloatArray, FloatArray]:
        """The pose cam_from_map (4,4) and its covariance (6,6) once the centre is known to be elsewhere.

        The turn follows as far as the points tie it to the centre.
        """
        turn, centre = self.cam_from_map[:3, :3], invert(self.cam_from_map)[:3, 3]
        follows = self.covariance[:3, 3:] @ np.linalg.inv(self.covariance[3:, 3:])
        shift = -turn @ (place.centre - centre)
        turned = so3_exp(follows @ shift) @ turn
        spread = turned @ place.covariance @ turned.T
        rest = self.covariance[:3, :3] - follows @ self.covariance[3:, :3]
        covariance = np.empty((6, 6))
        covariance[3:, 3:] = spread
        covariance[:3, 3:] = follows @ spread
        covariance[3:, :3] = covariance[:3, 3:].T
        covariance[:3, :3] = rest + follows @ spread @ follows.T
        return make_transform(turned, -turned @ place.centre), covariance


def fuse(first: PositionEstimate, second: PositionEstimate) -> tuple[PositionEstimate, float]:
    """The place that two independent ones make, and their squared Mahalanobis distance."""
    total = np.linalg.inv(first.covariance + second.covariance)
    off = second.centre - first.centre
    centre = first.centre + first.covariance @ total @ off
    return PositionEstimate(centre, first.covariance @ total @ second.covariance), float(off @ total @ off)


@dataclass(frozen=True, slots=True)
class SearchFrame:
    """A frame as it is searched.

    Attributes:
        pyramid: Its picture.
        row: Its own among the map's keyframes, -1 where it is none.
    """

    pyramid: Pyramid
    row: int


@dataclass(frozen=True, slots=True)
class NeighbourPose:
    """Where the camera was a frame away.

    Attributes:
        pose: (4,4) cam_from_map.
        step: 1 where that was a frame earlier, −1 where it was one later.
    """

    pose: FloatArray
    step: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidedLocaliser:
    """Finds poses of a camera's frames near where they are expected.

    Attributes:
        lens: The camera's.
        gallery: The map and what its points look like.
        limits: What makes a pose acceptable.
        exposure: Share of the time between two frames that the shutter is open.
        readout: The same from the first row's exposure to the last's.
        sees_room: Which pixels (N,2) of the camera show the room, as its mask says.
    """

    lens: Camera
    gallery: KeyframePatches
    limits: AcceptanceCriteria
    exposure: float
    readout: float = 0.0
    sees_room: Callable[[FloatArray], BoolArray]

    def locate(
        self, seen: SearchFrame, priors: list[FloatArray], beside: NeighbourPose, place: PositionEstimate
    ) -> PoseEstimate | None:
        """The pose of a frame.

        Args:
            seen: The frame.
            priors: Poses cam_from_map (4,4) it may have, the likeliest first.
            beside: The frame before or after.
            place: Where its motion leads to.
        """
        best: PoseEstimate | None = None
        for prior in priors:
            fix = self._search(self._view(seen, prior, beside), _LEVELS[0])
            if fix is not None and (best is None or fix.inliers > best.inliers):
                best = fix
            if (
                best is not None
                and best.inliers >= _SUFFICIENT_INLIERS
                and best.evidence >= _SUFFICIENT_WEIGHT_RATIO
            ):
                break
        for search in _LEVELS[1:]:
            if best is None:
                return None
            pose, _ = best.with_place(fuse(best.place, place)[0])
            best = self._search(self._view(seen, pose, beside), search)
        return best

    def look_again(self, seen: SearchFrame, pose: FloatArray, beside: NeighbourPose) -> PoseEstimate | None:
        """The pose (4,4) of a frame that is nearly known; the rest as for `locate`."""
        return self._search(self._view(seen, pose, beside), _LEVELS[-1])

    def _view(self, seen: SearchFrame, pose: FloatArray, beside: NeighbourPose) -> PredictedView:
        return PredictedView(
            lens=self.lens,
            pyramid=seen.pyramid,
            cam_from_map=pose,
            before=beside.pose,
            exposure=self.exposure,
            readout=beside.step * self.readout,
            row=seen.row,
        )

    def _search(self, view: PredictedView, search: SearchLevel) -> PoseEstimate | None:
        rows = select_patches(self.gallery, view)
        if len(rows) < _MIN_MATCHES:
            return None
        found = match_patches(self.gallery, view, rows, search)
        found = found.chosen(self.sees_room(found.px))
        return self._solve(view, found, search) if len(found.point) >= _MIN_MATCHES else None

    def _solve(self, view: PredictedView, found: PatchMatches, search: SearchLevel) -> PoseEstimate | None:
        scale = view.pyramid.step_px[0]
        limits = replace(
            self.limits,
            max_error_px=search.limit_px * scale,
            min_inliers=_MIN_MATCHES,
            max_sigma_depth=np.inf,
            min_noise_px=_MIN_NOISE_PX * scale,
        )
        points = self.gallery.scene_map.points[found.point]
        weight = _match_weights(found.px / (_CELL_SIDE_PX * scale), self.gallery.seen[found.point])
        views = make_observations(self.lens, np.array([0, len(points)]), points, found.mid_row_px, weight)
        best = self._refined(views, view.cam_from_map, limits)
        if best is None or best.evidence < _TRUSTED:
            sampled = ransac_pose(self.lens, points, found.mid_row_px, limits)
            other = None if sampled is None else self._refined(views, sampled, limits)
            if other is not None and (best is None or other.inliers > best.inliers):
                best = other
        return best

    def _refined(
        self, views: Observations, start: FloatArray, limits: AcceptanceCriteria
    ) -> PoseEstimate | None:
        pose = refine_poses(views, start[None], limits.max_error_px)
        judged = accept_poses(views, pose, limits)[0]
        if judged.covariance is None:
            return None
        return PoseEstimate(
            cam_from_map=pose[0],
            covariance=judged.covariance,
            inliers=judged.inliers,
            evidence=judged.evidence,
            error_px=judged.error_px,
            depth=float(np.median(views.points @ pose[0, 2, :3] + pose[0, 2, 3])),
        )


def _match_weights(cell: FloatArray, seen: IntArray) -> FloatArray:
    """(N,) how much points count that are seen in cells (N,2) of the image and by so many keyframes (N,)."""
    _, group, count = np.unique(np.floor(cell).astype(int), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(
        seen / (seen + _POINT_VARIANCE) / np.maximum(1.0, count[np.ravel(group)] / _FULL_WEIGHT_PER_CELL)
    )
