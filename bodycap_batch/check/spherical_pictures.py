"""Find equirectangular pictures, which show the whole sphere, by their edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.capture.images import Image
from bodycap_batch.core.arrays import FloatArray

_MIN_DIFFERENCE = 4.0
"""Minimum mean difference (grey levels) of columns half a picture apart. Pictures with less texture do not
show whether their edges meet. Evidence: none."""
_MAX_EDGE_RATIO = 0.25
"""Maximum ratio of the difference between the left and the right edge to that of columns half a picture
apart, both above the difference of neighbours. It is 0 if the edges meet, and about 1 if they do not.

Evidence: docs/decisions/check.md.
"""
_MAX_POLE_RATIO = 0.6
"""Maximum ratio of the spread of grey levels in the first and in the last row to that in the middle row. Both
rows of an equirectangular picture show a single point. Evidence: docs/decisions/check.md."""


def sphere_differences(image: Image) -> FloatArray:
    """Return how far the edges of a grey picture (H,W) are from those of an equirectangular picture.

    Returns:
        (6,) mean differences of grey levels: between the left and the right edge; between neighbouring
        columns; between columns half a picture apart; then the spread in the first, the last and the middle
        row.
    """
    values = image.astype(np.float64)
    height, width = values.shape
    apart = np.abs(values - np.roll(values, width // 2, axis=1)).mean()
    edges, near = np.abs(values[:, 0] - values[:, -1]).mean(), np.abs(np.diff(values, axis=1)).mean()
    return np.array([edges, near, apart, *(values[row].std() for row in (0, -1, height // 2))])


def is_sphere(differences: Sequence[FloatArray]) -> bool:
    """Return True if pictures are equirectangular.

    Args:
        differences: The `sphere_differences` of several pictures of a video.
    """
    edges, near, apart, top, bottom, middle = np.mean(differences, axis=0)
    meets = apart - near > _MIN_DIFFERENCE and edges - near < _MAX_EDGE_RATIO * (apart - near)
    return bool(meets and max(top, bottom) < _MAX_POLE_RATIO * middle)
