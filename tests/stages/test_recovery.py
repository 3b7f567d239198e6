"""Lost frames are recovered by the appearance of map points; frames that do not show the room stay lost."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import (
    interpolate_pose,
    invert,
    make_transform,
    so3_exp,
    so3_log,
    transform_points,
)
from bodycap_batch.model.optical_flow import detect_corners
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration import RegisteredCamera
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria
from bodycap_batch.registration.recovery import preparation, recover, search_images
from bodycap_batch.registration.recovery.guided_localisation import (
    GuidedLocaliser,
    NeighbourPose,
    PoseEstimate,
    SearchFrame,
)
from bodycap_batch.registration.recovery.motion_prior import MotionStatistics
from bodycap_batch.registration.recovery.patch_search import (
    KeyframePatches,
    PatchMatches,
    PredictedView,
    Pyramid,
)
from bodycap_batch.registration.recovery.preparation import prepare_recovery
from bodycap_batch.registration.recovery.propagation import LostInterval, Propagation
from bodycap_batch.registration.recovery.recover import find_lost_poses
from bodycap_batch.registration.recovery.search_images import (
    estimate_exposure,
    read_keyframe_patches,
    read_pyramids,
)
from tests.rooms import HALF_M, LENS, Room

COUNT = 44
LOST = range(18, 26)
CAMERA = Camera(
    model=str(LENS["model"]),
    width_px=320,
    height_px=240,
    params=np.array(LENS["params"]),
)


def _path() -> np.ndarray:
    """A camera that turns by 4 degrees a frame in a bow, with a swing of its height."""
    frames = np.arange(COUNT)
    turns = so3_exp(np.radians(4.0) * np.outer(frames, [0.1, 1.0, 0.0]))
    centres = np.column_stack([0.02 * frames, 0.2 * np.sin(frames / 7.0), 0.01 * frames])
    return make_transform(turns, centres)


PATH = _path()
ROOM = Room.make(3)


@dataclass
class _Video:
    """A camera as recovery uses one."""

    pictures: list[np.ndarray]
    name: str = "torso"
    mask: np.ndarray | None = None
    rotation_chain: None = None

    @property
    def damaged(self) -> np.ndarray:
        return np.zeros(0, np.int64)

    @property
    def times_ns(self) -> np.ndarray:
        return np.arange(COUNT, dtype=np.int64) * 33_333_333

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        column, row = np.clip(px.astype(int), 0, (319, 239)).T
        return np.ones(len(px), dtype=bool) if self.mask is None else self.mask[row, column]

    def read(self, indices: object) -> Iterator[tuple[int, np.ndarray]]:
        for index in np.asarray(indices).tolist():
            yield index, self.pictures[index]


class _SolvedVideo(_Video):
    """A camera with frames that can be solved again."""

    camera = CAMERA

    @property
    def frame_numbers(self) -> np.ndarray:
        return np.arange(COUNT)


@dataclass
class _Capture:
    video: _Video

    def camera(self, _: str) -> _Video:
        return self.video


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [ROOM.view(CAMERA, pose) for pose in PATH]


def _hits(px: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Intersections of lines of sight with the walls of the room."""
    ray = np.column_stack([CAMERA.unproject(px), np.ones(len(px))]) @ pose[:3, :3].T
    distance = ((np.sign(ray) * HALF_M - pose[:3, 3]) / ray).min(axis=1)
    return pose[:3, 3] + ray * distance[:, None]


def _map(pictures: list[np.ndarray]) -> Map:
    """Corners of every fourth image, observed by all keyframes that see them; none from the lost interval."""
    keyframes = [frame for frame in range(0, COUNT, 4) if frame not in LOST]
    points = np.concatenate(
        [_hits(detect_corners(pictures[k], 60, 8.0).astype(float), PATH[k]) for k in keyframes]
    )
    seen = []
    for row, keyframe in enumerate(keyframes):
        px = CAMERA.project(transform_points(invert(PATH[keyframe]), points))
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(((px > 2) & (px < (318, 238))).all(axis=1))
        seen.append((np.full(len(inside), row), inside, px[inside]))
    keyframe_of, point, px = (np.concatenate(each) for each in zip(*seen, strict=True))
    return Map(
        gauge="map-0",
        cameras={"torso": CAMERA},
        keyframe_camera=("torso",) * len(keyframes),
        keyframe_frame=np.array(keyframes),
        map_from_cam=PATH[keyframes],
        points=points,
        colors=np.zeros((len(points), 3), np.uint8),
        point_error_px=np.zeros(len(points)),
        obs_keyframe=keyframe_of,
        obs_point=point,
        obs_feature=point,
        obs_px=px,
    )


def _tracked() -> Registration:
    """All frames with their true poses and a sigma of a millimetre, except in the lost interval."""
    status = [FrameStatus.FEW_TRACKS if frame in LOST else FrameStatus.REGISTERED for frame in range(COUNT)]
    poses = np.array([np.full((4, 4), np.nan) if f in LOST else PATH[f] for f in range(COUNT)])
    covariance = np.tile(np.eye(6) * 1e-6, (COUNT, 1, 1))
    covariance[list(LOST)] = np.nan
    none = np.zeros(0, np.int64)
    return Registration(
        trajectory=Trajectory(
            camera="torso",
            gauge="map-0",
            frame_numbers=np.arange(COUNT),
            times_ns=np.arange(COUNT, dtype=np.int64) * 33_333_333,
            gauge_from_cam=poses,
            covariance=covariance,
            status=tuple(status),
            inliers=np.full(COUNT, 100),
            error_px=np.full(COUNT, 0.5),
        ),
        obs_frame=none,
        obs_keyframe=none,
        obs_feature=none,
        obs_px=np.zeros((0, 2), np.float32),
        wanted_keyframes=none,
        tried_keyframes=none,
    )


def _recovered(
    scene: Map, pictures: list[np.ndarray], context: StageContext, mask: np.ndarray | None = None
) -> Trajectory:
    capture = cast(Capture, _Capture(_Video(pictures, mask=mask)))
    return find_lost_poses(_tracked(), scene, capture, RegistrationOptions(), context).trajectory


@pytest.fixture
def context(tmp_path: Path) -> StageContext:
    return StageContext(work_dir=tmp_path, threads=1)


@pytest.fixture(scope="module")
def recovered(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    """The path with its lost frames found again."""
    context = StageContext(work_dir=tmp_path_factory.mktemp("recovered"), threads=1)
    return _recovered(_map(pictures), pictures, context)


def test_lost_frames_are_found_where_they_were(recovered: Trajectory) -> None:
    path = recovered
    assert path.localised.all()
    off_m = np.linalg.norm(path.gauge_from_cam[:, :3, 3] - PATH[:, :3, 3], axis=1)[list(LOST)]
    # A pixel of noise on 50 points of walls 2.5 m off leaves a centre open by about a centimetre.
    assert off_m.max() < 0.03
    sigma_m = np.sqrt(np.trace(path.covariance[:, 3:, 3:], axis1=1, axis2=2))[list(LOST)]
    assert (off_m < 4.0 * sigma_m).all()
    assert (sigma_m > 1e-3).all()


def test_poses_from_tracking_move_by_less_than_their_sigma(recovered: Trajectory) -> None:
    path, before = recovered, _tracked().trajectory
    known = before.localised
    off_m = np.linalg.norm((path.gauge_from_cam - before.gauge_from_cam)[known, :3, 3], axis=1)
    assert off_m.max() < 1e-3  # the sigma of an axis
    np.testing.assert_array_equal(path.covariance[known], before.covariance[known])
    assert [path.status[f] for f in np.flatnonzero(known)] == [
        before.status[f] for f in np.flatnonzero(known)
    ]


@pytest.mark.parametrize("other", ["black", "another room"])
def test_frames_that_show_no_part_of_the_map_stay_lost(
    pictures: list[np.ndarray], context: StageContext, other: str
) -> None:
    stranger = Room.make(11)
    shown = [
        picture
        if frame not in LOST
        else (np.zeros_like(picture) if other == "black" else stranger.view(CAMERA, PATH[frame]))
        for frame, picture in enumerate(pictures)
    ]
    path = _recovered(_map(pictures), shown, context)
    assert not path.localised[list(LOST)].any()
    assert all(path.status[frame] is FrameStatus.FEW_TRACKS for frame in LOST)


def test_a_registration_without_a_map_stays_as_it_is(
    pictures: list[np.ndarray], context: StageContext
) -> None:
    found = _tracked()
    lost = replace(found, trajectory=replace(found.trajectory, gauge="none"))
    inputs = recover.RecoveryInputs(
        capture=Capture(cameras=()),
        registrations=(),
        maps=(_map(pictures),),
        selection=_selection(),
    )
    assert recover.recover_lost_frames(lost, inputs, RegistrationOptions(), context) is lost


def test_masked_pixels_give_no_pose(pictures: list[np.ndarray], context: StageContext) -> None:
    mask = np.ones((240, 320), dtype=bool)
    mask[10:, :] = False
    path = _recovered(_map(pictures), pictures, context, mask)
    assert not path.localised[list(LOST)].any()


def test_a_long_interval_holds_a_limited_number_of_images() -> None:
    video = cast(CaptureCamera, _Video([np.zeros((240, 320), np.uint8)] * COUNT))
    held = sorted(read_pyramids(video, 4, 40, [20], max_frames=12))
    assert held == [3, 4, 5, 6, 18, 19, 20, 21, 22, 38, 39, 40]


def test_a_misplaced_keyframe_does_not_support_itself(
    monkeypatch: pytest.MonkeyPatch, context: StageContext
) -> None:
    """Between black frames, far from both ends, one keyframe and its own points are 60 cm off."""
    frames, middle, wrong = np.arange(90), 45, np.array([0.6, 0.0, 0.0])
    swaying = 0.02 * np.sin(np.column_stack([frames / 2.4, frames / 2.1 + 1.0, frames / 1.9 + 1.5]))
    centres = np.column_stack([0.01 * frames, 0.2 * np.sin(frames / 14.0), 0.005 * frames]) + swaying
    path = make_transform(so3_exp(np.radians(2.0) * np.outer(frames, [0.1, 1.0, 0.0])), centres)
    for name, value in {"COUNT": 90, "LOST": range(20, 70), "PATH": path}.items():
        monkeypatch.setitem(globals(), name, value)
    pictures = [
        np.zeros((240, 320), np.uint8)
        if frame in LOST and abs(frame - middle) > 4
        else ROOM.view(CAMERA, pose)
        for frame, pose in enumerate(path)
    ]
    scene = _map(pictures)
    corners = detect_corners(pictures[middle], 120, 8.0).astype(float)
    rows = np.arange(len(corners)) + len(scene.points)
    scene = replace(
        scene,
        keyframe_camera=(*scene.keyframe_camera, "torso"),
        keyframe_frame=np.append(scene.keyframe_frame, middle),
        map_from_cam=np.concatenate(
            [scene.map_from_cam, (make_transform(np.eye(3), wrong) @ path[middle])[None]]
        ),
        points=np.vstack([scene.points, _hits(corners, path[middle]) + wrong]),
        colors=np.zeros((len(scene.points) + len(rows), 3), np.uint8),
        point_error_px=np.zeros(len(scene.points) + len(rows)),
        obs_keyframe=np.append(scene.obs_keyframe, np.full(len(rows), len(scene.keyframe_camera))),
        obs_point=np.append(scene.obs_point, rows),
        obs_feature=np.append(scene.obs_feature, rows),
        obs_px=np.vstack([scene.obs_px, corners]),
    )
    found = _recovered(scene, pictures, context)
    off_m = np.linalg.norm(found.gauge_from_cam[:, :3, 3] - path[:, :3, 3], axis=1)[list(LOST)]
    assert not (off_m[np.isfinite(off_m)] > 0.1).any()


def test_points_on_one_small_object_give_no_wrong_pose(
    pictures: list[np.ndarray], context: StageContext
) -> None:
    scene = _map(pictures)
    middle = _hits(np.array([[160.0, 120.0]]), PATH[21])[0]
    away = np.linalg.norm(scene.points - middle, axis=1) > 0.5
    keep = ~away[scene.obs_point]
    small = replace(
        scene,
        obs_keyframe=scene.obs_keyframe[keep],
        obs_point=scene.obs_point[keep],
        obs_feature=scene.obs_feature[keep],
        obs_px=scene.obs_px[keep],
    )
    path = _recovered(small, pictures, context)
    off_m = np.linalg.norm(path.gauge_from_cam[:, :3, 3] - PATH[:, :3, 3], axis=1)[list(LOST)]
    assert not (off_m[np.isfinite(off_m)] > 0.1).any()


def _rolled(pictures: list[np.ndarray], readout_s: float) -> list[np.ndarray]:
    """Lost frames with a rolling shutter: bands of fifteen rows, each from the pose at its instant."""
    bands, out = 16, list(pictures)
    rows = CAMERA.height_px // bands
    for frame in LOST:
        shown = []
        for band in range(bands):
            late = ((band + 0.5) / bands - 0.5) * readout_s / 0.033333333
            first = frame if late >= 0.0 else frame - 1
            pose = interpolate_pose(PATH[first], PATH[first + 1], late if late >= 0.0 else 1.0 + late)
            params = CAMERA.params - (0.0, 0.0, 0.0, band * rows)
            shown.append(
                ROOM.view(
                    Camera(model=CAMERA.model, width_px=CAMERA.width_px, height_px=rows, params=params), pose
                )
            )
        out[frame] = np.vstack(shown)
    return out


def test_a_rolling_shutter_is_undone(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], context: StageContext
) -> None:
    monkeypatch.setitem(globals(), "LOST", range(20, 25))
    rolled = _rolled(pictures, 0.02)
    off = []
    for readout_s in (0.0, 0.02):
        scene = replace(_map(pictures), readout_s={"torso": readout_s})
        path = _recovered(scene, rolled, context)
        # Without the correction, the cells of a picture contradict each other, so most frames stay lost.
        lost = [frame for frame in LOST if path.localised[frame]]
        assert len(lost) >= (len(LOST) if readout_s else 1)
        turned = path.gauge_from_cam[lost, :3, :3].swapaxes(1, 2) @ PATH[lost, :3, :3]
        centre = np.linalg.norm(path.gauge_from_cam[lost, :3, 3] - PATH[lost, :3, 3], axis=1)
        off.append(np.median(np.linalg.norm(so3_log(turned), axis=1)) + np.median(centre))
    # Nine pixels from the first row to the last; what is left are bands of half a pixel.
    assert off[1] < 0.5 * off[0]


def test_masked_pixels_do_not_influence_the_exposure_time(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray]
) -> None:
    """The wearer's sleeve, which is still before the camera, looks like a short exposure."""

    def found(_: object, view: PredictedView, *__: object) -> PatchMatches:
        px = np.array([[20.0, 100.0], [200.0, 100.0]])
        score = np.array([0.9 - view.exposure_ratio, 0.5 + 0.1 * view.exposure_ratio])
        return PatchMatches(np.arange(2), px, px, score)

    monkeypatch.setattr(search_images, "match_patches", found)
    mask = np.ones((240, 320), dtype=bool)
    mask[:, :160] = False
    shares = []
    for hidden in (None, mask):
        camera = cast(CaptureCamera, _Video(pictures, mask=hidden))
        gallery = KeyframePatches(
            scene_map=_map(pictures),
            pyramids={},
            sharpness=np.zeros(0),
            usable=np.zeros(0, bool),
            keyframe_count=np.zeros(0, np.int64),
        )
        monkeypatch.setattr(search_images, "select_patches", lambda *_: np.arange(2))
        limits = AcceptanceCriteria(max_error_px=1.0, min_inliers=12, max_sigma_depth=0.1)
        finder = GuidedLocaliser(
            lens=CAMERA, patches=gallery, criteria=limits, exposure_ratio=0.0, is_unmasked=camera.is_unmasked
        )
        shares.append(estimate_exposure(camera, finder, _tracked().trajectory))
    assert shares == [0.0, 0.6]


def test_decoding_the_keyframes_reports_progress(pictures: list[np.ndarray], tmp_path: Path) -> None:
    reported: list[tuple[int, int]] = []

    def progress(done: int, total: int, what: str = "") -> None:
        if "decoded" in what:
            reported.append((done, total))

    scene = _map(pictures)
    context = StageContext(work_dir=tmp_path, progress=progress)
    capture = cast(Capture, _Capture(_Video(pictures)))
    read_keyframe_patches(scene, capture, capture.camera("torso"), context)
    count = len(scene.keyframe_camera)
    assert reported == [(number + 1, count) for number in range(count)]


def test_frames_still_lost_next_to_found_ones_are_searched_again(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], context: StageContext
) -> None:
    """The search starts from the frames found, which are not tracked, and ends if nothing is found."""
    asked = []

    def accepted_poses(propagation: Propagation) -> dict[int, PoseEstimate]:
        interval = propagation.interval
        asked.append((interval.start, interval.stop))
        if len(asked) > 1:
            assert {18, 19} <= set(interval.poses)
            assert not {18, 19} & set(interval.tracked_frames)
            return {}
        fix = replace(interval.poses[17], depth=1.0)
        return {18: fix, 19: fix}

    monkeypatch.setattr(recover, "_accepted_poses", accepted_poses)
    path = _recovered(_map(pictures), pictures, context)
    assert asked == [(18, 26), (20, 26)]
    assert path.localised[[18, 19]].all()
    assert not path.localised[20:26].any()


def test_progress_grows_over_the_passes_until_nothing_is_left(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[int] = []
    rounds = [[(18, 20), (23, 25)], []]
    monkeypatch.setattr(recover, "lost_intervals", lambda _: [(18, 22), (22, 26)])
    monkeypatch.setattr(recover, "_extended_intervals", lambda *_: rounds.pop(0))
    monkeypatch.setattr(recover._IntervalSearch, "recover_interval", lambda *_: {})

    def progress(done: int, _: int, what: str = "") -> None:
        if what.startswith("lost"):
            reported.append(done)

    context = StageContext(work_dir=tmp_path, progress=progress)
    capture = cast("Capture", _Capture(_Video(pictures)))
    find_lost_poses(_tracked(), _map(pictures), capture, RegistrationOptions(), context)
    assert reported == [18, 22, 22, 23]


def test_the_turn_between_two_frames_is_measured_once_for_all_passes(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], context: StageContext
) -> None:
    monkeypatch.setitem(globals(), "LOST", range(20, 23))
    measured: list[object] = []
    measure = Propagation._turn_of_pictures

    def counting(self: Propagation, *pyramids: Any) -> Any:
        measured.append(pyramids)
        return measure(self, *pyramids)

    monkeypatch.setattr(Propagation, "_turn_of_pictures", counting)
    rounds = [[(LOST[0], LOST[-1] + 1)], []]
    monkeypatch.setattr(recover, "_extended_intervals", lambda *_: rounds.pop(0))
    _recovered(_map(pictures), pictures, context)
    assert not rounds
    # Both directions pass each of the lost frames once.
    assert len(LOST) <= len(measured) <= 2 * len(LOST)


def test_intervals_are_searched_side_by_side(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    both = threading.Barrier(2, timeout=30.0)
    monkeypatch.setattr(recover, "lost_intervals", lambda _: [(18, 22), (22, 26)])
    monkeypatch.setattr(recover, "_extended_intervals", lambda *_: [])

    def wait_for_the_other(*_: object) -> dict[int, PoseEstimate]:
        both.wait()
        return {}

    monkeypatch.setattr(recover._IntervalSearch, "recover_interval", wait_for_the_other)
    capture = cast("Capture", _Capture(_Video(pictures)))
    context = StageContext(work_dir=tmp_path, threads=2)
    find_lost_poses(_tracked(), _map(pictures), capture, RegistrationOptions(), context)
    assert not both.broken


def _selection() -> KeyframeSelection:
    return KeyframeSelection(
        camera="torso",
        frames=np.arange(0, COUNT, 4),
        frame_count=COUNT,
        sharpness=np.ones(COUNT),
        noise_px=0.2,
    )


def _with_tracks(found: Registration, scene: Map, weak: int) -> Registration:
    """The points of each keyframe, tracked into the frames after it; few of them into frame `weak`."""
    frames, keyframes, features, px = [], [], [], []
    for frame in np.flatnonzero(found.trajectory.localised).tolist():
        row = int(np.searchsorted(scene.keyframe_frame, frame, side="right")) - 1
        point = scene.obs_point[scene.obs_keyframe == row]
        seen_px = CAMERA.project(transform_points(invert(PATH[frame]), scene.points[point]))
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(((seen_px > 2) & (seen_px < (318, 238))).all(axis=1))
        inside = inside[:20] if frame == weak else inside
        frames.append(np.full(len(inside), frame))
        keyframes.append(np.full(len(inside), scene.keyframe_frame[row]))
        features.append(point[inside])
        px.append(seen_px[inside])
    return replace(
        found,
        obs_frame=np.concatenate(frames),
        obs_keyframe=np.concatenate(keyframes),
        obs_feature=np.concatenate(features),
        obs_px=np.concatenate(px).astype(np.float32),
    )


def test_a_wrong_pose_next_to_a_lost_interval_is_searched_again(
    pictures: list[np.ndarray], context: StageContext
) -> None:
    """Twenty tracks slipped together: the last pose before the interval is 20 cm off with a small sigma."""
    scene, end = _map(pictures), LOST[0] - 1
    found = _with_tracks(_tracked(), scene, end)
    wrong = make_transform(np.eye(3), [0.2, 0.0, 0.0]) @ PATH[end]
    slipped = found.obs_frame == end
    points = scene.points[found.obs_feature[slipped]]
    px = found.obs_px.copy()
    px[slipped] = CAMERA.project(transform_points(invert(wrong), points))
    poses, inliers = found.trajectory.gauge_from_cam.copy(), found.trajectory.inliers.copy()
    poses[end], inliers[end] = wrong, 20
    path = replace(found.trajectory, gauge_from_cam=poses, inliers=inliers)
    found = replace(found, trajectory=path, obs_px=px)
    capture = cast(Capture, _Capture(_Video(pictures)))
    own = RegisteredCamera(camera=cast(CaptureCamera, _SolvedVideo(pictures)), registration=found)
    options = RegistrationOptions()
    refined_map, left = prepare_recovery(own, [], scene, _selection(), options)
    assert not left.trajectory.localised[end]
    off_m = [
        np.linalg.norm((each.gauge_from_cam - PATH)[:, :3, 3], axis=1)
        for each in (
            find_lost_poses(found, scene, capture, options, context).trajectory,
            find_lost_poses(left, refined_map, capture, options, context).trajectory,
        )
    ]
    assert off_m[0][end] > 0.1
    assert np.nanmax(off_m[1]) < 0.03
    assert np.isfinite(off_m[1][list(LOST)]).sum() >= len(LOST) - 1


def test_a_second_thread_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    monkeypatch.setitem(globals(), "LOST", range(20, 23))
    scene, end = _map(pictures), LOST[0] - 1
    found = _with_tracks(_tracked(), scene, end)
    inliers = found.trajectory.inliers.copy()
    inliers[end] = 20
    found = replace(found, trajectory=replace(found.trajectory, inliers=inliers))
    own = RegisteredCamera(camera=cast(CaptureCamera, _SolvedVideo(pictures)), registration=found)
    capture, options = cast(Capture, _Capture(_Video(pictures))), RegistrationOptions()
    before = cv2.getNumThreads()
    paths = []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        context = StageContext(work_dir=tmp_path, threads=threads)
        refined_map, left = prepare_recovery(own, [], scene, _selection(), options, threads)
        paths.append(find_lost_poses(left, refined_map, capture, options, context).trajectory)
    cv2.setNumThreads(before)
    assert not left.trajectory.localised[end]
    assert paths[0].localised[list(LOST)].any()
    assert paths[0].gauge_from_cam.tobytes() == paths[1].gauge_from_cam.tobytes()
    assert paths[0].covariance.tobytes() == paths[1].covariance.tobytes()


def test_too_few_poses_stay_unchanged(monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray]) -> None:
    scene = _map(pictures)
    found = _with_tracks(_tracked(), scene, -1)
    few = replace(found, trajectory=replace(found.trajectory, inliers=np.full(COUNT, 20)))
    own = RegisteredCamera(camera=cast(CaptureCamera, _SolvedVideo(pictures)), registration=few)
    monkeypatch.setattr(preparation, "LEAST_POSED", COUNT - len(LOST) - 10)
    refined_map, left = prepare_recovery(own, [], scene, _selection(), RegistrationOptions())
    assert refined_map is scene
    assert left is few


def test_well_supported_ends_leave_map_and_registration_unchanged(pictures: list[np.ndarray]) -> None:
    scene = _map(pictures)
    found = _with_tracks(_tracked(), scene, -1)
    own = RegisteredCamera(camera=cast(CaptureCamera, _SolvedVideo(pictures)), registration=found)
    refined_map, left = prepare_recovery(own, [found.trajectory], scene, _selection(), RegistrationOptions())
    assert refined_map is scene
    assert left is found


def _map_of_two_cameras(pictures: list[np.ndarray]) -> Map:
    """Return the map with two keyframes of a second camera: one sees every third point, one every sixth.

    Points that only the first camera sees do not count as static then.
    """
    scene = _map(pictures)
    count = len(scene.keyframe_camera)
    points, first = np.unique(scene.obs_point, return_index=True)
    rows = np.concatenate([first[points % 3 == 0], first[points % 6 == 0]])
    keyframe = np.repeat([count, count + 1], [(points % 3 == 0).sum(), (points % 6 == 0).sum()])
    return replace(
        scene,
        cameras={"torso": CAMERA, "left_palm": CAMERA},
        keyframe_camera=(*scene.keyframe_camera, "left_palm", "left_palm"),
        keyframe_frame=np.append(scene.keyframe_frame, [0, 4]),
        map_from_cam=np.concatenate([scene.map_from_cam, scene.map_from_cam[:2]]),
        obs_keyframe=np.append(scene.obs_keyframe, keyframe),
        obs_point=np.append(scene.obs_point, scene.obs_point[rows]),
        obs_feature=np.append(scene.obs_feature, scene.obs_feature[rows]),
        obs_px=np.concatenate([scene.obs_px, scene.obs_px[rows]]),
    )


@pytest.mark.parametrize(("contradicted", "step"), [([], 3), ([2], 3), ([20], 6)])
def test_only_points_of_other_cameras_find_frames_among_misplaced_keyframes(
    monkeypatch: pytest.MonkeyPatch,
    pictures: list[np.ndarray],
    context: StageContext,
    contradicted: list[int],
    step: int,
) -> None:
    used = []

    def search(propagation: Propagation) -> dict[int, PoseEstimate]:
        used.append(propagation.localiser.patches.usable)
        return {}

    monkeypatch.setattr(recover, "_accepted_poses", search)
    monkeypatch.setattr(recover, "estimate_exposure", lambda *_: 0.0)
    scene = _map_of_two_cameras(pictures)
    capture = cast(Capture, _Capture(_Video(pictures)))
    mask = np.isin(np.arange(COUNT), contradicted)
    known = recover.KnownFrames(contradicted=mask)
    find_lost_poses(_tracked(), scene, capture, RegistrationOptions(), context, known)
    points = np.unique(scene.obs_point)
    np.testing.assert_array_equal(np.intersect1d(np.flatnonzero(used[0]), points), points[points % step == 0])


def test_poses_from_tracking_among_misplaced_keyframes_are_withdrawn_before_the_search(
    monkeypatch: pytest.MonkeyPatch, pictures: list[np.ndarray], context: StageContext
) -> None:
    video = _SolvedVideo(pictures)
    scene, tracked = _map(pictures), _tracked()
    searched = []

    def find(registration: Registration, *rest: object) -> Registration:
        known = cast(recover.KnownFrames, rest[-1])
        assert known.contradicted is not None
        searched.append((registration.trajectory.status[29], np.flatnonzero(known.contradicted)))
        return registration

    monkeypatch.setattr(recover, "find_lost_poses", find)
    monkeypatch.setattr(
        recover, "prepare_recovery", lambda own, _, scene_map, *__: (scene_map, own.registration)
    )
    inputs = recover.RecoveryInputs(
        capture=Capture(cameras=(cast(CaptureCamera, video),)),
        registrations=(RegisteredCamera(camera=cast(CaptureCamera, video), registration=tracked),),
        maps=(scene,),
        selection=_selection(),
        misplaced=(29, 30),
    )
    recover.recover_lost_frames(tracked, inputs, RegistrationOptions(), context)
    assert searched[0][0] is FrameStatus.CONTRADICTED
    np.testing.assert_array_equal(searched[0][1], [29, 30, 31])


@pytest.fixture(scope="module")
def searched_frame(
    pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> tuple[GuidedLocaliser, SearchFrame, PoseEstimate]:
    """A localiser, a lost frame, and the pose that is found in it from its true pose."""
    path = _tracked().trajectory
    capture = cast(Capture, _Capture(_Video(pictures)))
    context = StageContext(work_dir=tmp_path_factory.mktemp("searched"), threads=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recover, "estimate_exposure", lambda *_: 0.0)
        localiser = recover.make_localiser(
            _map(pictures), capture, path, RegistrationOptions(), context, rotation=None
        )
    frame = SearchFrame(21, Pyramid.build(pictures[21]), -1)
    found = localiser.relocalise(frame, invert(PATH[21]), NeighbourPose(invert(PATH[20])))
    assert found is not None
    return localiser, frame, found


def test_a_pose_from_true_matches_does_not_depend_on_its_start(
    searched_frame: tuple[GuidedLocaliser, SearchFrame, PoseEstimate],
) -> None:
    localiser, frame, found = searched_frame
    assert localiser.start_dependence(frame, found, NeighbourPose(invert(PATH[20]))) < 0.1


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, None])
def test_the_covariance_contains_the_error_that_a_search_leaves_of_its_start(
    monkeypatch: pytest.MonkeyPatch,
    searched_frame: tuple[GuidedLocaliser, SearchFrame, PoseEstimate],
    share: float | None,
) -> None:
    localiser, frame, found = searched_frame
    centre = invert(found.cam_from_map)[:3, 3]

    def search(_localiser: object, _frame: object, pose: np.ndarray, _neighbour: object) -> object:
        """Find a pose whose centre keeps a share of the start's distance from the first pose."""
        moved = centre + (share or 0.0) * (invert(pose)[:3, 3] - centre)
        rotation = pose[:3, :3]
        return (
            None
            if share is None
            else replace(found, cam_from_map=make_transform(rotation, -rotation @ moved))
        )

    monkeypatch.setattr(GuidedLocaliser, "relocalise", search)
    left = localiser.start_dependence(frame, found, NeighbourPose(invert(PATH[20])))
    assert left == pytest.approx(0.99 if share is None else share, abs=1e-6)
    grown = found.with_start_error(left)
    np.testing.assert_allclose(grown.covariance, found.covariance / (1.0 - left) ** 2)


def test_found_neighbours_do_not_make_a_searched_pose_more_certain() -> None:
    """Wrong searches continue from frame to frame: only tracked frames and the own picture count."""
    positions = {
        frame: PoseEstimate(
            cam_from_map=invert(PATH[frame]),
            covariance=np.eye(6) * (0.1 if frame in LOST else 0.001) ** 2,
            inliers=30,
            inlier_weight_ratio=0.8,
            error_px=1.0,
            depth=2.5,
        )
        for frame in range(COUNT)
    }
    interval = LostInterval(
        start=LOST.start,
        stop=COUNT,
        times=np.arange(float(COUNT)),
        pyramids={},
        poses={frame: positions[frame] for frame in range(LOST.start)},
        tracked_frames=frozenset(range(LOST.start)),
        seed_poses={},
        keyframe_rows={},
        statistics=MotionStatistics(jerk_sigma=0.01, cubic_residual_sigma=0.01),
    )
    found = {frame: positions[frame] for frame in range(LOST.start, LOST.stop)}
    together = recover._smooth(found, interval).positions
    predicted = recover._predicted_positions(interval)
    frame = LOST.stop - 1
    position = recover._independent_position(found[frame], together[frame], predicted[frame])
    np.testing.assert_array_equal(position.centre, together[frame].centre)
    # The motion says nothing eight frames after the last tracked one; eight found poses would seem to.
    np.testing.assert_allclose(position.covariance, found[frame].position.covariance, rtol=0.05)
    assert np.trace(together[frame].covariance) < 0.9 * np.trace(position.covariance)
    near = recover._independent_position(found[LOST.start], together[LOST.start], predicted[LOST.start])
    assert np.trace(near.covariance) < 0.5 * np.trace(found[LOST.start].position.covariance)


def test_a_long_propagation_predicts_rotations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step of the constant motion doubled the deviation from a rotation: 0.07 after 50 frames."""
    lost = 60
    start = PoseEstimate(
        cam_from_map=invert(PATH[1]),
        covariance=np.eye(6) * 0.001**2,
        inliers=30,
        inlier_weight_ratio=0.8,
        error_px=1.0,
        depth=2.5,
    )
    interval = LostInterval(
        start=2,
        stop=2 + lost,
        times=np.arange(float(lost + 3)),
        pyramids={frame: cast(Pyramid, None) for frame in range(2, 2 + lost)},
        poses={0: replace(start, cam_from_map=invert(PATH[0])), 1: start},
        tracked_frames=frozenset({0, 1}),
        seed_poses={},
        keyframe_rows={},
        statistics=MotionStatistics(jerk_sigma=0.01, cubic_residual_sigma=0.01),
    )

    class Localiser:
        """Finds each frame where it is expected."""

        shutter = None

        def localise(self, frame: SearchFrame, priors: list[np.ndarray], *_: object) -> PoseEstimate:
            return replace(start, cam_from_map=priors[0])

    monkeypatch.setattr(Propagation, "_turn_of_pictures", lambda *_: None)
    found = Propagation(cast(GuidedLocaliser, Localiser()), interval).run()
    assert len(found) == lost
    rotations = np.array([estimate.cam_from_map[:3, :3] for estimate in found.values()])
    # Double precision leaves 1e-15.
    assert np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max() < 1e-12
