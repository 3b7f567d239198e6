"""The `bodycap` command with stand-in stages, in a process of its own or in that of the test."""

from __future__ import annotations

import functools
import io
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

from bodycap_batch import pipeline, runner, watch
from bodycap_batch.cli import main
from bodycap_batch.runner import dask_cluster, pool

CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))
_STARTING_CHILDREN = (
    (pipeline, "Settings"),
    (runner, "Children"),
    (watch, "WatchOptions"),
    (pool, "LocalPool"),
    (dask_cluster, "Cluster"),
)


@contextmanager
def stand_in_stages() -> Iterator[None]:
    """Let the commands start child processes with stand-in stages."""
    originals = [(module, name, getattr(module, name)) for module, name in _STARTING_CHILDREN]
    try:
        for module, name, value in originals:
            setattr(module, name, functools.partial(value, command=CHILD))
        yield
    finally:
        for module, name, value in originals:
            setattr(module, name, value)


def run_here(folder: Path, environment: Mapping[str, str], *arguments: str) -> tuple[int, str, str]:
    """Run the command in this process; return the exit code, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with (
        stand_in_stages(),
        chdir(folder),
        mock.patch.dict(os.environ, environment, clear=True),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        code = main(arguments)
    return code, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    with stand_in_stages():
        main()
