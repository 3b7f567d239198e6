"""A failed adjustment is an error, never a map."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, bundle_adjust
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options


class _Failing:
    """An adjuster and its summary, without a usable solution."""

    def solve(self) -> _Failing:
        return self

    def is_solution_usable(self) -> bool:
        return False

    def brief_report(self) -> str:
        return "no convergence"


def test_an_adjustment_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any) -> _Failing:
        return _Failing()

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", failing)
    with pytest.raises(EstimationError, match="0 keyframes could not be refined: no convergence"):
        adjust_and_filter(pycolmap.Reconstruction(), make_mapper_options(MapOptions(), [], 1.0), [])


def test_an_impossible_lens_is_not_accepted() -> None:
    """Pictures that are turned by 180 degrees fit a negative focal length."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 6, 60
    options.num_cameras_per_rig = 1
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    camera = model.camera(1)
    before = camera.params.copy()
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    for image in model.images.values():
        for point in image.points2D:
            point.xy = 2.0 * centre - point.xy
    bundle_adjust(model, make_mapper_options(MapOptions(), [], 1.0), [])
    assert model.camera(1).params.tolist() == before.tolist()
