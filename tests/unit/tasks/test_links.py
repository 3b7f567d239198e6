"""The stage that compares paths with the tracks of the video, and withdraws contradicted poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core import mechanisms
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import FrameTiming
from bodycap_batch.model.scene import (
    FrameStatus,
    KeyframeSelection,
    MapResult,
    OtherPaths,
    Registration,
    Trajectory,
)
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.links import LinksTask, run_links
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.stage import read_summary, write_summary
from tests.scenes import small_map
from tests.unit.evaluate.test_right_frames import FRAMES, true_path
from tests.unit.evaluate.test_track_check import LENS, video

WRONG = np.arange(FRAMES) >= 85
"""The last frames: their poses are a leap away from the true path."""


def path_of(poses: FloatArray, gauge: str = "map-0", posed: BoolArray | None = None) -> Trajectory:
    """A path whose frames are registered, or lost because another map holds them."""
    posed = np.ones(FRAMES, dtype=bool) if posed is None else posed
    return Trajectory(
        camera="torso",
        gauge=gauge,
        frame_numbers=np.arange(FRAMES),
        times_ns=np.arange(FRAMES) * 33_333_333,
        gauge_from_cam=np.where(posed[:, None, None], poses, np.nan),
        covariance=np.where(posed[:, None, None], 1e-6 * np.eye(6), np.nan),
        status=tuple(FrameStatus.REGISTERED if each else FrameStatus.OTHER_MAP for each in posed),
        inliers=np.full(FRAMES, 50),
        error_px=np.full(FRAMES, 0.5),
    )


def compare(folder: Path, path: Trajectory, *others: Trajectory) -> Path:
    """Run the stage on paths, and return the folder of its artefact."""
    refs = {
        name: ArtefactRef(path=folder / name, digest=name) for name in ("keyframes", "map", "registration")
    }
    for ref in refs.values():
        ref.path.mkdir()
    selection = KeyframeSelection(
        camera="torso", frames=np.array([0]), frame_count=FRAMES, sharpness=np.ones(FRAMES), noise_px=0.2
    )
    write_dataclass(selection, refs["keyframes"].path, "keyframes")
    write_dataclass(replace(video(true_path()).tracks, camera="torso"), refs["keyframes"].path, "tracks")
    maps = tuple(replace(small_map(each.gauge), cameras={"torso": LENS}) for each in (path, *others))
    scene = MapResult(
        maps=tuple(replace(each, keyframe_camera=("torso",) * 5) for each in maps),
        workspace=refs["map"].path / "workspace",
        log={},
    )
    write_dataclass(scene, refs["map"].path, "map")
    before = refs["registration"].path
    nothing = np.zeros(0, dtype=np.int64)
    registration = Registration(
        trajectory=path,
        obs_frame=nothing,
        obs_keyframe=nothing,
        obs_feature=nothing,
        obs_px=np.zeros((0, 2), dtype=np.float32),
        wanted_keyframes=nothing,
        tried_keyframes=np.array([0]),
    )
    write_dataclass(registration, before, "registration")
    write_dataclass(FrameTiming(nominal_fps=30.0, rolling_shutter_s=0.0), before, "timing")
    write_dataclass(LENS, before, "camera")
    write_summary(before, rolling=True)
    if others:
        write_dataclass(OtherPaths(trajectories=others), before, "other_paths")
    out = folder / "links"
    out.mkdir()
    run_links(LinksTask(**refs), StageContext(work_dir=folder), out)
    return out


def leap() -> FloatArray:
    poses = true_path()
    poses[WRONG, 0, 3] += 0.5
    return poses


def test_poses_that_the_tracks_contradict_are_withdrawn(tmp_path: Path) -> None:
    path = path_of(leap())
    out = compare(tmp_path, path)
    found = load_registration(out).trajectory
    gone = np.array([each is FrameStatus.CONTRADICTED for each in found.status])
    assert np.count_nonzero(gone ^ WRONG) <= 3, "the tracks show the time of a leap to a few frames"
    assert not np.isfinite(found.gauge_from_cam[gone]).any()
    assert np.array_equal(found.gauge_from_cam[~gone], path.gauge_from_cam[~gone])
    summary = read_summary(out)
    assert summary["withdrawn"] == summary["links"][0]["withdrawn"] == summary["contradicted"] == gone.sum()
    assert (summary["localised"], summary["rolling"]) == (FRAMES - gone.sum(), True)
    assert summary["links"][0]["contradicted"] == np.count_nonzero(gone[::2]), (
        "counted before they were withdrawn"
    )
    assert read_dataclass(Camera, out, "camera").model == LENS.model
    assert read_dataclass(FrameTiming, out, "timing").nominal_fps == 30.0


def test_a_path_is_kept_if_it_is_not_known_which_part_is_wrong(tmp_path: Path) -> None:
    poses = true_path()
    poses[55:, 0, 3] += 0.5
    out = compare(tmp_path, path_of(poses))
    link = read_summary(out)["links"][0]
    assert (link["withdrawn"], read_summary(out)["withdrawn"]) == (0, 0)
    assert link["contradicted"] > 0.4 * link["compared"]


def test_a_right_path_is_not_stored_again(tmp_path: Path) -> None:
    out = compare(tmp_path, path_of(true_path()))
    assert read_summary(out)["withdrawn"] == read_summary(out)["links"][0]["contradicted"] == 0
    assert [each.name for each in out.iterdir()] == ["summary.json"]


def test_poses_in_other_maps_are_withdrawn_and_the_path_says_so(tmp_path: Path) -> None:
    inside = np.arange(FRAMES) < 40
    out = compare(tmp_path, path_of(true_path(), posed=inside), path_of(leap(), "map-1", ~inside))
    found = load_registration(out).trajectory
    assert found.localised[inside].all()
    other = read_dataclass(OtherPaths, out, "other_paths").trajectories[0]
    gone = np.array([each is FrameStatus.CONTRADICTED for each in found.status])
    assert 12 <= gone.sum() <= 18
    assert np.array_equal(other.localised, ~inside & ~gone)


def test_without_the_mechanism_the_poses_stay(tmp_path: Path) -> None:
    mechanisms.begin_task({mechanisms.KEY_OPTION: ["withdrawn_poses"]})
    try:
        out = compare(tmp_path, path_of(leap()))
    finally:
        mechanisms.begin_task({})
    assert read_summary(out)["withdrawn"] == 0 < read_summary(out)["links"][0]["contradicted"]
