"""Frozen dataclasses on disk: round trips, stable bytes, refusals."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.dataclass_files import read_dataclass, read_npz, write_dataclass, write_npz
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.model.scene import (
    FrameStatus,
    KeyframeSelection,
    Map,
    MapResult,
    Registration,
    Trajectory,
)
from bodycap_batch.model.skeleton import Motion, Mount, SkeletonModel


def same(first: Any, second: Any) -> bool:
    """Return whether two values are equal, with NaN equal to NaN."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(
            first, second, equal_nan=first.dtype.kind == "f"
        )
    if dataclasses.is_dataclass(first):
        names = [field.name for field in dataclasses.fields(first)]
        return type(first) is type(second) and all(same(getattr(first, n), getattr(second, n)) for n in names)
    if isinstance(first, Mapping):
        return list(first) == list(second) and all(same(first[k], second[k]) for k in first)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(same(a, b) for a, b in zip(first, second, strict=True))
    return bool(first == second) or bool(np.isnan(first) and np.isnan(second))


def a_camera() -> Camera:
    return Camera(model="PINHOLE", width_px=64, height_px=48, params=np.array([50.1, 50.0, 32.0, 24.0]))


def a_trajectory(rng: np.random.Generator) -> Trajectory:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(3, 3))
    poses[1] = np.nan
    return Trajectory(
        camera="torso",
        gauge="g0",
        frame_numbers=np.arange(3),
        times_ns=np.arange(3) * 33_333_333 + 2**60,
        gauge_from_cam=poses,
        covariance=np.where(np.isnan(poses[:, :1, :1]), np.nan, np.eye(6)),
        status=(FrameStatus.KEYFRAME, FrameStatus.BLUR, FrameStatus.REGISTERED),
        inliers=np.array([30, 0, 40]),
        error_px=np.array([0.5, np.nan, 0.7]),
    )


def a_map(rng: np.random.Generator) -> Map:
    return Map(
        gauge="g0",
        cameras={"torso": a_camera(), "left_palm": a_camera()},
        keyframe_camera=("torso", "left_palm"),
        keyframe_frame=np.array([0, 5]),
        map_from_cam=np.tile(np.eye(4), (2, 1, 1)),
        points=rng.normal(size=(4, 3)),
        colors=rng.integers(0, 255, (4, 3)).astype(np.uint8),
        point_error_px=rng.random(4),
        obs_keyframe=np.array([0, 1]),
        obs_point=np.array([3, 2]),
        obs_feature=np.array([10, 11]),
        obs_px=rng.random((2, 2)),
    )


def a_skeleton() -> SkeletonModel:
    return SkeletonModel(
        name="two",
        joints=("Hips", "Spine"),
        parents=np.array([-1, 0]),
        offsets_m=np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 0.1]]),
        end_offsets_m=np.array([[np.nan] * 3, [0.0, 0.0, 0.2]]),
        roles=("Hips", "Spine"),
        bvh_channels=(("Xposition", "Yposition"), ()),
    )


def a_report() -> MergeReport:
    return MergeReport.from_dict(
        {
            "scale": {"source": "height", "relative_sigma": 0.05, "body_alone": {"costs": [[1.0, 2.5]]}},
            "exchanged_sides": {"cameras": {"left_palm": 1.0}, "says": "swapped"},
        }
    )


def a_merge(rng: np.random.Generator) -> MergeResult:
    return MergeResult(
        skeleton=a_skeleton(),
        fps=29.97,
        start_ns=12,
        graph_world_from_joint=np.tile(np.eye(4), (3, 2, 1, 1)),
        solved=np.array([True, False]),
        observed=np.zeros((3, 2), dtype=bool),
        motion=Motion(
            skeleton=a_skeleton(),
            fps=29.97,
            start_ns=12,
            root_in_world_m=rng.normal(size=(3, 3)),
            local_rotation=np.tile(np.eye(3), (3, 2, 1, 1)),
            observed=np.zeros((3, 2), dtype=bool),
        ),
        projection_gap={"cameras": {}},
        world_from_map={"g0": Similarity(scale=2.0, rotation=np.eye(3), translation=rng.normal(size=3))},
        trajectories=(a_trajectory(rng),),
        mounts=(Mount(camera="torso", role="Spine1", joint_from_cam=np.eye(4), sigma_rad=0.1, sigma_m=0.02),),
        unused_cameras={"left_palm": "no map"},
        report=a_report(),
    )


def a_registration(rng: np.random.Generator) -> Registration:
    extra = {
        field.name: np.array([1, 2])
        for field in dataclasses.fields(Registration)
        if field.name.endswith("_keyframes")
    }
    return Registration(
        trajectory=a_trajectory(rng),
        obs_frame=np.array([1, 1]),
        obs_keyframe=np.array([0, 0]),
        obs_feature=np.array([4, 5]),
        obs_px=rng.random((2, 2)).astype(np.float32),
        **extra,
    )


def a_selection(rng: np.random.Generator) -> KeyframeSelection:
    return KeyframeSelection(
        camera="torso", frames=np.array([0, 2]), frame_count=4, sharpness=rng.random(4), noise_px=0.25
    )


MAKERS = [a_trajectory, a_map, a_merge, a_registration, a_selection]


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_what_is_written_is_read_back_exactly(tmp_path: Path, make: Any) -> None:
    value = make(np.random.default_rng(1))
    write_dataclass(value, tmp_path, "value")
    assert same(read_dataclass(type(value), tmp_path, "value"), value)


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_equal_values_give_equal_bytes_at_any_time(
    tmp_path: Path, make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        write_dataclass(make(np.random.default_rng(1)), tmp_path / folder, "value")
        now = time.time() + 1e7
        monkeypatch.setattr(time, "time", lambda now=now: now)
    names = sorted(path.name for path in (tmp_path / "first").iterdir())
    assert names == ["value.json", "value.npz"]
    for name in names:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_numpy_itself_reads_the_arrays(tmp_path: Path) -> None:
    selection = a_selection(np.random.default_rng(1))
    write_dataclass(selection, tmp_path, "value")
    with np.load(tmp_path / "value.npz") as archive:
        assert np.array_equal(archive["sharpness"], selection.sharpness)


def test_a_path_is_kept_relative_so_that_the_artefact_can_move(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    (old / "workspace").mkdir(parents=True)
    result = MapResult(maps=(a_map(np.random.default_rng(1)),), workspace=old / "workspace", log={"n": 1})
    write_dataclass(result, old, "map")
    old.rename(new)
    assert read_dataclass(MapResult, new, "map").workspace == new / "workspace"


def test_a_path_outside_the_artefact_is_refused(tmp_path: Path) -> None:
    (tmp_path / "artefact").mkdir()
    result = MapResult(maps=(), workspace=tmp_path, log={})
    with pytest.raises(ValueError, match="subpath"):
        write_dataclass(result, tmp_path / "artefact", "map")


def test_a_value_without_arrays_needs_no_npz(tmp_path: Path) -> None:
    clock = CameraClock(nominal_fps=30.0, offset_s=-0.12)
    write_dataclass(clock, tmp_path, "clock")
    assert [path.name for path in tmp_path.iterdir()] == ["clock.json"]
    assert read_dataclass(CameraClock, tmp_path, "clock") == clock


@dataclass(frozen=True, slots=True, kw_only=True)
class Loose:
    """Fields with types that do not determine the values."""

    number: float
    anything: Mapping[str, Any]
    maybe: float | None = None


def test_nan_and_infinity_are_kept_in_fields_declared_as_float(tmp_path: Path) -> None:
    value = Loose(number=float("-inf"), anything={"nan": float("nan"), "np": np.float64(0.5), "t": (1, 2)})
    write_dataclass(value, tmp_path, "value")
    read = read_dataclass(Loose, tmp_path, "value")
    assert read.number == float("-inf")
    assert read.anything == {"nan": None, "np": 0.5, "t": [1, 2]}
    assert read.maybe is None


def test_other_objects_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="object"):
        write_dataclass(Loose(number=1.0, anything={"x": object()}), tmp_path, "value")


def test_another_type_is_refused(tmp_path: Path) -> None:
    write_dataclass(CameraClock(nominal_fps=30.0), tmp_path, "value")
    with pytest.raises(StoreError, match="CameraClock"):
        read_dataclass(Camera, tmp_path, "value")


@pytest.mark.parametrize("victim", ["value.json", "value.npz"])
@pytest.mark.parametrize("damage", ["missing", "cut", "empty"])
def test_damage_is_a_typed_error(tmp_path: Path, victim: str, damage: str) -> None:
    write_dataclass(a_selection(np.random.default_rng(1)), tmp_path, "value")
    path = tmp_path / victim
    if damage == "missing":
        path.unlink()
    else:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] if damage == "cut" else b"")
    with pytest.raises(StoreError):
        read_dataclass(KeyframeSelection, tmp_path, "value")


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "evil.npz", evil=np.array([object()], dtype=object))
    with pytest.raises(ValueError, match="pickle"):
        read_npz(tmp_path / "evil.npz")
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(tmp_path / "other.npz", {"evil": np.array([object()], dtype=object)})
