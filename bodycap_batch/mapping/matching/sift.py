"""Extract SIFT features of keyframes in several threads while the next frames are decoded."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.matching.descriptors import DESCRIPTOR_NORM
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX

_DETECTION_SCALE = 0.6
"""Scale of the reduced image in which features are detected, relative to the frame. OpenCV's detector first
doubles the size of the reduced image. Detection in the reduced image takes half the time of detection in the
full frame, and the map has the same accuracy. Evidence: docs/decisions/mapping.md."""
_MIN_LONG_SIDE_PX = 384
"""Minimum long side (px) of the reduced image in which features are detected. A smaller frame is not reduced.
Evidence: none."""
_CONTRAST_THRESHOLD = 0.02
"""Contrast threshold of the detector. It is half of OpenCV's default, because blurred walls and ceilings
have little contrast. Evidence: docs/decisions/mapping.md."""

_MASK_SURPLUS = 3
"""Number of features that are detected for each feature that is kept, if a part of the picture is left out.
Many of them lie there: the hand beside a wrist camera has most of the texture. Evidence:
docs/decisions/tracks.md."""
_POOR_RATIO = 0.5
"""Fraction of the maximum number of features below which a frame is poor in features. Features of such a
frame are detected again in the full frame, with `_POOR_CONTRAST_THRESHOLD`. Evidence:
docs/decisions/mapping.md."""
_POOR_CONTRAST_THRESHOLD = 0.01
"""Contrast threshold of the second detection. Evidence: docs/decisions/mapping.md."""


@dataclass(frozen=True, slots=True)
class SiftFeatures:
    """The features of one image.

    Attributes:
        keypoints: (N,4) x and y (px, COLMAP's origin), scale (px) and orientation (rad) of each keypoint.
        descriptors: (N,128) root-normalised descriptor of each keypoint.
        rgb: (N,3) colour of the image at each keypoint, 0 to 255.
    """

    keypoints: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8]


def extract_features(
    camera: CaptureCamera, frames: IntArray, count: int, context: StageContext
) -> Iterator[tuple[int, SiftFeatures]]:
    """Yield the index and the features of each frame, in frame order.

    Args:
        camera: Camera whose frames are read. Features outside the camera's mask are removed.
        frames: (K,) frame indices, increasing.
        count: Maximum number of features of a frame.
        context: Threads and cancellation.
    """
    import cv2

    detectors = [
        cv2.SIFT.create(
            count * (1 if camera.shows_only_room else _MASK_SURPLUS),
            contrastThreshold=_CONTRAST_THRESHOLD,
            enable_precise_upscale=True,
        )
        for _ in range(context.threads)
    ]
    if context.threads == 1:
        for index, rgb in camera.read(frames, colour=True):
            context.check_cancelled()
            yield index, _detect_features(detectors[0], camera, (index, rgb), count)
        return
    free: SimpleQueue[Any] = SimpleQueue()
    for detector in detectors:
        free.put(detector)

    def work(frame: tuple[int, npt.NDArray[np.uint8]]) -> SiftFeatures:
        detector = free.get()
        try:
            return _detect_features(detector, camera, frame, count)
        finally:
            free.put(detector)

    with ThreadPoolExecutor(context.threads) as pool:
        waiting: deque[tuple[int, Future[SiftFeatures]]] = deque()
        for index, rgb in camera.read(frames, colour=True):
            context.check_cancelled()
            waiting.append((index, pool.submit(work, (index, rgb))))
            if len(waiting) > 2 * context.threads:
                frame, job = waiting.popleft()
                yield frame, job.result()
        for frame, job in waiting:
            yield frame, job.result()


def _detect_features(
    detector: Any, camera: CaptureCamera, frame: tuple[int, npt.NDArray[np.uint8]], requested: int
) -> SiftFeatures:
    """Return the features of one frame, index and RGB image (H,W,3), that lie where the room is visible.

    Features are detected in a reduced image. If there are few, for example on a bare ceiling, they are
    detected in the full frame. At most `requested` features are returned, the strongest ones.
    """
    import cv2

    index, rgb = frame
    height, width = rgb.shape[:2]
    shrink = min(1.0, max(_DETECTION_SCALE, _MIN_LONG_SIDE_PX / max(height, width)))
    size = (round(width * shrink), round(height * shrink))
    whole = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    found, raw = detector.detectAndCompute(grey, None)
    count = detector.getNFeatures()
    if len(found) < _POOR_RATIO * requested and is_on(Mechanism.SECOND_DETECTION):
        record_act(Mechanism.SECOND_DETECTION)
        sensitive = cv2.SIFT.create(
            count, contrastThreshold=_POOR_CONTRAST_THRESHOLD, enable_precise_upscale=True
        )
        size, (found, raw) = (width, height), sensitive.detectAndCompute(whole, None)
    if not found:
        return SiftFeatures(
            np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.uint8)
        )
    scale = np.array([width / size[0], height / size[1]])
    pixels = (np.array([keypoint.pt for keypoint in found]) + CV2_PIXEL_OFFSET_PX) * scale
    shape = np.array([(keypoint.size * scale[0] / 2.0, np.radians(keypoint.angle)) for keypoint in found])
    keypoints = np.column_stack([pixels, shape]).astype(np.float32)
    keep = camera.is_unmasked(keypoints[:, :2], index)
    if keep.sum() > requested:
        response = np.where(keep, [keypoint.response for keypoint in found], -np.inf)
        keep[np.argsort(-response, kind="stable")[requested:]] = False
    keypoints = keypoints[keep]
    column = np.clip(keypoints[:, 0].astype(int), 0, width - 1)
    row = np.clip(keypoints[:, 1].astype(int), 0, height - 1)
    return SiftFeatures(keypoints, _root_sift(raw[keep]), rgb[row, column])


def _root_sift(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Normalise raw descriptors (N,128) to a sum of 1, and return their square roots as bytes.

    Source: Arandjelović, Zisserman, "Three things everyone should know to improve object
        retrieval", CVPR 2012.
    """
    normalised = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    return np.asarray(np.clip(np.round(DESCRIPTOR_NORM * np.sqrt(normalised)), 0, 255), dtype=np.uint8)
