"""Stage 1: select keyframes. The criteria are parallax, the fraction of surviving tracks, and sharpness."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera, FrameCandidate, FrameKeeper
from bodycap_batch.capture.video import COPY_AGAIN
from bodycap_batch.config import KeyframeOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.copied_frames import find_pictures
from bodycap_batch.model.frame_matches import FrameMatcher
from bodycap_batch.model.frozen_frames import find_frozen_frames, picture_change_px
from bodycap_batch.model.optical_flow import (
    GreyImage,
    Pixels,
    detect_corners,
    fit_rotation,
    make_coarse_image,
    pixel_scale,
    track_points,
    unit_directions,
)
from bodycap_batch.model.scene import KeyframeSelection
from bodycap_batch.model.sharpness import sharpness

_CORNERS = 120
"""Maximum number of corners that are tracked from each keyframe. Evidence: none."""
_CORNER_SPACING_PX = 12.0
"""Minimum distance between two corners, in px of an image with a long side of 640 px. Evidence: none."""
_WINDOW_PX = 11
"""Width of the tracker's window, px of the reduced image. Evidence: none."""
_MIN_TRACKS = 12
"""Minimum number of tracks for a parallax. With fewer tracks, the parallax is 0. Evidence: none."""
_ROTATION_ROUNDS = 3
"""Number of rounds of the robust rotation fit. Evidence: none."""
_NOVELTY_PER_MAX_GAP = 0.05
"""Novelty that is added to a keyframe's novelty if the time since the previous keyframe is `max_gap_s`. The
added novelty is proportional to this time. So if two keyframes have equally little new content, the keyframe
after the longer time is kept. Unit: 1. Evidence: none."""
_MIN_RELATIVE_SURVIVAL = 0.5
"""Minimum ratio of a candidate's track survival to the oldest candidate's track survival. A candidate with a
smaller ratio is not selected as keyframe. Evidence: none."""
_NOISE_SAMPLES = 20_000
"""Approximate number of samples from which the tracking noise is estimated. Each sample is one corner tracked
forward and backward. More samples do not change the estimate."""
_MIN_NOISE_CHANGE_PX = 0.1
"""Minimum change of a picture, px of the reduced image, for a sample of the tracking noise. In a copy of the
picture, points are tracked without error. Evidence: docs/decisions/keyframes.md."""
_RAYLEIGH_MEDIAN = 1.177
"""Ratio of the median of a Rayleigh distribution to its scale parameter sigma: sqrt(2 ln 2)."""


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A recent frame that may be selected as the next keyframe.

    Attributes:
        index: Frame index.
        image: The reduced image of the frame.
        sharpness: Sharpness of the frame, arbitrary unit.
        survival: Fraction of the last keyframe's corners that are still tracked in the frame.
        shot: The frame as it was read from the video.
    """

    index: int
    image: GreyImage
    sharpness: float
    survival: float
    shot: FrameCandidate


@dataclass(slots=True)
class _KeyframeTracker:
    """Tracks corners from the last keyframe to the newest frame, in reduced images.

    Reduced images (`make_coarse_image`) are smaller copies of the frames. Tracking in reduced images needs a
    quarter of the time of tracking in full images. The tracking noise in reduced images is small compared
    with the parallax of a keyframe.

    Attributes:
        camera: Intrinsics of the full image.
        mask: (H,W) True for each pixel of the reduced image that shows the room; None: every pixel shows the
            room.
        start_rays: (N,3) unit directions of the tracked corners in the last keyframe.
        px: (N,2) positions of the tracked corners in the newest frame, px of the reduced image.
        image: The reduced image of the newest frame.
        started: Number of corners that were detected in the last keyframe.
        round_trips: Distances (px of the full image) between the position of each corner and its position
            after forward and backward tracking; one array for each step.
        kept_samples: Total number of distances in `round_trips`.
        start_px: (N,2) positions of the tracked corners in the last keyframe, px of the reduced image.
        change_px: Change of the picture in the last step, px of the reduced image; NaN if it is unknown.
        shift_px: Median displacement of the corners in the last step, px of the reduced image; NaN if it is
            unknown.
        largest_shift_px: Largest median displacement of the corners since a keyframe, px of the reduced
            image.
    """

    camera: Camera
    mask: BoolArray | None = None
    start_rays: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    px: Pixels = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    image: GreyImage | None = None
    started: int = 0
    round_trips: list[Pixels] = field(default_factory=list)
    kept_samples: int = 0
    start_px: Pixels = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    change_px: float = float("nan")
    shift_px: float = float("nan")
    largest_shift_px: float = 0.0

    def restart(self, image: GreyImage) -> None:
        """Remove all tracks, and detect the corners of a new keyframe."""
        spacing = _CORNER_SPACING_PX * pixel_scale(image.shape[1], image.shape[0])
        self.px = detect_corners(image, _CORNERS, spacing, self.mask)
        self.image = image
        self.start_rays = self._rays()
        self.started = len(self.px)
        self.start_px = self.px

    def step(self, image: GreyImage) -> tuple[Pixels, Pixels]:
        """Track the corners into the next frame.

        Returns:
            Positions (M,2) of the tracked corners before and after this step, px of the reduced image.
        """
        before = image if self.image is None else self.image
        flow = track_points(before, image, self.px, window_px=_WINDOW_PX)
        self.change_px = picture_change_px(before, image)
        self.shift_px = _median_distance(self.px[flow.ok], flow.px[flow.ok])
        tracked = self.px[flow.ok], flow.px[flow.ok]
        self.px, self.start_rays = flow.px[flow.ok], self.start_rays[flow.ok]
        self.start_px = self.start_px[flow.ok]
        since_keyframe = _median_distance(self.start_px, self.px)
        # Without corners that are still tracked, the picture has changed.
        self.largest_shift_px = max(
            self.largest_shift_px, since_keyframe if np.isfinite(since_keyframe) else np.inf
        )
        is_copy = bool(self.round_trips) and self.change_px < _MIN_NOISE_CHANGE_PX
        if self.kept_samples < _NOISE_SAMPLES and not is_copy:
            self.round_trips.append(flow.round_trip_px[flow.ok] * self._full_scale(image))
            self.kept_samples += int(flow.ok.sum())
        self.image = image
        return tracked

    def _full_scale(self, image: GreyImage) -> float:
        """Return the ratio of the full image's width to the reduced image's width."""
        return float(self.camera.width_px / image.shape[1])

    def _rays(self) -> FloatArray:
        """Return the unit directions (N,3) of the tracked corners in the newest frame."""
        if self.image is None:
            return np.zeros((0, 3))
        return unit_directions(
            self.camera.unproject(self.px.astype(np.float64) * self._full_scale(self.image))
        )

    def survival(self) -> float:
        """Return the fraction of the last keyframe's corners that are still tracked."""
        return len(self.px) / self.started if self.started else 0.0

    def parallax_px(self) -> float:
        """Return the parallax since the last keyframe, px at the image centre.

        The parallax is the median displacement of the corners after the best rotation is removed.
        """
        if len(self.px) < _MIN_TRACKS:
            return 0.0
        rays = self._rays()
        usable = np.isfinite(rays).all(axis=1) & np.isfinite(self.start_rays).all(axis=1)
        if usable.sum() < _MIN_TRACKS:
            return 0.0
        first, second = self.start_rays[usable], rays[usable]
        rotation = fit_rotation(first, second, iterations=_ROTATION_ROUNDS)
        return float(np.median(np.linalg.norm(second - first @ rotation.T, axis=1))) * self.camera.focal_px

    def motion_px(self) -> float:
        """Return the largest motion of the picture since a keyframe, px at a long side of 640 px."""
        if self.image is None:
            return 0.0
        height, width = self.image.shape[:2]
        return self.largest_shift_px / pixel_scale(width, height)

    def noise_px(self) -> float:
        """Return the tracking noise: the standard deviation along an image axis, px of the full image.

        The noise is the error of a corner's position after one tracking step, from one frame to the next. The
        result is 0 if no corner was tracked.
        """
        if not self.kept_samples:
            return 0.0
        # The distance after forward and backward tracking has a Rayleigh distribution. The distance contains
        # the noise of two steps (forward and backward), so the result is divided by sqrt(2).
        return float(np.median(np.concatenate(self.round_trips)) / (_RAYLEIGH_MEDIAN * np.sqrt(2.0)))


def select_keyframes(
    camera: CaptureCamera,
    options: KeyframeOptions,
    context: StageContext,
    keeper: FrameKeeper | None = None,
    *,
    with_matches: bool = False,
) -> KeyframeSelection:
    """Select the keyframes of one camera: the frames from which the map is built.

    The parallax is the image motion that no rotation of the camera explains. A keyframe is due if the time
    since the last keyframe reaches `max_gap_s`, or if too few tracks survive, or if the parallax exceeds
    `parallax_px` after at least `min_gap_s`. If a keyframe is due, the sharpest of the last frames is
    selected.

    Args:
        camera: The camera with its video.
        options: Thresholds. Thresholds in pixels are for an image with a long side of 640 px.
        context: Progress and cancellation.
        keeper: Writes copies of frames. Every frame and every keyframe are passed to the keeper. None: no
            copies are written.
        with_matches: True to match adjacent frames also if the camera has a global shutter.

    Returns:
        The frame indices of the keyframes, the sharpness of every frame, the tracking noise and the damaged
        frames. Damaged frames are not selected. If the video has copies of frames, the indices count the
        other frames only, which are listed in `pictures`.

    Raises:
        CaptureError: The camera has no frames, or all its frames are damaged.
    """
    times_s = (camera.times_ns - camera.times_ns[:1]) * 1e-9
    count = len(times_s)
    if count == 0:
        raise CaptureError(
            "the camera has no frames between start_s and end_s",
            path=camera.chapters[0],
            hint="check start_s and end_s",
        )
    limit_px = options.parallax_px * pixel_scale(camera.camera.width_px, camera.camera.height_px)
    sharp, change_px, shift_px = np.zeros(count), np.full(count, np.nan), np.full(count, np.nan)
    selected, novelty = list[int](), [0.0]
    tracker = _KeyframeTracker(camera.camera, _coarse_mask(camera))
    matcher = _frame_matcher(camera, tracker.mask, with_matches=with_matches)
    recent: deque[_Candidate] = deque(maxlen=options.window)
    see, keep = (_ignore, _ignore) if keeper is None else (keeper.add_frame, keeper.add_keyframe)
    is_damaged = np.ones(count, dtype=bool)
    for shot in camera.frame_candidates():
        context.check_cancelled()
        index = shot.index
        is_damaged[index] = False
        sharp[index] = sharpness(shot.grey)
        image = make_coarse_image(shot.grey)
        see(shot)
        matcher.add(index, image, tracker.step(image) if selected else None)
        if not selected:
            selected.append(index)
            keep(shot)
            tracker.restart(image)
        else:
            change_px[index], shift_px[index] = tracker.change_px, tracker.shift_px
            recent.append(_Candidate(index, image, sharp[index], tracker.survival(), shot))
            gap_s = times_s[index] - times_s[selected[-1]]
            if _is_due(tracker, gap_s, limit_px, options):
                change = max(1.0 - tracker.survival(), tracker.parallax_px() / limit_px)
                novelty.append(change + _NOVELTY_PER_MAX_GAP * gap_s / options.max_gap_s)
                best = _restart_at_sharpest(recent, tracker)
                selected.append(best.index)
                keep(best.shot)
        if index % 30 == 0:
            context.progress(index, count, "frames")
    if is_damaged.all():
        raise CaptureError(
            f"none of the {count} frames can be decoded without errors",
            path=camera.chapters[0],
            hint=COPY_AGAIN,
        )
    frozen = find_frozen_frames(change_px, shift_px, np.asarray(times_s, dtype=np.float64))
    if frozen.any():
        selected, novelty = _without_frozen(selected, novelty, frozen | is_damaged)
    elif selected[-1] != shot.index:
        selected.append(shot.index)
        keep(shot)
        novelty.append(0.0)
    context.progress(count, count, "frames")
    if options.max_per_min is not None:
        minutes = (times_s[-1] - times_s[0]) / 60.0
        selected = _limit_keyframes(selected, novelty, max(2, int(np.ceil(options.max_per_min * minutes))))
    return KeyframeSelection(
        camera=camera.name,
        frames=np.array(selected, dtype=np.int64),
        frame_count=count,
        sharpness=sharp,
        noise_px=tracker.noise_px(),
        damaged=np.flatnonzero(is_damaged),
        frozen=frozen,
        motion_px=tracker.motion_px(),
        matches=matcher.matches(),
    ).only(find_pictures(change_px, shift_px, camera.times_ns))


def _frame_matcher(camera: CaptureCamera, mask: BoolArray | None, *, with_matches: bool) -> FrameMatcher:
    """Return the matcher of adjacent frames.

    It does nothing for a camera with a stated global shutter, unless matches are requested.
    """
    is_rolling = bool(camera.rolling_shutter_s) or not camera.rolling_shutter_known
    return FrameMatcher(camera.name, camera.camera.width_px, mask, enabled=is_rolling or with_matches)


def _without_frozen(
    selected: list[int], novelty: list[float], unusable: BoolArray
) -> tuple[list[int], list[float]]:
    """Replace each keyframe in a frozen part by the first frame with the same picture.

    The last usable frame becomes a keyframe, too.

    Args:
        selected: Frame indices of the keyframes.
        novelty: Novelty of each keyframe.
        unusable: (N,) True for each repetition of an earlier picture, and for each damaged frame.

    Returns:
        Frame indices of the keyframes, and their novelty.
    """
    measured = np.flatnonzero(~unusable)
    originals = measured[np.searchsorted(measured, selected, side="right") - 1].tolist()
    kept: dict[int, float] = {}
    for frame, value in zip([*originals, int(measured[-1])], [*novelty, 0.0], strict=True):
        kept.setdefault(frame, value)
    return list(kept), list(kept.values())


def _is_due(tracker: _KeyframeTracker, gap_s: float, limit_px: float, options: KeyframeOptions) -> bool:
    """Return whether a keyframe is due.

    Args:
        tracker: Tracks from the last keyframe to the newest frame.
        gap_s: Time since the last keyframe, seconds.
        limit_px: Threshold of the parallax, px of the full image. With a larger parallax, a keyframe is due
            after `min_gap_s`.
        options: Thresholds of the times and of the track survival.
    """
    return (
        gap_s >= options.max_gap_s
        or tracker.survival() < options.min_survival
        or (gap_s >= options.min_gap_s and tracker.parallax_px() > limit_px)
    )


def _limit_keyframes(selected: list[int], novelty: list[float], limit: int) -> list[int]:
    """Remove the least novel keyframes until `limit` keyframes are left.

    The first and the last keyframe are always kept. For every other keyframe, a sum is computed: its novelty
    plus the novelty of the next keyframe. In each step, the keyframe with the smallest sum is removed, and
    the novelty of the removed keyframe is added to the novelty of the next keyframe.

    Args:
        selected: Frame indices of the keyframes.
        novelty: Novelty of each keyframe: a measure of the content that the previous keyframe does not show.
        limit: Maximum number of keyframes.

    Returns:
        Frame indices of the remaining keyframes.
    """
    kept, remaining = list(selected), list(novelty)
    while len(kept) > max(2, limit):
        combined = [remaining[at] + remaining[at + 1] for at in range(1, len(kept) - 1)]
        least = int(np.argmin(combined)) + 1
        remaining[least + 1] += remaining[least]
        del kept[least], remaining[least]
    return kept


def _coarse_mask(camera: CaptureCamera) -> BoolArray | None:
    """Return the camera's mask at the size of the reduced images; None if the camera has no mask."""
    if camera.mask is None:
        return None
    return np.asarray(make_coarse_image(np.where(camera.mask, 255, 0).astype(np.uint8)) > 127)


def _median_distance(before: Pixels, after: Pixels) -> float:
    """Return the median distance between two positions (N,2) of each corner; NaN for too few corners."""
    if len(after) < _MIN_TRACKS:
        return float("nan")
    return float(np.median(np.linalg.norm(after - before, axis=1)))


def _ignore(_: FrameCandidate) -> None:
    """Do nothing."""


def _restart_at_sharpest(recent: deque[_Candidate], tracker: _KeyframeTracker) -> _Candidate:
    """Return the sharpest candidate that still overlaps with the last keyframe, and restart tracking there.

    Args:
        recent: Candidates in time order. The returned candidate and all earlier candidates are removed.
        tracker: Tracker that is restarted at the returned candidate, then advanced to the newest frame.
    """
    usable = [frame for frame in recent if frame.survival >= _MIN_RELATIVE_SURVIVAL * recent[0].survival]
    best = max(usable, key=lambda frame: frame.sharpness)
    tracker.restart(best.image)
    while recent and recent[0].index <= best.index:
        recent.popleft()
    for position, frame in enumerate(recent):
        tracker.step(frame.image)
        recent[position] = replace(frame, survival=tracker.survival())
    return best
