"""`bodycap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import make_progress_display
from bodycap_batch.cli.shared_options import (
    JobArgument,
    StoreOption,
    ThreadsOption,
    make_overrides,
    results_folder,
)
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_line
from bodycap_batch.config.bounds import MAX_FPS, MIN_FPS
from bodycap_batch.config.export_targets import TARGETS
from bodycap_batch.job_places import load_last_run


@app.command(short_help="Write the files for one program, or undistorted clips with their cameras.")
def export(  # noqa: PLR0913, PLR0917 - each option is a parameter
    job: JobArgument,
    target: Annotated[
        str | None, typer.Option("--for", metavar="PROGRAM", help=f"The program: {', '.join(TARGETS)}.")
    ] = None,
    undistorted: Annotated[
        bool,
        typer.Option(
            "--undistorted",
            help="Write the video of each camera without distortion, which matches the animated cameras.",
        ),
    ] = False,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to",
            metavar="DIR",
            help="Folder for the files (default: a folder PROGRAM or undistorted in the results).",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=MIN_FPS, max=MAX_FPS, help="Frames per second of the files (default: the rate of the motion)."
        ),
    ] = None,
    threads: ThreadsOption = None,
    store: StoreOption = None,
) -> None:
    """Write the files that one program expects, or undistorted clips, from the results of a finished job.

    The program decides the file formats, the joint names, the root joint, the units and the T-pose. The
    motion is not computed again. The file HOW_TO_IMPORT.txt says what to do in the program. The job may also
    be given by its results folder. To write the same files with every run, use `export: {target: PROGRAM}` in
    the job.

    The undistorted clip of a camera is an MP4 file with one picture for each frame of the animated cameras
    (cameras.glb and others). It has square pixels, and the principal point is in the centre. Beside it are a
    .chan file with the poses of the camera, and cameras.json with lens, picture size, rate and timecode.

    \b
    Examples:
      bodycap export out/my_walk --for unreal
      bodycap export out/my_walk --for blender --to ~/scenes/walk
      bodycap export out/my_walk --undistorted
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.api import Execution
    from bodycap_batch.config.export_targets import export_target
    from bodycap_batch.core.errors import JobError
    from bodycap_batch.pipeline import export_for, export_undistorted

    if target is not None:
        export_target(target)
    elif not undistorted:
        raise JobError(
            "neither a program nor --undistorted is given, so there is nothing to export",
            hint=f"add --undistorted, or --for with one of {', '.join(TARGETS)}",
        )
    resolved = load_last_run(job, make_overrides())
    out_dir = results_folder(resolved)
    with event_on_signal() as stop, make_progress_display(as_json=False) as display:
        settings = Execution(store=store, threads=threads, progress=display, cancelled=stop.is_set).settings(
            out_dir
        )
        written = []
        if target is not None:
            written += export_for(
                resolved, target, out_dir=out_dir, folder=to or out_dir / target, fps=fps, settings=settings
            )
        if undistorted:
            folder = to or out_dir / "undistorted"
            written += export_undistorted(
                resolved, out_dir=out_dir, folder=folder, fps=fps, settings=settings
            )
    for path in written:
        print_line(str(path))
