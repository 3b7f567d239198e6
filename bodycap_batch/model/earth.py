"""The place of the world on the Earth, from GPS positions of cameras.

The axes of a local frame of the Earth are east, north and up. The world's z axis is vertical already, so four
numbers relate the two: a heading and a shift. The scale of the world is not changed: it is only compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array

_EQUATOR_M, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""Radius of the equator (metres) and flattening of the ellipsoid WGS 84."""
_CORRELATION_S = 10.0
"""Time over which the errors of successive GPS positions are nearly equal, seconds. Evidence: none."""
_ROUNDS = 10
"""Number of times that the weights of the positions are computed. Evidence: none."""
_ROBUST_SIGMAS = 2.5
"""Residual, in standard deviations, from which a position counts less."""
_VERTICAL_RATIO = 2.0
"""Error of GPS altitudes, as a ratio of that of horizontal positions. Origin: usual dilutions of
precision."""
_MIN_FIXES = 5
"""Minimum number of positions. Evidence: none."""
_MAX_HEADING_SIGMA_RAD = float(np.radians(15.0))
"""Maximum standard deviation of the heading, radians. With a larger one, the place is not given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsFixes:
    """GPS positions of one camera.

    Attributes:
        times_s: (N,) time of each position on the clock of the camera, seconds.
        latitude_longitude_deg: (N,2) latitude and longitude, degrees.
        altitude_m: (N,) altitude, metres.
        sigma_m: (N,) standard deviation of a horizontal coordinate, metres.
    """

    times_s: FloatArray
    latitude_longitude_deg: FloatArray
    altitude_m: FloatArray
    sigma_m: FloatArray

    def __post_init__(self) -> None:
        count = len(self.times_s)
        set_array(self, "times_s", (count,))
        set_array(self, "latitude_longitude_deg", (count, 2))
        set_array(self, "altitude_m", (count,))
        set_array(self, "sigma_m", (count,))


@dataclass(frozen=True, slots=True, kw_only=True)
class EarthPlace:
    """The place of the world on the Earth.

    Attributes:
        latitude_longitude_deg: (2,) origin of the local frame, degrees.
        altitude_m: Altitude of this origin, metres.
        earth_from_world: (4,4) transform from the world to east, north, up at the origin, metres.
        heading_sigma_rad: Standard deviation of the heading, radians.
        sigma_m: (3,) standard deviations of the shift, metres.
        rms_m: Root mean square of the horizontal residuals, metres.
        fixes: Number of positions.
        scale: Length of the path by GPS, divided by that in the world. It is not applied.
        scale_sigma: Its standard deviation.
    """

    latitude_longitude_deg: FloatArray
    altitude_m: float
    earth_from_world: FloatArray
    heading_sigma_rad: float
    sigma_m: FloatArray
    rms_m: float
    fixes: int
    scale: float
    scale_sigma: float

    def figures(self) -> dict[str, Any]:
        """Return the place as plain JSON values."""
        return {
            "latitude_deg": round(float(self.latitude_longitude_deg[0]), 8),
            "longitude_deg": round(float(self.latitude_longitude_deg[1]), 8),
            "altitude_m": round(self.altitude_m, 3),
            "east_north_up_from_world": np.round(self.earth_from_world, 9).tolist(),
            "heading_sigma_deg": round(float(np.degrees(self.heading_sigma_rad)), 3),
            "sigma_m": np.round(self.sigma_m, 3).tolist(),
            "rms_m": round(self.rms_m, 3),
            "fixes": self.fixes,
            "scale": round(self.scale, 4),
            "scale_sigma": round(self.scale_sigma, 4),
        }


def east_north_up(
    latitude_longitude_deg: FloatArray, altitude_m: FloatArray, origin_deg: FloatArray, origin_m: float
) -> FloatArray:
    """Return positions (N,3) in the local frame of an origin, metres, for distances of some kilometres."""
    latitude = np.radians(origin_deg[0])
    squared = _FLATTENING * (2.0 - _FLATTENING)
    root = np.sqrt(1.0 - squared * np.sin(latitude) ** 2)
    north_m = _EQUATOR_M * (1.0 - squared) / root**3 + origin_m
    east_m = (_EQUATOR_M / root + origin_m) * np.cos(latitude)
    step = np.radians(latitude_longitude_deg - origin_deg)
    # A path may cross the meridian of 180 degrees.
    around = (step[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack([east_m * around, north_m * step[:, 0], altitude_m - origin_m], axis=1)


def place_on_earth(cameras: Sequence[tuple[GpsFixes, FloatArray]]) -> EarthPlace | None:
    """Return the place of the world on the Earth.

    Args:
        cameras: The positions of each camera by GPS, and its positions (N,3) in the world at the same times,
            metres; NaN where they are unknown.

    Returns:
        The place; None if there are too few positions, or if the path is too short for its heading.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991,
        in the horizontal plane, with weights against wrong positions.
    """
    known = [np.isfinite(world).all(axis=1) for _, world in cameras]
    if sum(int(each.sum()) for each in known) < _MIN_FIXES:
        return None
    rows = [(fixes, world[mask], mask) for (fixes, world), mask in zip(cameras, known, strict=True)]
    degrees = np.concatenate([fixes.latitude_longitude_deg[mask] for fixes, _, mask in rows])
    altitude_m = np.concatenate([fixes.altitude_m[mask] for fixes, _, mask in rows])
    sigma_m = np.concatenate([fixes.sigma_m[mask] for fixes, _, mask in rows])
    times_s = np.concatenate([fixes.times_s[mask] for fixes, _, mask in rows])
    world = np.concatenate([own for _, own, _ in rows])
    origin_deg, origin_m = degrees[0], float(altitude_m[0])
    earth = east_north_up(degrees, altitude_m, origin_deg, origin_m)
    seen, true = world[:, 0] + 1j * world[:, 1], earth[:, 0] + 1j * earth[:, 1]
    weight, noise_m = 1.0 / sigma_m**2, float(np.median(sigma_m))
    turn, shift, ratio, spread = 1.0 + 0.0j, 0.0j, 1.0, 0.0
    for _ in range(_ROUNDS):
        share = weight / weight.sum()
        own, other = seen - share @ seen, true - share @ true
        spread = float(share @ np.abs(own) ** 2)
        product = complex(share @ (np.conj(own) * other))
        if spread <= 0.0 or abs(product) == 0.0:
            return None
        turn, ratio = product / abs(product), abs(product) / spread
        shift = complex(share @ (true - turn * seen))
        size = np.abs(true - turn * seen - shift)
        noise_m = max(float(np.median(sigma_m)), float(np.median(size)) / np.sqrt(2.0 * np.log(2.0)))
        weight = 1.0 / (sigma_m**2 * (1.0 + (size / (_ROBUST_SIGMAS * noise_m)) ** 2))
    independent = max(1.0, float(np.ptp(times_s)) / _CORRELATION_S)
    sigma = noise_m / float(np.sqrt(independent))
    heading_sigma = sigma / float(np.sqrt(spread))
    if heading_sigma > _MAX_HEADING_SIGMA_RAD:
        return None
    up = float(np.median(earth[:, 2] - world[:, 2]))
    transform = np.eye(4)
    transform[:2, :2] = [[turn.real, -turn.imag], [turn.imag, turn.real]]
    transform[:3, 3] = [shift.real, shift.imag, up]
    return EarthPlace(
        latitude_longitude_deg=np.asarray(origin_deg),
        altitude_m=origin_m,
        earth_from_world=transform,
        heading_sigma_rad=heading_sigma,
        sigma_m=np.array([sigma, sigma, _VERTICAL_RATIO * sigma]),
        rms_m=float(np.sqrt(np.mean(size**2))),
        fixes=len(times_s),
        scale=float(ratio),
        scale_sigma=heading_sigma,
    )
