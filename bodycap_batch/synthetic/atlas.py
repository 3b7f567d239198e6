"""One image pyramid that holds all textures, and filtered look-ups in this pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray

_OCTAVES = 5
"""Number of pyramid levels in addition to the full size. Each level has half the size of the previous level.
"""
_STEPS = 2
"""Number of degrees of blur per octave (pyramid level). The first degree is the level itself. The second
degree is the mean of this level and the next level."""
_BORDER = 2**_OCTAVES
"""Width (texels of level 0) of the border around each image. It equals the width of one texel of the coarsest
level. Image positions are multiples of this width, so that a texel of the coarsest level never mixes two
images."""
_BATCH_COLUMNS = 1024
"""Number of columns of the array that passes look-ups to cv2.remap. cv2.remap refuses arrays with
more than 32,767 rows, so one long column is not possible."""
_MAX_TAPS = 6
"""Maximum number of texture look-ups for one pixel. The limit reduces the rendering time."""
_FOOTPRINT_SCALE = np.float32(1.4)
"""Multiplier of the area on the texture that is averaged for a pixel, in each direction. It is larger than 1
because lens and sensor blur slightly. With a multiplier of 1, sharp edges would shift by up to 0.1 px."""

Float32 = npt.NDArray[np.float32]
"""An array of float32."""
Bytes = npt.NDArray[np.uint8]
"""An array of uint8: an image or a part of an image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """How to average the texture over the footprints of N pixels.

    The footprint of a pixel is the area of the texture that the pixel shows.

    Attributes:
        kind: (N,) code of each pixel's filter: 16 · degree of blur (in half octaves) + number of look-ups.
        along: (2,N) longer axis of the footprint as a vector, texels of level 0. The look-ups are distributed
            along this axis.
    """

    kind: Bytes
    along: Float32


class Atlas:
    """An image pyramid that holds all textures, so that one look-up can serve pixels on any surface.

    Args:
        images: RGB images (H,W,3). Each image is surrounded by copies of its edge pixels, so that filtering
            never mixes two images.

    Attributes:
        origins: (N,2) texel coordinates (x, y) of each image's top left corner at level 0.
    """

    def __init__(self, images: Sequence[Bytes]) -> None:
        sizes = [tuple((-(-side // _BORDER) + 2) * _BORDER for side in image.shape[:2]) for image in images]
        origins, width, height = _pack_on_shelves(sizes)
        base = np.zeros((height, width, 3), np.uint8)
        for image, (tall, wide), (x, y) in zip(images, sizes, origins, strict=True):
            bottom, right = tall - _BORDER - image.shape[0], wide - _BORDER - image.shape[1]
            base[y : y + tall, x : x + wide] = cv2.copyMakeBorder(
                image, _BORDER, bottom, _BORDER, right, cv2.BORDER_REPLICATE
            )
        self.origins: FloatArray = np.array(origins, dtype=np.float64) + _BORDER
        # Each level has half the size of the previous level. With another ratio, sharp edges would
        # shift by a part of a texel.
        self._levels = [base]
        for _ in range(_OCTAVES):
            half = self._levels[-1].shape[1] // 2, self._levels[-1].shape[0] // 2
            self._levels.append(cv2.resize(self._levels[-1], half, interpolation=cv2.INTER_AREA))

    def sample(self, at: Float32, filters: Filter, cell: npt.NDArray[np.int64] | None = None) -> Bytes:
        """Return the average of the texture over the footprints of N pixels.

        Args:
            at: (2,N) texel coordinates (x, y) of the pixels at level 0. The centre of the first texel is
                (0.5, 0.5).
            filters: Filters. Each filter is for one pixel, or for a cell of pixels that share this filter.
            cell: (N,) index of each pixel's filter; None if pixel number i uses filter number i.

        Returns:
            (N,3) RGB colours of the pixels.
        """
        kinds = filters.kind if cell is None else filters.kind[cell]
        out = np.empty((at.shape[1], 3), np.uint8)
        order = np.argsort(kinds, kind="stable")
        counts = np.bincount(kinds, minlength=1)
        ends = np.cumsum(counts)
        for kind in np.flatnonzero(counts).tolist():
            pixels = order[ends[kind] - counts[kind] : ends[kind]]
            parts = [at[0].take(pixels), at[1].take(pixels)]
            if kind % 16 > 1:
                owner = pixels if cell is None else cell.take(pixels)
                parts += [filters.along[0].take(owner), filters.along[1].take(owner)]
            batch = [_as_batch(part) for part in parts]
            out[pixels] = self._look_up(batch, kind // 16, kind % 16)[: len(pixels)]
        return out

    def _look_up(self, batch: list[Float32], degree: int, taps: int) -> Bytes:
        """Return the mean of `taps` look-ups along the footprint's longer axis, in one or two levels."""
        levels = range(degree // _STEPS, degree // _STEPS + 1 + degree % _STEPS)
        if taps == 1 and len(levels) == 1:
            return np.asarray(self._bilinear(levels[0], batch[0], batch[1]).reshape(-1, 3))
        total = np.zeros((*batch[0].shape, 3), np.float32)
        for tap in range(taps):
            shift = np.float32((tap + 0.5) / taps - 0.5)
            xy = batch[:2] if taps == 1 else [batch[0] + shift * batch[2], batch[1] + shift * batch[3]]
            for level in levels:
                cv2.accumulate(self._bilinear(level, xy[0], xy[1]), total)
        return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / (taps * len(levels))).reshape(-1, 3))

    def _bilinear(self, level: int, x: Float32, y: Float32) -> Bytes:
        """Return bilinear look-ups in one pyramid level. The coordinates are texels of level 0."""
        scale, half = np.float32(0.5**level), np.float32(0.5)
        position = x * scale - half, y * scale - half
        found = cv2.remap(self._levels[level], *position, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found)


def select_filter(footprint: Float32) -> Filter:
    """Select the pyramid level and the number of look-ups for N pixels.

    Elongated footprints are averaged from several look-ups along their longer axis.

    Args:
        footprint: (4,N) changes of the texel coordinates. Rows 0 and 1: change of x and of y for a step of
            one pixel to the right. Rows 2 and 3: change of x and of y for a step of one pixel down.

    Source:
        McCormack et al., "Feline: fast elliptical lines for anisotropic texture mapping", 1999.
    """
    along, major, minor = _ellipse_axes(_FOOTPRINT_SCALE * footprint)
    np.maximum(minor, 1.0, out=minor)
    taps = np.clip(np.rint(major / minor), 1, _MAX_TAPS)
    octave = np.log2(np.maximum(np.maximum(minor, major / taps), 1.0))
    degree = np.minimum(np.rint(octave * _STEPS), _OCTAVES * _STEPS)
    return Filter(kind=(degree * 16 + taps).astype(np.uint8), along=along)


def _as_batch(values: Float32) -> Float32:
    """Return values (N,) as a two-dimensional array for cv2.remap, padded with zeros at the end."""
    out = np.zeros(-(-len(values) // _BATCH_COLUMNS) * _BATCH_COLUMNS, np.float32)
    out[: len(values)] = values
    return out.reshape(-1, _BATCH_COLUMNS)


def _ellipse_axes(footprint: Float32) -> tuple[Float32, Float32, Float32]:
    """Return the axes of elliptical footprints (4,N).

    Returns:
        The longer axis (2,N) as a vector, its length (N,), and the length (N,) of the shorter axis.
    """
    a, b, c, d = footprint
    # F has the rows (a, b) and (c, d). The matrix of the ellipse is F' F. Its eigenvalues are the squared
    # lengths of the axes.
    xx, yy, xy = a * a + c * c, b * b + d * d, a * b + c * d
    mean, half = np.float32(0.5) * (xx + yy), np.float32(0.5) * (xx - yy)
    spread = np.sqrt(half * half + xy * xy)
    major, minor = np.sqrt(mean + spread), np.sqrt(np.maximum(mean - spread, 0))
    # The half-angle formulas give the eigenvector of the larger eigenvalue.
    ratio = half / np.maximum(spread, np.float32(1e-12))
    cosine, sine = np.sqrt(np.maximum((1 + ratio) / 2, 0)), np.sqrt(np.maximum((1 - ratio) / 2, 0))
    return np.stack([major * cosine, major * np.copysign(sine, xy)]), major, minor


def _pack_on_shelves(sizes: Sequence[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int, int]:
    """Pack rectangles (height, width) in rows. The tallest rectangles come first.

    Returns:
        The origin (x, y) of each rectangle, and the width and height of the area that holds all rectangles.
    """
    area = sum(tall * wide for tall, wide in sizes)
    width = max(*(wide for _, wide in sizes), -(-int(np.sqrt(area)) // _BORDER) * _BORDER)
    origins = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: -sizes[i][0]):
        tall, wide = sizes[index]
        if x + wide > width:
            x, y, shelf = 0, y + shelf, 0
        origins[index] = (x, y)
        x, shelf = x + wide, max(shelf, tall)
    return origins, width, y + shelf
