"""Arrays inside the page: quantised to 16 bits or less, base64, thinned to a budget that is stated."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray, IntArray

NONE = 65535
"""The 16-bit code of a value that is not there."""
_LEVELS = NONE - 1
_TEXT = 4.0 / 3.0
"""Characters of base64 for each byte."""


def pack_scaled(values: FloatArray) -> dict[str, Any]:
    """Numbers (N,C) as 16 bits between each column's least and largest value; NaN stays NaN.

    The step is the range over 65,534: a third of a millimetre in a room 20 m across.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.where(np.isfinite(values), values, np.nan)
    low = np.nanmin(finite, axis=0, initial=np.inf)
    high = np.nanmax(finite, axis=0, initial=-np.inf)
    low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 0.0)
    span = np.where(high > low, high - low, 1.0)
    scaled = np.round((np.nan_to_num(finite) - low) / span * _LEVELS)
    codes = np.where(np.isfinite(finite), np.clip(scaled, 0, _LEVELS), NONE).astype("<u2")
    return {
        "low": [float(f"{value:.9g}") for value in low],
        "step": [float(f"{value:.9g}") for value in span / _LEVELS],
        "shape": list(values.shape),
        "u16": text_of(codes),
    }


def pack_bytes(values: npt.NDArray[np.uint8]) -> dict[str, Any]:
    """Bytes of any shape."""
    return {"shape": list(values.shape), "u8": text_of(values)}


def text_of(values: npt.NDArray[Any]) -> str:
    """Base64 of an array's bytes."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def thinned(count: int, most: int) -> IntArray:
    """At most `most` of `count` indices, evenly spread, first and last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.round(np.linspace(0, count - 1, max(most, 2))).astype(np.int64))


def affordable(budget: int, bytes_each: float) -> int:
    """How many items of so many bytes fit into a budget of characters."""
    return max(2, int(budget / (bytes_each * _TEXT)))


@dataclass(slots=True)
class Shown:
    """What the page shows of what there is.

    Attributes:
        share: Part of every budget that may be used; below 1 where the page would be too large.
        counts: By what is counted, how many are shown of how many.
    """

    share: float = 1.0
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    def of(self, budget: float) -> int:
        """What is left of a budget."""
        return int(budget * self.share)

    def note(self, what: str, shown: int, total: int) -> None:
        """Add to the account."""
        before = self.counts.get(what, (0, 0))
        self.counts[what] = (before[0] + int(shown), before[1] + int(total))

    def lines(self) -> list[str]:
        """The account as sentences: only what was thinned."""
        return [
            f"{shown:,} of {total:,} {what}" for what, (shown, total) in self.counts.items() if shown < total
        ]

    def document(self) -> Mapping[str, Any]:
        """The account as JSON values."""
        return {what: {"shown": shown, "of": total} for what, (shown, total) in self.counts.items()}
