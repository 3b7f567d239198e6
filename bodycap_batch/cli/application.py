"""The typer application. The modules of the commands register their commands with it."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import bodycap_batch
from bodycap_batch.cli.terminal import print_line

COMMAND_GROUPS = {
    "Record and solve": (
        "check", "run", "init", "lenses", "calibrate", "skeleton", "sync", "telemetry",
    ),
    "Look": ("open", "view", "report", "compare"),
    "Export": ("export",),
    "Operate": ("batch", "watch", "status", "retry", "cancel", "why", "gc", "doctor"),
    "Develop": ("synth", "evaluate"),
}  # fmt: skip
"""The commands in the order of the help, by the title of their group."""


class _GroupedCommands(TyperGroup):
    """The commands of `COMMAND_GROUPS`, in its order and under its titles."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - the signature is Click's
        """Write one section of the help for each group. All short helps begin in one column."""
        width = max(map(len, self.commands))
        room = formatter.width - 4 - width  # 2 columns before the name, 2 between name and help
        for title, names in COMMAND_GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(name.ljust(width), self.commands[name].get_short_help_str(room)) for name in names]
                )


# The help is plain text: formatting it with rich would double the time of `--help`.
app = typer.Typer(
    name="bodycap",
    cls=_GroupedCommands,
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
      bodycap check my_walk/    show the files, the settings and the problems
      bodycap run my_walk/      torso.mp4, left_palm.mp4, right_palm.mp4 inside
      make job                  run the example, in a clone of the repository

    \b
    Exit codes:
      0 done                            5 disk, store or cluster
      2 wrong job or command line       6 done, but not what --require states
      3 unusable video or calibration   70 a bug
      4 the videos are not sufficient   130 or 143 stopped; run it again to
        for a result                      continue
    """  # noqa: D301 - \b keeps lines as they are
