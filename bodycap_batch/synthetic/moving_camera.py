"""Render the frames of a camera with exposure and rolling shutter from one sharp image of each frame.

The sharp image shows each row at the middle of its exposure, and is exact. The motion blur is the mean of
several copies of it. In each copy, every pixel takes the colour of the point that it shows at an instant of
the exposure. This point is found from the exact distance and from the poses of the camera and of the moving
part at this instant. Around a jump of the distance, a pixel can show the near or the far surface. There, the
near surface is tried first, and the surface that is found decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.synthetic.atlas import Atlas, Bytes, Float32
from bodycap_batch.synthetic.lens import RayGrid, ray_grid
from bodycap_batch.synthetic.moving_body import MovingBody, joint_poses_at, picture_poses_at
from bodycap_batch.synthetic.moving_scene import ROOM, Hits, MovingPart, MovingScene, rays_in_part
from bodycap_batch.synthetic.triangles import dot

_NODE_S = 0.0005
"""Interval (seconds) of the instants at which the motion is evaluated. Poses between them are interpolated
linearly. A rotation of 20 rad/s has an error of (0.01 rad)² / 8 then."""
_BLUR_STEP_PX = 1.5
"""Distance (px) that the image moves between two copies. The image is band-limited to about 1.4 px."""
_MAX_COPIES = 24
"""Maximum number of copies. The limit reduces the rendering time."""
_CELL = 4
"""Side (px) of the cells for which the image motion is computed away from jumps."""
_JUMP_PX = 0.5
"""Minimum difference of the image motion of neighbouring cells on different planes that counts as a jump."""
_MARGIN_SHARE = 0.06
"""Maximum width of the border around the sharp image, as a share of the longer side. It serves a blur of
twice this width."""
_USUAL_DISTANCE_M = 0.5
"""Assumed distance (metres) of near objects, which determines the width of the border with the shift of the
camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frame:
    """Poses during one frame, and the size of the border of its sharp image.

    Attributes:
        node_s: (T,) instants, seconds.
        part_from_cam: (T,P,4,4) poses of the camera in the frames of the parts at these instants.
        row_s: (B,) middle of the exposure of each row, border included, or a single one.
        margin: Width of the border, px.
    """

    node_s: FloatArray
    part_from_cam: FloatArray
    row_s: FloatArray
    margin: int

    def at(self, shift_s: float) -> FloatArray:
        """Return the poses (P,B,4,4) for all rows, at a time relative to the middle of their exposures."""
        place = np.interp(self.row_s + shift_s, self.node_s, np.arange(len(self.node_s)))
        low = np.minimum(place.astype(np.int64), len(self.node_s) - 2)
        ratio = (place - low)[:, None, None, None]
        between = self.part_from_cam[low] * (1 - ratio) + self.part_from_cam[low + 1] * ratio
        return np.ascontiguousarray(between.transpose(1, 0, 2, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Jumps:
    """Pixels around jumps of the image motion, and the motion of the nearest surface around each.

    Attributes:
        pixels: (Z,) indices of the pixels.
        xy: (Z,2) their positions.
        near: (2,Z,2) image motion of the nearest surface around each of them; see `_image_motion`.
    """

    pixels: IntArray
    xy: Float32
    near: Float32


class MovingCamera:
    """Renderer of the frames of a camera on a moving body in a room.

    Args:
        motion: The moving body.
        mount: True mount of the camera.
        camera: Intrinsics of the camera.
        parts: The room, and the limbs of the wearer that the camera can see.
        atlas: Atlas of all textures.
        exposure_s: Exposure time, seconds.
        rolling_shutter_s: Time (seconds) between the exposures of the first and the last row.
        stabilised: Whether the camera stabilises its pictures.
    """

    def __init__(  # noqa: PLR0913 - what a camera consists of
        self,
        *,
        motion: MovingBody,
        mount: Mount,
        camera: Camera,
        parts: Sequence[MovingPart],
        atlas: Atlas,
        exposure_s: float = 0.0,
        rolling_shutter_s: float = 0.0,
        stabilised: bool = False,
    ) -> None:
        self.motion, self.mount, self._camera, self._stabilised = motion, mount, camera, stabilised
        self._exposure_s, self._rolling_s = exposure_s, rolling_shutter_s
        self._is_instant = exposure_s == 0.0 and rolling_shutter_s == 0.0
        self.scene = MovingScene(parts, atlas, fine=self._is_instant)
        shape = self.scene.triangles
        self._normals = shape.normal.T.astype(np.float32)
        self._offsets = (shape.normal * shape.point).sum(axis=1).astype(np.float32)
        share = _MARGIN_SHARE if self._exposure_s else 0.0
        self._margin = round(share * max(camera.width_px, camera.height_px))
        self.grid = ray_grid(camera, self._margin)
        self._px_per_rad = 1.0 / float(np.linalg.norm(self.grid.per_px_x[self.grid.valid], axis=-1).min())

    def render(self, t_s: float) -> Bytes:
        """Return the image (H,W,3) without noise. The exposure is centred on a common time (seconds)."""
        if self._is_instant:
            poses = self._part_from_cam(np.array([t_s]))[1]
            return self.scene.sharp(self.grid, poses.transpose(1, 0, 2, 3), self._gain(t_s))[0]
        frame = self._frame(t_s)
        grid = _cropped(self.grid, self._margin - frame.margin)
        middle = frame.at(0.0)
        image, hits = self.scene.sharp(grid, middle, self._gain(t_s))
        if self._exposure_s == 0.0:
            return image
        ends = [frame.at(sign * 0.5 * self._exposure_s) for sign in (-1.0, 1.0)]
        moved, jumps = self._image_motion(grid, hits, middle, ends, frame.margin)
        blurred = _blur(image, moved, jumps)
        inside = slice(frame.margin, blurred.shape[0] - frame.margin)
        columns = slice(frame.margin, blurred.shape[1] - frame.margin)
        out = np.ascontiguousarray(blurred[inside, columns])
        out[~grid.valid[inside, columns]] = 0
        return out

    def _frame(self, t_s: float) -> _Frame:
        """Return the poses during a frame."""
        height = self._camera.height_px
        rows = (np.arange(-self._margin, height + self._margin) + 0.5) / height - 0.5
        row_s = t_s + rows * self._rolling_s if self._rolling_s else np.array([t_s])
        half = self._exposure_s / 2
        count = int(np.ceil((row_s[-1] - row_s[0] + 2 * half) / _NODE_S)) + 2
        node_s = np.linspace(row_s[0] - half, row_s[-1] + half, count)
        world_from_cam, part_from_cam = self._part_from_cam(node_s)
        margin = self._needed_margin(world_from_cam[np.abs(node_s - t_s) <= half + _NODE_S])
        unused = self._margin - margin
        return _Frame(
            node_s=node_s,
            part_from_cam=part_from_cam,
            row_s=row_s[unused : len(row_s) - unused] if self._rolling_s else row_s,
            margin=margin,
        )

    def _part_from_cam(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the poses (T,4,4) of the camera in the world, and (T,P,4,4) in the frames of the parts."""
        joints = joint_poses_at(self.motion, times_s)
        world_from_cam = picture_poses_at(self.motion, self.mount, times_s, stabilised=self._stabilised)
        poses = [
            world_from_cam if part.joint == ROOM else invert(joints[:, part.joint]) @ world_from_cam
            for part in self.scene.parts
        ]
        return world_from_cam, np.stack(poses, axis=1)

    def _needed_margin(self, world_from_cam: FloatArray) -> int:
        """Return the width (px) of the border that the motion (T,4,4) of the camera in an exposure needs."""
        if self._margin == 0:
            return 0
        start, end = world_from_cam[0], world_from_cam[-1]
        cosine = (np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2
        turn_rad = np.arccos(np.clip(cosine, -1, 1))
        shift_rad = np.linalg.norm(end[:3, 3] - start[:3, 3]) / _USUAL_DISTANCE_M
        needed_px = 0.5 * (turn_rad + shift_rad) * self._px_per_rad
        return min(self._margin, int(np.ceil(min(needed_px, 1e6))) + 2)

    def _gain(self, t_s: float) -> Float32:
        """Return the brightness factor (F,) of each triangle: moving parts are lit from above."""
        joints = joint_poses_at(self.motion, np.array([t_s]))[0]
        gains = []
        for part in self.scene.parts:
            up = part.triangles.normal @ joints[part.joint, 2, :3]
            gains.append(np.ones(len(up)) if part.joint == ROOM else 0.75 + 0.25 * up)
        return np.concatenate(gains).astype(np.float32)

    def _image_motion(
        self, grid: RayGrid, hits: Hits, middle: FloatArray, ends: list[FloatArray], margin: int
    ) -> tuple[Float32, _Jumps]:
        """Return the image motion (2,H,W,2), px, and the pixels around its jumps.

        The motion is the position in the sharp image of the point that a pixel shows at an instant, minus the
        position of the pixel. With the time x, which is -1 at the start of the exposure and 1 at its end, it
        is x times the first plus x² times the second returned part.
        """
        size = grid.valid.shape
        index = np.arange(hits.faces.size).reshape(size)
        coarse = index[_CELL // 2 :: _CELL, _CELL // 2 :: _CELL]

        def motion_of(pixels: IntArray) -> Float32:
            faces = hits.faces[pixels]
            rays = grid.planes[:3].reshape(3, -1)[:, pixels]
            start, end = (self._moved(pixels, faces, rays, middle, each, size, margin) for each in ends)
            return np.stack([0.5 * (end - start), 0.5 * (end + start)])

        cells = motion_of(coarse.ravel()).reshape(2, *coarse.shape, 2)
        far = float(np.abs(cells).sum(axis=0).max())
        plane = np.append(self.scene.triangles.plane, -1)[hits.faces[coarse]]
        jump = _find_jumps(cells, plane)
        whole = np.empty((2, *size, 2), np.float32)
        # Pixel (x, y) of the image is at ((x − s) / c, (y − s) / c) of the cells.
        scale, shift = 1.0 / _CELL, -(_CELL // 2) / _CELL
        matrix = np.array([[scale, 0, shift], [0, scale, shift]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for coefficient, out in zip(cells, whole, strict=True):
            cv2.warpAffine(coefficient, matrix, size[::-1], out, flags, cv2.BORDER_REPLICATE)
        exact = index[_spread_to_pixels(_dilated(jump, 1), size)]
        whole.reshape(2, -1, 2)[:, exact] = motion_of(exact)
        radius = int(np.ceil(far / _CELL)) + 1
        around = index[_spread_to_pixels(_dilated(jump, radius), size)]
        y, x = np.divmod(around, size[1])
        nearest = _nearest_cells(hits.distance[coarse], radius)
        cell = nearest[np.minimum(y // _CELL, len(coarse) - 1), np.minimum(x // _CELL, coarse.shape[1] - 1)]
        xy = np.stack([x, y], axis=1).astype(np.float32)
        return whole, _Jumps(pixels=around, xy=xy, near=cells.reshape(2, -1, 2)[:, cell])

    def _moved(  # noqa: PLR0913, PLR0917 - one value each
        self,
        pixels: IntArray,
        faces: IntArray,
        rays: Float32,
        middle: FloatArray,
        then: FloatArray,
        size: tuple[int, ...],
        margin: int,
    ) -> Float32:
        """Return the image motion (N,2) of pixels at another instant. They show triangles `faces` (N,)."""
        y, x = np.divmod(pixels, size[1])
        found, instants = np.maximum(faces, 0), then.shape[1]
        part = self.scene.part_of_face[found]
        row = y if instants > 1 else np.zeros_like(y)
        turned, start = rays_in_part(rays, then.reshape(-1, 4, 4), part * instants + row)
        normal = self._normals.take(found, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (self._offsets.take(found) - dot(normal, start)) / dot(normal, turned)
        point = start + far * turned
        to_cam = invert(middle).reshape(-1, 4, 4)
        for _ in range(2 if instants > 1 else 1):
            direction, origin = rays_in_part(point, to_cam, part * instants + row)
            at = self._camera.project((direction + origin).T.astype(np.float64)) - 0.5 + margin
            row = np.clip(np.nan_to_num(np.rint(at[:, 1])), 0, size[0] - 1).astype(np.int64)
        limit = 2.0 * max(margin, 8)
        out = np.clip(at - np.stack([x, y], axis=1), -limit, limit)
        out[(faces < 0) | (far <= 0) | ~np.isfinite(at[:, 0] + at[:, 1])] = 0.0
        return np.asarray(out, dtype=np.float32)


def _cropped(grid: RayGrid, border: int) -> RayGrid:
    """Return viewing rays without a border of some pixels."""
    if border == 0:
        return grid
    inside = slice(border, -border), slice(border, -border)
    return RayGrid(
        in_cam=grid.in_cam[inside],
        per_px_x=grid.per_px_x[inside],
        per_px_y=grid.per_px_y[inside],
        valid=grid.valid[inside],
        planes=np.ascontiguousarray(grid.planes[:, inside[0], inside[1]]),
    )


def _find_jumps(cells: Float32, plane: IntArray) -> BoolArray:
    """Return a mask (R,C) of the cells at which the image motion (2,R,C,2) jumps between two planes (R,C)."""
    jump = np.zeros(plane.shape, np.bool_)
    for axis in (0, 1):
        difference = np.abs(np.diff(cells, axis=axis + 1)).sum(axis=0).max(axis=-1)
        found = (difference > _JUMP_PX) & (np.diff(plane, axis=axis) != 0)
        along = np.moveaxis(jump, axis, 0)
        along[:-1] |= np.moveaxis(found, axis, 0)
        along[1:] |= np.moveaxis(found, axis, 0)
    return jump


def _dilated(mask: BoolArray, radius: int) -> BoolArray:
    """Return a mask (R,C) that is True within a number of cells of a True cell, across, along and between."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _spread_to_pixels(mask: BoolArray, size: tuple[int, ...]) -> BoolArray:
    """Return a mask (H,W) of the pixels in the True cells. Pixels beyond the last cell belong to it."""
    rows = np.minimum(np.arange(size[0]) // _CELL, mask.shape[0] - 1)
    columns = np.minimum(np.arange(size[1]) // _CELL, mask.shape[1] - 1)
    return np.asarray(mask[rows][:, columns])


def _nearest_cells(distance: Float32, radius: int) -> IntArray:
    """Return the index (R,C) of the cell with the least distance (R,C) in a square around each cell."""
    order = np.argsort(distance, axis=None, kind="stable")
    rank = np.empty(order.shape, np.float32)
    rank[order] = np.arange(len(order))
    side = 2 * radius + 1
    least = cv2.erode(rank.reshape(distance.shape), np.ones((side, side), np.uint8))
    return np.asarray(order[least.astype(np.int64)])


def _blur(image: Bytes, moved: Float32, jumps: _Jumps) -> Bytes:
    """Return the mean (H,W,3) of copies of an image that are moved by the image motion (2,H,W,2)."""
    height, width = image.shape[:2]
    length = 2.0 * np.linalg.norm(moved[0, ::8, ::8], axis=-1)
    count = int(np.clip(np.ceil(np.percentile(length, 95) / _BLUR_STEP_PX), 2, _MAX_COPIES))
    base = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    total = np.zeros(image.shape, np.float32)
    softness = np.zeros(2)
    for x in ((2.0 * np.arange(count) + 1.0) / count - 1.0).tolist():
        place = cv2.addWeighted(moved[0], x, moved[1], x * x, 0.0)
        if len(jumps.pixels):
            near = cv2.addWeighted(jumps.near[0], x, jumps.near[1], x * x, 0.0)
            place.reshape(-1, 2)[jumps.pixels] = _motion_at_jumps(place, jumps.xy, near)
        place += base
        part = place[::8, ::8] % 1.0
        softness += (part * (1.0 - part)).mean(axis=(0, 1)) / count
        cv2.accumulate(
            cv2.remap(image, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), total
        )
    # Linear interpolation between pixels is a blur with the variance f · (1 − f) for a fraction f of a pixel.
    # The second derivatives undo it.
    across, along = (softness / 2).tolist()
    kernel = np.array([[0, -along, 0], [-across, 1 + 2 * (across + along), -across], [0, -along, 0]]) / count
    sharpened = cv2.filter2D(total, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.convertScaleAbs(np.maximum(sharpened, 0, out=sharpened)))


def _motion_at_jumps(moved: Float32, xy: Float32, near: Float32) -> Float32:
    """Return the image motion (Z,2) that pixels around jumps follow at one instant.

    A pixel follows a surface if the surface is found at the place from which it would come. The surface that
    is nearest around the pixel is tried first, then the one that is found instead. If that one is hidden in
    the image by the nearest surface, the pixel takes the colour next to its border.

    Args:
        moved: (H,W,2) image motion of the surface in each pixel.
        xy: (Z,2) positions of the pixels.
        near: (Z,2) image motion of the surface that is nearest around each of them.
    """
    found = _look_up(moved, xy + near)
    out = found.copy()
    rest = np.flatnonzero(_differs(found, near))
    if len(rest):
        second = _look_up(moved, xy[rest] + found[rest])
        hidden = _differs(second, found[rest])
        out[rest] = np.where(hidden[:, None], near[rest], second)
    return out


def _differs(one: Float32, other: Float32) -> BoolArray:
    """Return a mask (Z,): True where image motions (Z,2) differ by more than a jump."""
    difference = cv2.absdiff(one, other)
    return np.asarray((difference[:, 0] > _JUMP_PX) | (difference[:, 1] > _JUMP_PX))


def _look_up(moved: Float32, xy: Float32) -> Float32:
    """Return the image motion (Z,2) at the pixels nearest to positions (Z,2)."""
    columns = np.clip(np.rint(xy[:, 0]).astype(np.int32), 0, moved.shape[1] - 1)
    rows = np.clip(np.rint(xy[:, 1]).astype(np.int32), 0, moved.shape[0] - 1)
    return np.asarray(moved.reshape(-1, 2)[rows * moved.shape[1] + columns])
