"""Lines of text in a picture, in any script."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

WHITE, GREY, GREEN, RED, AMBER = (
    (240, 240, 240),
    (150, 155, 165),
    (95, 215, 135),
    (255, 105, 95),
    (245, 190, 70),
)


def write(image: Picture, text: str, at: tuple[int, int], colour: Colour = WHITE, size: int = 14) -> int:
    """Write one line with its baseline at a pixel; return the column after it."""
    import cv2

    after, _ = cv2.putText(image, text, at, colour, cv2.FontFace("sans"), size, 400)
    return int(after[0])


def width_of(text: str, size: int = 14) -> int:
    """Width of a line in pixels."""
    import cv2

    return int(cv2.getTextSize((4096, 64), text, (0, 0), cv2.FontFace("sans"), size, 400)[2])


def shortened(text: str, width: int, size: int = 14) -> str:
    """The text, its end cut off where it is wider than so many pixels."""
    if width_of(text, size) <= width:
        return text
    while text and width_of(text + "…", size) > width:
        text = text[:-1]
    return text + "…" if text else ""
