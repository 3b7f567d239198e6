"""SIFT features of keyframes, found side by side while the next frames decode."""

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
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX

_DETECTION_SCALE = 0.6
"""OpenCV's detector starts on the image at twice its size. On 0.6 of it, 1.2 times the frame, it takes
half the time of a detector on the frame's own pixels, and the map's keyframes are as exact (walk12 0.55 and
0.51 cm, room12 0.69 and 0.69); on 0.5 walk12 goes to 0.9."""
_MIN_LONG_SIDE_PX = 384
"""Long side below which an image is not shrunk further."""
_CONTRAST_THRESHOLD = 0.02
"""Half of OpenCV's: blurred walls and ceilings have little else (room12 0.84 cm with the usual 0.04). The
strongest 512 of what is found make as exact a map (keyframes of walk12 0.49 and 0.55 cm, room12 0.70 and
0.69, tum_fr1_xyz 0.87 and 0.84), at half the matching."""
_NORM = 512.0


@dataclass(frozen=True, slots=True)
class SiftFeatures:
    """One image's features.

    Attributes:
        keypoints: (N,4) float32: x, y (COLMAP's origin), scale, orientation (rad).
        descriptors: (N,128) uint8, root-normalised.
        rgb: (N,3) uint8 colour at each.
    """

    keypoints: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]
    rgb: npt.NDArray[np.uint8]


def extract_features(
    camera: CaptureCamera, frames: IntArray, count: int, context: StageContext
) -> Iterator[tuple[int, SiftFeatures]]:
    """Yield (frame, features) in frame order, at most `count` features a frame, none where a mask says so."""
    import cv2

    detectors = [
        cv2.SIFT.create(count, contrastThreshold=_CONTRAST_THRESHOLD, enable_precise_upscale=True)
        for _ in range(context.threads)
    ]
    if context.threads == 1:
        for index, rgb in camera.read(frames, colour=True):
            context.check_cancelled()
            yield index, _detect_features(detectors[0], camera, rgb)
        return
    free: SimpleQueue[Any] = SimpleQueue()
    for detector in detectors:
        free.put(detector)

    def work(rgb: npt.NDArray[np.uint8]) -> SiftFeatures:
        detector = free.get()
        try:
            return _detect_features(detector, camera, rgb)
        finally:
            free.put(detector)

    with ThreadPoolExecutor(context.threads) as pool:
        waiting: deque[tuple[int, Future[SiftFeatures]]] = deque()
        for index, rgb in camera.read(frames, colour=True):
            context.check_cancelled()
            waiting.append((index, pool.submit(work, rgb)))
            if len(waiting) > 2 * context.threads:
                frame, job = waiting.popleft()
                yield frame, job.result()
        for frame, job in waiting:
            yield frame, job.result()


def _detect_features(detector: Any, camera: CaptureCamera, rgb: npt.NDArray[np.uint8]) -> SiftFeatures:
    import cv2

    height, width = rgb.shape[:2]
    shrink = min(1.0, max(_DETECTION_SCALE, _MIN_LONG_SIDE_PX / max(height, width)))
    size = (round(width * shrink), round(height * shrink))
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    found, raw = detector.detectAndCompute(grey, None)
    if not found:
        return SiftFeatures(
            np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.uint8)
        )
    scale = np.array([width / size[0], height / size[1]])
    pixels = (np.array([each.pt for each in found]) + CV2_PIXEL_OFFSET_PX) * scale
    shape = np.array([(each.size * scale[0] / 2.0, np.radians(each.angle)) for each in found])
    keypoints = np.column_stack([pixels, shape]).astype(np.float32)
    keep = (
        camera.is_unmasked(keypoints[:, :2]) if camera.mask is not None else np.ones(len(found), dtype=bool)
    )
    keypoints = keypoints[keep]
    column = np.clip(keypoints[:, 0].astype(int), 0, width - 1)
    row = np.clip(keypoints[:, 1].astype(int), 0, height - 1)
    return SiftFeatures(keypoints, _root_sift(raw[keep]), rgb[row, column])


def _root_sift(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Square roots of descriptors that sum to one, as bytes of length 512.

    Source: Arandjelović, Zisserman, "Three things everyone should know to improve object
        retrieval", CVPR 2012.
    """
    share = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    return np.asarray(np.clip(np.round(_NORM * np.sqrt(share)), 0, 255), dtype=np.uint8)
