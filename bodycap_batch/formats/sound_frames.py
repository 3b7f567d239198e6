"""Convert samples of sound to the frames that PyAV encodes."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame

_FRAME_SAMPLES = 1024
"""Number of samples of a frame. Origin: the frames of AAC have this size."""


def sound_frames(
    samples: npt.NDArray[np.float32], rate_hz: int, layout: str = "mono", start: int = 0
) -> Iterator[AudioFrame]:
    """Yield the frames of PyAV for samples (N,) or (channels,N); the first has the timestamp `start`."""
    import av

    planes = np.atleast_2d(samples)
    for first in range(0, planes.shape[1], _FRAME_SAMPLES):
        part = np.ascontiguousarray(planes[:, first : first + _FRAME_SAMPLES], np.float32)
        frame = av.AudioFrame.from_ndarray(part, format="fltp", layout=layout)
        frame.sample_rate, frame.pts, frame.time_base = rate_hz, start + first, Fraction(1, rate_hz)
        yield frame
