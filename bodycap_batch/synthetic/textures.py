"""Procedural textures of building materials and furniture: RGB uint8 images of any size.

The arguments `height` and `width` are in texels. The argument `scale` is in texels per metre, so that bricks
have the same size on every wall.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""RGB image (H,W,3), uint8."""
Grey = npt.NDArray[np.float32]
"""Brightness image (H,W) or RGB colour (3,), float32."""
Texture = Callable[[int, int, float, np.random.Generator], Image]
"""Function that draws a texture as an RGB image. Its arguments are the height and the width (texels), the
scale (texels per metre) and a random generator."""


def colour(
    rng: np.random.Generator, saturation: float = 0.6, value: tuple[float, float] = (0.3, 0.95)
) -> Grey:
    """Return a random RGB colour (3,), 0 to 255.

    Args:
        rng: Source of randomness.
        saturation: Maximum saturation, 0 to 1.
        value: Minimum and maximum brightness, 0 to 1.
    """
    hsv = np.array([[[rng.uniform(0, 360), rng.uniform(0.2, 1.0) * saturation, rng.uniform(*value)]]])
    return np.asarray(cv2.cvtColor(hsv.astype(np.float32), cv2.COLOR_HSV2RGB)[0, 0] * 255.0, dtype=np.float32)


def fractal(height: int, width: int, cell: float, rng: np.random.Generator, octaves: int = 4) -> Grey:
    """Return smooth random noise (H,W) with mean 0 and an amplitude of about 1.

    Args:
        height: Height of the noise image, texels.
        width: Width of the noise image, texels.
        cell: Size of the largest features, texels.
        rng: Source of randomness.
        octaves: Number of noise images that are added. Each image has half the feature size and half the
            amplitude of the previous image.
    """
    out = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        size = max(cell / 2**octave, 1.0)
        rows, columns = int(height / size) + 3, int(width / size) + 3
        grid = rng.standard_normal((rows, columns), dtype=np.float32)
        big = cv2.resize(grid, (int(columns * size) + 1, int(rows * size) + 1), interpolation=cv2.INTER_CUBIC)
        shift = int(size)
        out += big[shift : shift + height, shift : shift + width] * 0.5**octave
    return out


def tint_shade(shade: Grey, base: Grey) -> Image:
    """Return an image of a colour (3,) multiplied by a brightness (H,W) of about 1.

    Negative brightness becomes 0.
    """
    np.maximum(shade, 0, out=shade)
    return np.asarray(cv2.merge([cv2.convertScaleAbs(shade, alpha=float(part)) for part in base]))


def shade_image(image: Image, shade: Grey) -> Image:
    """Return an image multiplied by a brightness (H,W) of about 1."""
    return np.asarray(cv2.multiply(image, cv2.merge([shade.astype(np.float32)] * 3), dtype=cv2.CV_8U))


def faded(image: Image, contrast: float, scale: float, rng: np.random.Generator) -> Image:
    """Return an image with less contrast about its mean colour, and the faint structure of paint.

    Args:
        image: (H,W,3) image.
        contrast: 1: the image as it is; 0: paint of one colour.
        scale: Texels per metre.
        rng: Source of randomness.
    """
    height, width = image.shape[:2]
    shade = 1.0 + 0.008 * fractal(height, width, scale * 0.8, rng, 3)
    shade += 0.005 * rng.standard_normal((height, width), dtype=np.float32)
    paint = tint_shade(shade, np.array(cv2.mean(image)[:3], np.float32))
    return np.asarray(cv2.addWeighted(image, contrast, paint, 1.0 - contrast, 0.0))


def plaster(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of a painted wall that is almost plain."""
    shade = 1.0 + 0.012 * fractal(height, width, scale * 0.8, rng, 3)
    shade += 0.008 * rng.standard_normal((height, width), dtype=np.float32)
    return tint_shade(shade, 0.35 * colour(rng, 0.5, (0.75, 0.9)) + np.float32(0.6 * 225.0))


def bricks(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of rows of bricks with mortar between them. Each brick has a different tint."""
    tall, long, gap = 0.075 * scale, 0.22 * scale, max(1, round(0.009 * scale))
    out = np.full((height, width, 3), 170, np.uint8)
    base = 0.5 * colour(rng, 0.5) + np.float32(0.5) * np.array([165, 90, 70], np.float32)
    for row in range(int(height / tall) + 1):
        top, left = round(row * tall), -rng.uniform(0.2, 0.8) * long
        while left < width:
            right = left + long * rng.uniform(0.85, 1.1)
            tint = base * rng.uniform(0.6, 1.25) + rng.normal(0, 10, 3)
            corners = (round(left), top), (round(right) - gap, round(top + tall) - gap)
            cv2.rectangle(out, *corners, np.clip(tint, 0, 255).tolist(), -1)
            left = right
    grain = 1.0 + 0.10 * fractal(height, width, 0.03 * scale, rng, 3)
    return shade_image(out, grain)


def planks(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of wooden boards along the width, with grain, knots and joints."""
    board = max(8, round(rng.uniform(0.10, 0.16) * scale))
    base = np.array([[205, 165, 115], [150, 105, 70], [120, 75, 50], [185, 150, 120]], np.float32)
    tint = base[rng.integers(len(base))] * np.float32(rng.uniform(0.85, 1.1))
    grain = np.empty((height, width), np.float32)
    for top in range(0, height, board):
        rows = min(board, height - top)
        left = -int(rng.uniform(0, 1.5) * scale)
        while left < width:
            right = min(width, left + int(rng.uniform(0.8, 2.0) * scale))
            start = max(left, 0)
            if right > start:
                grain[top : top + rows, start:right] = _grain(rows, right - start, scale, rng)
                grain[top : top + rows, right - 2 : right] = 0.45
            left = right
        grain[top : top + 2] = 0.5
    return tint_shade(grain, tint)


def _grain(rows: int, columns: int, scale: float, rng: np.random.Generator) -> Grey:
    """Return the brightness image of one wooden board, with warped rings and knots."""
    y = np.linspace(0, rows / scale, rows, dtype=np.float32)[:, None]
    warp = fractal(rows, columns, 0.25 * scale, rng, 3)
    rings = np.sin((y * rng.uniform(250, 420) + 2.2 * warp) + rng.uniform(0, 6))
    speckle = rng.standard_normal((rows, columns), dtype=np.float32)
    shade = rng.uniform(0.78, 1.12) + 0.09 * rings + 0.05 * warp + 0.03 * speckle
    for _ in range(rng.poisson(columns / scale * 1.5)):
        knot = (int(rng.uniform(0, columns)), int(rng.uniform(0, rows)))
        size = max(2, int(rng.uniform(0.006, 0.015) * scale))
        cv2.ellipse(shade, knot, (2 * size, size), 0, 0, 360, 0.4, -1, cv2.LINE_AA)
    return np.asarray(shade, dtype=np.float32)


def carpet(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of a woven carpet with irregular polygons, a border and pile."""
    out = np.full((height, width, 3), 0, np.uint8)
    out[:] = np.clip(colour(rng, 0.7, (0.3, 0.6)), 0, 255)
    for size, count in ((0.22, 3.5), (0.10, 14.0), (0.045, 50.0)):
        for _ in range(int(count * height * width / scale**2)):
            _blot(
                out, rng.uniform(0, width), rng.uniform(0, height), size * scale * rng.uniform(0.5, 1.3), rng
            )
    border = round(0.12 * scale)
    for inset in (border // 3, border):
        line = np.clip(colour(rng), 0, 255).tolist()
        cv2.rectangle(out, (inset, inset), (width - inset, height - inset), line, max(2, border // 6))
    pile = 1.0 + 0.09 * rng.standard_normal((height, width), dtype=np.float32)
    return shade_image(out, pile)


def _blot(out: Image, x: float, y: float, size: float, rng: np.random.Generator) -> None:
    """Draw an irregular polygon of one colour around a centre x, y (texels)."""
    corners = int(rng.integers(3, 8))
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    radius = size * rng.uniform(0.4, 1.0, corners)
    points = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=-1)
    cv2.fillPoly(out, [np.round(points * 16).astype(np.int32)], colour(rng).tolist(), cv2.LINE_AA, 4)


def granite(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of speckled stone for worktops."""
    noise = fractal(height, width, 0.05 * scale, rng, 4) + 0.8 * fractal(height, width, 0.012 * scale, rng, 2)
    shade = 0.85 + 0.18 * np.tanh(1.5 * noise)
    for level, depth in ((1.7, 0.4), (-1.9, 1.5)):
        spots = fractal(height, width, 0.02 * scale, rng, 2)
        shade = np.where(spots > level if level > 0 else spots < level, shade * depth, shade)
    return tint_shade(shade.astype(np.float32), colour(rng, 0.3, (0.5, 0.8)))


def tiles(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of floor tiles with different brightness, with chips and stains."""
    side = rng.uniform(0.28, 0.36) * scale
    base = colour(rng, 0.3, (0.5, 0.8))
    shade = np.ones((height, width), np.float32)
    for row in range(int(height / side) + 1):
        for column in range(int(width / side) + 1):
            box = np.s_[
                int(row * side) : int((row + 1) * side), int(column * side) : int((column + 1) * side)
            ]
            shade[box] = rng.uniform(0.7, 1.15)
            shade[box][: max(2, int(0.006 * scale))] = 0.45
            shade[box][:, : max(2, int(0.006 * scale))] = 0.45
    shade *= 1.0 + 0.10 * np.tanh(fractal(height, width, 0.12 * scale, rng, 5))
    for _ in range(int(14 * height * width / scale**2)):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        size = max(1, int(rng.uniform(0.004, 0.02) * scale))
        cv2.ellipse(
            shade, spot, (size, max(1, size // 2)), rng.uniform(0, 180), 0, 360, rng.uniform(0.4, 0.8), -1
        )
    return tint_shade(shade, base)


def fabric(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of upholstery with woven threads, stripes of random width and a few folds."""
    out = np.empty((height, width, 3), np.uint8)
    stop = 0
    while stop < width:
        start, stop = stop, stop + max(2, int(rng.uniform(0.008, 0.05) * scale))
        out[:, start:stop] = colour(rng, 0.6, (0.3, 0.8))
    weave = 1.0 + 0.10 * rng.standard_normal((height, width), dtype=np.float32)
    folds = 1.0 + 0.10 * fractal(height, width, 0.25 * scale, rng, 3)
    return shade_image(out, weave * folds)


def ceiling_panels(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of acoustic panels with faint holes, some stains and some grilles."""
    side = 0.6 * scale
    shade = np.full((height, width), 1.0, np.float32)
    holes = rng.uniform(size=(height // 4 + 1, width // 4 + 1)).astype(np.float32)
    shade -= 0.18 * (cv2.resize(holes, (width, height), interpolation=cv2.INTER_NEAREST) > 0.985)
    for row in range(int(height / side) + 1):
        for column in range(int(width / side) + 1):
            top, left = int(row * side), int(column * side)
            shade[top : int(top + side), left : int(left + side)] *= rng.uniform(0.94, 1.02)
            kind = rng.uniform()
            if kind < 0.10:
                _grille(shade[top : int(top + side), left : int(left + side)], scale, rng)
            elif kind < 0.35:
                stain = (int(left + rng.uniform() * side), int(top + rng.uniform() * side))
                axes = (int(rng.uniform(0.03, 0.14) * scale), int(rng.uniform(0.02, 0.09) * scale))
                cv2.ellipse(
                    shade, stain, axes, rng.uniform(0, 180), 0, 360, rng.uniform(0.72, 0.9), -1, cv2.LINE_AA
                )
    line = max(2, round(0.012 * scale))
    for at in np.arange(0, max(height, width) + side, side).astype(int):
        shade[at : at + line] = 0.72
        shade[:, at : at + line] = 0.72
    return tint_shade(shade, np.array([222, 222, 216], np.float32))


def _grille(panel: Grey, scale: float, rng: np.random.Generator) -> None:
    """Draw the slots of an air outlet on a panel."""
    margin = int(rng.uniform(0.06, 0.14) * scale)
    pitch = max(4, int(rng.uniform(0.025, 0.04) * scale))
    for top in range(margin, panel.shape[0] - margin, pitch):
        panel[top : top + pitch // 2, margin : panel.shape[1] - margin] = rng.uniform(0.25, 0.45)


def metal(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of painted sheet metal with scratches."""
    shade = np.ones((height, width), np.float32) + 0.03 * fractal(height, width, 0.2 * scale, rng, 3)
    for _ in range(int(30 * height * width / scale**2) + 3):
        start = np.array([rng.uniform(0, width), rng.uniform(0, height)])
        end = start + rng.normal(0, 0.05 * scale, 2)
        cv2.line(
            shade, tuple(start.astype(int)), tuple(end.astype(int)), rng.uniform(0.5, 1.2), 1, cv2.LINE_AA
        )
    return tint_shade(shade, colour(rng, 0.4, (0.4, 0.75)))
