"""One colour a camera, the same in every file and picture of a job."""

from __future__ import annotations

from collections.abc import Iterable

Colour = tuple[int, int, int]

CAMERA_COLOURS: tuple[Colour, ...] = (
    (0, 158, 115), (204, 100, 165), (175, 138, 0), (135, 115, 220), (213, 80, 20), (50, 125, 210),
    (0, 150, 175), (150, 105, 70),
)  # fmt: skip
"""Told apart by the colour-blind (after M. Okabe, K. Ito, Color Universal Design), each with a contrast of 3
and more on white paper and on the preview's dark ground. Orange and blue, the limbs' own there, come late."""


def camera_colours(cameras: Iterable[str]) -> dict[str, Colour]:
    """The colour of each camera of a job, by the order of their names; after eight they begin again."""
    names = sorted(set(cameras))
    return {name: CAMERA_COLOURS[number % len(CAMERA_COLOURS)] for number, name in enumerate(names)}


def as_hex(colour: Colour) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
