"""Pairs that only look alike are found by the rotation of the videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.rotation_graph import PairRotation, find_contradicted_pairs
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.rotation_chain import RotationChain
from tests.unit.mapping import wall

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
FRAMES, STEP = 240, 6
RATE_DEG = 1.5
"""Turn of the cameras in a frame: once around in the video."""


def yaw(degrees: float) -> FloatArray:
    return so3_exp(np.array([0.0, np.deg2rad(degrees), 0.0]))


def heading_deg(ref: ImageRef) -> float:
    """Two cameras turn in opposite directions."""
    return (RATE_DEG if ref.camera == "head" else -RATE_DEG) * ref.frame


def chain(camera: str, *, drift: float = 0.05, gaps: tuple[int, ...] = ()) -> RotationChain:
    """The rotation of a video whose angles are too large by `drift`; it is unknown in some links."""
    frames = np.arange(0, FRAMES + 1, STEP)
    turn = -np.deg2rad(heading_deg(ImageRef(camera, STEP)) * (1.0 + drift))
    turns = np.tile([0.0, turn, 0.0], (len(frames) - 1, 1))
    turns[list(gaps)] = np.nan
    sigma = np.where(np.isfinite(turns[:, 0]), 0.005, np.nan)
    return RotationChain(frames=frames, turns=turns, sigma_rad=sigma, turn_sigma=0.05)


def known(*chains: tuple[str, RotationChain | None]) -> dict[str, CameraIntrinsics]:
    times_ns = (np.arange(FRAMES + 1) * 33_333_333).astype(np.int64)
    return {name: CameraIntrinsics(LENS, True, each, times_ns) for name, each in chains}


def looks_like(first: ImageRef, second: ImageRef, turned_deg: float = 0.0) -> PairRotation:
    """A pair whose second keyframe looks as if the camera were turned further by `turned_deg`."""
    rng = np.random.default_rng(first.frame * 1000 + second.frame)
    noise = so3_exp(rng.normal(0.0, np.deg2rad(2.0), 3))
    rotation = yaw(heading_deg(second) + turned_deg).T @ yaw(heading_deg(first)) @ noise
    return PairRotation((first, second), rotation)


def overlapping(camera: str, other: str, turned_deg: float = 0.0) -> list[PairRotation]:
    """Pairs of keyframes whose headings differ by at most 30°, after the second one is turned."""
    refs = [ImageRef(name, frame) for name in sorted({camera, other}) for frame in range(0, FRAMES, 10)]
    out = []
    for number, first in enumerate(refs):
        for second in refs[number + 1 :]:
            apart = (heading_deg(second) + turned_deg - heading_deg(first) + 180.0) % 360.0 - 180.0
            if {first.camera, second.camera} == {camera, other} and abs(apart) <= 30.0:
                out.append(looks_like(first, second, turned_deg))
    return out


def pairs_of(items: list[PairRotation]) -> set[Pair]:
    return {item.pair for item in items}


def test_pairs_across_equal_bays_are_contradicted() -> None:
    right = overlapping("head", "head")
    alike = [item for turn in (90.0, 180.0, 270.0) for item in overlapping("head", "head", turn)]
    assert len(alike) > 2 * len(right)
    cameras = known(("head", chain("head")))
    assert find_contradicted_pairs(right + alike, cameras) == pairs_of(alike)
    assert find_contradicted_pairs(right, cameras) == set()
    assert find_contradicted_pairs([], cameras) == set()


def test_the_camera_that_looks_elsewhere_is_turned_as_most_pairs_say() -> None:
    own = overlapping("head", "head") + overlapping("palm", "palm")
    right = overlapping("head", "palm")
    alike = [item for turn in (90.0, 180.0) for item in overlapping("head", "palm", turn)[::2]]
    cameras = known(("head", chain("head")), ("palm", chain("palm")))
    assert find_contradicted_pairs(own + right + alike, cameras) == pairs_of(alike) - pairs_of(right)


def test_cameras_stay_apart_if_nothing_shows_which_pairs_are_right() -> None:
    own = overlapping("head", "head") + overlapping("palm", "palm")
    between = [item for turn in (0.0, 90.0, 180.0, 270.0) for item in overlapping("head", "palm", turn)]
    cameras = known(("head", chain("head")), ("palm", chain("palm")))
    assert find_contradicted_pairs(own + between, cameras) == pairs_of(between)


def test_near_frames_join_the_parts_beside_a_gap() -> None:
    right = overlapping("head", "head")
    alike = overlapping("head", "head", 90.0)
    cameras = known(("head", chain("head", gaps=(15, 28))))
    assert find_contradicted_pairs(right + alike, cameras) == pairs_of(alike)


def test_pairs_correct_a_video_whose_rotation_is_wrong() -> None:
    right = overlapping("head", "head")
    assert find_contradicted_pairs(right, known(("head", chain("head", drift=0.15)))) == set()


def test_pairs_of_a_camera_with_an_unknown_rotation_are_not_judged() -> None:
    pairs = overlapping("head", "head") + overlapping("head", "head", 90.0)
    assert find_contradicted_pairs(pairs, known(("head", None))) == set()
    mixed = overlapping("head", "palm", 90.0)
    assert find_contradicted_pairs(mixed, known(("head", chain("head")), ("palm", None))) == set()


def test_contradicted_pairs_are_removed_from_the_database(tmp_path: Path) -> None:
    wall.write_wall(tmp_path)
    frames = np.arange(wall.KEYFRAMES)
    turns = np.zeros((len(frames) - 1, 3))
    turns[6, 1] = np.pi / 2
    bay = RotationChain(frames=frames, turns=turns, sigma_rad=np.full(len(turns), 0.005), turn_sigma=0.05)
    refs = [ImageRef("cam", frame) for frame in range(wall.KEYFRAMES)]
    pairs = [(a, b) for a in refs for b in refs if 0 < b.frame - a.frame <= 5]
    context = StageContext(work_dir=tmp_path, threads=1)
    times_ns = frames.astype(np.int64) * 500_000_000
    verified = match_pairs(
        tmp_path, pairs, {"cam": CameraIntrinsics(wall.LENS, True, bay, times_ns)}, context
    )
    # The video turns by 90° behind frame 6; the other part of the wall only looks like the first one.
    assert len(verified) > 30
    assert not any(a.frame <= 6 < b.frame for a, b in verified)
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        stored = {(a, b) for a, b in pairs if database.exists_two_view_geometry(ids[a], ids[b])}
    assert stored == verified.keys()
