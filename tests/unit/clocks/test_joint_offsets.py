"""All clocks from the differences of pairs: loops, contradictions, covariance."""

from __future__ import annotations

import itertools

import pytest

from bodycap_batch.clocks.joint_offsets import (
    CRYSTAL_SIGMA_PPM,
    UNLIKE_SIGMA_S,
    WAY_SIGMA_S,
    connected_cameras,
    solve_clocks,
)
from bodycap_batch.clocks.pair_offsets import PairOffset

OFFSETS = {"torso": 0.0, "head": 0.4, "left": -1.2, "right": 7.0}
DRIFTS = {"torso": 0.0, "head": 30.0, "left": -45.0, "right": 10.0}
STARTS = {"torso": 0.0, "head": 0.02, "left": 100.0, "right": -3.0}
FLOORS = dict.fromkeys(STARTS, WAY_SIGMA_S)


def pair(first, second, pivot_s=200.0, error_s=0.0, **more):
    """The exact difference of two clocks at a time of the second camera."""
    common = pivot_s * (1 + 1e-6 * DRIFTS[second]) + OFFSETS[second]
    first_s = (common - OFFSETS[first]) / (1 + 1e-6 * DRIFTS[first])
    drift = ((1 + 1e-6 * DRIFTS[second]) / (1 + 1e-6 * DRIFTS[first]) - 1) * 1e6
    options = {
        "accepted": True, "sigma_s": 3e-4, "drift_ppm": drift, "drift_sigma_ppm": 2.0,
        "drift_measured": True, "evidence": 100.0, **more,
    }  # fmt: skip
    return PairOffset(
        first=first, second=second, pivot_s=pivot_s, offset_s=first_s - pivot_s + error_s, **options
    )


def all_pairs():
    return [pair(*names) for names in itertools.combinations(OFFSETS, 2)]


def test_offsets_and_drifts_are_recovered_at_camera_time_0():
    clocks = solve_clocks("torso", all_pairs(), STARTS, FLOORS).clocks
    for name, clock in clocks.items():
        # The product of drift and drift is left out: 2e-9 of 200 s.
        assert clock.offset_s == pytest.approx(OFFSETS[name], abs=2e-6)
        assert clock.drift_ppm == pytest.approx(DRIFTS[name], abs=0.01)
    assert clocks["torso"].sigma_s == 0.0


def test_a_drift_that_no_pair_measures_is_0_with_the_sigma_of_crystals():
    short = [pair("torso", "head", drift_measured=False, drift_ppm=0.0, drift_sigma_ppm=CRYSTAL_SIGMA_PPM)]
    clock = solve_clocks("torso", short, STARTS, FLOORS).clocks["head"]
    assert clock.drift_ppm == 0.0
    assert clock.drift_sigma_ppm == pytest.approx(CRYSTAL_SIGMA_PPM, rel=0.01)


def test_another_reference_gives_the_same_differences():
    clocks = solve_clocks("left", all_pairs(), STARTS, FLOORS).clocks
    assert clocks["left"].offset_s == 0.0
    assert clocks["torso"].drift_ppm == pytest.approx(45.0, abs=0.01)
    assert clocks["torso"].offset_s == pytest.approx(1.2 * (1 + 45e-6), abs=2e-5)


def test_more_pairs_reduce_sigma_down_to_the_way_of_sound():
    direct = pair("torso", "head", sigma_s=0.002)
    some = solve_clocks("torso", [direct], STARTS, FLOORS).clocks["head"]
    chain = [pair("torso", "left", sigma_s=0.002), pair("head", "left", sigma_s=0.002)]
    more = solve_clocks("torso", [direct, *chain], STARTS, FLOORS).clocks["head"]
    assert WAY_SIGMA_S < more.sigma_s < some.sigma_s


def test_a_camera_of_another_model_has_a_larger_sigma():
    floors = dict.fromkeys(OFFSETS, WAY_SIGMA_S) | {"head": UNLIKE_SIGMA_S}
    clocks = solve_clocks("torso", all_pairs(), STARTS, floors).clocks
    assert clocks["head"].sigma_s >= UNLIKE_SIGMA_S
    assert clocks["left"].sigma_s < 0.002


def test_the_pair_that_contradicts_the_loops_is_dropped():
    pairs = [p for p in all_pairs() if (p.first, p.second) != ("head", "right")]
    found = solve_clocks(
        "torso", [*pairs, pair("head", "right", error_s=0.3, evidence=500.0)], STARTS, FLOORS
    )
    assert [(p.first, p.second) for p, _ in found.dropped] == [("head", "right")]
    assert found.dropped[0][1] == pytest.approx(0.3, abs=1e-3)
    assert found.clocks["right"].offset_s == pytest.approx(OFFSETS["right"], abs=1e-5)


def test_in_one_loop_the_pair_with_the_least_evidence_is_dropped():
    pairs = [
        pair("torso", "head", evidence=50.0),
        pair("torso", "left", error_s=0.2, evidence=20.0),
        pair("head", "left", evidence=40.0),
    ]
    found = solve_clocks("torso", pairs, STARTS, FLOORS)
    assert [(p.first, p.second) for p, _ in found.dropped] == [("torso", "left")]
    assert found.clocks["left"].offset_s == pytest.approx(OFFSETS["left"], abs=1e-5)


def test_differences_of_the_way_of_sound_are_no_contradiction():
    pairs = [pair("torso", "head", error_s=0.002), pair("torso", "left"), pair("head", "left")]
    assert not solve_clocks("torso", pairs, STARTS, FLOORS).dropped


def test_a_camera_without_a_pair_has_no_clock():
    found = solve_clocks("torso", [pair("torso", "head"), pair("left", "right")], STARTS, FLOORS)
    assert set(found.clocks) == {"torso", "head"}
    assert connected_cameras("torso", [pair("torso", "head"), pair("left", "right")]) == ["torso", "head"]
    assert set(solve_clocks("torso", [], {}, {}).clocks) == {"torso"}


def test_a_drift_that_was_not_measured_widens_the_offset_at_camera_time_0():
    short = [pair("torso", "left", drift_measured=False, drift_ppm=0.0)]
    clock = solve_clocks("torso", short, STARTS, FLOORS).clocks["left"]
    assert clock.drift_ppm == 0.0
    assert clock.drift_sigma_ppm == pytest.approx(CRYSTAL_SIGMA_PPM, rel=1e-3)
    # The pivot is 200 s from camera time 0.
    assert clock.sigma_s == pytest.approx(200.0 * 1e-6 * CRYSTAL_SIGMA_PPM, rel=0.1)
    assert abs(clock.correlation) < 1.0
