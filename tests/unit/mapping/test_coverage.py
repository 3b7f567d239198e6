"""A map must contain a part of the keyframes. Keyframes of a covered lens show nothing and do not count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    _write_camera,
    count_features,
    write_image,
)
from bodycap_batch.mapping.validation.epipolar_consistency import check_coverage
from bodycap_batch.model.camera import Camera

LENS = Camera(model="PINHOLE", width_px=64, height_px=48, params=np.array([50.0, 50.0, 32.0, 24.0]))


def _model(keyframes: int) -> SimpleNamespace:
    return SimpleNamespace(num_reg_images=lambda: keyframes)


def test_the_features_of_each_keyframe_are_counted(tmp_path: Path) -> None:
    features = {0: 500, 1: 0, 2: 19, 3: 20}
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        camera = _write_camera(database, LENS.to_pycolmap())
        for frame, count in features.items():
            image = write_image(database, ImageRef("torso", frame), camera)
            database.write_keypoints(image, np.ones((count, 2), np.float32))
    assert count_features(tmp_path) == {ImageRef("torso", frame): count for frame, count in features.items()}


@pytest.mark.parametrize(
    ("registered", "textured", "is_refused"),
    [(14, 140, False), (13, 140, True), (14, 25, False), (1, 2, True)],
)
def test_a_map_must_contain_a_tenth_of_the_keyframes_with_texture(
    registered: int, textured: int, is_refused: bool
) -> None:
    tried = [{"pair": ["a", "b"], "doubt": "the two cameras are too close"}, {"failed": "other"}]
    error = check_coverage([_model(registered)], 150, textured, tried, MapOptions())
    assert (error is not None) == is_refused
    if error is not None:
        assert f"{registered} of 150 keyframes, {textured} of which show texture" in str(error)
        assert "to start from, the two cameras are too close" in str(error)
        assert "other" not in str(error)


def test_no_model_is_refused_even_if_no_keyframe_has_texture() -> None:
    assert check_coverage([], 5, 0, [], MapOptions()) is not None
