"""Find map points in a frame near an expected pose, by image patches around the points in keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.optical_flow import GreyImage, pixel_scale
from bodycap_batch.model.rolling_shutter import px_at_mid_row
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.tracking.klt import grid_sample

_MAX_POINTS = 300
"""Maximum number of points searched in a frame. Evidence: none."""
_GRID_CELLS = 8
"""Number of grid cells along each side of the image. The searched points are spread over these cells.
Evidence: none."""
_MARGIN_PX = 4.0
"""Pixels: minimum distance of a searched point from the border of the image. Evidence: none."""
_MIN_COSINE = 0.6
"""Minimum cosine of the angle between two lines of sight to a point: from the frame and from the keyframe.
The warp of a patch is only valid for similar directions. Evidence: none."""
_MAX_LOG_SCALE = 0.8
"""Maximum absolute logarithm of the distance ratio. This ratio is the distance between point and keyframe,
divided by the distance between point and frame. Evidence: none."""
_SCALE_PENALTY, _SHARPNESS_REWARD = 0.3, 0.1
"""Weights in the score of a keyframe. _SCALE_PENALTY: weight of the absolute logarithm of the distance ratio,
which lowers the score. _SHARPNESS_REWARD: weight of the keyframe's sharpness, which raises the score. The
cosine of the angle between the two lines of sight has weight 1. Evidence: none."""
_MAX_BLUR_PX = 40.0
"""Pixels at 640 px image width: maximum length of rendered motion blur. Evidence: none."""
_MAX_BLUR_SAMPLES = 5
"""Maximum number of samples along the motion blur. It bounds the computing time."""
_BLUR_STEP_PX = 3.0
"""Pixels of the pyramid level: maximum distance between two samples along the motion blur. If the number of
samples is limited, the distance is larger. Evidence: none."""
_WARP_STEP_PX = 4.0
"""Pixels: step of the finite differences that determine the warp of a patch. Evidence: none."""
_MIN_DEPTH_RATIO = 0.25
"""Minimum depth of a point, as a fraction of the median depth. The position of a nearer point is usually
wrong, and would have a large influence on the pose. Evidence: none."""
_MIN_CONTRAST = 3.0
"""Minimum contrast of a patch: the standard deviation of its grey values. Evidence: none."""
_LEVELS = 3
"""Number of levels of an image pyramid."""

Patches = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Pyramid:
    """A frame at three sizes. The longer side of the first image has at most 640 pixels.

    Each further image has half the size of the image before.

    Attributes:
        levels: The three images, the largest first.
        step_px: (3,) number of pixels of the frame per pixel of each image.
    """

    levels: tuple[GreyImage, ...]
    step_px: tuple[float, ...]

    @staticmethod
    def build(grey: GreyImage) -> Pyramid:
        """Return the image pyramid of a frame (H,W)."""
        import cv2

        height, width = grey.shape
        step = max(1.0, pixel_scale(width, height))
        images, steps = [], []
        for _ in range(_LEVELS):
            size = (round(width / step), round(height / step))
            image = grey if step == 1.0 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
            images.append(np.asarray(image, dtype=np.uint8))
            steps.append(step)
            step *= 2.0
        return Pyramid(tuple(images), tuple(steps))


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframePatches:
    """The map and the images of its keyframes, from which patches around map points are taken.

    Attributes:
        scene_map: The map.
        pyramids: Image pyramids of keyframes, by row index in the map.
        sharpness: (K,) sharpness of the keyframes, relative to the median sharpness of their camera.
        usable: (P,) True for points that may be searched.
        keyframe_count: (P,) number of keyframes that see each point.
    """

    scene_map: Map
    pyramids: Mapping[int, Pyramid]
    sharpness: FloatArray
    usable: BoolArray
    keyframe_count: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedView:
    """The expected view of a frame, in which map points are searched.

    Attributes:
        lens: The camera model.
        frame: Frame index.
        pyramid: Image pyramid of the frame.
        cam_from_map: (4,4) expected pose of the frame.
        neighbour_pose: (4,4) pose cam_from_map of the frame before, or of the frame after.
        exposure_ratio: Exposure time as a fraction of the frame interval.
        readout_ratio: Readout time as a fraction of the frame interval; 0 if the map was not adjusted for a
            rolling shutter. It is negative if `neighbour_pose` is the pose of the frame after.
        shutter: The rolling shutter with the rotation of the camera from matches between adjacent frames.
            None: it is unknown, and the image motion is used.
        keyframe_row: Row index of this frame among the map's keyframes, or -1. Patches of this keyframe are
            not used, because they would match even if its pose in the map is wrong.
    """

    lens: Camera
    frame: int
    pyramid: Pyramid
    cam_from_map: FloatArray
    neighbour_pose: FloatArray
    exposure_ratio: float
    readout_ratio: float = 0.0
    shutter: TurningShutter | None = None
    keyframe_row: int = -1

    def px_in_picture(self, points: FloatArray, px: FloatArray) -> FloatArray:
        """Return where points (N,3) are seen in the picture, from their pixels (N,2) at the frame time.

        The shift of a point depends on the row in which it is exposed. Without a rotation from matches, the
        row at the instant of the middle row is used instead: a point moves little during the readout.
        """
        if not self._turns:
            return px_at_mid_row(self.lens, px, image_motion(self, points, px), -self.readout_ratio)
        assert self.shutter is not None
        shifted = px_at_mid_row(self.lens, px, self._shift_motion(points, px), -self.readout_ratio)
        return self.shutter.px_in_picture(np.full(len(px), self.frame), shifted)

    def px_at_mid_row(self, points: FloatArray, expected_px: FloatArray, px: FloatArray) -> FloatArray:
        """Return where observed pixels (N,2) would be at the instant of the middle row.

        Args:
            points: (N,3) observed points in the map.
            expected_px: (N,2) their expected pixels at the instant of the middle row.
            px: (N,2) observed pixels; NaN for points that were not found.
        """
        if not self._turns:
            motion = image_motion(self, points, expected_px)
            return px_at_mid_row(self.lens, px, motion, self.readout_ratio)
        assert self.shutter is not None
        out = px - px_at_mid_row(self.lens, px, self._shift_motion(points, expected_px), self.readout_ratio)
        seen = np.isfinite(px).all(axis=1)
        turned = px.copy()
        turned[seen] = self.shutter.px_at_mid_row(np.full(int(seen.sum()), self.frame), px[seen])
        return np.asarray(turned - out)

    @property
    def _turns(self) -> bool:
        """True if the rotation of the camera in this frame is known from matches."""
        return self.shutter is not None and self.shutter.path.is_known(self.frame)

    def _shift_motion(self, points: FloatArray, px: FloatArray) -> FloatArray:
        """Return the motion (N,2) of points since the neighbouring frame, without the rotation."""
        shift = invert(self.neighbour_pose)[:3, 3]
        rotation = self.cam_from_map[:3, :3]
        before = (points - shift) @ rotation.T
        return np.asarray(np.nan_to_num(px - self.lens.project(before)))


@dataclass(frozen=True, slots=True)
class SearchLevel:
    """Parameters of one search: patch size, search range and limits.

    Attributes:
        pyramid_level: Index of the pyramid level.
        patch_side: Side of a patch in pixels of the level; odd.
        search_radius: Maximum distance from the expected pixel, in pixels of the level.
        min_score: Minimum normalised correlation.
        limit_px: Inlier limit of the pose from the matches, in pixels at 640 px image width.
    """

    pyramid_level: int
    patch_side: int
    search_radius: int
    min_score: float
    limit_px: float


@dataclass(frozen=True, slots=True)
class PatchMatches:
    """Map points found in a frame.

    Attributes:
        point: (N,) index of the map point.
        px: (N,2) pixel at which the point was found.
        mid_row_px: (N,2) this pixel moved to the instant of the middle row. The poses of the map refer to
            this instant.
        score: (N,) normalised correlation.
    """

    point: IntArray
    px: FloatArray
    mid_row_px: FloatArray
    score: FloatArray

    def select(self, selected: BoolArray) -> PatchMatches:
        """Return the matches that a mask selects."""
        return PatchMatches(
            self.point[selected], self.px[selected], self.mid_row_px[selected], self.score[selected]
        )


def select_patches(patches: KeyframePatches, view: PredictedView) -> IntArray:
    """Select map points to search in a frame, and the keyframe that provides the patch of each point.

    The points are spread over the image. The selected keyframe sees its point from a similar direction and
    distance.

    Returns:
        Row indices of the map's observations that provide the patches, increasing.
    """
    scene, lens = patches.scene_map, view.lens
    x_in_cam = transform_points(view.cam_from_map, scene.points)
    px = lens.project(x_in_cam)
    size = np.array([lens.width_px, lens.height_px])
    with np.errstate(invalid="ignore"):
        inside = ((px > _MARGIN_PX) & (px < size - _MARGIN_PX)).all(axis=1) & patches.usable
    inside &= x_in_cam[:, 2] > _MIN_DEPTH_RATIO * np.median(x_in_cam[inside, 2]) if inside.any() else False
    is_held = np.zeros(len(scene.keyframe_camera), dtype=bool)
    is_held[[row for row in patches.pyramids if row != view.keyframe_row]] = True
    rows = np.flatnonzero(inside[scene.obs_point] & is_held[scene.obs_keyframe])
    point, keyframe = scene.obs_point[rows], scene.obs_keyframe[rows]
    x_from_camera = scene.points[point] - invert(view.cam_from_map)[:3, 3]
    x_from_keyframe = scene.points[point] - scene.map_from_cam[keyframe, :3, 3]
    camera_distance, keyframe_distance = (
        np.linalg.norm(x_from_camera, axis=1),
        np.linalg.norm(x_from_keyframe, axis=1),
    )
    cosine = np.einsum("ni,ni->n", x_from_camera, x_from_keyframe) / np.maximum(
        camera_distance * keyframe_distance, 1e-12
    )
    log_scale = np.abs(np.log(np.maximum(keyframe_distance, 1e-12) / np.maximum(camera_distance, 1e-12)))
    is_similar = (cosine > _MIN_COSINE) & (log_scale < _MAX_LOG_SCALE)
    score = (
        cosine - _SCALE_PENALTY * log_scale + _SHARPNESS_REWARD * np.minimum(patches.sharpness[keyframe], 2.0)
    )
    rows, point, score = rows[is_similar], point[is_similar], score[is_similar]
    order = np.lexsort((-score, point))
    best = order[np.unique(point[order], return_index=True)[1]]
    rows, point = rows[best], point[best]
    cell = np.clip((px[point] / size * _GRID_CELLS).astype(int), 0, _GRID_CELLS - 1)
    chosen = grid_sample(cell[:, 1] * _GRID_CELLS + cell[:, 0], patches.keyframe_count[point], _MAX_POINTS)
    return np.asarray(np.sort(rows[chosen]))


def match_patches(
    patches: KeyframePatches, view: PredictedView, rows: IntArray, level: SearchLevel
) -> PatchMatches:
    """Search points around their expected pixels by normalised correlation.

    A patch of a keyframe is warped to the expected view. Its surface is assumed to be at the depth of the
    point and to face the camera. The patch is blurred along the path of the point in the image during the
    exposure.

    Args:
        patches: The map and the images of its keyframes.
        view: The expected view of the frame.
        rows: Row indices of the map's observations that provide the patches, from `select_patches`.
        level: Size and range of the search.

    Returns:
        The points found, with subpixel precision.

    Source: the search in blurred frames is from Klein, Murray, "Improving the agility of keyframe-based
        SLAM", ECCV 2008. The warp is from Klein, Murray, "Parallel tracking and mapping", ISMAR 2007.
    """
    scene, lens = patches.scene_map, view.lens
    points = scene.points[scene.obs_point[rows]]
    px = lens.project(transform_points(view.cam_from_map, points))
    is_projected = np.isfinite(px).all(axis=1)
    rows, points, px = rows[is_projected], points[is_projected], px[is_projected]
    if len(rows) == 0:
        return PatchMatches(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    warp = _patch_warps(scene, lens, view.cam_from_map, rows, px)
    step = view.pyramid.step_px[level.pyramid_level]
    motion = image_motion(view, points, px)
    images, is_inside = _render_patches(patches, rows, warp, _motion_blur(view, motion), level, step)
    expected_px = view.px_in_picture(points, px)
    found_px, score = np.full((len(rows), 2), np.nan), np.zeros(len(rows))
    target = view.pyramid.levels[level.pyramid_level].astype(np.float32)
    searched = np.flatnonzero(is_inside)
    centres = np.round(expected_px[searched] / step - 0.5).astype(np.int64).tolist()
    for number, (column, row) in zip(searched.tolist(), centres, strict=True):
        match = _best_match(target, images[number], column, row, level.search_radius)
        if match is not None:
            found_px[number], score[number] = match[:2], match[2]
    found_px = (found_px + 0.5) * step
    accepted = (score > level.min_score) & np.isfinite(found_px).all(axis=1)
    mid_row_px = view.px_at_mid_row(points, px, found_px)
    return PatchMatches(
        scene.obs_point[rows[accepted]], found_px[accepted], mid_row_px[accepted], score[accepted]
    )


def _patch_warps(
    scene: Map, lens: Camera, cam_from_map: FloatArray, rows: IntArray, px: FloatArray
) -> FloatArray:
    """Return the derivatives (N,2,2) of the keyframe's pixel with respect to the frame's pixel.

    Args:
        scene: The map.
        lens: The camera model of the frame.
        cam_from_map: (4,4) pose of the frame.
        rows: (N,) row indices of the map's observations that provide the patches.
        px: (N,2) pixels of the points in the frame.
    """
    keyframe = scene.obs_keyframe[rows]
    depth = transform_points(cam_from_map, scene.points[scene.obs_point[rows]])[:, 2]
    map_from_cam, keyframe_from_map = invert(cam_from_map), invert(scene.map_from_cam[keyframe])
    names = np.array(scene.keyframe_camera)[keyframe]
    projections = []
    for offset in ((0.0, 0.0), (_WARP_STEP_PX, 0.0), (0.0, _WARP_STEP_PX)):
        rays = np.column_stack([lens.unproject(px + offset), np.ones(len(px))]) * depth[:, None]
        x_in_keyframe = transform_points(keyframe_from_map, transform_points(map_from_cam, rays))
        keyframe_px = np.full((len(px), 2), np.nan)
        for name in np.unique(names).tolist():
            is_own = names == name
            keyframe_px[is_own] = scene.cameras[name].project(x_in_keyframe[is_own])
        projections.append(keyframe_px)
    return (
        np.stack([projections[1] - projections[0], projections[2] - projections[0]], axis=2) / _WARP_STEP_PX
    )


def image_motion(view: PredictedView, points: FloatArray, px: FloatArray) -> FloatArray:
    """Return the motion (N,2) of points in the image since the neighbouring frame, in pixels.

    Args:
        view: The expected view of the frame.
        points: (N,3) points in the map.
        px: (N,2) expected pixels of the points in the frame.
    """
    return np.asarray(np.nan_to_num(px - view.lens.project(transform_points(view.neighbour_pose, points))))


def _motion_blur(view: PredictedView, motion_px: FloatArray) -> FloatArray:
    """Return the motion (N,2) of points during the exposure in pixels, limited to `_MAX_BLUR_PX`."""
    blur = motion_px * view.exposure_ratio
    longest = _MAX_BLUR_PX * max(1.0, view.pyramid.step_px[0])
    return np.asarray(
        blur * np.minimum(1.0, longest / np.maximum(np.linalg.norm(blur, axis=1), 1e-9))[:, None]
    )


def _render_patches(
    patches: KeyframePatches,
    rows: IntArray,
    warp: FloatArray,
    blur_px: FloatArray,
    level: SearchLevel,
    step_px: float,
) -> tuple[Patches, BoolArray]:
    """Render the patches of points, warped and blurred.

    Args:
        patches: The map and the images of its keyframes.
        rows: (N,) row indices of the map's observations that provide the patches.
        warp: (N,2,2) derivative of the keyframe's pixel with respect to the frame's pixel.
        blur_px: (N,2) motion in the frame during the exposure, in pixels of the frame.
        level: Size of the patches.
        step_px: Number of pixels of the frame per pixel of a patch.

    Returns:
        Patches (N,side,side), and a mask (N,) of the patches that lie inside their keyframes and have
        contrast.
    """
    import cv2

    scene, side = patches.scene_map, level.patch_side
    keyframe = scene.obs_keyframe[rows]
    keyframe_rows, source_index = np.unique(keyframe, return_inverse=True)
    sources = [patches.pyramids[row] for row in keyframe_rows.tolist()]
    step = np.array([source.step_px[level.pyramid_level] for source in sources])[source_index]
    limit = (
        np.array([source.levels[level.pyramid_level].shape[::-1] for source in sources])[source_index] - 1.0
    )
    axis = np.arange(side) - side // 2
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2).astype(np.float32)
    offset = np.matmul(grid, (warp * step_px / step[:, None, None]).astype(np.float32).swapaxes(1, 2))
    shift = np.einsum("nij,nj->ni", warp, blur_px) / step[:, None]
    longest = float(np.linalg.norm(shift, axis=1).max(initial=0.0)) if np.isfinite(shift).all() else np.inf
    samples = int(np.clip(np.ceil(longest / _BLUR_STEP_PX) + 1, 1, _MAX_BLUR_SAMPLES))
    fraction = np.linspace(-0.5, 0.5, samples) if samples > 1 else np.zeros(1)
    centre = scene.obs_px[rows] / step[:, None] - 0.5
    centres = centre[:, None, :] + fraction[None, :, None] * shift[:, None, :]
    corners = (0, side - 1, side * (side - 1), side * side - 1)
    extent = np.abs(offset[:, corners]).max(axis=1)  # A warp is linear, so its corners are farthest out.
    low, high = centres.min(axis=1) - extent, centres.max(axis=1) + extent
    is_inside = ((low >= 0.0) & (high <= limit)).all(axis=1)
    images = np.zeros((len(rows), side, side), np.float32)
    for number, source in enumerate(sources):
        own = np.flatnonzero((source_index == number) & is_inside)
        if len(own) == 0:
            continue
        sample, own_offset = centres[own].astype(np.float32), offset[own]
        # One array for each axis, as OpenCV needs them, and one row for each patch: OpenCV takes 32,766 rows.
        column, row = (
            (sample[:, :, None, axis] + own_offset[:, None, :, axis]).reshape(-1, side * side)
            for axis in (0, 1)
        )
        rendered = cv2.remap(source.levels[level.pyramid_level], column, row, cv2.INTER_LINEAR)
        images[own] = rendered.reshape(len(own), samples, side, side).mean(axis=1, dtype=np.float32)
    return images, is_inside & (images.std(axis=(1, 2)) >= _MIN_CONTRAST)


def _best_match(
    target: Patches, patch: Patches, column: int, row: int, radius: int
) -> tuple[float, float, float] | None:
    """Return column, row and correlation of the best match near an expected pixel.

    Returns None if the best match lies at the border of the searched area, or if this area is too small.

    Args:
        target: (H,W) image of the frame.
        patch: (side,side) patch to search.
        column: Expected column of the patch's centre.
        row: Expected row of the patch's centre.
        radius: Maximum distance from the expected pixel along each axis.
    """
    import cv2

    half = patch.shape[0] // 2
    height, width = target.shape
    left, top = max(column - half - radius, 0), max(row - half - radius, 0)
    right, bottom = min(column + half + radius + 1, width), min(row + half + radius + 1, height)
    if right - left < patch.shape[1] + 2 or bottom - top < patch.shape[0] + 2:
        return None
    scores = cv2.matchTemplate(target[top:bottom, left:right], patch, cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(scores)
    if not (0 < x < scores.shape[1] - 1 and 0 < y < scores.shape[0] - 1):
        return None
    across = _subpixel_peak(scores[y, x - 1], scores[y, x], scores[y, x + 1])
    down = _subpixel_peak(scores[y - 1, x], scores[y, x], scores[y + 1, x])
    return left + x + half + across, top + y + half + down, float(best)


def _subpixel_peak(before: float, middle: float, after: float) -> float:
    """Return the position of the peak of a parabola through three values, relative to the middle value."""
    curvature = float(before) - 2.0 * float(middle) + float(after)
    return 0.5 * (float(before) - float(after)) / curvature if curvature < 0.0 else 0.0
