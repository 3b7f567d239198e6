"""A share below one never reads as all, one above nothing never as none."""

from __future__ import annotations

import pytest

from bodycap_batch.core.percent import format_percent


@pytest.mark.parametrize(
    ("share", "digits", "says"),
    [
        (1.0, 1, "100.0%"),
        (0.9996, 1, "99.9%"),
        (0.99999, 0, "99%"),
        (0.9876, 1, "98.8%"),
        (0.5, 0, "50%"),
        (0.0004, 1, "0.1%"),
        (0.0, 1, "0.0%"),
        (1.234, 0, "123%"),
        (-0.04, 1, "-4.0%"),
    ],
)
def test_rounding_never_says_all_or_nothing_where_it_is_not(share: float, digits: int, says: str) -> None:
    assert format_percent(share, digits) == says
