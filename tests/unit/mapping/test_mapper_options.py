"""Tests of the options of the incremental mapper."""

from __future__ import annotations

import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_a_keyframe_is_registered_with_points_as_exact_as_matches(scale: float) -> None:
    settings = make_mapper_options(MapOptions(), [1], scale)
    assert settings.mapper.abs_pose_max_error == pytest.approx(4.0 * scale)
    assert settings.mapper.abs_pose_max_error <= settings.mapper.filter_max_reproj_error * 1.001
