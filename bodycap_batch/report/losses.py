"""Why frames were lost: each stretch with what was measured in and around it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.pictures import Look
from bodycap_batch.report.placing import common_times_s

_FAST_DEG = 8.0
"""Turn from one frame to the next: optical flow loses most tracks above 20°, and blur begins far earlier."""
_PLAIN = 0.3
"""Corners over those of the camera's registered frames."""


class Cause(StrEnum):
    """What most likely lost a stretch, as far as it can be measured."""

    DARK = "too dark"
    FAST = "fast turn"
    BLUR = "motion blur"
    PLAIN = "plain surfaces"
    SHALLOW = "points too far away or too close together"
    UNKNOWN_PLACE = "what it saw is not in the map"
    NO_MAP = "no map to stand on"


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """A stretch of frames without a pose.

    Attributes:
        camera: Camera name.
        first: Index of its first frame.
        last: Index of its last frame.
        start_s: Common time of the first.
        end_s: Common time of the last.
        reason: The status most of its frames have.
        sharpness: Its median sharpness over the registered frames' median; NaN where unknown.
        turn_deg: Turn per frame beside it; NaN where no pair of neighbours is registered.
    """

    camera: str
    first: int
    last: int
    start_s: float
    end_s: float
    reason: FrameStatus
    sharpness: float
    turn_deg: float

    @property
    def frames(self) -> int:
        """How many."""
        return self.last - self.first + 1

    @property
    def middle(self) -> int:
        """The frame that stands for it."""
        return (self.first + self.last) // 2


def find_losses(inputs: ReportInputs) -> list[Loss]:
    """Every stretch of lost frames, camera by camera."""
    return [
        loss for registration in inputs.registrations for loss in _of_camera(inputs, registration.trajectory)
    ]


def cause_of(loss: Loss, look: Look | None, usual_corners: float | None) -> Cause:
    """The likeliest cause, from what was measured.

    Args:
        loss: The stretch.
        look: Its middle frame; None where it could not be decoded.
        usual_corners: Corners in this camera's registered frames; None where there are none to compare.
    """
    if loss.reason is FrameStatus.NO_MAP:
        return Cause.NO_MAP
    if look is not None and look.dark:
        return Cause.DARK
    if loss.turn_deg > _FAST_DEG:
        return Cause.FAST
    if loss.reason is FrameStatus.BLUR:
        return Cause.BLUR
    if loss.reason is FrameStatus.UNCONSTRAINED:
        return Cause.SHALLOW
    if look is not None and usual_corners and look.corners < _PLAIN * usual_corners:
        return Cause.PLAIN
    return Cause.BLUR if loss.sharpness < BLUR_SHARPNESS_RATIO else Cause.UNKNOWN_PLACE


def turn_per_frame_deg(trajectory: Trajectory) -> FloatArray:
    """(N−1,) rotation from each frame to the next; NaN where one of them has no pose."""
    rotation, kept = trajectory.gauge_from_cam[:, :3, :3], trajectory.localised
    both = kept[:-1] & kept[1:]
    out = np.full(max(len(kept) - 1, 0), np.nan)
    step = np.swapaxes(rotation[:-1][both], -1, -2) @ rotation[1:][both]
    out[both] = np.degrees(rotation_angle_rad(step))
    return out


def frames_by_cause(causes: Mapping[Loss, Cause]) -> Counter[Cause]:
    """Lost frames of each cause, all cameras together."""
    counts: Counter[Cause] = Counter()
    for loss, cause in causes.items():
        counts[cause] += loss.frames
    return counts


def _of_camera(inputs: ReportInputs, path: Trajectory) -> Iterator[Loss]:
    lost = ~path.localised
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    times = common_times_s(inputs, path.camera, path.times_ns)
    selection = inputs.selection(path.camera)
    sharpness = None if selection is None or lost.all() else selection.sharpness
    usual = np.nan if sharpness is None else float(np.median(sharpness[~lost]))
    turns = turn_per_frame_deg(path)
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        beside = np.concatenate([turns[max(0, first - 3) : first], turns[stop - 1 : stop + 2]])
        beside = beside[np.isfinite(beside)]
        reasons = Counter(path.status[first:stop])
        yield Loss(
            camera=path.camera,
            first=int(first),
            last=int(stop - 1),
            start_s=float(times[first]),
            end_s=float(times[stop - 1]),
            reason=reasons.most_common(1)[0][0],
            sharpness=float(np.median(sharpness[first:stop])) / usual
            if sharpness is not None and usual > 0
            else float("nan"),
            turn_deg=float(beside.max()) if len(beside) else float("nan"),
        )
