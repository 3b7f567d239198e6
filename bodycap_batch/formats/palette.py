"""One colour a camera, the same in every file and picture of a job."""

from __future__ import annotations

from collections.abc import Iterable

Colour = tuple[int, int, int]

CAMERA_COLOURS: tuple[Colour, ...] = (
    (21, 164, 122), (207, 102, 167), (191, 138, 0), (133, 111, 230), (191, 63, 17), (115, 142, 216),
    (10, 118, 126), (144, 102, 69),
)  # fmt: skip
"""Told apart by those who see no red, no green or no blue: 16 and more of CIELAB (1976) lie between any two,
simulated after G. Machado et al., A physiologically-based model for simulation of color vision deficiency,
2009. Each has a contrast of 3 and more on white paper and on the preview's dark ground. Orange and blue, the
limbs' own there, come late."""


def camera_colours(cameras: Iterable[str]) -> dict[str, Colour]:
    """The colour of each camera of a job, by the order of their names; after eight they begin again."""
    names = sorted(set(cameras))
    return {name: CAMERA_COLOURS[number % len(CAMERA_COLOURS)] for number, name in enumerate(names)}


def hex_from_colour(colour: Colour) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
