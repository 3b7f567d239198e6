"""Estimate a mean difference over captures and perturbations, with an interval from the bootstrap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.99
"""Probability of an interval. There are some twenty columns, so 95 % would find a difference in every
comparison."""
LEAST_PAIRS = 6
"""Least number of pairs for a decision: by chance, six differences have one sign with a probability of
3 %."""
_LEAST = 1e-6
"""Least difference, in the unit of a column. Smaller ones come from the rounding of numbers."""
_DRAWS = 4000
_SEED = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A mean difference.

    Attributes:
        mean: Mean over the captures of the mean over each capture's perturbations.
        low: Lower end of the interval.
        high: Upper end of the interval.
        pairs: Number of pairs.
        captures: Number of captures.
    """

    mean: float
    low: float
    high: float
    pairs: int
    captures: int


def estimate(values: Mapping[str, Sequence[float]]) -> Estimate | None:
    """Return the mean difference with its interval; None without values.

    Captures are drawn with replacement, and then the perturbations of each drawn capture. Because the drawn
    means of few captures vary less than those of new captures would, the interval is widened by the usual
    factor, the root of n / (n - 1).

    Args:
        values: The differences of each capture's pairs.
    """
    rows = [np.asarray(each, dtype=float) for each in values.values() if len(each)]
    if not rows:
        return None
    counts = np.array([len(row) for row in rows])
    padded = np.zeros((len(rows), counts.max()))
    for index, row in enumerate(rows):
        padded[index, : len(row)] = row
    mean = float(np.mean([row.mean() for row in rows]))
    rng = np.random.default_rng(_SEED)
    chosen = rng.integers(len(rows), size=(_DRAWS, len(rows)))
    size = counts[chosen][..., None]
    seeds = (rng.random((*chosen.shape, padded.shape[1])) * size).astype(int)
    drawn = np.where(np.arange(padded.shape[1]) < size, padded[chosen[..., None], seeds], 0.0)
    means = (drawn.sum(axis=2) / size[..., 0]).mean(axis=1)
    low, high = np.quantile(means, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0]) - mean
    units = len(rows) if len(rows) > 1 else int(counts[0])
    wider = float(np.sqrt(units / (units - 1.0))) if units > 1 else 1.0
    return Estimate(
        mean=mean,
        low=mean + wider * float(low),
        high=mean + wider * float(high),
        pairs=int(counts.sum()),
        captures=len(rows),
    )


def word_of(found: Estimate | None, sign: int) -> str:
    """Return "better", "worse", "no difference" or "too few" for a difference of side B from side A.

    Args:
        found: The difference.
        sign: 1 if more is better, -1 if less is better.
    """
    if found is None:
        return "too few"
    low, high = sorted((sign * found.low, sign * found.high))
    if found.pairs < LEAST_PAIRS and max(-low, high, abs(found.mean)) > _LEAST:
        return "too few"
    return "better" if low > _LEAST else "worse" if high < -_LEAST else "no difference"
