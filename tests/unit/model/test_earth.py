"""The place of the world on the Earth from GPS positions."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.earth import GpsFixes, east_north_up, place_on_earth

ORIGIN_DEG, ALTITUDE_M = np.array([48.1, 11.5]), 500.0
HEADING_RAD = np.radians(70.0)


def walk(length_m: float, seconds: float = 120.0) -> tuple[FloatArray, FloatArray]:
    """Return times (N,) and positions (N,3) in the world of a person who walks in a bow."""
    times_s = np.arange(0.0, seconds, 0.5)
    share = times_s / seconds
    world = np.stack(
        [length_m * share, 0.3 * length_m * np.sin(3.0 * share), 1.0 + 0.05 * np.sin(9.0 * times_s)], axis=1
    )
    return times_s, world


def fixes_of(times_s: FloatArray, world: FloatArray, noise_m: float, scale: float = 1.0) -> GpsFixes:
    """Return GPS positions with errors that last for some seconds."""
    rng = np.random.default_rng(4)
    turn = np.array([[np.cos(HEADING_RAD), -np.sin(HEADING_RAD)], [np.sin(HEADING_RAD), np.cos(HEADING_RAD)]])
    earth = np.column_stack([scale * world[:, :2] @ turn.T + [20.0, -30.0], world[:, 2] + 2.0])
    slow = np.repeat(rng.normal(0.0, noise_m, (len(times_s) // 20 + 1, 3)), 20, axis=0)[: len(times_s)]
    earth = earth + slow
    metres = east_north_up(ORIGIN_DEG + 1e-5 * np.eye(2), np.zeros(2), ORIGIN_DEG, ALTITUDE_M)
    degrees = ORIGIN_DEG + np.stack(
        [1e-5 * earth[:, 1] / metres[0, 1], 1e-5 * earth[:, 0] / metres[1, 0]], axis=1
    )
    return GpsFixes(
        times_s=times_s,
        latitude_longitude_deg=degrees,
        altitude_m=ALTITUDE_M + earth[:, 2],
        sigma_m=np.full(len(times_s), max(noise_m, 0.01)),
    )


def test_heading_and_shift_are_found() -> None:
    times_s, world = walk(150.0)
    place = place_on_earth([(fixes_of(times_s, world, 0.0), world)])
    assert place is not None
    found = np.arctan2(place.earth_from_world[1, 0], place.earth_from_world[0, 0])
    assert found == pytest.approx(HEADING_RAD, abs=1e-4)
    assert place.scale == pytest.approx(1.0, abs=1e-4)
    # The origin is the first position, which the transform maps to 0.
    np.testing.assert_allclose((place.earth_from_world @ [*world[0], 1.0])[:2], 0.0, atol=0.02)
    up = place.earth_from_world[:3, :3] @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0])


def test_sigmas_cover_the_errors_of_noisy_positions() -> None:
    times_s, world = walk(150.0)
    place = place_on_earth([(fixes_of(times_s, world, 3.0), world)])
    assert place is not None
    found = np.arctan2(place.earth_from_world[1, 0], place.earth_from_world[0, 0])
    assert abs(found - HEADING_RAD) < 3.0 * place.heading_sigma_rad < 0.3
    assert abs(place.scale - 1.0) < 3.0 * place.scale_sigma


def test_a_wrong_scale_is_reported_and_not_applied() -> None:
    times_s, world = walk(150.0)
    place = place_on_earth([(fixes_of(times_s, world, 0.5, scale=1.2), world)])
    assert place is not None
    assert place.scale == pytest.approx(1.2, abs=3.0 * place.scale_sigma)
    assert abs(place.scale - 1.0) > 3.0 * place.scale_sigma
    assert np.linalg.norm(place.earth_from_world[:3, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize("length_m", [0.0, 4.0])
def test_a_short_path_gives_no_place(length_m: float) -> None:
    times_s, world = walk(length_m)
    assert place_on_earth([(fixes_of(times_s, world, 3.0), world)]) is None


def test_unknown_positions_are_left_out() -> None:
    times_s, world = walk(150.0)
    partly = world.copy()
    partly[10:200] = np.nan
    place = place_on_earth([(fixes_of(times_s, world, 0.0), partly)])
    assert place is not None
    assert place.fixes == len(world) - 190
    assert place_on_earth([(fixes_of(times_s, world, 0.0), np.full_like(world, np.nan))]) is None
    assert place_on_earth([]) is None


def test_a_path_across_the_meridian_of_180_degrees() -> None:
    degrees = np.array([[10.0, 179.99995], [10.0, -179.99995]])
    metres = east_north_up(degrees, np.zeros(2), degrees[0], 0.0)
    assert 10.0 < metres[1, 0] < 12.0
