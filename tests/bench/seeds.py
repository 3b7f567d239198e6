"""Influence of chance on a map: the same keyframes mapped with several seeds and compared with the truth."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bodycap_batch.capture import open_capture
from bodycap_batch.config import KeyframeOptions, MapOptions
from bodycap_batch.config.job import load_job
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping import build_map
from bodycap_batch.model.geometry import align_points
from bodycap_batch.model.scene import Map
from tests.bench.rows import DATA


def main(arguments: Sequence[str]) -> int:
    """Map captures with seeds 0, 1, …; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="make bench ARGS='seeds …'", description=__doc__)
    parser.add_argument("captures", nargs="+", help="names of captures with truth, or folders")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="number of seeds (5)")
    options = parser.parse_args(arguments)
    for name in options.captures:
        folder = Path(name) if Path(name).is_dir() else options.data / name
        rms_m = []
        for seed, errors_m in enumerate(_errors_by_seed(folder, options.seeds)):
            rms_m.append(float(np.sqrt((errors_m**2).mean())))
            _write_line(
                f"{folder.name}, seed {seed}: {len(errors_m)} keyframes in the largest map, "
                f"{100 * rms_m[-1]:.2f} cm, worst {100 * errors_m.max():.1f}"
            )
        _write_line(summary(folder.name, rms_m))
    return 0


def summary(name: str, rms_m: Sequence[float]) -> str:
    """Return the mean error and the deviation of single seeds from it, as text."""
    mean, deviation = float(np.mean(rms_m)), float(np.std(rms_m, ddof=1)) if len(rms_m) > 1 else 0.0
    width = max(rms_m) - min(rms_m)
    return (
        f"{name}: {100 * mean:.2f} cm on the average of {len(rms_m)} seeds, standard deviation "
        f"{deviation / mean:.0%}, from least to largest {width / mean:.0%} of it"
    )


def _errors_by_seed(folder: Path, seeds: int) -> list[FloatArray]:
    """Return the errors (K,) in metres of the largest map's keyframes, per seed."""
    capture = open_capture(load_job(folder).capture)
    truth = {camera.name: read_tum(folder / "gt" / f"{camera.name}.tum") for camera in capture.cameras}
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as work:
        root = Path(work)
        chosen = [
            select_keyframes(camera, KeyframeOptions(), StageContext(work_dir=root))
            for camera in capture.cameras
        ]
        out = []
        for seed in range(seeds):
            context = StageContext(work_dir=root / str(seed), threads=2)
            found = build_map(capture, chosen, MapOptions(seed=seed), context)
            poses = {name: path.world_from_cam for name, path in truth.items()}
            out.append(keyframe_errors_m(found.maps[0], poses))
    return out


def keyframe_errors_m(scene_map: Map, truth: dict[str, FloatArray]) -> FloatArray:
    """Return the errors (K,) of keyframe centres after alignment by one similarity.

    Args:
        scene_map: The map.
        truth: Per camera, a true pose (4,4) for each frame.
    """
    expected = np.array(
        [
            truth[camera][frame, :3, 3]
            for camera, frame in zip(
                scene_map.keyframe_camera, scene_map.keyframe_frame.tolist(), strict=True
            )
        ]
    )
    centres = scene_map.map_from_cam[:, :3, 3]
    return np.asarray(np.linalg.norm(align_points(centres, expected).apply(centres) - expected, axis=1))


def _write_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
