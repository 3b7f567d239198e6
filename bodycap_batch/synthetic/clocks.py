"""The clocks of the cameras of a synthetic capture, and the delay between sound and picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.mounts import mount_of, reference_index
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.synthetic.options import SynthOptions

_DRIFT_PPM = 50.0
"""Maximum drift, parts per million, of a clock that is drawn at random. Origin: usual tolerance of crystals.
"""
_SEED_KEY = 101
"""Number that makes the random numbers of the clocks independent of those of the rest of a capture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueClock:
    """The true clock of one camera, whose video starts at camera time 0.

    Attributes:
        offset_s: Common time = camera time · (1 + drift_ppm · 1e-6) + offset_s, seconds.
        drift_ppm: Drift, parts per million.
        skew_s: Time in the file at which a sound is heard − time in the file at which its picture is seen,
            without the way of sound, seconds.
    """

    offset_s: float
    drift_ppm: float
    skew_s: float

    def common_s(self, camera_s: FloatArray) -> FloatArray:
        """Return the common times of camera times (T,), both in seconds."""
        return np.asarray(camera_s * (1.0 + 1e-6 * self.drift_ppm) + self.offset_s)


def true_clocks(options: SynthOptions) -> dict[str, TrueClock]:
    """Return the clock of each camera.

    With common clocks, only the stated offsets count. With free clocks, offset and drift of each camera are
    drawn at random, unless they are stated or the camera is the reference.
    """
    reference = reference_name(options.cameras)
    clocks = {}
    for index, name in enumerate(options.cameras):
        # Each camera has its own random numbers, so that a stated value changes no other value.
        rng = np.random.default_rng([options.seed, _SEED_KEY, index])
        offset_s, drift_ppm, skew_s = rng.uniform(-1.0, 1.0, 3).tolist()
        is_drawn = options.clocks == "free" and name != reference
        clocks[name] = TrueClock(
            offset_s=options.offsets_s.get(name, offset_s * options.offset_range_s if is_drawn else 0.0),
            drift_ppm=options.drifts_ppm.get(name, drift_ppm * _DRIFT_PPM if is_drawn else 0.0),
            skew_s=options.sound_skews_s.get(name, skew_s * options.sound_skew_range_s + 0.0),
        )
    return clocks


def reference_name(cameras: tuple[str, ...]) -> str:
    """Return the name of the camera whose clock is the common clock: on the torso, else the first camera."""
    places = [mount_of(name) for name in cameras]
    return cameras[reference_index([None if place is None else place[1] for place in places])]


def has_own_clocks(options: SynthOptions) -> bool:
    """Return True if the truth of the clocks does not fit into the calibration file."""
    return options.clocks == "free" or options.sound


def first_and_last_s(options: SynthOptions, clocks: Mapping[str, TrueClock]) -> tuple[float, float]:
    """Return the common times, seconds, at which the first video starts and the last one ends."""
    ends = [float(clock.common_s(np.array(options.seconds))) for clock in clocks.values()]
    return min(clock.offset_s for clock in clocks.values()), max(ends)
