"""The difference of the clocks of two cameras, however it was measured."""

from __future__ import annotations

from dataclasses import dataclass

CRYSTAL_SIGMA_PPM = 40.0
"""Standard deviation of the drift between two clocks, ppm, if it was not measured. Origin: crystals have a
tolerance of ±50 ppm, about 29 ppm of standard deviation each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockPair:
    """What a measurement says about the clocks of two cameras.

    Time of the first camera = time of the second camera + `offset_s` at the time `pivot_s` of the second
    camera. From there the difference changes by `drift_ppm`.

    Attributes:
        first: Name of the first camera.
        second: Name of the second camera.
        accepted: True if the offset is determined.
        reason: Why the pair was not accepted; empty if it was.
        pivot_s: Time on the second camera's clock, seconds, at which offset and drift are not correlated.
        offset_s: Difference of the clocks at the pivot, seconds.
        sigma_s: Standard deviation of the offset, seconds.
        drift_ppm: Drift, parts per million; 0 if it was not measured.
        drift_sigma_ppm: Standard deviation of the drift.
        drift_measured: True if the drift was measured.
        evidence: How clear the offset is; each measurement has its own scale.
    """

    first: str
    second: str
    accepted: bool = False
    reason: str = ""
    pivot_s: float = 0.0
    offset_s: float = 0.0
    sigma_s: float = float("inf")
    drift_ppm: float = 0.0
    drift_sigma_ppm: float = CRYSTAL_SIGMA_PPM
    drift_measured: bool = False
    evidence: float = 0.0
