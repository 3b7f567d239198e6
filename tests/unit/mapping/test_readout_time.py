"""Which readout times are significant, and which cameras may share one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.mapping.intrinsics.readout_time import (
    groups_of_equal_cameras,
    judged_readout,
)
from bodycap_batch.model.camera import Camera

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))


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
