"""Run a job from Python and read its results back.

    .venv/bin/python examples/python_api.py my_walk/ --height 1.75

The same as `bodycap run my_walk/ --height 1.75`; finished stages are shared with it.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter
from pathlib import Path

import numpy as np

from bodycap_batch.config.job import Overrides, load_job
from bodycap_batch.core.progress import Event
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.pipeline import Settings, run_job
from bodycap_batch.store import Store


def show(event: Event) -> None:
    """Print every event except the progress."""
    if event.kind != "progress":
        print(event.kind, event.stage, event.camera)


def main() -> None:
    """Run the job given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("job", type=Path, help="a job file or a folder of videos")
    parser.add_argument("--height", type=float, help="the subject's height in metres")
    arguments = parser.parse_args()

    job = load_job(arguments.job, Overrides(height_m=arguments.height))
    out = job.out
    assert out is not None  # a loaded job has a folder for its results: out/NAME beside the job
    settings = Settings(store=Store(out.parent / ".store"), threads=2, listener=show, cancelled=lambda: False)
    summary = run_job(job, out_dir=out, settings=settings)

    with (summary.out_dir / "frames.csv").open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(line for line in stream if not line.startswith("#"))
        print("frames by status:", dict(Counter(row["status"] for row in rows)))
    for path in sorted((summary.out_dir / "trajectories").glob("*.tum")):
        centres = read_tum(path).world_from_cam[:, :3, 3]
        length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
        print(f"{path.stem} travelled {length:.2f}")
    if (summary.out_dir / "motion.bvh").exists():
        skeleton, motion = read_bvh(summary.out_dir / "motion.bvh")
        assert motion is not None
        hips = motion.world_from_joint()[:, 0, :3, 3]
        print(f"{len(skeleton.joints)} joints, {len(hips)} ticks at {motion.fps:g} Hz")
        print(f"hips between {hips[:, 2].min():.2f} and {hips[:, 2].max():.2f} m over the floor")


if __name__ == "__main__":
    main()
