"""One colour per camera, the same in every file and image of a job."""

from __future__ import annotations

from collections.abc import Iterable

Colour = tuple[int, int, int]

CAMERA_COLOURS: tuple[Colour, ...] = (
    (21, 164, 122), (207, 102, 167), (191, 138, 0), (133, 111, 230), (191, 63, 17), (115, 142, 216),
    (10, 118, 126), (144, 102, 69),
)  # fmt: skip
"""RGB, 0 to 255. People with any colour vision deficiency can distinguish them: any two differ by 16 or more
in CIELAB (1976), as simulated after G. Machado et al., "A physiologically-based model for simulation of color
vision deficiency", 2009. Each has a contrast of at least 3 on white and on the dark background of the
preview. Orange and blue come late because the preview draws the limbs in them."""


def camera_colours(cameras: Iterable[str]) -> dict[str, Colour]:
    """Return the colour of each camera of a job.

    Colours are assigned in the order of the names; the ninth camera has the colour of the first.
    """
    names = sorted(set(cameras))
    return {name: CAMERA_COLOURS[number % len(CAMERA_COLOURS)] for number, name in enumerate(names)}


def hex_from_colour(colour: Colour) -> str:
    """Return a colour as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
