"""Localise single frames: search map points at the pixels that an expected pose predicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, transform_points
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.registration.poses.batched_pnp import Observations, make_observations, refine_poses
from bodycap_batch.registration.poses.observations import point_weights
from bodycap_batch.registration.poses.pnp import (
    TRUSTED_WEIGHT_RATIO,
    AcceptanceCriteria,
    accept_poses,
    ransac_pose,
)
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
    SearchLevel(pyramid_level=2, patch_side=15, search_radius=14, min_score=0.6, limit_px=12.0),
    SearchLevel(pyramid_level=1, patch_side=21, search_radius=8, min_score=0.7, limit_px=6.0),
    SearchLevel(pyramid_level=0, patch_side=31, search_radius=8, min_score=0.75, limit_px=4.0),
)
"""Searches from coarse to fine. The last search uses the largest image of the pyramid. The pose errors are
then a quarter smaller than with the half-size image (evidence: docs/decisions/registration.md). Evidence for
the other values: none."""
_CELL_SIDE_PX = 40.0
"""Pixels at 640 px image width: side of a cell of the image grid. It is about the side of a patch."""
_FULL_WEIGHT_PER_CELL = 2.0
"""Maximum sum of the weights of the matches in one cell. With more matches, each match has a lower weight,
because overlapping patches have common errors. Evidence: docs/decisions/registration.md."""
_MIN_NOISE_PX = 1.0
"""Pixels at 640 px image width: smallest assumed noise of a patch match. In a blurred frame with few matches,
the residuals may be smaller by chance. Evidence: none."""
_MIN_MATCHES = 8
"""Minimum number of matches for a pose. Evidence: none."""
_SUFFICIENT_INLIERS, _SUFFICIENT_WEIGHT_RATIO = 25, 0.6
"""Minimum number of inliers and minimum inlier weight ratio of a pose that ends the search in a frame. The
remaining expected poses are then not tried. Evidence: none."""

_RESTART_PX = 2.5
"""Pixels at 640 px image width: median movement of the points by which the start of a repeated search is
displaced. It is less than half of the range of the last search. Evidence: docs/decisions/registration.md."""
_RESTART_STEP = 1e-3
"""Step of the difference that gives the movement of the points, in radians and fractions of the depth."""
_MAX_START_DEPENDENCE = 0.99
"""Largest used fraction of an error of the start that a search leaves. The covariance is finite then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseEstimate:
    """A pose with its uncertainty and its support, from patch matches or from tracking.

    Attributes:
        cam_from_map: (4,4) pose.
        covariance: (6,6) covariance as in `Trajectory`.
        inliers: Number of inliers.
        inlier_weight_ratio: Ratio of the inliers' weight to the weight of all matches.
        error_px: Mean residual of the inliers, pixels.
        depth: Median depth of the matched points, in map units.
    """

    cam_from_map: FloatArray
    covariance: FloatArray
    inliers: int
    inlier_weight_ratio: float
    error_px: float
    depth: float

    @staticmethod
    def from_trajectory(path: Trajectory, frame: int) -> PoseEstimate:
        """Return the pose of a localised frame of a trajectory.

        The trajectory does not contain the depth of the points, so the depth is set to infinity. It does not
        contain the inlier weight ratio either, so this ratio is set to 1.
        """
        return PoseEstimate(
            cam_from_map=invert(path.gauge_from_cam[frame]),
            covariance=path.covariance[frame],
            inliers=int(path.inliers[frame]),
            inlier_weight_ratio=1.0,
            error_px=float(path.error_px[frame]),
            depth=np.inf,
        )

    @property
    def position(self) -> PositionEstimate:
        """The camera centre with its covariance in the axes of the map."""
        rotation = self.cam_from_map[:3, :3]
        covariance = rotation.T @ self.covariance[3:, 3:] @ rotation
        return PositionEstimate(invert(self.cam_from_map)[:3, 3], covariance)

    @property
    def support(self) -> float:
        """Number of inliers times the inlier weight ratio."""
        return self.inliers * self.inlier_weight_ratio

    def has_support(self, min_inliers: int, min_inlier_weight_ratio: float) -> bool:
        """Return True if enough matches agree with the pose."""
        return self.inliers >= min_inliers and self.inlier_weight_ratio >= min_inlier_weight_ratio

    def with_start_error(self, dependence: float) -> PoseEstimate:
        """Return the pose with the covariance that contains the error of the start of its search.

        The pose is the start of its own search. If the search leaves a fraction f of an error of the start,
        the error of the matches repeats in the start and adds up to 1 / (1 − f) times its size.

        Args:
            dependence: The fraction, from `GuidedLocaliser.start_dependence`.
        """
        return replace(self, covariance=self.covariance / (1.0 - dependence) ** 2)

    def conditioned_on_centre(self, position: PositionEstimate) -> tuple[FloatArray, FloatArray]:
        """Return the pose and its covariance after the camera centre is moved to another position.

        The rotation changes too, according to its correlation with the centre.

        Args:
            position: The other position, with its uncertainty.

        Returns:
            Pose cam_from_map (4,4) and its covariance (6,6).
        """
        rotation, centre = self.cam_from_map[:3, :3], invert(self.cam_from_map)[:3, 3]
        gain = self.covariance[:3, 3:] @ np.linalg.inv(self.covariance[3:, 3:])
        shift = -rotation @ (position.centre - centre)
        new_rotation = so3_exp(gain @ shift) @ rotation
        position_covariance = new_rotation @ position.covariance @ new_rotation.T
        conditional = self.covariance[:3, :3] - gain @ self.covariance[3:, :3]
        covariance = np.empty((6, 6))
        covariance[3:, 3:] = position_covariance
        covariance[:3, 3:] = gain @ position_covariance
        covariance[3:, :3] = covariance[:3, 3:].T
        covariance[:3, :3] = conditional + gain @ position_covariance @ gain.T
        return make_transform(new_rotation, -new_rotation @ position.centre), covariance


def fuse(first: PositionEstimate, second: PositionEstimate) -> tuple[PositionEstimate, float]:
    """Combine two independent positions.

    Returns:
        The weighted mean, and the squared Mahalanobis distance between the two positions.
    """
    information = np.linalg.inv(first.covariance + second.covariance)
    difference = second.centre - first.centre
    centre = first.centre + first.covariance @ information @ difference
    covariance = first.covariance @ information @ second.covariance
    return PositionEstimate(centre, covariance), float(difference @ information @ difference)


@dataclass(frozen=True, slots=True)
class SearchFrame:
    """A frame to be searched.

    Attributes:
        index: Frame index.
        pyramid: Image pyramid of the frame.
        keyframe_row: Row index of the frame among the map's keyframes, or -1 if the frame is not a keyframe.
    """

    index: int
    pyramid: Pyramid
    keyframe_row: int


@dataclass(frozen=True, slots=True)
class NeighbourPose:
    """Pose of the camera in the previous or next frame. It determines the motion blur in the searched frame.

    Attributes:
        pose: (4,4) cam_from_map.
        direction: 1 for the pose of the frame before, −1 for the pose of the frame after.
    """

    pose: FloatArray
    direction: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidedLocaliser:
    """Estimates the poses of a camera's frames near expected poses.

    Attributes:
        lens: The camera model.
        patches: The map and the images of its keyframes.
        criteria: The conditions that a pose must meet.
        exposure_ratio: Exposure time as a fraction of the frame interval.
        readout_ratio: Readout time as a fraction of the frame interval.
        shutter: The rolling shutter with the rotation of the camera from matches between adjacent frames.
            None: the rotation is unknown, or the shutter is global.
        is_unmasked: Function from pixels (N,2) to a mask (N,) of the pixels at which the
            room is visible.
    """

    lens: Camera
    patches: KeyframePatches
    criteria: AcceptanceCriteria
    exposure_ratio: float
    readout_ratio: float = 0.0
    shutter: TurningShutter | None = None
    is_unmasked: Callable[[FloatArray], BoolArray]

    def localise(
        self,
        search_frame: SearchFrame,
        priors: list[FloatArray],
        neighbour: NeighbourPose,
        predicted: PositionEstimate,
    ) -> PoseEstimate | None:
        """Estimate the pose of a frame, searching from coarse to fine.

        Args:
            search_frame: The frame.
            priors: Expected poses cam_from_map (4,4), the most likely pose first.
            neighbour: Pose of the frame before or after.
            predicted: Camera position that is expected from the camera's motion.

        Returns:
            The pose, or None if a search fails.
        """
        best: PoseEstimate | None = None
        for prior in priors:
            estimate = self._search(self._view(search_frame, prior, neighbour), _LEVELS[0])
            if estimate is not None and (best is None or estimate.inliers > best.inliers):
                best = estimate
            if best is not None and best.has_support(_SUFFICIENT_INLIERS, _SUFFICIENT_WEIGHT_RATIO):
                break
        for level in _LEVELS[1:]:
            if best is None:
                return None
            pose, _ = best.conditioned_on_centre(fuse(best.position, predicted)[0])
            best = self._search(self._view(search_frame, pose, neighbour), level)
        return best

    def relocalise(
        self, search_frame: SearchFrame, pose: FloatArray, neighbour: NeighbourPose
    ) -> PoseEstimate | None:
        """Estimate the pose of a frame again, with only the finest search.

        Args:
            search_frame: The frame.
            pose: (4,4) pose cam_from_map from an earlier search of this frame.
            neighbour: Pose of the frame before or after.

        Returns:
            The pose, or None if the search fails.
        """
        return self._search(self._view(search_frame, pose, neighbour), _LEVELS[-1])

    def start_dependence(
        self, search_frame: SearchFrame, estimate: PoseEstimate, neighbour: NeighbourPose
    ) -> float:
        """Return the fraction of an error of the start that remains in a found pose.

        The finest search is repeated from two poses on both sides of the found pose, along the direction that
        is known least. Matches at true places lead back to one pose. False matches are anywhere in the search
        range around the start: enough of them agree with the start, wherever it is.

        Args:
            search_frame: The frame.
            estimate: The found pose.
            neighbour: Pose of the frame before or after.

        Returns:
            Distance between the two centres that were found over the distance of the two starts, at most
            `_MAX_START_DEPENDENCE`. It is this limit, too, if a search fails.
        """
        unit = np.repeat([1.0, estimate.depth], 3)
        weakest = unit * np.linalg.eigh(estimate.covariance / np.outer(unit, unit))[1][:, -1]

        def displaced(size: float) -> FloatArray:
            change = size * weakest
            step = make_transform(np.ravel(so3_exp(change[:3])).reshape(3, 3), change[3:])
            return np.asarray(step @ estimate.cam_from_map)

        def projected(pose: FloatArray) -> FloatArray:
            return self.lens.project(transform_points(pose, self.patches.scene_map.points))

        x_in_cam = transform_points(estimate.cam_from_map, self.patches.scene_map.points)
        px = projected(estimate.cam_from_map)
        with np.errstate(invalid="ignore"):
            seen = ((px > 0.0) & (px < (self.lens.width_px, self.lens.height_px))).all(axis=1)
        seen &= self.patches.usable & (x_in_cam[:, 2] > 0.0)
        moved_px = np.linalg.norm(projected(displaced(_RESTART_STEP)) - px, axis=1)[seen]
        moved_px = moved_px[np.isfinite(moved_px)]
        if len(moved_px) == 0 or np.median(moved_px) == 0.0:
            return _MAX_START_DEPENDENCE
        size = _RESTART_STEP * _RESTART_PX * search_frame.pyramid.step_px[0] / float(np.median(moved_px))
        starts = [displaced(size), displaced(-size)]
        found = [self.relocalise(search_frame, start, neighbour) for start in starts]
        if found[0] is None or found[1] is None:
            return _MAX_START_DEPENDENCE
        before, after = (
            np.linalg.norm(np.subtract(*invert(np.array(poses))[:, :3, 3]))
            for poses in (starts, [found[0].cam_from_map, found[1].cam_from_map])
        )
        return min(float(after / max(before, np.finfo(float).tiny)), _MAX_START_DEPENDENCE)

    def _view(self, search_frame: SearchFrame, pose: FloatArray, neighbour: NeighbourPose) -> PredictedView:
        """Return the expected view of a frame."""
        return PredictedView(
            lens=self.lens,
            frame=search_frame.index,
            pyramid=search_frame.pyramid,
            cam_from_map=pose,
            neighbour_pose=neighbour.pose,
            exposure_ratio=self.exposure_ratio,
            readout_ratio=neighbour.direction * self.readout_ratio,
            shutter=self.shutter,
            keyframe_row=search_frame.keyframe_row,
        )

    def _search(self, view: PredictedView, level: SearchLevel) -> PoseEstimate | None:
        """Search for the points that should be visible in a view, and estimate the pose from the matches."""
        rows = select_patches(self.patches, view)
        if len(rows) < _MIN_MATCHES:
            return None
        matches = match_patches(self.patches, view, rows, level)
        matches = matches.select(self.is_unmasked(matches.px))
        return self._solve(view, matches, level) if len(matches.point) >= _MIN_MATCHES else None

    def _solve(self, view: PredictedView, matches: PatchMatches, level: SearchLevel) -> PoseEstimate | None:
        """Estimate a pose from matches.

        The expected pose is refined. If few matches agree with the result, a RANSAC pose is refined too, and
        the pose with more inliers is returned.
        """
        scale = view.pyramid.step_px[0]
        criteria = replace(
            self.criteria,
            max_error_px=level.limit_px * scale,
            min_inliers=_MIN_MATCHES,
            max_sigma_depth=np.inf,
            min_noise_px=_MIN_NOISE_PX * scale,
        )
        points = self.patches.scene_map.points[matches.point]
        weight = _match_weights(
            matches.px / (_CELL_SIDE_PX * scale), self.patches.keyframe_count[matches.point]
        )
        observations = make_observations(
            self.lens, np.array([0, len(points)]), points, matches.mid_row_px, weight
        )
        best = self._refined(observations, view.cam_from_map, criteria)
        if best is None or best.inlier_weight_ratio < TRUSTED_WEIGHT_RATIO:
            sampled = ransac_pose(self.lens, points, matches.mid_row_px, criteria)
            other = None if sampled is None else self._refined(observations, sampled, criteria)
            if other is not None and (best is None or other.inliers > best.inliers):
                best = other
        return best

    def _refined(
        self, observations: Observations, start: FloatArray, criteria: AcceptanceCriteria
    ) -> PoseEstimate | None:
        """Return the refined pose; None if it is not acceptable."""
        pose = refine_poses(observations, start[None], criteria.max_error_px)
        accepted = accept_poses(observations, pose, criteria)[0]
        if accepted.covariance is None:
            return None
        return PoseEstimate(
            cam_from_map=pose[0],
            covariance=accepted.covariance,
            inliers=accepted.inliers,
            inlier_weight_ratio=accepted.inlier_weight_ratio,
            error_px=accepted.error_px,
            depth=float(np.median(observations.points @ pose[0, 2, :3] + pose[0, 2, 3])),
        )


def _match_weights(cell: FloatArray, keyframe_count: IntArray) -> FloatArray:
    """Return the weights (N,) of matches. Matches in a crowded cell have lower weights.

    Args:
        cell: (N,2) pixel of each match, in units of the cell's side.
        keyframe_count: (N,) number of keyframes that see each matched point.
    """
    _, group, count = np.unique(np.floor(cell).astype(int), axis=0, return_inverse=True, return_counts=True)
    crowding = np.maximum(1.0, count[np.ravel(group)] / _FULL_WEIGHT_PER_CELL)
    return np.asarray(point_weights(keyframe_count) / crowding)
