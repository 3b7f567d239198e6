"""Stage 1: keyframes by rotation-free parallax, track survival and sharpness."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera, FrameCandidate, FrameKeeper
from bodycap_batch.config import KeyframeOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import (
    GreyImage,
    Pixels,
    detect_corners,
    fit_rotation,
    make_coarse_image,
    pixel_scale,
    sharpness,
    track_points,
    unit_directions,
)
from bodycap_batch.model.scene import KeyframeSelection

_CORNERS = 120
_CORNER_SPACING_PX = 12.0
_WINDOW_PX = 11
_MIN_TRACKS = 12
_PASSING = 0.05
"""What the mere passing of `max_gap_s` counts for beside what is seen, where a budget has to choose."""
_NOISE_SAMPLES = 20_000


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A recent frame that may still become a keyframe."""

    index: int
    image: GreyImage
    sharpness: float
    survival: float
    shot: FrameCandidate


@dataclass(slots=True)
class _Tracker:
    """Tracks from the last keyframe to the newest frame, followed in reduced images.

    Their noise there is small beside a keyframe's parallax, and they cost a quarter.
    """

    camera: Camera
    mask: BoolArray | None = None
    start_rays: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    px: Pixels = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    image: GreyImage | None = None
    started: int = 0
    round_trips: list[Pixels] = field(default_factory=list)
    kept_samples: int = 0

    def restart(self, image: GreyImage) -> None:
        """Begin at a new keyframe."""
        spacing = _CORNER_SPACING_PX * pixel_scale(image.shape[1], image.shape[0])
        self.px = detect_corners(image, _CORNERS, spacing, self.mask)
        self.image = image
        self.start_rays = self._rays()
        self.started = len(self.px)

    def step(self, image: GreyImage) -> None:
        """Follow the tracks into the next frame."""
        before = image if self.image is None else self.image
        flow = track_points(before, image, self.px, window_px=_WINDOW_PX)
        self.px, self.start_rays = flow.px[flow.ok], self.start_rays[flow.ok]
        if self.kept_samples < _NOISE_SAMPLES:
            self.round_trips.append(flow.round_trip_px[flow.ok] * self._enlarged(image))
            self.kept_samples += int(flow.ok.sum())
        self.image = image

    def _enlarged(self, image: GreyImage) -> float:
        return float(self.camera.width_px / image.shape[1])

    def _rays(self) -> FloatArray:
        if self.image is None:
            return np.zeros((0, 3))
        return unit_directions(self.camera.unproject(self.px.astype(np.float64) * self._enlarged(self.image)))

    def survival(self) -> float:
        """Share of the keyframe's corners still tracked."""
        return len(self.px) / self.started if self.started else 0.0

    def parallax_px(self) -> float:
        """Median displacement that no rotation explains, in pixels at the image centre."""
        if len(self.px) < _MIN_TRACKS:
            return 0.0
        rays = self._rays()
        usable = np.isfinite(rays).all(axis=1) & np.isfinite(self.start_rays).all(axis=1)
        if usable.sum() < _MIN_TRACKS:
            return 0.0
        first, second = self.start_rays[usable], rays[usable]
        rotation = fit_rotation(first, second, iterations=3)
        return float(np.median(np.linalg.norm(second - first @ rotation.T, axis=1))) * self.camera.focal_px

    def noise_px(self) -> float:
        """One standard deviation, per axis, of a single track step."""
        if not self.kept_samples:
            return 0.0
        # A Rayleigh variable's median is 1.177 σ; the round trip adds two steps' noise.
        return float(np.median(np.concatenate(self.round_trips)) / (1.177 * np.sqrt(2.0)))


def select_keyframes(
    camera: CaptureCamera,
    options: KeyframeOptions,
    context: StageContext,
    keeper: FrameKeeper | None = None,
) -> KeyframeSelection:
    """Choose the frames of one camera that the map is built from.

    A keyframe is due once the scene moved by `parallax_px` beyond what a rotation explains, too few
    tracks survive, or `max_gap_s` has passed; the sharpest of the last frames is then taken.

    Args:
        camera: The camera's video, calibrated.
        options: Thresholds; pixels are for a 640 px long side.
        context: Progress and cancellation.
        keeper: Where given, it is shown every frame and those that are chosen.

    Raises:
        CaptureError: The camera has no frames.
    """
    times_s = (camera.times_ns - camera.times_ns[:1]) * 1e-9
    count = len(times_s)
    if count == 0:
        raise CaptureError("no frames to work on", path=camera.chapters[0], hint="check start_s and end_s")
    limit_px = options.parallax_px * pixel_scale(camera.camera.width_px, camera.camera.height_px)
    sharp = np.zeros(count)
    chosen: list[int] = []
    novelty = [0.0]
    tracker = _Tracker(camera.camera, _coarse_mask(camera))
    recent: deque[_Candidate] = deque(maxlen=options.window)
    see, keep = (_no_keeping, _no_keeping) if keeper is None else (keeper.add_frame, keeper.add_keyframe)
    for shot in camera.frame_candidates():
        context.check_cancelled()
        index = shot.index
        sharp[index] = sharpness(shot.grey)
        image = make_coarse_image(shot.grey)
        see(shot)
        if not chosen:
            chosen.append(index)
            keep(shot)
            tracker.restart(image)
        else:
            tracker.step(image)
            recent.append(_Candidate(index, image, sharp[index], tracker.survival(), shot))
            gap_s = times_s[index] - times_s[chosen[-1]]
            if _is_due(tracker, gap_s, limit_px, options):
                seen = max(1.0 - tracker.survival(), tracker.parallax_px() / limit_px)
                novelty.append(seen + _PASSING * gap_s / options.max_gap_s)
                best = _take_sharpest(recent, tracker)
                chosen.append(best.index)
                keep(best.shot)
        if index % 30 == 0:
            context.progress(index, count, "frames")
    if chosen[-1] != count - 1:
        chosen.append(count - 1)
        keep(shot)
        novelty.append(0.0)
    context.progress(count, count, "frames")
    if options.max_per_min is not None:
        minutes = (times_s[-1] - times_s[0]) / 60.0
        chosen = _within_budget(chosen, novelty, max(2, int(np.ceil(options.max_per_min * minutes))))
    return KeyframeSelection(
        camera=camera.name,
        frames=np.array(chosen, dtype=np.int64),
        frame_count=count,
        sharpness=sharp,
        noise_px=tracker.noise_px(),
    )


def _is_due(tracker: _Tracker, gap_s: float, limit_px: float, options: KeyframeOptions) -> bool:
    """Whether a keyframe is due after so much time since the last one."""
    return (
        gap_s >= options.max_gap_s
        or tracker.survival() < options.min_survival
        or (gap_s >= options.min_gap_s and tracker.parallax_px() > limit_px)
    )


def _within_budget(chosen: list[int], novelty: list[float], most: int) -> list[int]:
    """Leave out keyframes, never the first or last, until `most` are left.

    Args:
        chosen: Frame indices.
        novelty: How much each shows that the one before it did not; it adds up where one is left out.
        most: How many may stay.
    """
    kept, news = list(chosen), list(novelty)
    while len(kept) > max(2, most):
        step = [news[at] + news[at + 1] for at in range(1, len(kept) - 1)]
        least = int(np.argmin(step)) + 1
        news[least + 1] += news[least]
        del kept[least], news[least]
    return kept


def _coarse_mask(camera: CaptureCamera) -> BoolArray | None:
    if camera.mask is None:
        return None
    return np.asarray(make_coarse_image(np.where(camera.mask, 255, 0).astype(np.uint8)) > 127)


def _no_keeping(_: FrameCandidate) -> None:
    """Keep nothing."""


def _take_sharpest(recent: deque[_Candidate], tracker: _Tracker) -> _Candidate:
    """Pick the sharpest recent frame that still sees what the keyframe saw; restart the tracks there."""
    usable = [frame for frame in recent if frame.survival >= 0.5 * recent[0].survival]
    best = max(usable, key=lambda frame: frame.sharpness)
    tracker.restart(best.image)
    while recent and recent[0].index <= best.index:
        recent.popleft()
    for position, frame in enumerate(recent):
        tracker.step(frame.image)
        recent[position] = replace(frame, survival=tracker.survival())
    return best
