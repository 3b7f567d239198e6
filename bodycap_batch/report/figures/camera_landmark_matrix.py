"""Draw the camera-landmark matrix: rows are frames, columns are landmarks, dots are observations.

Landmarks are sorted by their first observation, so new landmarks appear on the diagonal.

Source: M. Vo, Kim, Choudhary, "Motion Capture using Body Mounted Cameras in an Unknown Environment",
    figures 3 and 5.
"""

from __future__ import annotations

import base64

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.model.scene import Map, Registration
from bodycap_batch.report.figures.svg import element, number, svg_image, text
from bodycap_batch.report.report_inputs import ReportInputs

_WIDTH, _LEFT, _TOP, _RIGHT = 960.0, 92.0, 20.0, 12.0
"""Width of the drawing, and its left, top and right margins, SVG units."""
_MAX_ROWS, _MAX_COLUMNS = 720, 856
"""Number of pixel rows of all bands together, and number of pixel columns: one pixel for each SVG unit.

The bands have more rows if some of them have the minimum height.
"""
_MIN_BAND_HEIGHT = 60.0
"""Minimum height of a camera's band, SVG units. Two lines of text fit into this height."""
_BAND_MARGIN = 8.0
"""Height of the space between two bands, SVG units."""
_COMPRESSION = 7
"""Level of the compression of the images, 0 to 9. Level 9 takes eight times as long for files that are 8 %
smaller. Evidence: docs/decisions/report.md."""
_NO_POINT = -1
"""Point index of a feature that has no point in the map."""


def draw_camera_landmark_matrix(inputs: ReportInputs, colours: dict[str, str], detail: float = 1.0) -> str:
    """Draw the matrix of all cameras that are registered in the largest map, with one band for each camera.

    Args:
        inputs: The results of the job.
        colours: Colour ``#rrggbb`` of each camera, by camera name.
        detail: Fraction of the pixels that may be used, 0 to 1.

    Returns:
        The drawing as SVG; "" if no camera is registered in the largest map, or if this map has no points.
    """
    if not inputs.maps or not inputs.registrations or not len(inputs.maps[0].points):
        return ""
    scene = inputs.maps[0]
    observations = {
        registration.trajectory.camera: _observations(registration, scene)
        for registration in inputs.registrations
        if registration.trajectory.gauge == scene.gauge
    }
    if not observations:
        return ""
    column_of_point = _order_by_first_observation(list(observations.values()), len(scene.points))
    total_frames = sum(len(registration.trajectory.status) for registration in inputs.registrations)
    parts, top = [], _TOP
    for name, (frames, points) in observations.items():
        registration = inputs.registration(name)
        assert registration is not None
        frame_count = len(registration.trajectory.status)
        height = max(_MIN_BAND_HEIGHT, frame_count / total_frames * _MAX_ROWS)
        pixels = (max(1, round(height * detail**0.5)), max(1, round(_MAX_COLUMNS * detail**0.5)))
        size = (frame_count, len(scene.points))
        image = _encode_matrix(frames, column_of_point[points], size, pixels, colours[name])
        parts.append(_draw_band(name, image, top, height, colours[name]))
        parts.append(_draw_keyframe_rows(scene, name, frame_count, top, height))
        top += height + _BAND_MARGIN
    title = (
        f"Camera-landmark matrix: {len(scene.points):,} landmarks in the order of their first observation, "
        f"frames of {', '.join(observations)} from top to bottom"
    )
    head = text(
        _LEFT,
        13.0,
        f"landmarks 1 … {len(scene.points):,}, in the order of their first observation",
        class_="tick",
    )
    return svg_image(_WIDTH, top + 4.0, head + "".join(parts), title, class_="matrix")


def _observations(registration: Registration, scene: Map) -> tuple[IntArray, IntArray]:
    """Return the frame indices (N,) and the point indices (N,) of a camera's observations.

    These are the observations of tracked features in all frames, and the map's observations in keyframes.
    """
    camera = registration.trajectory.camera
    tracked = scene.points_of(camera, registration.obs_keyframe, registration.obs_feature)
    of_keyframes = np.isin(scene.obs_keyframe, scene.keyframes_of(camera))
    frames = np.concatenate([registration.obs_frame, scene.keyframe_frame[scene.obs_keyframe[of_keyframes]]])
    points = np.concatenate([tracked, scene.obs_point[of_keyframes]])
    in_map = points != _NO_POINT
    return frames[in_map], points[in_map]


def _order_by_first_observation(observations: list[tuple[IntArray, IntArray]], count: int) -> IntArray:
    """Return the matrix column (P,) of each point.

    Points are sorted by the first camera that observes the point, then by the first frame of this camera that
    observes the point.

    Args:
        observations: Frame indices and point indices of the observations of each camera.
        count: Number of points P.
    """
    key = np.full(count, np.iinfo(np.int64).max)
    for index, (frames, points) in reversed(list(enumerate(observations))):
        first = np.full(count, np.iinfo(np.int64).max)
        np.minimum.at(first, points, frames + (index << 40))
        key = np.minimum(key, first)
    column = np.empty(count, dtype=np.int64)
    column[np.argsort(key, kind="stable")] = np.arange(count)
    return column


def _encode_matrix(
    frames: IntArray, columns: IntArray, size: tuple[int, int], pixels: tuple[int, int], colour: str
) -> str:
    """Return the matrix of one camera as a PNG image in base64.

    A pixel can represent several entries of the matrix. The pixel's opacity shows the fraction of these
    entries that are observations.

    Args:
        frames: (N,) frame index of each observation.
        columns: (N,) matrix column of each observation.
        size: Number of frames and number of landmarks.
        pixels: Maximum height and maximum width of the image, pixels.
        colour: Colour of the camera, ``#rrggbb``.
    """
    import cv2

    rows_px, columns_px = min(pixels[0], size[0]), min(pixels[1], size[1])
    row = (frames * rows_px // max(size[0], 1)).astype(np.int64)
    column = (columns * columns_px // max(size[1], 1)).astype(np.int64)
    counts = np.bincount(row * columns_px + column, minlength=rows_px * columns_px)
    entries_per_pixel = (size[0] / rows_px) * (size[1] / columns_px)
    fill = np.sqrt(np.clip(counts / max(entries_per_pixel, 1.0), 0.0, 1.0)).reshape(rows_px, columns_px)
    image = np.zeros((rows_px, columns_px, 4), np.uint8)
    image[..., :3] = [int(colour[i : i + 2], 16) for i in (5, 3, 1)]
    image[..., 3] = np.where(fill > 0, 40 + 215 * fill, 0).astype(np.uint8)
    _, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    return base64.b64encode(encoded.tobytes()).decode("ascii")


def _draw_band(name: str, image: str, top: float, height: float, colour: str) -> str:
    width = _WIDTH - _LEFT - _RIGHT
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
            element("rect", x=_LEFT - 4.0, y=top, width=3.0, height=height, fill=colour),
            text(_LEFT - 14.0, top + 14.0, name, class_="label", text_anchor="end"),
            text(_LEFT - 14.0, top + 28.0, "frames ↓", class_="tick", text_anchor="end"),
        )
    )


def _draw_keyframe_rows(scene: Map, name: str, frame_count: int, top: float, height: float) -> str:
    """Draw a faint horizontal line across a camera's band at each keyframe."""
    keyframes = scene.keyframe_frame[scene.keyframes_of(name)]
    rows = top + (keyframes + 0.5) / max(frame_count, 1) * height
    right = number(_WIDTH - _RIGHT)
    path = "".join(f"M{number(_LEFT)} {number(y)}H{right}" for y in np.unique(rows.round(1)))
    return element("path", class_="keyrow", d=path) if path else ""
