"""All textures in one image pyramid, and filtered look-ups in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray

_OCTAVES = 5
"""Levels of the pyramid above the full size."""
_STEPS = 2
"""Degrees of blur for each octave: a pyramid level, and the mean of two levels."""
_BORDER = 2**_OCTAVES
"""Texels around an image: one texel of the coarsest level. Images lie at multiples of it, so that no texel of
the coarsest level mixes two images."""
_BATCH_COLUMNS = 1024
"""Width of the image in which look-ups are given to cv2.remap, which refuses more than 32,767 rows."""
_MAX_TAPS = 6
"""Look-ups for a pixel at most; limits time."""
_FOOTPRINT_SCALE = np.float32(1.4)
"""Size of a pixel's footprint relative to the pixel, because lens and sensor blur a little. Without it, sharp
edges shift by up to 0.1 px."""

Float32 = npt.NDArray[np.float32]
"""An array of float32."""
Bytes = npt.NDArray[np.uint8]
"""An array of uint8: an image or a part of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """How to average the texture under each of N pixels.

    Attributes:
        kind: (N,) 16 · degree of blur (half octaves) + number of look-ups.
        along: (2,N) longer axis of the footprint, texels of level 0; look-ups are spaced along it.
    """

    kind: Bytes
    along: Float32


class Atlas:
    """An image pyramid that holds all textures.

    Args:
        images: RGB images. Each is surrounded by copies of its edge, so that filtering never mixes two
            images.

    Attributes:
        origins: (N,2) texel (x, y) of each image's top left corner at level 0.
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
        # Each level is half of the last one. Any other ratio shifts sharp edges by a fraction of a texel.
        self._levels = [base]
        for _ in range(_OCTAVES):
            half = self._levels[-1].shape[1] // 2, self._levels[-1].shape[0] // 2
            self._levels.append(cv2.resize(self._levels[-1], half, interpolation=cv2.INTER_AREA))

    def sample(self, at: Float32, filters: Filter, cell: npt.NDArray[np.int64] | None = None) -> Bytes:
        """Return the average of the texture under N pixels.

        Args:
            at: (2,N) texel coordinates (x, y) at level 0; the first texel's centre is (0.5, 0.5).
            filters: Filters of the pixels, or of cells of pixels.
            cell: (N,) index of each pixel's filter; None if each pixel has its own.

        Returns:
            (N,3) RGB.
        """
        kinds = filters.kind if cell is None else filters.kind[cell]
        out = np.empty((at.shape[1], 3), np.uint8)
        for kind in np.flatnonzero(np.bincount(kinds, minlength=1)).tolist():
            pixels = np.flatnonzero(kinds == kind)
            parts = [at[0].take(pixels), at[1].take(pixels)]
            if kind % 16 > 1:
                owner = pixels if cell is None else cell.take(pixels)
                parts += [filters.along[0].take(owner), filters.along[1].take(owner)]
            batch = [_as_batch(part) for part in parts]
            out[pixels] = self._look_up(batch, kind // 16, kind % 16)[: len(pixels)]
        return out

    def _look_up(self, batch: list[Float32], degree: int, taps: int) -> Bytes:
        """Return the mean of `taps` look-ups along the footprint's longer axis, in one level or in two."""
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
        """Return the bilinear look-ups in one level at texel coordinates of level 0."""
        scale, half = np.float32(0.5**level), np.float32(0.5)
        position = x * scale - half, y * scale - half
        found = cv2.remap(self._levels[level], *position, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found)


def select_filter(footprint: Float32) -> Filter:
    """Select the pyramid level and the number of look-ups for N pixels.

    Elongated footprints are averaged from several look-ups along their longer axis.

    Args:
        footprint: (4,N) derivatives of the texel coordinates x and y: one pixel to the right, then down.

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
    """Return values (N,) as an image for cv2.remap, padded with zeros."""
    out = np.zeros(-(-len(values) // _BATCH_COLUMNS) * _BATCH_COLUMNS, np.float32)
    out[: len(values)] = values
    return out.reshape(-1, _BATCH_COLUMNS)


def _ellipse_axes(footprint: Float32) -> tuple[Float32, Float32, Float32]:
    """Return the longer axis (2,N) as a vector and the lengths (N,) of both axes, of footprints (4,N)."""
    a, b, c, d = footprint
    # The matrix of the ellipse is F' F. Its eigenvalues are the squared lengths of the axes.
    xx, yy, xy = a * a + c * c, b * b + d * d, a * b + c * d
    mean, half = np.float32(0.5) * (xx + yy), np.float32(0.5) * (xx - yy)
    spread = np.sqrt(half * half + xy * xy)
    major, minor = np.sqrt(mean + spread), np.sqrt(np.maximum(mean - spread, 0))
    # The eigenvector of the larger eigenvalue, from the half-angle formulas.
    ratio = half / np.maximum(spread, np.float32(1e-12))
    cosine, sine = np.sqrt(np.maximum((1 + ratio) / 2, 0)), np.sqrt(np.maximum((1 - ratio) / 2, 0))
    return np.stack([major * cosine, major * np.copysign(sine, xy)]), major, minor


def _pack_on_shelves(sizes: Sequence[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int, int]:
    """Pack rectangles (height, width) in rows, the tallest first.

    Returns:
        Origin (x, y) of each rectangle; width and height of the whole.
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
