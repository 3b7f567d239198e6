"""Colours of the cameras. A camera has the same colour in every file and image of a job."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray

Colour = tuple[int, int, int]

CAMERA_COLOURS: tuple[Colour, ...] = (
    (21, 164, 122), (207, 102, 167), (191, 138, 0), (133, 111, 230), (191, 63, 17), (115, 142, 216),
    (10, 118, 126), (144, 102, 69),
)  # fmt: skip
"""Colours of the cameras, RGB, 0 to 255. People with any colour vision deficiency can distinguish the
colours: in a simulation of such vision, two colours differ by at least 16 in CIELAB (1976). Each colour has a
contrast ratio of at least 3 to white and to the dark background of the preview. Orange and blue are late in
the list, because the preview draws the limbs in orange and blue. Source of the simulated vision: G. Machado
et al., "A physiologically-based model for simulation of color vision deficiency", 2009."""


def camera_colours(cameras: Iterable[str]) -> dict[str, Colour]:
    """Return the colour of each camera of a job.

    Colours are assigned to the cameras in the order of the camera names. The ninth camera has the same colour
    as the first camera.
    """
    names = sorted(set(cameras))
    return {name: CAMERA_COLOURS[number % len(CAMERA_COLOURS)] for number, name in enumerate(names)}


def hex_from_colour(colour: Colour) -> str:
    """Return a colour as a text in the form ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def linear_colours(srgb: npt.NDArray[np.uint8]) -> FloatArray:
    """Return the linear intensities (N,3), 0 to 1, of sRGB colours (N,3).

    Source: IEC 61966-2-1.
    """
    value = srgb / 255.0
    return np.asarray(np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))
