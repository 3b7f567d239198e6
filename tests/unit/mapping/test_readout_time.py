"""Readout times from several cameras, from maps and from matches are combined."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    groups_of_equal_cameras,
    inner_poses,
    judged_readout,
)
from bodycap_batch.model.camera import Camera

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))


def found(best_s: float, sigma_s: float = 0.0005) -> Readout:
    return Readout(best_s, sigma_s, "estimated", best_s)


def test_equal_cameras_share_the_mean_of_maps() -> None:
    each = [found(0.0165), found(0.0167), found(0.0160)]
    pooled = [one.pooled(each) for one in each]
    assert {item.seconds for item in pooled} == {pooled[0].best_s}
    assert pooled[0].best_s == pytest.approx(0.0164, abs=0.00005)
    # All cameras have the error of the spline in common, 2.5 % of the readout time.
    assert 0.00041 < pooled[0].sigma_s < 0.0006


def test_cameras_that_contradict_each_other_do_not_share_a_readout() -> None:
    each = [found(0.016), found(0.024)]
    assert each[0].pooled(each) == each[0]


def test_a_single_camera_keeps_its_readout() -> None:
    assert found(0.016).pooled([found(0.016)]) == found(0.016)


def test_maps_and_matches_are_weighted_by_their_standard_deviations() -> None:
    combined = found(0.0160, 0.0009).with_other_estimate(found(0.0150, 0.0003))
    assert combined.seconds == combined.best_s == pytest.approx(0.0151, abs=0.00005)
    assert combined.source == "estimated"
    assert 0.0003 < combined.sigma_s < 0.0006


def test_the_scatter_of_map_and_matches_is_in_the_standard_deviation() -> None:
    combined = found(0.0240, 0.0002).with_other_estimate(found(0.0220, 0.0002))
    assert combined.seconds == pytest.approx(0.0230)
    assert combined.sigma_s > 0.0009


def test_matches_are_right_if_the_map_contradicts_them() -> None:
    combined = found(0.0100).with_other_estimate(found(0.0200, 0.0006))
    assert (combined.seconds, combined.sigma_s) == pytest.approx((0.0200, 0.0100))


def test_a_map_without_an_estimate_leaves_that_from_matches() -> None:
    nothing = Readout(0.0, float("inf"), "none found", 0.0180)
    combined = nothing.with_other_estimate(found(0.0200, 0.0006))
    assert (combined.seconds, combined.sigma_s) == pytest.approx((0.0200, 0.0020))


def test_the_error_that_all_estimates_have_in_common_counts_once() -> None:
    # A scatter of 0.2 ms and the common error, 2.5 % of 15 ms, are in each estimate.
    each = [found(0.0150, 0.00043)] * 3
    combined = each[0].pooled(each).with_other_estimate(found(0.0150, 0.00043))
    assert 0.000375 < combined.sigma_s < 0.00044


def test_equal_cameras_without_a_significant_readout_may_have_one_together() -> None:
    each = [judged_readout(0.0018, 0.0007), judged_readout(0.0021, 0.0008), judged_readout(0.0020, 0.0007)]
    assert not any(item.seconds for item in each)
    assert each[0].pooled(each).seconds == pytest.approx(0.0020, abs=0.0001)


@pytest.mark.parametrize(
    ("best_s", "sigma_s", "source"),
    [
        (0.0004, 0.0003, "none found"),
        (0.0019, 0.0007, "not determined"),
        (0.0, 0.0012, "not determined"),
        (0.0030, 0.0003, "estimated"),
        (0.0200, 0.0050, "not determined"),
    ],
)
def test_no_readout_is_found_only_if_it_is_below_two_milliseconds(
    best_s: float, sigma_s: float, source: str
) -> None:
    readout = judged_readout(best_s, sigma_s)
    assert readout.source.startswith(source)
    assert readout.seconds == (best_s if source == "estimated" else 0.0)
    assert readout.determined == (source != "not determined")


def test_cameras_of_other_lenses_are_in_other_groups() -> None:
    def camera(name: str, focal_px: float = 400.0, fps: float = 30.0) -> Any:
        lens = Camera(
            model="PINHOLE", width_px=640, height_px=480, params=np.array([focal_px, focal_px, 320.0, 240.0])
        )
        return SimpleNamespace(name=name, camera=lens, nominal_fps=fps, given=None)

    cameras = [camera("a"), camera("b", 500.0), camera("c"), camera("d", fps=60.0)]
    assert groups_of_equal_cameras(cameras) == [["a", "c"], ["b"], ["d"]]
    # A map contradicted the given intrinsics of one camera. It may still be of the same model.
    cameras[2].given, cameras[2].camera = cameras[2].camera, camera("c", 410.0).camera
    assert groups_of_equal_cameras(cameras) == [["a", "c"], ["b"], ["d"]]


def test_only_frames_between_poses_tell_a_readout() -> None:
    posed = np.array([True, True, True, False, True, True, True, True])
    times_ns = np.array([0, 33, 66, 99, 132, 165, 198, 700]) * 1_000_000
    path: Any = SimpleNamespace(localised=posed, times_ns=times_ns)
    assert inner_poses(path).tolist() == [False, True, False, False, False, True, False, False]
