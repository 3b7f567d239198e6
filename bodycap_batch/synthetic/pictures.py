"""Procedural textures of pictures, papers, books and boxes in a laboratory."""

from __future__ import annotations

import cv2
import numpy as np

from bodycap_batch.synthetic.textures import Image, Texture, colour, fractal

_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
"""Characters that random words consist of."""


def _word(rng: np.random.Generator) -> str:
    """Return a random word."""
    return "".join(rng.choice(list(_LETTERS), int(rng.integers(3, 9))))


def _write(image: Image, x: float, y: float, size: float, rng: np.random.Generator) -> None:
    """Draw a random word into an image. The letters are about `size` texels tall.

    The top left corner of the word is at x, y (texels).
    """
    at = (round(x), round(y + size))
    thickness = max(1, round(size / 9))
    ink = colour(rng, 0.9, (0.05, 0.5)).tolist()
    cv2.putText(image, _word(rng), at, cv2.FONT_HERSHEY_SIMPLEX, size / 22.0, ink, thickness, cv2.LINE_AA)


def _paper(height: int, width: int, rng: np.random.Generator) -> Image:
    """Return the image of a sheet of nearly white paper."""
    out = np.empty((height, width, 3), np.uint8)
    out[:] = np.clip(225 + 0.12 * (colour(rng) - 128), 0, 255)
    return out


def _framed(image: Image, rng: np.random.Generator) -> Image:
    """Draw a frame around an image and return the image."""
    edge = max(2, min(image.shape[:2]) // 40)
    cv2.rectangle(
        image, (0, 0), (image.shape[1] - 1, image.shape[0] - 1), colour(rng, 0.5, (0.1, 0.5)).tolist(), edge
    )
    return image


def abstract(height: int, width: int, _scale: float, rng: np.random.Generator) -> Image:
    """Return an abstract picture: overlapping shapes, drawn from large to small."""
    out = np.empty((height, width, 3), np.uint8)
    out[:] = colour(rng)
    for ratio, count in ((0.35, 7), (0.15, 22), (0.06, 70), (0.025, 120)):
        for _ in range(count):
            centre = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
            size = max(2, int(ratio * min(height, width) * rng.uniform(0.4, 1.2)))
            tint, kind = colour(rng, 0.9, (0.05, 1.0)).tolist(), rng.integers(4)
            if kind == 0:
                cv2.circle(out, centre, size, tint, -1, cv2.LINE_AA)
            elif kind == 1:
                box = cv2.boxPoints((centre, (2.0 * size, size * rng.uniform(0.6, 2)), rng.uniform(0, 180)))
                cv2.fillPoly(out, [box.astype(np.int32)], tint, cv2.LINE_AA)
            elif kind == 2:
                corners = np.array(centre) + rng.normal(0, size, (3, 2))
                cv2.fillPoly(out, [corners.astype(np.int32)], tint, cv2.LINE_AA)
            else:
                cv2.circle(out, centre, size, tint, max(1, size // 4), cv2.LINE_AA)
    return _framed(out, rng)


def landscape(height: int, width: int, _scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of several ridges of hills, one behind the other, under a cloudy sky."""
    clouds = fractal(height, width, width / 3, rng, 5)
    out = np.clip(colour(rng, 0.5, (0.7, 0.95)) + 22.0 * clouds[..., None], 0, 255)
    for ridge in range(6):
        level = height * (0.35 + 0.11 * ridge)
        line = level + fractal(1, width, width / 4, rng, 7)[0] * height * 0.07
        shade = 0.75 + 0.25 * fractal(height, width, width / 9, rng, 6)
        below = np.arange(height)[:, None] > line
        out = np.where(
            below[..., None], np.clip(shade[..., None] * colour(rng, 0.7, (0.2, 0.8)), 0, 255), out
        )
    return _framed(np.asarray(out, dtype=np.uint8), rng)


def research_poster(height: int, width: int, _scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a poster with a title, columns of text and plots."""
    out = _paper(height, width, rng)
    unit = min(height, width) / 36.0
    cv2.rectangle(out, (0, 0), (width, int(4 * unit)), colour(rng, 0.9, (0.2, 0.6)).tolist(), -1)
    for word in range(4):
        _write(out, unit + word * width / 4.2, unit, 1.8 * unit, rng)
    columns = 2 if width < height else 3
    for column in range(columns):
        left, y = width * column / columns + unit, 5.0 * unit
        wide = width / columns - 2 * unit
        while y < height - 3 * unit:
            if rng.uniform() < 0.3 and y + 8 * unit < height:
                _plot(out, (int(left), int(y), int(wide), int(7 * unit)), rng)
                y += 8 * unit
            else:
                for word in range(3):
                    _write(out, left + word * wide / 3, y, unit * rng.uniform(0.5, 0.9), rng)
                y += 1.4 * unit
    return _framed(out, rng)


def _plot(out: Image, box: tuple[int, int, int, int], rng: np.random.Generator) -> None:
    """Draw a random plot into a box (left, top, width, height; texels): bars, curves or a colour map."""
    left, top, wide, tall = box
    if wide < 8 or tall < 8:
        return
    cv2.rectangle(out, (left, top), (left + wide, top + tall), (40, 40, 40), 2)
    kind = rng.integers(3)
    if kind == 0:
        for bar in range(8):
            high = int(tall * rng.uniform(0.1, 0.95))
            x = left + int(bar * wide / 8)
            tint = colour(rng, 0.9).tolist()
            cv2.rectangle(out, (x + 2, top + tall - high), (x + int(wide / 10), top + tall), tint, -1)
    elif kind == 1:
        for _ in range(3):
            heights = top + tall * (0.5 + 0.2 * fractal(1, wide, wide / 4, rng, 3)[0])
            points = np.column_stack([left + np.arange(wide), heights]).astype(np.int32)
            cv2.polylines(out, [points], False, colour(rng, 0.9, (0.1, 0.7)).tolist(), 2, cv2.LINE_AA)
    else:
        patch = fractal(tall, wide, tall / 2, rng, 5)
        coloured = cv2.applyColorMap(
            np.clip(128 + 70 * patch, 0, 255).astype(np.uint8), int(rng.integers(12))
        )
        target = out[top : top + tall, left : left + wide]
        target[:] = coloured[: target.shape[0], : target.shape[1]]


def street_map(height: int, width: int, _scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a street map: blocks of different colours between streets, with names."""
    count = 90
    seeds = rng.uniform(0, 1, (count, 2)) * [width, height]
    y, x = np.mgrid[0:height:3, 0:width:3].astype(np.float32)
    distance = np.full(y.shape, np.inf, np.float32)
    second, owner = distance.copy(), np.zeros(y.shape, np.int32)
    for index, (seed_x, seed_y) in enumerate(seeds):
        here = np.hypot(x - seed_x, y - seed_y)
        closer = here < distance
        second = np.where(closer, distance, np.minimum(second, here))
        owner[closer] = index
        distance = np.minimum(distance, here)
    tints = np.array([colour(rng, 0.5, (0.5, 0.95)) for _ in range(count)])
    small = np.where((second - distance > 0.008 * width)[..., None], tints[owner], 250).astype(np.uint8)
    out = np.ascontiguousarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))
    for _ in range(60):
        size = min(height, width) * rng.uniform(0.012, 0.03)
        _write(out, rng.uniform(0, width * 0.9), rng.uniform(0, height * 0.95), size, rng)
    return _framed(out, rng)


def notes(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a cork board with sheets of paper pinned to it."""
    cork = 1.0 + 0.16 * np.tanh(fractal(height, width, 0.012 * scale, rng, 3))
    out = np.clip(cork[..., None] * np.array([185, 140, 95], np.float32), 0, 255).astype(np.uint8)
    for _ in range(int(14 * height * width / scale**2) + 4):
        tall = max(4, min(int(rng.uniform(0.10, 0.28) * scale), height - 1))
        wide = max(4, min(int(rng.uniform(0.09, 0.22) * scale), width - 1))
        sheet = _paper(tall, wide, rng)
        if rng.uniform() < 0.4:
            sheet[:] = colour(rng, 0.7, (0.6, 1.0))
        for line in range(int(rng.integers(2, 8))):
            _write(sheet, 0.08 * wide, line * tall / 8, tall / 14, rng)
        cv2.rectangle(sheet, (0, 0), (wide - 1, tall - 1), (90, 90, 90), 1)
        cv2.circle(sheet, (wide // 2, 6), 4, colour(rng, 1.0).tolist(), -1, cv2.LINE_AA)
        _paste(
            out, sheet, (rng.uniform(0, width - wide), rng.uniform(0, height - tall)), rng.uniform(-12, 12)
        )
    return _framed(out, rng)


def _paste(out: Image, sheet: Image, corner: tuple[float, float], degrees: float) -> None:
    """Copy a sheet into an image. The sheet is rotated about its centre."""
    tall, wide = sheet.shape[:2]
    matrix = cv2.getRotationMatrix2D((wide / 2, tall / 2), degrees, 1.0)
    matrix[:, 2] += corner
    size = (out.shape[1], out.shape[0])
    mask = cv2.warpAffine(np.full((tall, wide), 255, np.uint8), matrix, size)
    warped = cv2.warpAffine(sheet, matrix, size)
    out[mask > 127] = warped[mask > 127]


def books(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a row of books: spines of different sizes, with titles and gaps."""
    out = np.full((height, width, 3), 25, np.uint8)
    x = 0
    while x < width:
        thick = max(3, int(rng.uniform(0.015, 0.055) * scale))
        tall = int(min(1.0, rng.uniform(0.62, 0.98)) * height)
        spine = np.empty((tall, thick, 3), np.uint8)
        spine[:] = colour(rng, 0.8, (0.15, 0.95))
        for _ in range(int(rng.integers(1, 4))):
            band = int(rng.uniform(0, tall * 0.9))
            spine[band : band + max(2, int(tall * rng.uniform(0.01, 0.08)))] = colour(rng, 0.9)
        title = np.full((thick, tall, 3), 0, np.uint8)
        title[:] = cv2.rotate(spine, cv2.ROTATE_90_CLOCKWISE)
        _write(title, 0.15 * tall, 0.15 * thick, 0.6 * thick, rng)
        spine = cv2.rotate(title, cv2.ROTATE_90_COUNTERCLOCKWISE)
        visible = out[height - tall :, x : x + thick]
        visible[:] = spine[:, : visible.shape[1]]
        x += thick + (int(rng.uniform(0.02, 0.08) * scale) if rng.uniform() < 0.08 else 1)
    return out


def whiteboard(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a whiteboard with words, boxes and scribbled lines."""
    out = np.full((height, width, 3), 238, np.uint8)
    pens = [(30, 30, 160), (170, 30, 30), (20, 110, 40), (30, 30, 30)]
    for _ in range(int(30 * height * width / scale**2)):
        x, y = rng.uniform(0, width * 0.9), rng.uniform(0, height * 0.9)
        kind, pen = rng.integers(3), pens[rng.integers(len(pens))]
        if kind == 0:
            _write(out, x, y, scale * rng.uniform(0.02, 0.05), rng)
        elif kind == 1:
            corner = (int(x + scale * rng.uniform(0.05, 0.2)), int(y + scale * rng.uniform(0.04, 0.12)))
            cv2.rectangle(out, (int(x), int(y)), corner, pen, 2, cv2.LINE_AA)
        else:
            steps = np.array([x, y]) + np.cumsum(rng.normal(0, 0.02 * scale, (14, 2)), axis=0)
            cv2.polylines(out, [steps.astype(np.int32)], False, pen, 2, cv2.LINE_AA)
    return _framed(out, rng)


def cardboard(height: int, width: int, scale: float, rng: np.random.Generator) -> Image:
    """Return the texture of a cardboard box with tape, print and a label."""
    shade = 1.0 + 0.05 * fractal(height, width, 0.1 * scale, rng, 4)
    out = np.clip(shade[..., None] * np.array([188, 150, 105], np.float32), 0, 255).astype(np.uint8)
    middle = int(rng.uniform(0.3, 0.7) * width)
    out[:, middle : middle + int(0.05 * scale)] = np.clip(colour(rng, 0.3, (0.6, 0.9)), 0, 255)
    for _ in range(9):
        size = min(height, width) * rng.uniform(0.03, 0.12)
        _write(out, rng.uniform(0, 0.7 * width), rng.uniform(0, 0.85 * height), size, rng)
    left, top = int(rng.uniform(0, 0.6) * width), int(rng.uniform(0, 0.6) * height)
    label = _paper(max(4, height // 4), max(4, width // 3), rng)
    for line in range(4):
        _write(label, 2, line * label.shape[0] / 4, label.shape[0] / 7, rng)
    target = out[top : top + label.shape[0], left : left + label.shape[1]]
    target[:] = label[: target.shape[0], : target.shape[1]]
    return np.asarray(out)


def screen(height: int, width: int, _scale: float, rng: np.random.Generator) -> Image:
    """Return a picture of a monitor that shows many windows."""
    out = np.full((height, width, 3), 35, np.uint8)
    for _ in range(6):
        left, top = int(rng.uniform(0, 0.6) * width), int(rng.uniform(0, 0.6) * height)
        box = (left, top, int(0.35 * width), int(0.35 * height))
        cv2.rectangle(
            out, (left, top), (left + box[2], top + box[3]), colour(rng, 0.2, (0.1, 0.95)).tolist(), -1
        )
        if rng.uniform() < 0.5:
            _plot(out, box, rng)
        else:
            for line in range(9):
                _write(out, left + 4, top + line * box[3] / 9, box[3] / 16, rng)
    cv2.rectangle(out, (0, 0), (width - 1, height - 1), (10, 10, 10), max(2, height // 30))
    return out


WALL_PICTURES: tuple[Texture, ...] = (
    abstract,
    landscape,
    research_poster,
    street_map,
    notes,
    research_poster,
)
