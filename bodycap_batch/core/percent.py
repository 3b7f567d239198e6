"""Format fractions as percentages."""

from __future__ import annotations


def format_percent(fraction: float, digits: int = 0) -> str:
    """Format a fraction as a rounded percentage.

    A fraction between 0 and 1 never gives 0 % or 100 %. With one decimal, 0.9996 gives ``99.9 %``, and 0.0004
    gives ``0.1 %``.

    Args:
        fraction: The fraction; 1 is 100 %. Values below 0 and above 1 are rounded as usual.
        digits: Number of decimals.

    Returns:
        The percentage as text.
    """
    step = 10.0**-digits
    value = 100.0 * fraction
    if 0.0 < fraction < 1.0:
        value = min(max(value, step), 100.0 - step)
    return f"{value:.{digits}f} %"
