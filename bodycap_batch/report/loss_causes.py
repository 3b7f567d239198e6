"""The causes of lost frames: how each one is recognised, and what avoids it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.report.grades import Advice

if TYPE_CHECKING:
    from bodycap_batch.report.frame_pictures import FrameAppearance

DARK_BRIGHTNESS = 30.0
"""Minimum mean brightness (0 to 255) of a frame that is not treated as dark. Evidence: none."""
FAST_DEG = 8.0
"""Maximum rotation (degrees) between successive frames that is not treated as a fast turn.

Optical flow loses most tracks above 20 degrees. Motion blur starts at much smaller angles.
"""
PLAIN_RATIO = 0.3
"""Minimum ratio of a lost frame's number of corners to the usual number in the camera's registered frames.

A frame with fewer corners shows plain surfaces. Evidence: none.
"""
_MIN_LOST_SHARE = 0.02
"""Minimum fraction of all frames that a cause of losses must affect to give advice. Evidence: none."""
_MAX_SPANS = 3
"""Maximum number of lost spans of a camera that advice names, the longest ones. Evidence: none."""


class LossCause(StrEnum):
    """The likely cause of a lost interval, derived from measurements."""

    DARK = "too dark"
    FAST = "fast turn"
    BLUR = "motion blur"
    PLAIN = "plain surfaces"
    SHALLOW = "points too far away or too close together"
    UNKNOWN_PLACE = "place not in the map"
    CONTRADICTED = "part that contradicts the map"
    NO_MAP = "no map for this camera"
    OTHER_MAP = "part in another map"
    ROTATION_ONLY = "camera that hardly moves"
    DAMAGED = "damaged video"
    FROZEN = "frozen recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class LostSpan:
    """Successive frames of one camera without a pose.

    Attributes:
        camera: Camera name.
        first: Index of the first frame.
        frames: Number of frames.
        from_s: Common time of the first frame, seconds.
        to_s: Common time of the last frame, seconds.
        reason: The most frequent status of the frames.
        cause: The likely cause.
        sharpness: Ratio of the frames' median sharpness to the median sharpness of the camera's registered
            frames; NaN if unknown.
        turn_deg: Largest rotation between two successive registered frames near the span, degrees; NaN if
            there are no such frames.
        appearance: Appearance of the frame in the middle; None if it was not decoded.
    """

    camera: str
    first: int = 0
    frames: int
    from_s: float
    to_s: float
    reason: FrameStatus = FrameStatus.FEW_TRACKS
    cause: LossCause = LossCause.UNKNOWN_PLACE
    sharpness: float = math.nan
    turn_deg: float = math.nan
    appearance: FrameAppearance | None = None

    @property
    def last(self) -> int:
        """Index of the last frame."""
        return self.first + self.frames - 1

    @property
    def middle(self) -> int:
        """Index of the frame in the middle."""
        return (self.first + self.last) // 2

    @property
    def facts(self) -> str:
        """What was measured in the frames, in words."""
        facts = [] if math.isnan(self.sharpness) else [f"sharpness {format_percent(self.sharpness)}"]
        facts += [] if math.isnan(self.turn_deg) else [f"turned {self.turn_deg:.0f}° per frame"]
        facts += [] if self.appearance is None else [f"{self.appearance.corners} corners"]
        return ", ".join(facts)

    def to_dict(self) -> dict[str, Any]:
        """Return the span as plain JSON values, as in ``verdict.json``."""
        return {
            "from_s": round(self.from_s, 3),
            "to_s": round(self.to_s, 3),
            "frames": self.frames,
            "cause": self.cause.value,
        }


_WALLS = (
    "Put up posters or patterned cloth where the cameras look, or point the cameras away from plain walls "
    "and bare ceilings."
)
CAUSES = {
    LossCause.DARK: (
        f"the mean brightness of the frame is below {DARK_BRIGHTNESS:.0f} of 255",
        "Switch lights on or film by day, and keep sleeves and straps away from the lens.",
    ),
    LossCause.FAST: (
        f"just before or after the lost frames, the camera turned more than {FAST_DEG:.0f}° per frame",
        "Turn and swing more slowly, or film at 60 frames per second or more.",
    ),
    LossCause.BLUR: (
        f"the sharpness is below {BLUR_SHARPNESS_RATIO * 100:.0f} % of the sharpness of the registered "
        "frames",
        "Use more light and an exposure time of 1/240 s or shorter: sharp frames with noise are better than "
        "blurred frames.",
    ),
    LossCause.PLAIN: (
        f"the frame has under {PLAIN_RATIO * 100:.0f} % of the corners of the camera's registered frames",
        _WALLS,
    ),
    LossCause.SHALLOW: (
        "the visible points did not determine the position",
        "Turn the camera so that it sees both near and far objects, spread over the whole picture.",
    ),
    LossCause.UNKNOWN_PLACE: (
        "the frame is sharp and textured, but it does not match the map",
        "Turn the camera so that it sees less of the wearer's body, keep other people out of the picture, "
        "and walk past each place more than once.",
    ),
    LossCause.CONTRADICTED: (
        "keyframes near it contradict the rest of the map, or the video does not move as the pose does",
        _WALLS,
    ),
    LossCause.NO_MAP: (
        "there is no map for this camera",
        "Let all cameras see the same places: walk in a loop and look around in each place.",
    ),
    LossCause.OTHER_MAP: (
        "the frame has a pose in another map, whose place in the room is not known",
        "Turn more slowly between the parts of the video, and let the camera see the same things before and "
        "after.",
    ),
    LossCause.ROTATION_ONLY: (
        "only its rotation is known",
        "Move the camera by at least a twentieth of the distance to the room, or walk some steps: a camera "
        "that only turns shows no position.",
    ),
    LossCause.DAMAGED: (
        "the decoder reports damaged data, or gives no picture for the frame",
        "Copy the video again from the camera's card. If it is damaged there, too, use another card.",
    ),
    LossCause.FROZEN: (
        "the video repeats one picture, although the camera moves before or after it",
        "Use a fast memory card and a fully charged battery, close other apps, and play the videos before "
        "the cameras are taken off.",
    ),
}
"""Rule by which each cause is found, and what avoids it."""


def advice_about_losses(lost: Sequence[LostSpan], frames: int) -> Iterator[Advice]:
    """Yield the advice against each cause of losses that affects enough frames, with the places in the video.

    Args:
        lost: The lost spans.
        frames: Number of frames of all cameras.
    """
    by_cause: dict[LossCause, list[LostSpan]] = defaultdict(list)
    for span in lost:
        by_cause[span.cause].append(span)
    for cause, spans in by_cause.items():
        count = sum(span.frames for span in spans)
        if count < _MIN_LOST_SHARE * frames:
            continue
        where = "; ".join(
            f"{sum(span.frames for span in own)} of {camera}, at {_times(own)}"
            for camera in sorted({span.camera for span in spans})
            if (own := [span for span in spans if span.camera == camera])
        )
        rule, action = CAUSES[cause]
        are = "have a rotation only" if cause is LossCause.ROTATION_ONLY else "were lost"
        yield Advice(
            action=action,
            reason=f"{count} frames {are} ({where}); likely cause: {cause.value} ({rule})",
            priority=1.0 + count / frames,
        )


def _times(spans: Sequence[LostSpan]) -> str:
    """Return the times of the longest spans, in the order of time: ``0:12 to 0:15 and 1:02``."""
    longest = sorted(sorted(spans, key=lambda span: -span.frames)[:_MAX_SPANS], key=lambda span: span.from_s)
    texts = []
    for span in longest:
        first, last = _clock_text(span.from_s), _clock_text(span.to_s)
        texts.append(first if first == last else f"{first} to {last}")
    rest = len(spans) - len(longest)
    return ", ".join(dict.fromkeys(texts)) + (f" and {rest} more times" if rest else "")


def _clock_text(seconds: float) -> str:
    """Return a time as minutes and whole seconds, as players show it."""
    whole = max(0, round(seconds))
    return f"{whole // 60}:{whole % 60:02}"
