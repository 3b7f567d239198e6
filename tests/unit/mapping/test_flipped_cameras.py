"""A camera with a flipped picture is found by its matches with other cameras."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from bodycap_batch import merging
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions, MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    read_image_ids,
    read_keypoint_colours,
)
from bodycap_batch.mapping.matching.flipped_cameras import (
    add_flip_hint,
    exclude_flipped_cameras,
    excluded_camera_note,
    flip_notes,
    label_cameras,
    mirror_descriptors,
)
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.mapping.matching.retrieval import count_ratio_test_matches, largest_descriptors
from bodycap_batch.model.map_diagnostics import CameraGroups, MapDiagnostics
from bodycap_batch.model.scene import KeyframeSelection
from bodycap_batch.tasks import merge
from bodycap_batch.tasks.inputs import ArtefactRef


def _wall() -> np.ndarray:
    """Return a wall (480,1600) of irregular blots, which differ from their mirror images."""
    rng = np.random.default_rng(5)
    wall = np.full((480, 1600), 120, np.uint8)
    for x, y, shade in zip(
        rng.integers(0, 1600, 700), rng.integers(0, 480, 700), rng.integers(0, 255, 700), strict=True
    ):
        corners = np.add(rng.integers(-28, 28, (4, 2)), (x, y))
        cv2.fillPoly(wall, [corners.astype(np.int32)], int(shade))
    return cv2.GaussianBlur(wall, (0, 0), 1.5)


WALL = _wall()
LEFT_OR_TORSO = MapDiagnostics(undecided_groups=((("left",), ("torso",)),))


class _Pan:
    """A camera that pans along the wall from `start`; its picture may be mirrored or upside down."""

    shows_only_room = True

    def __init__(
        self, name: str, start: int, *, mirrored: bool = False, upside_down: bool = False, count: int = 6
    ) -> None:
        self.frames = np.arange(count)
        self.name, self._start, self._mirrored, self._turned = name, start, mirrored, upside_down

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return np.ones(len(px), dtype=bool)

    def read(self, frames: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        assert colour
        for frame in map(int, frames):
            left = self._start + 60 * frame
            image = WALL[:, left : left + 640]
            image = image[:, ::-1] if self._mirrored else image
            yield (
                frame,
                np.repeat((image[::-1, ::-1] if self._turned else image)[..., None], 3, axis=2).copy(),
            )


def _workspace(folder: Path, *cameras: _Pan) -> list[KeyframeSelection]:
    """Write a database of the cameras' keyframes into a folder, and return the selections."""
    folder.mkdir(exist_ok=True)
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        lens = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[420.0, 420.0, 320.0, 240.0])
        ids = [database.write_camera(lens) for _ in cameras]
        for each in ids:
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, each))
            database.write_rig(rig)
    keyframes = [
        CameraKeyframes(cast(CaptureCamera, camera), number, camera.frames)
        for camera, number in zip(cameras, ids, strict=True)
    ]
    add_keyframes(folder, keyframes, MapOptions(), StageContext(work_dir=folder, threads=1))
    chosen: list[Any] = [SimpleNamespace(camera=camera.name, frames=camera.frames) for camera in cameras]
    return cast(list[KeyframeSelection], chosen)


def _remaining(folder: Path, *cameras: _Pan) -> tuple[list[str], MapDiagnostics]:
    """Return the names of the remaining cameras, and the diagnostics."""
    left, _, diagnostics = exclude_flipped_cameras(folder, _workspace(folder, *cameras), MapOptions())
    return [item.camera for item in left], diagnostics


def _content(folder: Path) -> list[tuple[Any, ...]]:
    """Return everything that a database holds about its images."""
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        assert database.num_cameras() == database.num_rigs()
        assert database.num_images() == database.num_frames()
        return [
            (
                ref,
                number,
                database.read_image(number).camera_id,
                np.asarray(database.read_keypoints(number)).tobytes(),
                np.asarray(database.read_descriptors(number).data).tobytes(),
                read_keypoint_colours(folder, number).tobytes(),
            )
            for ref, number in sorted(read_image_ids(database).items())
        ]


def test_descriptors_of_a_mirrored_picture_can_be_computed() -> None:
    sift = cv2.SIFT_create(500)
    image = WALL[:, :640]

    def found(picture: np.ndarray, *, mirrored: bool) -> np.ndarray:
        points, raw = sift.detectAndCompute(picture, None)
        rooted = 512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
        bytes_ = rooted.round().clip(0, 255).astype(np.uint8)
        shape = np.array([(*each.pt, each.size, each.angle) for each in points], np.float32)
        return largest_descriptors(mirror_descriptors(bytes_) if mirrored else bytes_, shape)

    there = found(np.ascontiguousarray(image[:, ::-1]), mirrored=False)
    # Nearly all of 128; features found on one side only and those with two directions are lost.
    assert count_ratio_test_matches(found(image, mirrored=True), there[None])[0] > 90
    assert count_ratio_test_matches(found(image, mirrored=False), there[None])[0] < 15


def test_the_flipped_one_of_three_cameras_is_left_out(tmp_path: Path) -> None:
    cameras = _Pan("head", 300), _Pan("left", 0, mirrored=True), _Pan("torso", 150, upside_down=True)
    assert _remaining(tmp_path, *cameras) == (
        ["head", "torso"],
        MapDiagnostics(flipped_cameras=("left",)),
    )
    assert "camera left shows the room mirrored" in excluded_camera_note("left")


def test_the_database_is_the_same_as_without_the_flipped_camera(tmp_path: Path) -> None:
    head, left, torso = _Pan("head", 300), _Pan("left", 0, mirrored=True), _Pan("torso", 150)
    _remaining(tmp_path / "all", left, head, torso)
    _workspace(tmp_path / "two", head, torso)
    assert _content(tmp_path / "all") == _content(tmp_path / "two")
    for folder in ("all", "two"):
        files = sorted(each.name for each in (tmp_path / folder).rglob("*") if each.is_file())
        assert files == sorted([*(f"{number}.npy" for number in range(1, 13)), DATABASE_NAME])


def test_cameras_with_equal_orientation_are_kept(tmp_path: Path) -> None:
    cameras = _Pan("head", 300), _Pan("left", 0), _Pan("torso", 150)
    assert _remaining(tmp_path, *cameras) == (["head", "left", "torso"], MapDiagnostics())


def test_a_camera_without_keyframes_is_kept(tmp_path: Path) -> None:
    cameras = _Pan("head", 300, count=0), _Pan("left", 0), _Pan("torso", 150)
    assert _remaining(tmp_path, *cameras)[0] == ["head", "left", "torso"]


def test_two_cameras_that_see_mirror_images_are_both_kept_and_named(tmp_path: Path) -> None:
    left, diagnostics = _remaining(tmp_path, _Pan("left", 0, mirrored=True), _Pan("torso", 150))
    assert (left, diagnostics) == (["left", "torso"], LEFT_OR_TORSO)
    (note,) = flip_notes(diagnostics)
    assert note.startswith("cameras left and torso see mirror images of each other: the result is right if")
    assert note.count("wrong") == 1
    assert note.endswith("may have mirrored the picture")
    error = add_flip_hint(EstimationError("too few", hint="film more"), diagnostics)
    assert error is not None
    assert error.hint is not None
    assert error.hint.startswith("cameras left and torso see mirror images")
    assert error.hint.endswith("; film more")


def test_the_hint_of_a_failed_merge_names_the_mirror_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise EstimationError("the body cannot place left", hint="film more")

    mapped = SimpleNamespace(diagnostics=LEFT_OR_TORSO)
    monkeypatch.setattr(merging, "merge_trajectories", refuse)
    monkeypatch.setattr(merge, "_merge_inputs", lambda _: None)
    monkeypatch.setattr(merge, "load_map", lambda _: mapped)
    task = merge.MergeTask(
        options=MergeOptions(),
        map=ArtefactRef(path=tmp_path, digest=""),
        registrations={},
        clocks=ArtefactRef(path=tmp_path, digest=""),
        body=cast(Any, None),
        footage=None,
    )
    with pytest.raises(EstimationError) as caught:
        merge.run_merge(task, StageContext(work_dir=tmp_path, threads=1), tmp_path)
    assert str(caught.value.hint).startswith("cameras left and torso see mirror images of each other")
    assert str(caught.value.hint).endswith("film more")


def test_an_initial_pair_of_an_excluded_camera_is_not_used(tmp_path: Path) -> None:
    cameras = _Pan("head", 300), _Pan("left", 0, mirrored=True), _Pan("torso", 150)
    named = MapOptions(init_frames=("left:1", "torso:2"))
    _, options, diagnostics = exclude_flipped_cameras(tmp_path, _workspace(tmp_path, *cameras), named)
    assert options.init_frames is None
    assert diagnostics.excluded_from_pair == ("left",)
    assert "left out" in diagnostics.to_log()["named_initial_pair"]["failed"]
    note = "map.init_frames is not used, because one of its frames belongs to camera left, which is left out"
    assert note in flip_notes(diagnostics)


def _labels(evidence: dict[str, int]) -> tuple[set[str], tuple[CameraGroups, ...]]:
    """Label five cameras with names of one letter; the result must not depend on their order."""
    found = [
        label_cameras(cameras, {(pair[0], pair[1]): each for pair, each in evidence.items()})
        for cameras in permutations("abcde")
    ]
    assert all(each == found[0] for each in found)
    return found[0]


def test_a_tie_of_two_cameras_does_not_affect_the_others() -> None:
    assert _labels({"ab": 90, "ae": -80, "cd": -300}) == ({"e"}, ((("c",), ("d",)),))
    assert _labels({"ab": 90, "cd": 80, "ac": -70}) == (set(), ((("a", "b"), ("c", "d")),))


def test_contradictory_evidence_excludes_no_camera() -> None:
    assert _labels({"ab": 100, "bc": 100, "ac": -90, "cd": 100}) == (set(), ((("a",), ("c",)),))
    # Evidence three times as strong wins: b, c and d agree with a, in spite of the pair of a and c.
    assert _labels({"ab": 300, "bc": 300, "ac": -90, "cd": 100, "ae": -100}) == ({"e"}, ())
    assert _labels({"ab": -300, "bc": -290, "ac": -100}) == (set(), ((("a",), ("b",)),))
    assert _labels({"ab": -300, "bc": -290, "ac": -70}) == ({"b"}, ())
