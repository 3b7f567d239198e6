"""Map points found in a frame by the look they have in keyframes, where a pose says to look for them."""

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
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.tracking.klt import grid_sample

_MAX_POINTS = 300
_GRID_CELLS = 8
_MARGIN_PX = 4.0
_MIN_COSINE = 0.6
"""Of the angle between the two lines of sight: a patch is taken to face the camera."""
_MAX_LOG_SCALE = 0.8
_SCALE_PENALTY, _SHARPNESS_REWARD = 0.3, 0.1
"""What a keyframe's distance (log of the ratio) and sharpness count beside its line of sight's cosine."""
_MAX_BLUR_PX = 40.0
_MAX_BLUR_SAMPLES = 5
_BLUR_STEP_PX = 3.0
"""Pixels of the level from sample to sample; a longer blur is sampled less densely."""
_WARP_STEP_PX = 4.0
_MIN_DEPTH_RATIO = 0.25
"""Of the median depth: what seems to hang before the lens was triangulated wrongly and would tie the pose."""
_MIN_CONTRAST = 3.0
_LEVELS = 3

Patches = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Pyramid:
    """A frame reduced to at most 640 pixels' long side, to half and to a quarter of that.

    Attributes:
        levels: The images.
        step_px: (3,) how many of the frame's own pixels one of theirs is.
    """

    levels: tuple[GreyImage, ...]
    step_px: tuple[float, ...]

    @staticmethod
    def of(grey: GreyImage) -> Pyramid:
        """Reduce a frame (H,W)."""
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
    """What a map's points look like.

    Attributes:
        scene_map: The map.
        pictures: Keyframes by their row in the map.
        sharpness: (K,) of the keyframes, in medians of their camera.
        usable: (P,) points that may be looked for.
        seen: (P,) by how many keyframes each point is seen.
    """

    scene_map: Map
    pictures: Mapping[int, Pyramid]
    sharpness: FloatArray
    usable: BoolArray
    seen: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedView:
    """Where a frame is thought to be.

    Attributes:
        lens: Its camera.
        pyramid: Its picture.
        cam_from_map: (4,4) its pose.
        before: (4,4) the same a frame earlier; a frame later where `readout` is negative.
        exposure: Share of the time between two frames that the shutter is open.
        readout: Share of it from the first row's exposure to the last's that the map was refined for.
        row: Of the frame itself among the map's keyframes, -1 where it is none: its own look is found in it
            wherever the map puts it.
    """

    lens: Camera
    pyramid: Pyramid
    cam_from_map: FloatArray
    before: FloatArray
    exposure: float
    readout: float = 0.0
    row: int = -1


@dataclass(frozen=True, slots=True)
class SearchLevel:
    """How points are looked for.

    Attributes:
        level: Of the pyramid.
        side: Of a patch, in the level's pixels; odd.
        radius: How far around its expected place a patch is looked for, in the level's pixels.
        score: Least correlation.
        limit_px: Inlier limit of the pose that is solved from what is found, at 640 pixels' width.
    """

    level: int
    side: int
    radius: int
    score: float
    limit_px: float


@dataclass(frozen=True, slots=True)
class PatchMatches:
    """Points found.

    Attributes:
        point: (N,) which.
        px: (N,2) where.
        mid_row_px: (N,2) where they were at the instant of the middle row, to which the map's poses belong.
        score: (N,) normalised correlation.
    """

    point: IntArray
    px: FloatArray
    mid_row_px: FloatArray
    score: FloatArray

    def chosen(self, which: BoolArray) -> PatchMatches:
        """Some of them."""
        return PatchMatches(self.point[which], self.px[which], self.mid_row_px[which], self.score[which])


def select_patches(gallery: KeyframePatches, view: PredictedView) -> IntArray:
    """Rows of the map's observations to take points' looks from: one for each of some well spread points."""
    scene, lens = gallery.scene_map, view.lens
    x_in_cam = transform_points(view.cam_from_map, scene.points)
    px = lens.project(x_in_cam)
    size = np.array([lens.width_px, lens.height_px])
    with np.errstate(invalid="ignore"):
        inside = ((px > _MARGIN_PX) & (px < size - _MARGIN_PX)).all(axis=1) & gallery.usable
    inside &= x_in_cam[:, 2] > _MIN_DEPTH_RATIO * np.median(x_in_cam[inside, 2]) if inside.any() else False
    held = np.zeros(len(scene.keyframe_camera), dtype=bool)
    held[[row for row in gallery.pictures if row != view.row]] = True
    rows = np.flatnonzero(inside[scene.obs_point] & held[scene.obs_keyframe])
    point, keyframe = scene.obs_point[rows], scene.obs_keyframe[rows]
    here = scene.points[point] - invert(view.cam_from_map)[:3, 3]
    there = scene.points[point] - scene.map_from_cam[keyframe, :3, 3]
    near, far = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=1)
    cosine = np.einsum("ni,ni->n", here, there) / np.maximum(near * far, 1e-12)
    log_scale = np.abs(np.log(np.maximum(far, 1e-12) / np.maximum(near, 1e-12)))
    alike = (cosine > _MIN_COSINE) & (log_scale < _MAX_LOG_SCALE)
    worth = (
        cosine - _SCALE_PENALTY * log_scale + _SHARPNESS_REWARD * np.minimum(gallery.sharpness[keyframe], 2.0)
    )
    rows, point, worth = rows[alike], point[alike], worth[alike]
    order = np.lexsort((-worth, point))
    best = order[np.unique(point[order], return_index=True)[1]]
    rows, point = rows[best], point[best]
    cell = np.clip((px[point] / size * _GRID_CELLS).astype(int), 0, _GRID_CELLS - 1)
    picked = grid_sample(cell[:, 1] * _GRID_CELLS + cell[:, 0], gallery.seen[point], _MAX_POINTS)
    return np.asarray(np.sort(rows[picked]))


def match_patches(
    gallery: KeyframePatches, view: PredictedView, rows: IntArray, search: SearchLevel
) -> PatchMatches:
    """Look for points around where a pose projects them, by normalised correlation.

    A point's look is taken from a keyframe, warped to how this camera sees it (its surroundings are taken to
    face the camera, at the point's depth) and blurred along the way that it crosses the image while the
    shutter is open.

    Args:
        gallery: The map and its keyframes' pictures.
        view: The frame and its expected pose.
        rows: Observations of the map to take looks from, as `select_patches` gives them.
        search: Where and how.

    Returns:
        The points found, to a fraction of a pixel.

    Source: Klein, Murray, "Improving the agility of keyframe-based SLAM", ECCV 2008, for looking in blurred
        frames for what blurs alike; the warp is Klein, Murray, "Parallel tracking and mapping", ISMAR 2007.
    """
    scene, lens = gallery.scene_map, view.lens
    points = scene.points[scene.obs_point[rows]]
    px = lens.project(transform_points(view.cam_from_map, points))
    shown = np.isfinite(px).all(axis=1)
    rows, points, px = rows[shown], points[shown], px[shown]
    if len(rows) == 0:
        return PatchMatches(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    warp = _patch_warps(scene, lens, view.cam_from_map, rows, px)
    step = view.pyramid.step_px[search.level]
    crossing = _image_motion(view, points, px)
    patches, whole = _render_patches(gallery, rows, warp, _motion_blur(view, crossing), search, step)
    # Within the readout a point crosses a small part of the image: its row hardly depends on it.
    seen_px = px_at_mid_row(lens, px, crossing, -view.readout)
    found_px, score = np.full((len(rows), 2), np.nan), np.zeros(len(rows))
    target = view.pyramid.levels[search.level].astype(np.float32)
    for number in np.flatnonzero(whole).tolist():
        place = _best_match(target, patches[number], seen_px[number] / step - 0.5, search.radius)
        if place is not None:
            found_px[number] = (np.array(place[:2]) + 0.5) * step
            score[number] = place[2]
    good = (score > search.score) & np.isfinite(found_px).all(axis=1)
    mid_row_px = px_at_mid_row(lens, found_px, crossing, view.readout)
    return PatchMatches(scene.obs_point[rows[good]], found_px[good], mid_row_px[good], score[good])


def _patch_warps(
    scene: Map, lens: Camera, cam_from_map: FloatArray, rows: IntArray, px: FloatArray
) -> FloatArray:
    """(N,2,2) the keyframes' pixels by this camera's, around points seen at `px` (N,2)."""
    keyframe = scene.obs_keyframe[rows]
    depth = transform_points(cam_from_map, scene.points[scene.obs_point[rows]])[:, 2]
    back, ahead = invert(cam_from_map), invert(scene.map_from_cam[keyframe])
    names = np.array(scene.keyframe_camera)[keyframe]
    places = []
    for offset in ((0.0, 0.0), (_WARP_STEP_PX, 0.0), (0.0, _WARP_STEP_PX)):
        rays = np.column_stack([lens.unproject(px + offset), np.ones(len(px))]) * depth[:, None]
        seen = transform_points(ahead, transform_points(back, rays))
        place = np.full((len(px), 2), np.nan)
        for name in np.unique(names).tolist():
            mine = names == name
            place[mine] = scene.cameras[name].project(seen[mine])
        places.append(place)
    return np.stack([places[1] - places[0], places[2] - places[0]], axis=2) / _WARP_STEP_PX


def _image_motion(view: PredictedView, points: FloatArray, px: FloatArray) -> FloatArray:
    """(N,2) how far points seen at `px` (N,2) moved since the frame before."""
    return np.asarray(np.nan_to_num(px - view.lens.project(transform_points(view.before, points))))


def _motion_blur(view: PredictedView, crossing_px: FloatArray) -> FloatArray:
    """(N,2) how far points cross the image while the shutter is open; held to what is sane."""
    moved = crossing_px * view.exposure
    longest = _MAX_BLUR_PX * max(1.0, view.pyramid.step_px[0])
    return np.asarray(
        moved * np.minimum(1.0, longest / np.maximum(np.linalg.norm(moved, axis=1), 1e-9))[:, None]
    )


def _render_patches(
    gallery: KeyframePatches,
    rows: IntArray,
    warp: FloatArray,
    blur_px: FloatArray,
    search: SearchLevel,
    step_px: float,
) -> tuple[Patches, BoolArray]:
    """Looks (N,side,side) of points, warped and blurred, and which (N,) lie within their keyframes.

    `step_px` is what one of the patches' pixels spans in the frame they are looked for in.
    """
    import cv2

    scene, side = gallery.scene_map, search.side
    keyframe = scene.obs_keyframe[rows]
    held, which = np.unique(keyframe, return_inverse=True)
    sources = [gallery.pictures[row] for row in held.tolist()]
    step = np.array([source.step_px[search.level] for source in sources])[which]
    limit = np.array([source.levels[search.level].shape[::-1] for source in sources])[which] - 1.0
    along = np.arange(side) - side // 2
    grid = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2).astype(np.float32)
    offset = np.matmul(grid, (warp * step_px / step[:, None, None]).astype(np.float32).swapaxes(1, 2))
    shift = np.einsum("nij,nj->ni", warp, blur_px) / step[:, None]
    longest = float(np.linalg.norm(shift, axis=1).max(initial=0.0)) if np.isfinite(shift).all() else np.inf
    samples = int(np.clip(np.ceil(longest / _BLUR_STEP_PX) + 1, 1, _MAX_BLUR_SAMPLES))
    share = np.linspace(-0.5, 0.5, samples) if samples > 1 else np.zeros(1)
    centre = scene.obs_px[rows] / step[:, None] - 0.5
    centres = centre[:, None, :] + share[None, :, None] * shift[:, None, :]
    reach = np.abs(offset).max(axis=1)
    low, high = centres.min(axis=1) - reach, centres.max(axis=1) + reach
    whole = ((low >= 0.0) & (high <= limit)).all(axis=1)
    patches = np.zeros((len(rows), side, side), np.float32)
    for number, source in enumerate(sources):
        mine = np.flatnonzero((which == number) & whole)
        if len(mine) == 0:
            continue
        at = centres[mine].astype(np.float32)[:, :, None, :] + offset[mine][:, None, :, :]
        at = at.reshape(-1, side, 2)
        drawn = cv2.remap(
            source.levels[search.level],
            np.ascontiguousarray(at[..., 0]),
            np.ascontiguousarray(at[..., 1]),
            cv2.INTER_LINEAR,
        )
        patches[mine] = drawn.reshape(len(mine), samples, side, side).mean(axis=1, dtype=np.float32)
    return patches, whole & (patches.std(axis=(1, 2)) >= _MIN_CONTRAST)


def _best_match(
    target: Patches, patch: Patches, expected: FloatArray, radius: int
) -> tuple[float, float, float] | None:
    """Column, row and correlation of a patch's best place near an expected one; None at the border."""
    import cv2

    half = patch.shape[0] // 2
    column, row = (round(float(each)) for each in expected)
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


def _subpixel_peak(before: float, at: float, after: float) -> float:
    """Where a parabola through three values peaks, from the middle one."""
    bend = float(before) - 2.0 * float(at) + float(after)
    return 0.5 * (float(before) - float(after)) / bend if bend < 0.0 else 0.0
