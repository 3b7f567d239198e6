"""The lens of a camera as its video determines it, before there is a map."""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.model.camera import Camera

_MAX_SIGMA = 0.2
"""Maximum relative standard deviation of a focal length that is constant while the map is built. That of a
typical field of view, which is taken otherwise, is 0.3. Evidence: docs/decisions/tracks.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LensEstimate:
    """The lens of a camera as the tracks of its video determine it.

    Attributes:
        lens: The intrinsics; the principal point is the centre of the picture.
        focal_sigma: Relative standard deviation of the focal length.
        pairs: Number of pairs of frames.
        error_px: Median distance of the points from their epipolar lines, px.
    """

    lens: Camera
    focal_sigma: float
    pairs: int
    error_px: float

    @property
    def is_determined(self) -> bool:
        """True if the tracks determine the focal length well enough for the map."""
        return self.focal_sigma < _MAX_SIGMA
