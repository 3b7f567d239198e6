"""Run a job from Python and read its results back.

    .venv/bin/python examples/python_api.py my_walk/ --height 1.75

The same as `bodycap run my_walk/ --height 1.75`; finished stages are shared with it.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from bodycap_batch import Event, load_job, run_job


def show(event: Event) -> None:
    """Print every event except the progress."""
    if event.kind != "progress":
        print(event.kind, event.label, event.what)


def main() -> None:
    """Run the job given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("job", type=Path, help="a job file or a folder of videos")
    parser.add_argument("--height", type=float, help="the subject's height in metres")
    arguments = parser.parse_args()

    job = load_job(arguments.job, height_m=arguments.height, progress=show)
    result = run_job(job, progress=show)

    trajectories = result.trajectories()
    statuses = Counter(status.value for path in trajectories.values() for status in path.status)
    print("frames by status:", dict(statuses))
    for name, path in trajectories.items():
        centres = path.centres[path.localised]
        length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
        sigma = np.median(path.frames.sigma_position[path.localised])
        print(f"{name} travelled {length:.2f}; its centres have a standard deviation of {sigma:.4f}")
    if job.options.skeleton != "none":
        body = result.motion()
        hips = body.positions_m[:, body.index("Hips"), 2]
        print(f"{len(body.joints)} joints, {len(hips)} ticks")
        print(f"hips between {hips.min():.2f} and {hips.max():.2f} m over the floor")


if __name__ == "__main__":
    main()
