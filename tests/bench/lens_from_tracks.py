"""Compare the lens that the tracks of a video determine with the given one.

`python -m tests.bench lens [FOLDER...]` prints a line for each camera. Evidence: docs/decisions/tracks.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture import open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.tasks.keyframes import regions_and_lens
from tests.bench.rows import DATA


def main(arguments: Sequence[str]) -> int:
    """Print the estimated lens of each camera of some captures beside the given one; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench lens", description=__doc__)
    parser.add_argument(
        "folders", nargs="*", type=Path, help="captures (default: walk12, room12, tum_fr1_xyz)"
    )
    options = parser.parse_args(arguments)
    folders = options.folders or [DATA / name for name in ("walk12", "room12", "tum_fr1_xyz")]
    for folder in folders:
        for camera in open_capture(load_job(folder.resolve()).capture).cameras:
            unknown = replace(camera, camera=replace(camera.camera, refine=True))
            shown = regions_and_lens(unknown, StageContext(work_dir=Path()))
            regions, moving, found = shown.fixed, shown.moving, shown.lens
            share = f"fixed {regions.mean():4.0%}, moving {moving.mean() if moving.size else 0:4.0%}"
            sys.stdout.write(f"{folder.name:16} {camera.name:16} {share} {_line(camera.camera, found)}\n")
            sys.stdout.flush()
    return 0


def _line(given: Camera, found: LensEstimate | None) -> str:
    """Return the estimate, and the error of the angle of a pixel at a fifth of the width from the centre."""
    if found is None:
        return "too little motion"
    text = (
        f"{found.lens.model:22} f {found.lens.focal_px:7.1f} px +- {100 * found.focal_sigma:4.1f} %, "
        f"distortion {found.lens.params[3]:+.3f}, {found.error_px:.2f} px"
    )
    if given.refine:
        return text
    px = np.array([[given.principal_point_px[0] + 0.2 * given.width_px, given.principal_point_px[1]]])
    angles = [float(np.linalg.norm(np.arctan(each.unproject(px)))) for each in (given, found.lens)]
    return f"{text}; given {given.focal_px:.1f} px, angle {100 * (angles[1] / angles[0] - 1):+.1f} %"
