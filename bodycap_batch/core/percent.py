"""Shares as text that never says more than is true."""

from __future__ import annotations


def format_percent(share: float, digits: int = 0) -> str:
    """A share as a percentage, rounded, but never up to all nor down to nothing.

    Args:
        share: 1 is all. Below 0 and above 1 it is a plain percentage.
        digits: After the point.

    Returns:
        ``100.0%`` for 1 alone: 0.9996 with one digit is ``99.9%``, 0.0004 is ``0.1%``.
    """
    step = 10.0**-digits
    value = 100.0 * share
    if 0.0 < share < 1.0:
        value = min(max(value, step), 100.0 - step)
    return f"{value:.{digits}f}%"
