"""`bodycap watch`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import (
    MemoryOption,
    RequireOption,
    ThreadsOption,
    WatchStoreOption,
    checked_requirement,
)
from bodycap_batch.cli.signals import event_on_signal, signal_exit_code
from bodycap_batch.cli.terminal import print_timed_message
from bodycap_batch.core.context import cores

if TYPE_CHECKING:
    from bodycap_batch.watch import Watcher, WatchOptions


RootOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="DIR", help="A folder with files that every job may read. You can repeat this option."
    ),
]
LimitOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="Change a limit for jobs (default: video_gb=64 video_hours=4 video_px=8192 files=10000 "
        "yaml_kb=1024 yaml_depth=20). You can repeat this option.",
    ),
]

WebOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT", help="Serve a web page that shows the jobs, for example on 127.0.0.1:8080."
    ),
]
TokenOption = Annotated[
    str,
    typer.Option(
        metavar="TOKEN",
        help="Token that a browser must send (/?token=TOKEN). A token is required if other machines can "
        "reach the address of --web.",
        envvar="BODYCAP_WEB_TOKEN",
        show_envvar=True,
        show_default=False,
    ),
]


@app.command(short_help="Run every folder of videos that someone puts into an inbox.")
def watch(  # noqa: PLR0913, PLR0917 - the flags a user types
    inbox: Annotated[
        Path,
        typer.Argument(
            metavar="[INBOX]",
            help="The folder to watch (inbox/), or the folder that contains inbox/.",
            show_default=True,
        ),
    ] = Path("jobs/inbox"),
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Number of jobs at the same time.")] = 1,
    threads: ThreadsOption = None,
    store: WatchStoreOption = None,
    memory_mb: MemoryOption = None,
    root: RootOption = None,
    limit: LimitOption = None,
    unchanged_s: Annotated[
        float,
        typer.Option(
            "--settle",
            min=0.0,
            metavar="SECONDS",
            help="If a folder has not changed for this time, the folder is complete and its job starts.",
        ),
    ] = 10.0,
    require: RequireOption = None,
    web: WebOption = None,
    web_token: TokenOption = "",
    once: Annotated[bool, typer.Option("--once", help="Stop when nothing is left to do.")] = False,
) -> None:
    """Run every folder of videos, or job file, that someone puts into INBOX.

    A folder is complete when it has not changed for a while, and no file in it shows that a video is not
    complete: a copy under another name (torso.mp4.part), or a video that is cut. The wait for such a file
    ends after 30 minutes. A folder with a file named READY is complete at once. Jobs move from inbox/ to
    running/, then to done/ or failed/. These folders are next to inbox/. done/NAME/result/ holds the results,
    done/NAME/input/ holds the dropped files. Stop the command with Ctrl-C at any time: the jobs continue when
    you start the command again. One watcher at a time may work on the folders.

    With --require, a job whose results do not reach the grade and the share goes to failed/, with its
    results and exit code 6. `require:` in the job file replaces it.

    A dropped job may only use files in its own folder and in the folders given by --root.

    \b
    Examples:
      bodycap watch jobs/inbox
      bodycap watch /mnt/nas/jobs/inbox --root /mnt/nas/footage --jobs 2
      bodycap watch jobs/inbox --once      run the jobs that are there, then stop
      bodycap watch jobs/inbox --web 127.0.0.1:8080
      bodycap status jobs                      list the jobs
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.limits import limits_from
    from bodycap_batch.watch import JobPermissions, Watcher, WatchOptions, spool_from_path

    spool = spool_from_path(inbox)
    options = WatchOptions(
        permissions=JobPermissions(
            roots=tuple(map(_existing_folder, root or ())), limits=limits_from(limit or ())
        ),
        store=store,
        jobs=jobs,
        threads=threads or cores(),
        memory_mb=memory_mb,
        unchanged_s=unchanged_s,
        require=checked_requirement(require),
        once=once,
    )
    with event_on_signal() as stop:
        watcher = Watcher(spool, options, print_timed_message)
        print_timed_message(f"watching {spool.inbox}; finished jobs are moved to {spool.done}")
        with _live_page(watcher, options, web, web_token):
            worst = _run(watcher, stop)
    if stop.is_set():
        print_timed_message("the watcher stopped; unfinished jobs continue when you start the watcher again")
        raise typer.Exit(signal_exit_code())
    raise typer.Exit(worst)


def _run(watcher: Watcher, stop: threading.Event) -> int:
    """Run the watcher until it ends or the user stops it; return the exit code."""

    def end() -> None:
        stop.wait()
        watcher.stop()

    threading.Thread(target=end, name="stop", daemon=True).start()
    return watcher.run()


@contextmanager
def _live_page(watcher: Watcher, options: WatchOptions, address: str | None, token: str) -> Iterator[None]:
    """Serve the live page while the body of the `with` statement runs; without an address, do nothing."""
    if address is None:
        yield
        return
    from bodycap_batch.watch.web import LivePage, access_from_address

    access, limits = access_from_address(address, token), options.permissions.limits
    with LivePage(watcher.spool, access, limits, lambda: watcher.access_failures.text) as page:
        print_timed_message(f"live page: {page.access.url}{'?token=TOKEN' if page.access.token else ''}")
        yield


def _existing_folder(path: Path) -> Path:
    from bodycap_batch.core.errors import JobError

    if not path.is_dir():
        raise JobError("there is no such folder", path=path, field="--root", hint="give an existing folder")
    return path.resolve()
