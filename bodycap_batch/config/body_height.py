"""Read a body height as people write it: ``1.75``, ``1,75``, ``175``, ``1.75m``, ``5'9"``."""

from __future__ import annotations

import re

from bodycap_batch.core.errors import JobError

MIN_HEIGHT_M, MAX_HEIGHT_M = 0.4, 2.6
"""Minimum and maximum stature (metres) of a subject. Evidence: none."""
_METRES_PER_INCH = 0.0254
"""Length of an inch, metres. Source: the definition of the inch."""
_INCHES_PER_FOOT = 12.0
"""Length of a foot, inches. Source: the definition of the foot."""
_UNITS = {"m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each metric unit, metres."""
_NUMBER = r"(\d+(?:[.,]\d+)?)"
_METRIC = re.compile(rf"{_NUMBER}\s*([a-z]*)")
_FEET = re.compile(rf"(\d+)\s*(?:'|’|′|ft\.?|feet|foot)\s*(?:{_NUMBER}\s*(?:\"|''|”|″|in\.?|inch|inches)?)?")
_INCHES = re.compile(rf"{_NUMBER}\s*(?:\"|''|”|″|in\.?|inch|inches)")


def height_from_text(text: str | float) -> float:
    """Return a body height in metres.

    A number without a unit means metres if it is below 40, and centimetres otherwise.

    Args:
        text: The height as the user writes it, for example ``1.75``, ``1,75 m``, ``175`` or ``5'9"``.

    Raises:
        JobError: The text is no height, or no person has this height.
    """
    metres = _metres(str(text).strip().lower())
    if metres is not None and MIN_HEIGHT_M <= metres <= MAX_HEIGHT_M:
        return metres
    raise JobError(
        f"{str(text)[:40]!r} is not a body height"
        if metres is None
        else f"a body height of {metres:g} m is not plausible",
        field="height_m",
        hint="give the height in metres (1.75), in centimetres (175) or in feet and inches (5'9\")",
    )


def describe_height(metres: float) -> str:
    """Return a height in metres and in feet and inches, as text for the user."""
    feet, inches = divmod(round(metres / _METRES_PER_INCH), int(_INCHES_PER_FOOT))
    return f"{metres:.4g} m ({feet} ft {inches} in)"


def _metres(text: str) -> float | None:
    """Return the length that a text in lower case gives, metres; None if it gives none."""
    if found := _FEET.fullmatch(text):
        inches = _number(found[2]) if found[2] else 0.0
        return round((_INCHES_PER_FOOT * int(found[1]) + inches) * _METRES_PER_INCH, 4)
    if found := _INCHES.fullmatch(text):
        return round(_number(found[1]) * _METRES_PER_INCH, 4)
    found = _METRIC.fullmatch(text)
    if found is None or (found[2] and found[2] not in _UNITS):
        return None
    value = _number(found[1])
    unit = _UNITS[found[2]] if found[2] else 1.0 if value < MIN_HEIGHT_M / 0.01 else 0.01
    return round(value * unit, 4)


def _number(text: str) -> float:
    return float(text.replace(",", "."))
