"""The `bodycap` command with stand-in stages."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

from bodycap_batch import cluster, pipeline, watch
from bodycap_batch.cli import main
from bodycap_batch.runner import pool

CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))

if __name__ == "__main__":
    pipeline.Settings = functools.partial(pipeline.Settings, command=CHILD)  # type: ignore[assignment, misc]
    watch.WatchOptions = functools.partial(watch.WatchOptions, command=CHILD)  # type: ignore[assignment, misc]
    pool.LocalPool = functools.partial(pool.LocalPool, command=CHILD)  # type: ignore[assignment, misc]
    cluster.Cluster = functools.partial(cluster.Cluster, command=CHILD)  # type: ignore[assignment, misc]
    main()
