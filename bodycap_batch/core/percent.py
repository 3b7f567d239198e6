"""Fractions as percentages in text."""

from __future__ import annotations


def format_percent(fraction: float, digits: int = 0) -> str:
    """Return a fraction as a rounded percentage; only 1 gives 100 % and only 0 gives 0 %.

    Args:
        fraction: The value, 1 for 100 %. Values below 0 and above 1 are rounded as usual.
        digits: Number of decimals.

    Returns:
        The text: with one decimal, 0.9996 gives ``99.9%`` and 0.0004 gives ``0.1%``.
    """
    step = 10.0**-digits
    value = 100.0 * fraction
    if 0.0 < fraction < 1.0:
        value = min(max(value, step), 100.0 - step)
    return f"{value:.{digits}f}%"
