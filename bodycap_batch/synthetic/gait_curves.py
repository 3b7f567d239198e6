"""Joint angles by percent of the gait cycle, and how cadence and stance depend on speed.

A gait cycle starts when the heel of a foot touches the floor, and ends when this heel touches the floor
again. Each curve is a Fourier series with coefficients of our own: a periodic spline was drawn through events
of the cycle (extremes and values between them, read from the sources), and its first harmonics were kept.

Sources: the mean curves at free speed of M. H. Schwartz, A. Rozumalski, J. P. Trost, "The effect of walking
speed on the gait of typically developing children", J. Biomech. 41, 2008; events of adults of J. Perry,
J. M. Burnfield, "Gait Analysis: Normal and Pathological Function", 2nd ed., Slack 2010. The angles of the hip
are relative to the pelvis of a standing person: the mean tilt of the pelvis (12 degrees) is subtracted.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray

REFERENCE_M_S = 1.3
"""Speed of walking to which the mean curves belong, metres per second. Origin: the free speed of adults."""
_KNEE = (
    22.62,
    (-2.24, -13.76, -0.58, -0.51, -0.47, -0.09),
    (-18.87, 7.08, 4.28, 0.63, 0.33, 0.31),
)
"""Mean, cosine and sine coefficients of the flexion of the knee (degrees) at `REFERENCE_M_S`. Events: 5
degrees at 0 %, 18.5 at 13 %, 6 at 40 %, 34 at 60 %, 60 at 72 %, 18 at 90 %."""
_KNEE_BY_SPEED = (4.92, (2.38, -2.89, -1.38, -0.94), (-0.69, 1.25, -0.73, 0.26))
"""Change of the flexion of the knee with speed, degrees per metre per second. Events: +9 at 13 %, 0 at 40 to
50 %, +6 at 72 %. Source: the curves of Schwartz et al. (2008) at five speeds."""
_HIP = (7.35, (20.64, -3.0, -0.16, -0.09), (-2.96, -1.66, 1.58, -0.11))
"""Mean, cosine and sine coefficients of the flexion of the hip (degrees) at `REFERENCE_M_S`. Events: 24.5
degrees at 0 %, 0.5 at 30 %, −16.5 at 52 %, 25 at 88 %."""
_LIST_DEG = ((0.71, 0.0, 0.0), (2.55, 0.0, 1.83))
"""Cosine and sine coefficients of the list of the pelvis (degrees, this side up) at `REFERENCE_M_S`. Events:
4 degrees at 15 %, and the opposite half a cycle later. Source: Schwartz et al. (2008)."""
_WALK_RATIO = 0.00646
"""Ratio of step length (metres) to cadence (steps per minute) of a person of `_USUAL_HEIGHT_M`. Origin: at
the lower limit of a constant ratio, the speed is 62 m/min and the cadence 98 steps/min, so the step is 0.633
m long. Source: D. Murakami, Y. Otaka, "Estimated lower speed boundary at which the walk ratio constancy is
broken in healthy adults", J. Phys. Ther. Sci. 29, 2017."""
_CONSTANT_RATIO_M_S = 62.0 / 60.0
"""Speed, metres per second, above which the walk ratio is constant. Source: Murakami and Otaka (2017)."""
_SLOW_RATIO_GAIN = 0.55
"""Relative increase of the walk ratio per metre per second below `_CONSTANT_RATIO_M_S`. Murakami and Otaka
(2017) report an increase; this slope has no evidence."""
_USUAL_HEIGHT_M = 1.70
"""Stature (metres) to which `_WALK_RATIO` belongs. The length of a step is proportional to the stature."""
_STANCE_AT_REST, _STANCE_BY_SPEED = 0.642, -0.035
"""Share of stance in a cycle: value at speed 0, and change per metre per second. Source: C. Kirtley,
M. W. Whittle, R. J. Jefferson, "Influence of walking speed on gait parameters", J. Biomed. Eng. 7, 1985."""


def _series(cycle: FloatArray, cosines: tuple[float, ...], sines: tuple[float, ...]) -> FloatArray:
    """Return the sum of harmonics at cycle positions (T,), 0 to 1."""
    out = np.zeros_like(cycle)
    for number, (cosine, sine) in enumerate(zip(cosines, sines, strict=True), start=1):
        angle = 2.0 * np.pi * number * cycle
        out = out + cosine * np.cos(angle) + sine * np.sin(angle)
    return out


def knee_flexion_deg(cycle: FloatArray, speed_m_s: FloatArray) -> FloatArray:
    """Return the flexion of the knee (T,) in degrees.

    Args:
        cycle: (T,) position in the gait cycle of this leg, 0 to 1.
        speed_m_s: (T,) speed of walking, metres per second.
    """
    mean = _KNEE[0] + _series(cycle, *_KNEE[1:])
    change = _KNEE_BY_SPEED[0] + _series(cycle, *_KNEE_BY_SPEED[1:])
    return np.asarray(mean + (speed_m_s - REFERENCE_M_S) * change)


def hip_flexion_deg(cycle: FloatArray) -> FloatArray:
    """Return the flexion of the hip (T,) in degrees at `REFERENCE_M_S` for cycle positions (T,), 0 to 1."""
    return np.asarray(_HIP[0] + _series(cycle, *_HIP[1:]))


def pelvis_list_deg(cycle: FloatArray) -> FloatArray:
    """Return how far the pelvis is up on one side (T,) in degrees at `REFERENCE_M_S`.

    Args:
        cycle: (T,) position in the gait cycle of the leg on this side, 0 to 1.
    """
    return _series(cycle, *_LIST_DEG)


def steps_per_s(speed_m_s: FloatArray, height_m: float) -> FloatArray:
    """Return the number of steps (T,) per second of walking people.

    Args:
        speed_m_s: (T,) speeds, metres per second.
        height_m: Stature, metres.
    """
    slow = np.maximum(0.0, _CONSTANT_RATIO_M_S - speed_m_s)
    ratio = _WALK_RATIO * height_m / _USUAL_HEIGHT_M * (1.0 + _SLOW_RATIO_GAIN * slow)
    return np.asarray(np.sqrt(60.0 * speed_m_s / ratio) / 60.0)


def stance_share(speed_m_s: FloatArray) -> FloatArray:
    """Return the share (T,) of a gait cycle during which a foot is on the floor."""
    return np.asarray(_STANCE_AT_REST + _STANCE_BY_SPEED * speed_m_s)
