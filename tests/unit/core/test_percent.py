"""A fraction below one is never rounded to 100 %, one above zero never to 0 %."""

from __future__ import annotations

import pytest

from bodycap_batch.core.percent import format_percent


@pytest.mark.parametrize(
    ("fraction", "digits", "expected"),
    [
        (1.0, 1, "100.0 %"),
        (0.9996, 1, "99.9 %"),
        (0.99999, 0, "99 %"),
        (0.9876, 1, "98.8 %"),
        (0.5, 0, "50 %"),
        (0.0004, 1, "0.1 %"),
        (0.0, 1, "0.0 %"),
        (1.234, 0, "123 %"),
        (-0.04, 1, "-4.0 %"),
    ],
)
def test_only_one_gives_100_and_only_zero_gives_0(fraction: float, digits: int, expected: str) -> None:
    assert format_percent(fraction, digits) == expected
