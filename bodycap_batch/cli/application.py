"""The typer application. The modules of the commands register their commands with it."""

from __future__ import annotations

from typing import Annotated

import typer

import bodycap_batch
from bodycap_batch.cli.terminal import print_line

# The help is plain text: formatting it with rich would double the time of `--help`.
app = typer.Typer(
    name="bodycap",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        print_line(f"bodycap {bodycap_batch.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Body motion and a map of the room from body-worn cameras.

    The input is a folder of videos. The results are a map of the room (PLY), the motion (BVH), the camera
    paths (TUM) and numbers about their quality (metrics.json).

    \b
    Try it:
      bodycap run my_walk/            a folder with torso.mp4, left_palm.mp4, right_palm.mp4
      bodycap check my_walk/          show the files and settings of the job, and its problems
      make job                        run the example, in a clone of the repository

    \b
    Exit codes:
      0 done            3 unusable video or calibration    70 a bug
      2 wrong job or    4 the videos are not sufficient    130 or 143 stopped; run it
        command line      for a result                       again to continue
                        5 disk, store or cluster
    """  # noqa: D301 - \b keeps lines as they are
