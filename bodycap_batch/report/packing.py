"""Pack arrays for the page: quantise to at most 16 bits, encode as base64, and thin to a size budget.

To thin means to keep only some of the items, evenly spaced or randomly selected.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray

MISSING_CODE = 65535
"""The 16-bit code that stands for a missing value (NaN)."""
_LEVELS = MISSING_CODE - 1
"""Number of steps between the smallest and the largest value of a column."""
_CHARACTERS_PER_BYTE = 4.0 / 3.0
"""Number of base64 characters for each byte."""


def pack_scaled(values: FloatArray) -> dict[str, Any]:
    """Pack numbers (N,C) as 16-bit codes between the smallest and the largest value of each column.

    NaN and infinite values become `MISSING_CODE`. A step is the column's range divided by 65,534: a third of
    a millimetre in a room of 20 m.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.where(np.isfinite(values), values, np.nan)
    low = np.nanmin(finite, axis=0, initial=np.inf)
    high = np.nanmax(finite, axis=0, initial=-np.inf)
    low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 0.0)
    span = np.where(high > low, high - low, 1.0)
    scaled = np.round((np.nan_to_num(finite) - low) / span * _LEVELS)
    codes = np.where(np.isfinite(finite), np.clip(scaled, 0, _LEVELS), MISSING_CODE).astype("<u2")
    return {
        "low": [float(f"{value:.9g}") for value in low],
        "step": [float(f"{value:.9g}") for value in span / _LEVELS],
        "shape": list(values.shape),
        "u16": base64_text(codes),
    }


def pack_bytes(values: npt.NDArray[np.uint8]) -> dict[str, Any]:
    """Pack an array of bytes of any shape."""
    return {"shape": list(values.shape), "u8": base64_text(values)}


def base64_text(values: npt.NDArray[Any]) -> str:
    """Return the bytes of an array as base64 text."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def affordable_count(characters: int, bytes_per_item: float) -> int:
    """Return the number of items that fit into a number of base64 characters, but at least two."""
    return max(2, int(characters / (bytes_per_item * _CHARACTERS_PER_BYTE)))


@dataclass(slots=True)
class PageBudget:
    """The usable fraction of the page's size budgets, and the number of shown items of each kind.

    Each kind of item on the page (points, pictures, poses) has a budget: a maximum number of items or of
    characters.

    Attributes:
        share: Factor by which every budget is multiplied. It is below 1 if the page would otherwise be too
            large.
        counts: Number of shown items and number of available items, by the name of the items.
    """

    share: float = 1.0
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    def scaled(self, budget: float) -> int:
        """Return a budget multiplied by the usable fraction."""
        return int(budget * self.share)

    def record(self, items: str, shown: int, available: int) -> None:
        """Add to the numbers of shown and available items of one kind."""
        earlier = self.counts.get(items, (0, 0))
        self.counts[items] = (earlier[0] + int(shown), earlier[1] + int(available))

    def thinned_lines(self) -> list[str]:
        """Return a phrase for each kind of item that was thinned."""
        return [
            f"{shown:,} of {available:,} {items}"
            for items, (shown, available) in self.counts.items()
            if shown < available
        ]

    def to_dict(self) -> Mapping[str, Any]:
        """Return the numbers of shown and available items as JSON values."""
        return {items: {"shown": shown, "of": available} for items, (shown, available) in self.counts.items()}
