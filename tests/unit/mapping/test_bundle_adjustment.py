"""A failed adjustment is an error, never a map."""

from __future__ import annotations

from typing import Any

import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter
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
