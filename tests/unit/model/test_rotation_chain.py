"""The rotation of a camera through its video, and the poses that it contradicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp, so3_log
from bodycap_batch.model.rotation_chain import RotationChain, find_folded

FRAMES = 101


def path() -> FloatArray:
    """Rotations world_from_cam of a camera that turns by 2 degrees a frame about a slowly moving axis."""
    time = np.arange(FRAMES)
    steps = np.deg2rad(2.0) * np.column_stack([np.sin(time / 30), np.cos(time / 30), 0.2 * np.ones(FRAMES)])
    out = [np.eye(3)]
    for step in so3_exp(steps[1:]):
        out.append(out[-1] @ step)
    return np.array(out)


def chain_of(rotations: FloatArray, nodes: np.ndarray, sigma_deg: float = 0.1) -> RotationChain:
    turns = so3_log(np.swapaxes(rotations[nodes[1:]], 1, 2) @ rotations[nodes[:-1]])
    return RotationChain(
        frames=nodes,
        turns=turns,
        sigma_rad=np.full(len(turns), np.deg2rad(sigma_deg)),
        turn_sigma=0.02,
    )


def without_link(chain: RotationChain, number: int) -> RotationChain:
    turns = chain.turns.copy()
    turns[number] = np.nan
    return replace(chain, turns=turns)


def test_a_chain_gives_the_rotation_between_any_two_frames() -> None:
    rotations = path()
    chain = chain_of(rotations, np.arange(0, FRAMES, 5))
    for first, last in [(0, 100), (3, 4), (7, 58), (10, 15), (42, 43)]:
        found = chain.between(first, last)
        assert found is not None
        rotation, sigma = found
        true = rotations[last].T @ rotations[first]
        # Within a link of 10 degrees, the axis turns by a sixth of a radian. A cut link at each end is wrong
        # by up to an eighth of their product, 0.2 degrees.
        assert float(rotation_angle_rad(rotation @ true.T)) < np.deg2rad(0.5)
        assert sigma > 0.0
    assert chain.between(0, FRAMES) is None


def test_a_link_that_tracks_do_not_determine_gives_no_rotation() -> None:
    chain = without_link(chain_of(path(), np.arange(0, FRAMES, 5)), 10)
    assert chain.between(40, 60) is None
    assert chain.between(0, 50) is not None
    assert chain.confirms(np.array([40, 60]), path()[[40, 60]]) is None


def folded(rotations: FloatArray, start: int, stop: int, angle_deg: float) -> FloatArray:
    out = rotations.copy()
    out[start:stop] = so3_exp([0.0, np.deg2rad(angle_deg), 0.0]) @ rotations[start:stop]
    return out


@pytest.mark.parametrize(
    ("start", "stop", "lost"),
    [(60, FRAMES, 0), (0, 40, 0), (60, FRAMES, 12), (40, 60, 0)],
    ids=["end", "begin", "after lost frames", "between"],
)
def test_a_part_that_is_folded_is_found(start: int, stop: int, lost: int) -> None:
    rotations = path()
    frames = np.array([frame for frame in range(FRAMES) if not start - lost <= frame < start])
    chain = chain_of(rotations, np.arange(0, FRAMES, 5))
    found = find_folded(chain, frames, folded(rotations, start, stop, 90.0)[frames])
    assert found.tolist() == [start <= frame < stop for frame in frames]
    assert not find_folded(chain, frames, rotations[frames]).any()


@pytest.mark.parametrize(("sigma_deg", "is_wrong"), [(0.1, True), (1.0, False)])
def test_a_turn_is_wrong_only_beyond_its_own_deviation(sigma_deg: float, is_wrong: bool) -> None:
    rotations = path()
    turned = so3_exp(np.array([[0.0, np.deg2rad(8.0), 0.0]]))[0]
    found = chain_of(rotations, np.arange(FRAMES), sigma_deg).compare(
        10, 14, np.stack([rotations[10], rotations[14] @ turned])
    )
    assert found is not None
    assert found.angle_rad == pytest.approx(np.deg2rad(8.0), rel=1e-3)
    # Four links, and 2 % of a turn of 8 degrees.
    assert found.sigma_rad == pytest.approx(np.deg2rad(np.hypot(4 * sigma_deg, 0.16)), rel=0.05)
    assert found.is_wrong(np.deg2rad(5.0)) is is_wrong
    assert not found.is_wrong(np.deg2rad(9.0))


def test_an_inexact_chain_contradicts_nothing() -> None:
    rotations = path()
    chain = chain_of(rotations, np.arange(0, FRAMES, 5), sigma_deg=20.0)
    assert not find_folded(chain, np.arange(FRAMES), folded(rotations, 60, FRAMES, 90.0)).any()
    assert not find_folded(None, np.arange(FRAMES), folded(rotations, 60, FRAMES, 90.0)).any()


def test_what_follows_a_folded_part_beyond_unknown_rotations_is_not_kept() -> None:
    """Nothing tells whether the last part belongs to the first one: the map joins it to the folded part."""
    rotations = path()
    chain = without_link(chain_of(rotations, np.arange(0, FRAMES, 5)), 17)  # frames 85 to 90
    frames = np.array([frame for frame in range(FRAMES) if not 84 <= frame <= 91])
    found = find_folded(chain, frames, folded(rotations, 60, FRAMES, 90.0)[frames])
    assert found.tolist() == (frames >= 60).tolist()
