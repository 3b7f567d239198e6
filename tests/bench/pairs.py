"""Pairs that only look alike: how many of them the rotation of the videos shows.

``python -m tests.bench pairs FOLDER... --out FOLDER``: captures with true paths, without the removal of such
pairs. A pair is wrong if its rotation differs by more than 25° from the truth, and right below 15°. With
``--set NAME=VALUE``, a constant of `rotation_graph` has another value.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from bodycap_batch.capture import CaptureCamera, open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.core.mechanisms import VARIABLE, Mechanism
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching import rotation_graph
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef
from bodycap_batch.mapping.matching.pair_matching import read_pair_rotations
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.tasks.loading import load_keyframes
from tests.bench.measure import true_poses
from tests.bench.rows import BODYCAP, REPOSITORY

_WRONG_RAD, _RIGHT_RAD = np.deg2rad((25.0, 15.0))


def main(arguments: Sequence[str]) -> int:
    """Match the pairs, print the figures of each capture; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench pairs", description=__doc__)
    parser.add_argument("captures", nargs="+", type=Path, metavar="FOLDER", help="folders of captures")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results, kept")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="vary a constant")
    options = parser.parse_args(arguments)
    for item in options.set:
        name, _, value = item.partition("=")
        if not hasattr(rotation_graph, name):
            raise SystemExit(f"rotation_graph has no constant {name}")
        setattr(rotation_graph, name, float(value))
    for folder in options.captures:
        store = options.out / folder.name
        if not any(store.glob("artefacts/map/*")):
            place = ["--out", str(store / "out"), "--store", str(store)]
            subprocess.run(
                [*BODYCAP, "run", str(folder), "--skeleton", "none", "--until", "map", *place],
                cwd=REPOSITORY,
                env={**os.environ, VARIABLE: Mechanism.PAIR_ROTATIONS.value},
                check=True,
                stdout=subprocess.DEVNULL,
            )
        cameras = open_capture(load_job(folder).capture).cameras
        sys.stdout.write(f"{folder.name}: {_figures(folder, store, cameras)}\n")
        sys.stdout.flush()
    return 0


def _figures(folder: Path, store: Path, cameras: Sequence[CaptureCamera]) -> str:
    """Return how many of the wrong and of the right pairs are removed."""
    selections = {
        item.camera: item for item in map(load_keyframes, sorted(store.glob("artefacts/keyframes/*")))
    }
    known = {
        camera.name: CameraIntrinsics(
            camera.camera, True, selections[camera.name].rotation_chain, camera.times_ns
        )
        for camera in cameras
    }
    truth = {camera.name: true_poses(folder / "gt" / f"{camera.name}.tum", camera) for camera in cameras}
    workspace = next(store.glob("artefacts/map/*/workspace"))
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        pairs = read_pair_rotations(database)
    found = rotation_graph.find_contradicted_pairs(pairs, known)

    def rotation(ref: ImageRef) -> np.ndarray:
        return np.asarray(truth[ref.camera][ref.frame, :3, :3])

    errors = np.array(
        [
            np.linalg.norm(so3_log(rotation(one.pair[1]).T @ rotation(one.pair[0]) @ one.rotation.T))
            for one in pairs
        ]
    )
    removed = np.array([one.pair in found for one in pairs])
    wrong, right = errors > _WRONG_RAD, errors < _RIGHT_RAD
    return (
        f"{(removed & wrong).sum()} of {wrong.sum()} wrong pairs removed, "
        f"{(removed & right).sum()} of {right.sum()} right ones"
    )
