"""From where frames have poses into the stretches where they were lost, one frame after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.camera import Camera
from bodycap_batch.geometry import interpolate_pose, invert, make_transform, so3_exp
from bodycap_batch.registration.batch import Views, make_views, refine_poses
from bodycap_batch.registration.pose import PoseLimits, judge_poses, sample_pose
from bodycap_batch.registration.smoothing import CentreFilter, Place, Steadiness
from bodycap_batch.registration.templates import (
    Found,
    Gallery,
    Pyramid,
    Search,
    View,
    choose_rows,
    find_points,
)
from bodycap_batch.tracking import bearings, coarse_image, coarse_motion, detect_corners, fit_rotation, moved

_SEARCHES = (
    Search(level=2, side=15, radius=14, score=0.6, limit_px=12.0),
    Search(level=1, side=21, radius=8, score=0.7, limit_px=6.0),
    Search(level=0, side=31, radius=8, score=0.75, limit_px=4.0),
)
"""From far and coarse to near and fine. The last one at full size: errors of frames with known poses are a
quarter smaller than from half size."""
_POINT_VARIANCE = 6.0
"""As for tracks."""
_CELL_PX = 40.0
_PER_CELL = 2.0
"""Patches that overlap err together: so many count in a square of about a patch's side. Otherwise fifty
patches on one grating of a ceiling pass for a pose that is 60 cm off."""
_MIN_NOISE_PX = 1.0
"""Of patches found in blurred frames: fewer than twenty that happen to agree better tell nothing better."""
_MIN_FOUND = 8
_MIN_INLIERS, _MIN_EVIDENCE = 10, 0.45
_SEED_INLIERS, _SEED_EVIDENCE = 15, 0.5
_GATE = 16.0
"""Squared Mahalanobis distance from where the motion leads: 99.9 % of three axes."""
_SURE_INLIERS, _SURE_EVIDENCE = 25, 0.6
_MISSES = 3
"""Frames in a row that are not found, after which a stretch is left: by then the prediction is off by more
than is searched."""
_SEED_SPREAD = 40.0
_TRUSTED = 0.6
"""As for tracks: beyond it sampling finds nothing better."""
_WARM_UP = 6
_GUIDES, _GUIDE_SPACING_PX, _GRID = 48, 12.0, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
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

    @property
    def place(self) -> Place:
        """Where the camera was."""
        turn = self.cam_from_map[:3, :3]
        return Place(invert(self.cam_from_map)[:3, 3], turn.T @ self.covariance[3:, 3:] @ turn)

    def with_place(self, place: Place) -> tuple[FloatArray, FloatArray]:
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


def together(first: Place, second: Place) -> tuple[Place, float]:
    """The place that two independent ones make, and their squared Mahalanobis distance."""
    total = np.linalg.inv(first.covariance + second.covariance)
    off = second.centre - first.centre
    centre = first.centre + first.covariance @ total @ off
    return Place(centre, first.covariance @ total @ second.covariance), float(off @ total @ off)


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame as it is searched.

    Attributes:
        pyramid: Its picture.
        row: Its own among the map's keyframes, -1 where it is none.
    """

    pyramid: Pyramid
    row: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Finder:
    """Finds poses of a camera's frames near where they are expected.

    Attributes:
        lens: The camera's.
        gallery: The map and what its points look like.
        limits: What makes a pose acceptable.
        exposure: Share of the time between two frames that the shutter is open.
        sees_room: Which pixels (N,2) of the camera show the room, as its mask says.
    """

    lens: Camera
    gallery: Gallery
    limits: PoseLimits
    exposure: float
    sees_room: Callable[[FloatArray], BoolArray]

    def locate(self, seen: Seen, priors: list[FloatArray], before: FloatArray, place: Place) -> Fix | None:
        """The pose of a frame.

        Args:
            seen: The frame.
            priors: Poses cam_from_map (4,4) it may have, the likeliest first.
            before: (4,4) pose a frame earlier.
            place: Where its motion leads to.
        """
        best: Fix | None = None
        for prior in priors:
            fix = self._search(self._view(seen, prior, before), _SEARCHES[0])
            if fix is not None and (best is None or fix.inliers > best.inliers):
                best = fix
            if best is not None and best.inliers >= _SURE_INLIERS and best.evidence >= _SURE_EVIDENCE:
                break
        for search in _SEARCHES[1:]:
            if best is None:
                return None
            pose, _ = best.with_place(together(best.place, place)[0])
            best = self._search(self._view(seen, pose, before), search)
        return best

    def look_again(self, seen: Seen, pose: FloatArray, before: FloatArray) -> Fix | None:
        """The pose of a frame that is nearly known; `pose` and `before` as for `locate`."""
        return self._search(self._view(seen, pose, before), _SEARCHES[-1])

    def _view(self, seen: Seen, pose: FloatArray, before: FloatArray) -> View:
        return View(
            lens=self.lens,
            pyramid=seen.pyramid,
            cam_from_map=pose,
            before=before,
            exposure=self.exposure,
            row=seen.row,
        )

    def _search(self, view: View, search: Search) -> Fix | None:
        rows = choose_rows(self.gallery, view)
        if len(rows) < _MIN_FOUND:
            return None
        found = find_points(self.gallery, view, rows, search)
        found = found.chosen(self.sees_room(found.px))
        return self._solve(view, found, search) if len(found.point) >= _MIN_FOUND else None

    def _solve(self, view: View, found: Found, search: Search) -> Fix | None:
        scale = view.pyramid.step_px[0]
        limits = replace(
            self.limits,
            max_error_px=search.limit_px * scale,
            min_inliers=_MIN_FOUND,
            max_sigma_depth=np.inf,
            min_noise_px=_MIN_NOISE_PX * scale,
        )
        points = self.gallery.scene_map.points[found.point]
        weight = _weights(found.px / (_CELL_PX * scale), self.gallery.seen[found.point])
        views = make_views(self.lens, np.array([0, len(points)]), points, found.px, weight)
        best = self._refined(views, view.cam_from_map, limits)
        if best is None or best.evidence < _TRUSTED:
            sampled = sample_pose(self.lens, points, found.px, limits)
            other = None if sampled is None else self._refined(views, sampled, limits)
            if other is not None and (best is None or other.inliers > best.inliers):
                best = other
        return best

    def _refined(self, views: Views, start: FloatArray, limits: PoseLimits) -> Fix | None:
        pose = refine_poses(views, start[None], limits.max_error_px)
        judged = judge_poses(views, pose, limits)[0]
        if judged.covariance is None:
            return None
        return Fix(
            cam_from_map=pose[0],
            covariance=judged.covariance,
            inliers=judged.inliers,
            evidence=judged.evidence,
            error_px=judged.error_px,
            depth=float(np.median(views.points @ pose[0, 2, :3] + pose[0, 2, 3])),
        )


def _weights(cell: FloatArray, seen: IntArray) -> FloatArray:
    """(N,) how much points count that are seen in cells (N,2) of the image and by so many keyframes (N,)."""
    _, group, count = np.unique(np.floor(cell).astype(int), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(seen / (seen + _POINT_VARIANCE) / np.maximum(1.0, count[np.ravel(group)] / _PER_CELL))


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A lost stretch and what is around it.

    Attributes:
        start: Its first frame.
        stop: One past its last.
        times: (N,) of all the camera's frames, in frame intervals.
        pyramids: Pictures by frame, of the frames on either side too.
        known: Poses around it, by frame.
        seeds: Poses cam_from_map (4,4) within it that are not believed.
        rows: Their rows in the map, by frame.
        steadiness: How evenly the camera moves.
    """

    start: int
    stop: int
    times: FloatArray
    pyramids: Mapping[int, Pyramid]
    known: Mapping[int, Fix]
    seeds: Mapping[int, FloatArray]
    rows: Mapping[int, int]
    steadiness: Steadiness

    def seen(self, frame: int) -> Seen:
        """A frame of which the picture is held."""
        return Seen(self.pyramids[frame], self.rows.get(frame, -1))


@dataclass(slots=True)
class _Walk:
    """Where a walk has come to: the last frame, its pose and its turn from the one before."""

    frame: int
    pose: FloatArray
    turn: FloatArray
    path: CentreFilter


@dataclass(slots=True)
class March:
    """Walks through a stretch from all sides.

    Attributes:
        finder: Finds poses.
        stretch: The stretch.
        fixes: What was found, by direction and frame.
    """

    finder: Finder
    stretch: Stretch
    fixes: dict[tuple[int, int], Fix] = field(default_factory=dict)

    def run(self) -> dict[int, Fix]:
        """The best pose found for each frame, walking in from both ends and out from the seeds."""
        stretch = self.stretch
        for direction, end in ((1, stretch.start - 1), (-1, stretch.stop)):
            if end in stretch.known:
                self._walk(self._warmed_up(end, direction), direction)
        for frame, prior in sorted(stretch.seeds.items()):
            if (1, frame) in self.fixes or (-1, frame) in self.fixes or frame not in stretch.pyramids:
                continue
            spread = np.eye(3) * (_SEED_SPREAD * stretch.steadiness.jerk) ** 2
            expected = Place(invert(prior)[:3, 3], spread)
            fix = self.finder.locate(stretch.seen(frame), [prior], prior, expected)
            if fix is None or fix.inliers < _SEED_INLIERS or fix.evidence < _SEED_EVIDENCE:
                continue
            for direction in (1, -1):
                self.fixes[direction, frame] = fix
                path = CentreFilter(stretch.steadiness, fix.place)
                self._walk(_Walk(frame, fix.cam_from_map, np.eye(3), path), direction)
        best: dict[int, Fix] = {}
        for (_, frame), fix in sorted(self.fixes.items()):
            other = best.get(frame)
            if other is None or fix.inliers * fix.evidence > other.inliers * other.evidence:
                best[frame] = fix
        return best

    def again(self, fixes: Mapping[int, Fix], places: Mapping[int, Place]) -> dict[int, Fix]:
        """Look once more from smoothed places, and between two frames of which one was missed.

        Args:
            fixes: What `run` found.
            places: Smoothed places of these frames and those around them.
        """
        out = {}
        poses = {frame: fix.with_place(places[frame])[0] for frame, fix in fixes.items()}
        poses |= {frame: fix.cam_from_map for frame, fix in self.stretch.known.items()}
        for frame in range(self.stretch.start, self.stretch.stop):
            before, after = poses.get(frame - 1), poses.get(frame + 1)
            fix: Fix | None = None
            if frame not in self.stretch.pyramids:
                continue
            seen = self.stretch.seen(frame)
            if frame in fixes:
                other = after if before is None else before
                fix = self.finder.look_again(seen, poses[frame], poses[frame] if other is None else other)
                fix = max(fixes[frame], fix or fixes[frame], key=lambda each: each.inliers * each.evidence)
            elif before is not None and after is not None:
                halfway = invert(interpolate_pose(invert(before), invert(after), 0.5))
                turn = halfway[:3, :3]
                prior = make_transform(turn, -turn @ places[frame].centre)
                fix = self.finder.locate(seen, [prior], before, places[frame])
            if fix is not None and fix.inliers >= _MIN_INLIERS and fix.evidence >= _MIN_EVIDENCE:
                out[frame] = fix
        return out

    def _warmed_up(self, end: int, direction: int) -> _Walk:
        """A walk that has come through the frames with poses up to an end of the stretch."""
        known = self.stretch.known
        behind = [end - direction * number for number in range(_WARM_UP)]
        gap = next((number for number, frame in enumerate(behind) if frame not in known), _WARM_UP)
        frames = behind[:gap][::-1]
        path = CentreFilter(self.stretch.steadiness, known[frames[0]].place)
        for last, frame in pairwise(frames):
            path.predict(abs(self.stretch.times[frame] - self.stretch.times[last]))
            path.update(known[frame].place)
        turns = [known[frame].cam_from_map[:3, :3] for frame in frames[-2:]]
        turn = turns[1] @ turns[0].T if len(turns) == 2 else np.eye(3)
        return _Walk(end, known[end].cam_from_map, turn, path)

    def _walk(self, walk: _Walk, direction: int) -> None:
        stretch, misses = self.stretch, 0
        while misses <= _MISSES:
            frame = walk.frame + direction
            inside = stretch.start <= frame < stretch.stop and frame in stretch.pyramids
            if not inside or (direction, frame) in self.fixes:
                return
            place = walk.path.predict(abs(stretch.times[frame] - stretch.times[walk.frame]))
            priors = [make_transform(turn, -turn @ place.centre) for turn in self._turns(walk, frame)]
            fix = self.finder.locate(stretch.seen(frame), priors, walk.pose, place)
            walk.frame = frame
            good = fix is not None and fix.inliers >= _MIN_INLIERS and fix.evidence >= _MIN_EVIDENCE
            both, distance = (place, np.inf) if fix is None else together(fix.place, place)
            if fix is None or not good or distance >= _GATE:
                misses += 1
                walk.pose = priors[0]
                continue
            self.fixes[direction, frame] = fix
            walk.path.update(fix.place)
            pose, _ = fix.with_place(both)
            walk.turn, walk.pose, misses = pose[:3, :3] @ walk.pose[:3, :3].T, pose, 0

    def _turns(self, walk: _Walk, frame: int) -> list[FloatArray]:
        """Rotations (3,3) the next frame may have: as the image turned, and as the camera turned before."""
        here, lens = walk.pose[:3, :3], self.finder.lens
        last, this = self.stretch.pyramids.get(walk.frame), self.stretch.pyramids[frame]
        steady = [walk.turn @ here]
        if last is None:
            return steady
        first, second = coarse_image(last.levels[0]), coarse_image(this.levels[0])
        width = lens.width_px
        corners = detect_corners(first, _GUIDES, _GUIDE_SPACING_PX)
        motion = coarse_motion(first, second, corners * np.float32(width / first.shape[1]), width)
        if motion is None:
            return steady
        shares = np.linspace(0.2, 0.8, _GRID)
        grid = np.stack(np.meshgrid(shares * width, shares * lens.height_px), axis=-1).reshape(-1, 2)
        arrived = moved(grid.astype(np.float32), motion.homography).astype(np.float64)
        inside = ((arrived > 0.0) & (arrived < (width, lens.height_px))).all(axis=1)
        if inside.sum() < _GRID:
            return steady
        before, after = (bearings(lens.unproject(each[inside])) for each in (grid, arrived))
        return [fit_rotation(before, after) @ here, *steady]
