"""All textures in one image pyramid, and filtered look-ups in it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from bodycap_batch.arrays import FloatArray

LEVELS = 6
_CELL = 2 ** (LEVELS - 1)
_BATCH_COLUMNS = 1024
"""Look-ups go through cv2.remap as an image of this width: it refuses more than 32,767 rows."""
_MAX_TAPS = 6

Float32 = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


class Atlas:
    """A pyramid of all images.

    Args:
        images: RGB images; each is surrounded by copies of its edge, so that filtering never mixes two.

    Attributes:
        origins: (N,2) texel (x, y) of each image's top left corner at level 0.
        levels: The pyramid, level 0 first.
    """

    def __init__(self, images: Sequence[npt.NDArray[np.uint8]]) -> None:
        sizes = [tuple(-(-side // _CELL) * _CELL + 2 * _CELL for side in image.shape[:2]) for image in images]
        origins, width, height = _shelves(sizes)
        base = np.zeros((height, width, 3), np.uint8)
        for image, (tall, wide), (x, y) in zip(images, sizes, origins, strict=True):
            bottom, right = tall - _CELL - image.shape[0], wide - _CELL - image.shape[1]
            base[y : y + tall, x : x + wide] = cv2.copyMakeBorder(
                image, _CELL, bottom, _CELL, right, cv2.BORDER_REPLICATE
            )
        self.origins: FloatArray = np.array(origins, dtype=np.float64) + _CELL
        self.levels = [base]
        while len(self.levels) < LEVELS:
            finer = self.levels[-1]
            half = (finer.shape[1] // 2, finer.shape[0] // 2)
            self.levels.append(cv2.resize(finer, half, interpolation=cv2.INTER_AREA))

    def sample(self, at: Float32, footprint: Float32) -> Bytes:
        """Average the texture under pixels.

        Args:
            at: (2,N) texel coordinates (x, y) at level 0 (the first texel's centre is 0.5, 0.5).
            footprint: (4,N) derivatives: of x and y to the right, of x and y downwards.

        Returns:
            (N,3) RGB.

        Source: elongated footprints are averaged from several look-ups along their longer axis, as in
            McCormack et al., "Feline: fast elliptical lines for anisotropic texture mapping", 1999.
        """
        along, major, minor = _axes(footprint)
        np.maximum(minor, 1.0, out=minor)
        taps = np.clip(np.rint(major / minor), 1, _MAX_TAPS)
        lod = np.log2(np.maximum(np.maximum(minor, major / taps), 1.0))
        np.minimum(lod, LEVELS - 1.001, out=lod)
        key = lod.astype(np.uint8) * 16 + taps.astype(np.uint8)
        out = np.empty((at.shape[1], 3), np.uint8)
        for value in np.flatnonzero(np.bincount(key, minlength=1)):
            chosen = np.flatnonzero(key == value)
            level, count = int(value) // 16, int(value) % 16
            parts = (*at, lod) if count == 1 else (*at, lod, *along)
            batch = [_batched(part.take(chosen)) for part in parts]
            out[chosen] = self._look_up(batch, level, count)[: len(chosen)]
        return out

    def _look_up(self, batch: list[Float32], level: int, taps: int) -> Bytes:
        """Blend of two levels, averaged over taps along the footprint's longer axis."""
        x, y, lod, *along = batch
        share = lod - np.float32(level)
        rest = np.float32(1) - share
        total = None if taps == 1 else np.zeros((*x.shape, 3), np.float32)
        for tap in range(taps):
            shift = np.float32((tap + 0.5) / taps - 0.5)
            place = (x, y) if taps == 1 else (x + shift * along[0], y + shift * along[1])
            finer = self._bilinear(level, *place)
            blend = cv2.blendLinear(finer, self._bilinear(level + 1, *place), rest, share)
            if total is None:
                return np.asarray(blend.reshape(-1, 3))
            cv2.accumulate(blend, total)
        return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / taps).reshape(-1, 3))

    def _bilinear(self, level: int, x: Float32, y: Float32) -> Bytes:
        scale, half = np.float32(0.5**level), np.float32(0.5)
        image = self.levels[level]
        looked = cv2.remap(
            image, x * scale - half, y * scale - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(looked)


def _batched(values: Float32) -> Float32:
    """Values (N,) as an image that cv2.remap takes, padded with zeros."""
    out = np.zeros(-(-len(values) // _BATCH_COLUMNS) * _BATCH_COLUMNS, np.float32)
    out[: len(values)] = values
    return out.reshape(-1, _BATCH_COLUMNS)


def _axes(footprint: Float32) -> tuple[Float32, Float32, Float32]:
    """Longer axis (2,N) as a vector and the lengths (N,) of both axes of parallelograms (4,N)."""
    a, b, c, d = footprint
    # The ellipse's matrix is F' F; its eigenvalues are the squared axes.
    xx, yy, xy = a * a + c * c, b * b + d * d, a * b + c * d
    mean, half = np.float32(0.5) * (xx + yy), np.float32(0.5) * (xx - yy)
    spread = np.sqrt(half * half + xy * xy)
    major, minor = np.sqrt(mean + spread), np.sqrt(np.maximum(mean - spread, 0))
    # The eigenvector of the larger eigenvalue, from the half-angle formulas.
    ratio = half / np.maximum(spread, np.float32(1e-12))
    cosine, sine = np.sqrt(np.maximum((1 + ratio) / 2, 0)), np.sqrt(np.maximum((1 - ratio) / 2, 0))
    return np.stack([major * cosine, major * np.copysign(sine, xy)]), major, minor


def _shelves(sizes: Sequence[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int, int]:
    """Place rectangles (height, width) on shelves, tallest first.

    Returns:
        (x, y) of each, and the width and height of the whole.
    """
    area = sum(tall * wide for tall, wide in sizes)
    width = max(*(wide for _, wide in sizes), -(-int(np.sqrt(area)) // _CELL) * _CELL)
    origins = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: -sizes[i][0]):
        tall, wide = sizes[index]
        if x + wide > width:
            x, y, shelf = 0, y + shelf, 0
        origins[index] = (x, y)
        x, shelf = x + wide, max(shelf, tall)
    return origins, width, y + shelf
