"""The camera-landmark matrix: rows are frames, columns are landmarks, a dot where a frame saw one.

Source: M. Vo, Kim, Choudhary, "Motion Capture using Body Mounted Cameras in an Unknown Environment",
    figures 3 and 5: landmarks in the order they were first seen, so that new ones "drip" down the diagonal.
"""

from __future__ import annotations

import base64

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.model.scene import Map, Registration
from bodycap_batch.report.figures.svg import element, number, picture, text
from bodycap_batch.report.inputs import ReportInputs

_WIDTH, _LEFT, _TOP, _MAX_ROWS, _MAX_COLUMNS = 960.0, 92.0, 20.0, 720, 856
_LEAST_BAND = 60.0
_MISSING = -1


def matrix(inputs: ReportInputs, tones: dict[str, str], detail: float = 1.0) -> str:
    """Draw the matrix of all registered cameras against the largest map.

    Args:
        inputs: The results.
        tones: Colour of each camera, ``#rrggbb``.
        detail: Share of the pixels that may be used.
    """
    if not inputs.maps or not inputs.registrations:
        return ""
    scene = inputs.maps[0]
    seen = {
        each.trajectory.camera: _observations(each, scene)
        for each in inputs.registrations
        if each.trajectory.gauge == scene.gauge
    }
    if not seen:
        return ""
    order = _by_first_sight(list(seen.values()), len(scene.points))
    parts, top = [], _TOP
    for name, (frames, points) in seen.items():
        registration = inputs.registration(name)
        assert registration is not None
        count = len(registration.trajectory.status)
        share = count / sum(len(each.trajectory.status) for each in inputs.registrations)
        height = max(_LEAST_BAND, share * _MAX_ROWS)
        pixels = (max(1, round(height * detail**0.5)), max(1, round(_MAX_COLUMNS * detail**0.5)))
        image = _image(frames, order[points], (count, len(scene.points)), pixels, tones[name])
        parts.append(_band(name, image, top, height, tones[name]))
        parts.append(_keyframes(scene, name, count, top, height))
        top += height + 8.0
    title = (
        f"Camera-landmark matrix: {len(scene.points):,} landmarks in the order of first sight, "
        f"frames of {', '.join(seen)} from top to bottom"
    )
    head = text(
        _LEFT, 13.0, f"landmarks 1 … {len(scene.points):,}, in the order they were first seen", class_="tick"
    )
    return picture(_WIDTH, top + 4.0, head + "".join(parts), title, class_="matrix")


def _observations(registration: Registration, scene: Map) -> tuple[IntArray, IntArray]:
    """Frame and point index of every tracked or mapped observation of a camera."""
    camera = registration.trajectory.camera
    tracked = scene.points_of(camera, registration.obs_keyframe, registration.obs_feature)
    mine = np.isin(scene.obs_keyframe, scene.keyframes_of(camera))
    frames = np.concatenate([registration.obs_frame, scene.keyframe_frame[scene.obs_keyframe[mine]]])
    points = np.concatenate([tracked, scene.obs_point[mine]])
    known = points != _MISSING
    return frames[known], points[known]


def _by_first_sight(seen: list[tuple[IntArray, IntArray]], count: int) -> IntArray:
    """(P,) column of each point: by the first camera that saw it, then by its first frame there."""
    key = np.full(count, np.iinfo(np.int64).max)
    for index, (frames, points) in reversed(list(enumerate(seen))):
        first = np.full(count, np.iinfo(np.int64).max)
        np.minimum.at(first, points, frames + (index << 40))
        key = np.minimum(key, first)
    column = np.empty(count, dtype=np.int64)
    column[np.argsort(key, kind="stable")] = np.arange(count)
    return column


def _image(
    frames: IntArray, columns: IntArray, size: tuple[int, int], pixels: tuple[int, int], tone: str
) -> str:
    """A PNG whose opacity says how many of a cell's observations there are."""
    import cv2

    rows_px, columns_px = min(pixels[0], size[0]), min(pixels[1], size[1])
    row = (frames * rows_px // max(size[0], 1)).astype(np.int64)
    column = (columns * columns_px // max(size[1], 1)).astype(np.int64)
    counts = np.bincount(row * columns_px + column, minlength=rows_px * columns_px)
    cell = (size[0] / rows_px) * (size[1] / columns_px)
    strength = np.sqrt(np.clip(counts / max(cell, 1.0), 0.0, 1.0)).reshape(rows_px, columns_px)
    image = np.zeros((rows_px, columns_px, 4), np.uint8)
    image[..., :3] = [int(tone[i : i + 2], 16) for i in (5, 3, 1)]
    image[..., 3] = np.where(strength > 0, 40 + 215 * strength, 0).astype(np.uint8)
    _, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return base64.b64encode(encoded.tobytes()).decode("ascii")


def _band(name: str, image: str, top: float, height: float, tone: str) -> str:
    width = _WIDTH - _LEFT - 12.0
    return "".join(
        (
            element("rect", class_="plate", x=_LEFT, y=top, width=width, height=height),
            element(
                "image",
                href=f"data:image/png;base64,{image}",
                x=_LEFT,
                y=top,
                width=width,
                height=height,
                preserveAspectRatio="none",
                style="image-rendering:pixelated",
            ),
            element("rect", x=_LEFT - 4.0, y=top, width=3.0, height=height, fill=tone),
            text(_LEFT - 14.0, top + 14.0, name, class_="label", text_anchor="end"),
            text(_LEFT - 14.0, top + 28.0, "frames ↓", class_="tick", text_anchor="end"),
        )
    )


def _keyframes(scene: Map, name: str, count: int, top: float, height: float) -> str:
    """Keyframe rows as ticks on both sides and a faint line across."""
    rows = top + (scene.keyframe_frame[scene.keyframes_of(name)] + 0.5) / max(count, 1) * height
    path = "".join(f"M{number(_LEFT)} {number(y)}H{number(_WIDTH - 12.0)}" for y in np.unique(rows.round(1)))
    return element("path", class_="keyrow", d=path) if path else ""
