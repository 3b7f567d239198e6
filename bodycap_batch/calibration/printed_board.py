"""Write a calibration board as a PDF page to print."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.calibration.board_detection import CalibrationBoard, GreyImage
from bodycap_batch.core.arrays import runs
from bodycap_batch.formats.atomic_files import write_text

PRINTED_BOARD = CalibrationBoard(kind="charuco", columns=7, rows=5)
"""The board to print: a usual ChArUco board, which `find_board` tries first."""
_PAGE_MM = (297.0, 210.0)
"""Width and height of the page (millimetres): A4 across. Source: ISO 216."""
_SQUARE_MM = 36.0
"""Side of a printed square, millimetres. The board also fits on US letter paper (279 mm × 216 mm)."""
_PIXELS = 8
"""Number of pixels of a square in the drawn board. A marker has a border and 4 bits across, six parts in all,
and covers 0.75 of the square; a part is therefore exactly one pixel."""
_POINTS_PER_MM = 72.0 / 25.4
"""Number of PDF units in a millimetre. Source: ISO 32000."""


def write_board(path: Path) -> None:
    """Write the board to print as a PDF page. Raises `StoreError` if the file cannot be written."""
    write_text(path, _pdf(_page(PRINTED_BOARD.picture(_PIXELS))))


def _page(picture: GreyImage) -> str:
    """Return the drawing commands of a page: a rectangle for each run of black pixels, and a line of text."""
    height, width = picture.shape
    side = _SQUARE_MM / _PIXELS * _POINTS_PER_MM
    left = (_PAGE_MM[0] * _POINTS_PER_MM - width * side) / 2
    top = (_PAGE_MM[1] * _POINTS_PER_MM + height * side) / 2
    commands = ["0 g"]
    for row, pixels in enumerate(picture):
        for start, end in runs(np.asarray(pixels < 128)):
            x, y = left + start * side, top - (row + 1) * side
            commands.append(f"{x:.3f} {y:.3f} {(end - start) * side:.3f} {side:.3f} re f")
    text = f"ChArUco 7x5, 4X4_50. Print at 100 %: a square is {_SQUARE_MM:.0f} mm wide. Glue it on a plate."
    commands.append(f"BT /F1 9 Tf {left:.2f} {(top - height * side) / 2:.2f} Td ({text}) Tj ET")
    return "\n".join(commands)


def _pdf(content: str) -> str:
    """Return a PDF file with one page that has these drawing commands."""
    width, height = (size * _POINTS_PER_MM for size in _PAGE_MM)
    objects = (
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.2f} {height:.2f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    )
    out, starts = "%PDF-1.4\n", []
    for number, text in enumerate(objects, start=1):
        starts.append(len(out))
        out += f"{number} 0 obj\n{text}\nendobj\n"
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    return out + (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(out)}\n%%EOF\n"
    )
