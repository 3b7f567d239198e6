"""`bodycap calibrate` and `lenses`: the lens of a camera."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import command_context
from bodycap_batch.cli.shared_options import JsonOption, JsonProgressOption, parse_size
from bodycap_batch.cli.terminal import print_json, print_line, print_lines
from bodycap_batch.core.errors import JobError

if TYPE_CHECKING:
    from bodycap_batch.calibration import CalibrationBoard


@app.command()
def calibrate(  # noqa: PLR0913, PLR0917 - the flags a user types
    video: Annotated[
        Path | None, typer.Argument(metavar="[VIDEO]", help="A video of the board.", show_default=False)
    ] = None,
    print_: Annotated[
        Path | None,
        typer.Option("--print", metavar="FILE.pdf", help="Write a board to print, and calibrate nothing."),
    ] = None,
    chessboard: Annotated[
        str | None,
        typer.Option(
            metavar="CxR",
            help="The board is a chessboard with this number of inner corners, for example 9x6.",
        ),
    ] = None,
    charuco: Annotated[
        str | None,
        typer.Option(
            metavar="CxR", help="The board is a ChArUco board with this number of squares, for example 7x5."
        ),
    ] = None,
    dictionary: Annotated[
        str, typer.Option(help="ChArUco: name of the family of markers (OpenCV's dictionary).")
    ] = "4X4_50",
    marker: Annotated[
        float, typer.Option(help="ChArUco: side of a marker divided by the side of a square.")
    ] = 0.75,
    legacy: Annotated[
        bool, typer.Option("--legacy", help="ChArUco: the board was made with OpenCV before version 4.6.")
    ] = False,
    lens: Annotated[
        Literal["auto", "pinhole", "opencv", "fisheye"],
        typer.Option(help="Camera model; auto selects opencv, or fisheye if fisheye fits better."),
    ] = "auto",
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Camera to calibrate. The calibrations of other cameras in the file stay unchanged. "
            "Default: one calibration for all cameras.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File for the result (default: calib.json in the folder of the video).",
        ),
    ] = None,
    json_progress: JsonProgressOption = False,
) -> None:
    """Calibrate a camera from a video of a board.

    Print a board (--print), and glue it on something flat. Film the board with the camera settings of your
    captures: stabilisation is off; picture size, zoom and lens mode are the same. Move the board slowly to
    every corner of the picture, near and far, and tilt the board to all sides; half a minute is enough. If no
    board is named, its kind and size are measured. The command writes calib.json and a picture from which the
    distortion is removed, so that you can check it. Nothing is written if the error is too large, or if the
    views do not determine the focal length.

    \b
    Examples:
      bodycap calibrate --print board.pdf
      bodycap calibrate my_walk/board.mp4
      bodycap calibrate my_walk/board.mp4 --charuco 7x5
      bodycap calibrate board.mp4 --chessboard 9x6 --camera torso --out my_walk/calib.json
      bodycap calibrate wide.mp4 --chessboard 9x6 --lens fisheye
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.calibration import (
        calibrate_clip,
        find_board,
        write_board,
        write_calibration,
        write_preview,
    )

    if print_ is not None:
        write_board(print_)
        print_line(f"board: {print_.resolve()} (print it at 100 %, and glue it on something flat)")
        return
    if video is None:
        raise JobError(
            "the video is missing",
            field="VIDEO",
            hint="give a video of a board; `bodycap calibrate --print board.pdf` writes a board to print",
        )
    stated = _stated_board(chessboard, charuco, dictionary, marker, legacy=legacy)
    target = out or video.parent / "calib.json"
    with command_context("calibrate", as_json=json_progress) as context:
        result = calibrate_clip(video, stated or find_board(video, context), lens, context)
    preview = target.with_name(f"{target.stem}{f'_{camera}' if camera else ''}.png")
    write_calibration(result, target, camera)
    write_preview(result, preview)
    if not json_progress:
        print_lines([*result.lines(), f"calibration: {target.resolve()}", f"preview: {preview.resolve()}"])


def _stated_board(
    chessboard: str | None, charuco: str | None, dictionary: str, marker: float, *, legacy: bool
) -> CalibrationBoard | None:
    """Return the board in the options; None if the options name none."""
    from bodycap_batch.calibration import CalibrationBoard

    if chessboard is not None and charuco is not None:
        raise JobError(
            "only one board can be used",
            field="--charuco or --chessboard",
            hint="give one of the two options, for example --charuco 7x5, or none",
        )
    if chessboard is not None:
        columns, rows = parse_size(chessboard, "--chessboard", "the size of a board", _SIZE_HINT)
        return CalibrationBoard(kind="chessboard", columns=columns, rows=rows)
    if charuco is None:
        return None
    columns, rows = parse_size(charuco, "--charuco", "the size of a board", _SIZE_HINT)
    return CalibrationBoard(
        kind="charuco", columns=columns, rows=rows, dictionary=dictionary, marker=marker, legacy=legacy
    )


_SIZE_HINT = "give columns x rows, for example 7x5"
_MAX_LISTED = 200
"""Maximum number of profiles that the text lists."""


@app.command()
def lenses(
    search: Annotated[
        list[str],
        typer.Argument(metavar="SEARCH...", help="Words of the model, lens mode or size: hero11 wide 4k."),
    ],
    as_json: JsonOption = False,
) -> None:
    """Search the lenses that a job can name.

    A job names a lens as `calibration: GoPro HERO11 Black / Wide / 4K`. It is the first guess, which the map
    refines. The profiles are from Gyroflow's collection (CC0).

    \b
    Example:
      bodycap lenses hero11 wide 4k
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.lens_profiles import search_lenses

    words = " ".join(search)
    found = search_lenses(words)
    if not found:
        raise JobError(
            f"there is no lens profile with the words {words!r}",
            hint="search with fewer words, for example the model alone",
        )
    if as_json:
        print_json([{"name": each.name, **asdict(each)} for each in found], indent=1)
        return
    for profile in found[:_MAX_LISTED]:
        print_line(profile.text())
    if len(found) > _MAX_LISTED:
        print_line(f"and {len(found) - _MAX_LISTED} more: search with more words")
