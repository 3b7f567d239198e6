"""Readout times from pairs of keyframes, where the matches between adjacent frames do not suffice."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.intrinsics.readout_pairs import (
    advantage_sigmas,
    doubtful_groups,
    estimate_from_pairs,
    sampled_keyframes,
)
from bodycap_batch.mapping.intrinsics.readout_time import Readout
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, write_image
from bodycap_batch.mapping.matching.descriptors import DESCRIPTOR_NORM
from bodycap_batch.mapping.matching.pair_selection import PairGenerator
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.scene import KeyframeSelection

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
FRAMES = 80
FRAME_S = 1 / 30
NOISE_PX = 0.3


def pose_at(time_s: FloatArray, speed: float) -> tuple[FloatArray, FloatArray]:
    """Orientation (N,3,3) and position (N,3), m, of a camera that turns and moves to and fro."""
    phase = 2 * np.pi * time_s
    turn = [0.3 * np.sin(1.1 * phase), 0.5 * np.sin(1.4 * phase + 1.0), 0.3 * np.cos(1.2 * phase)]
    shift = [0.5 * np.sin(0.9 * phase), 0.3 * np.cos(0.7 * phase), 0.4 * np.sin(0.6 * phase)]
    return np.asarray(so3_exp(speed * np.stack(turn, axis=-1))), np.stack(shift, axis=-1)


def film(points: FloatArray, readout_s: float, speed: float) -> list[FloatArray]:
    """Observed pixels (M,2) of points (M,3) in each frame; NaN outside the picture."""
    rng = np.random.default_rng(1)
    out = []
    for frame in range(FRAMES):
        delay = np.zeros(len(points))
        for _ in range(8):
            rotation, position = pose_at(frame * FRAME_S + delay, speed)
            px = LENS.project(np.einsum("mji,mj->mi", rotation, points - position))
            delay = (np.nan_to_num(np.clip(px[:, 1] / 480.0, 0, 1), nan=0.5) - 0.5) * readout_s
        inside = np.asarray(((px > 0) & (px < (640, 480))).all(axis=1))
        out.append(np.where(inside[:, None], px + rng.normal(0, NOISE_PX, px.shape), np.nan))
    return out


def selection(
    camera: str, frames: IntArray, count: int, matches: FrameMatches | None = None
) -> KeyframeSelection:
    return KeyframeSelection(
        camera=camera,
        frames=frames,
        frame_count=count,
        sharpness=np.ones(count),
        noise_px=0.5,
        matches=matches,
    )


class Scene:
    """A camera that was filmed with a readout time, with the features of every second frame."""

    def __init__(self, folder: Path, readout_s: float, speed: float = 1.0) -> None:
        self.folder = folder
        rng = np.random.default_rng(2)
        points = rng.normal(size=(900, 3))
        points *= rng.uniform(2.0, 5.0, (900, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        px = film(points, readout_s, speed)
        first, second, frame = [], [], []
        for number in range(FRAMES - 1):
            rows = np.flatnonzero(np.isfinite(px[number] + px[number + 1]).all(axis=1))
            frame.append(np.full(len(rows), number))
            first.append(px[number][rows].astype(np.float32))
            second.append(px[number + 1][rows].astype(np.float32))
        matches = FrameMatches(
            camera="palm",
            frame=np.concatenate(frame),
            first_px=np.concatenate(first),
            second_px=np.concatenate(second),
        )
        self.selection = selection("palm", np.arange(0, FRAMES, 2), FRAMES, matches)
        camera = SimpleNamespace(
            name="palm",
            camera=LENS,
            calibrated=True,
            times_ns=np.round(np.arange(FRAMES) * FRAME_S * 1e9).astype(np.int64),
        )
        self.capture: Any = SimpleNamespace(camera=lambda name: camera, cameras=(camera,))
        directions = np.abs(rng.normal(size=(len(points), 128))) ** 3
        directions *= DESCRIPTOR_NORM / np.linalg.norm(directions, axis=1, keepdims=True)
        descriptors = np.round(directions).clip(0, 255).astype(np.uint8)
        with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
            camera_id = database.write_camera(LENS.to_pycolmap())
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
            database.write_rig(rig)
            for number in self.selection.frames.tolist():
                rows = np.flatnonzero(np.isfinite(px[number]).all(axis=1))[:150]
                image_id = write_image(database, ImageRef("palm", number), camera_id)
                keypoints = np.column_stack([px[number][rows], np.ones(len(rows)), np.zeros(len(rows))])
                database.write_keypoints(image_id, keypoints.astype(np.float32))
                sift = pycolmap.FeatureExtractorType.SIFT
                database.write_descriptors(image_id, pycolmap.FeatureDescriptors(sift, descriptors[rows]))

    def estimated(self, readout: Readout) -> Readout:
        """The readout time that follows from pairs, if matches between adjacent frames tell this one."""
        context = StageContext(work_dir=self.folder, threads=1)
        refs = [ImageRef("palm", frame) for frame in self.selection.frames.tolist()]
        times = {"palm": self.capture.camera("palm").times_ns}
        generator = PairGenerator(self.folder, refs, times, MapOptions(), context)
        found = estimate_from_pairs(
            self.folder, self.capture, [self.selection], {"palm": readout}, context, generator
        )
        return found["palm"]


def undetermined(best_s: float, sigma_s: float = 0.0048) -> Readout:
    return Readout(0.0, sigma_s, "not determined: the camera turns too evenly, or too little", best_s)


def test_pairs_of_keyframes_determine_a_readout_that_adjacent_frames_do_not(tmp_path: Path) -> None:
    found = Scene(tmp_path, 0.018).estimated(undetermined(0.013))
    assert found.source == "estimated"
    assert found.seconds == found.best_s
    # Adjacent frames alone are 5 ms off. The sigma is honest, so later estimates can improve on it.
    assert abs(found.seconds - 0.018) < 0.002
    assert abs(found.seconds - 0.018) < 2.0 * found.sigma_s
    assert found.sigma_s < 0.002


@pytest.mark.parametrize("best_s", [0.013, -0.006])
def test_a_global_shutter_stays_undetermined(tmp_path: Path, best_s: float) -> None:
    readout = undetermined(best_s)
    assert Scene(tmp_path, 0.0).estimated(readout) == readout


def test_a_correction_needs_an_advantage_in_independent_blocks() -> None:
    rng = np.random.default_rng(3)
    blocks = rng.integers(0, 20, (200, 2))
    none = np.full(200, 30)
    assert advantage_sigmas(none + np.where(rng.random(200) < 0.8, 1, -1), none, blocks) > 3.0
    assert abs(advantage_sigmas(none + np.where(rng.random(200) < 0.5, 1, -1), none, blocks)) < 3.0
    assert advantage_sigmas(none, none, blocks) == 0.0
    # The keyframes of a block have a common advantage, so their pairs are not independent.
    common = np.array([1] * 13 + [-1] * 7)[blocks].sum(axis=1)
    naive = (common > 0).sum() - (common < 0).sum()
    assert naive / np.sqrt((common != 0).sum()) > 3.0
    assert advantage_sigmas(none + common, none, blocks) < 3.0


def test_only_undetermined_shutters_that_displace_far_are_doubtful(tmp_path: Path) -> None:
    scene = Scene(tmp_path, 0.018)

    def doubtful(readout: Readout) -> list[list[str]]:
        return doubtful_groups(scene.capture, [scene.selection], {"palm": readout})

    assert doubtful(undetermined(0.013)) == [["palm"]]
    assert doubtful(undetermined(0.0005)) == []
    assert doubtful(undetermined(0.013, float("inf"))) == []
    assert doubtful(Readout(0.013, 0.001, "estimated", 0.013)) == []
    folder = tmp_path / "slow"
    folder.mkdir()
    slow = Scene(folder, 0.018, speed=0.02)
    assert doubtful_groups(slow.capture, [slow.selection], {"palm": undetermined(0.013)}) == []


def test_the_sample_is_evenly_spaced() -> None:
    many = selection("palm", np.arange(1000) * 3, 3000)
    few = selection("torso", np.arange(10), 3000)
    (kept,) = sampled_keyframes([many, few], ["palm"])
    assert len(kept.frames) == 200
    assert (kept.frames[0], kept.frames[-1]) == (0, 2997)
    assert set(np.diff(kept.frames)) <= {15, 18}
    (short,) = sampled_keyframes([many, few], ["torso"])
    assert np.array_equal(short.frames, few.frames)
