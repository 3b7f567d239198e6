"""Draw lines of text, in any script, into an image."""

from __future__ import annotations

from bodycap_batch.overlay import Colour, RgbImage

WHITE, GREY, GREEN, RED, AMBER = (
    (240, 240, 240),
    (150, 155, 165),
    (95, 215, 135),
    (255, 105, 95),
    (245, 190, 70),
)
"""RGB colours of text on a dark background."""
_FONT, _FONT_WEIGHT = "sans", 400
"""OpenCV's built-in font, which has glyphs of many scripts, and the regular weight of this font."""


def draw_text(image: RgbImage, text: str, at: tuple[int, int], colour: Colour = WHITE, size: int = 14) -> int:
    """Draw one line of text into an image.

    Args:
        image: (H,W,3) RGB image, changed in place.
        text: The line of text.
        at: Column and row of the start of the baseline, pixels.
        colour: RGB colour of the text.
        size: Font size, pixels.

    Returns:
        The column after the text.
    """
    import cv2

    end, _ = cv2.putText(image, text, at, colour, cv2.FontFace(_FONT), size, _FONT_WEIGHT)
    return int(end[0])


def text_width_px(text: str, size: int = 14) -> int:
    """Return the width of a line of text in pixels."""
    import cv2

    return int(cv2.getTextSize((4096, 64), text, (0, 0), cv2.FontFace(_FONT), size, _FONT_WEIGHT)[2])


def shorten_to_width(text: str, width_px: int, size: int = 14) -> str:
    """Return the text. If it is too wide, its end is replaced by an ellipsis."""
    if text_width_px(text, size) <= width_px:
        return text
    while text and text_width_px(text + "…", size) > width_px:
        text = text[:-1]
    return text + "…" if text else ""
