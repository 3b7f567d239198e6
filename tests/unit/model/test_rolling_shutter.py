"""Rows exposed one after another: where pixels are at the middle row's instant, and the readout time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.export.metrics import observation_errors
from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    RollingShutterModel,
    judged_readout,
    map_with_readouts,
    stated_readout,
)
from bodycap_batch.mapping.reconstruction.motion_adjustment import AdjustedReadout
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from bodycap_batch.model.rolling_shutter import px_at_mid_row
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
FRAMES = 90
FRAME_S = 1 / 30
NOISE_PX = 0.3


def poses_at(time_s: FloatArray) -> FloatArray:
    """A hand-held wobble before a wall: map_from_cam (N,4,4)."""
    phase = 2 * np.pi * time_s
    centre = [0.5 * np.sin(0.7 * phase), 0.3 * np.cos(1.1 * phase), 0.2 * np.sin(0.9 * phase)]
    turn = [0.25 * np.sin(0.8 * phase), 0.3 * np.cos(0.6 * phase), 0.2 * np.sin(phase)]
    return make_transform(so3_exp(np.stack(turn, axis=1)), np.stack(centre, axis=1))


@dataclass
class Film:
    """Points seen by a camera whose rows (columns, where it lies sideways) are exposed one after another."""

    readout_s: float
    sideways: bool = False

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.points = self.rng.uniform((-4, -3, 3), (4, 3, 6), (500, 3))
        self.times_s = np.arange(FRAMES) * FRAME_S
        self.map_from_cam = poses_at(self.times_s)

    def seen(self, frame: int) -> tuple[IntArray, FloatArray]:
        """Points in view and their pixels: each where it is when its own row is exposed."""
        delay = np.zeros(len(self.points))
        for _ in range(4):
            cam_from_map = invert(poses_at(self.times_s[frame] + delay))
            px = LENS.project(
                np.einsum("mij,mj->mi", cam_from_map[:, :3, :3], self.points) + cam_from_map[:, :3, 3]
            )
            along = px[:, 0] / 640.0 if self.sideways else px[:, 1] / 480.0
            delay = (np.clip(along, 0, 1) - 0.5) * self.readout_s
        inside = ((px > 0) & (px < (640, 480))).all(axis=1)
        return np.flatnonzero(inside), px[inside] + self.rng.normal(0, NOISE_PX, (int(inside.sum()), 2))

    def trajectory(self) -> Trajectory:
        return Trajectory(
            camera="head",
            gauge="a",
            frame_numbers=np.arange(FRAMES),
            times_ns=np.round(self.times_s * 1e9).astype(np.int64),
            gauge_from_cam=self.map_from_cam,
            covariance=np.broadcast_to(np.eye(6), (FRAMES, 6, 6)),
            status=(FrameStatus.REGISTERED,) * FRAMES,
            inliers=np.full(FRAMES, 100),
            error_px=np.full(FRAMES, 0.5),
        )


def the_map(film: Film, keyframes: range) -> Any:
    """COLMAP's model of some frames: their pixels as seen, poses and points of the truth."""
    return map_of({"head": film}, keyframes)


def map_of(films: Mapping[str, Film], keyframes: range) -> Any:
    """The same for several cameras, by name; each sees points of its own."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera_id, (name, film) in enumerate(films.items(), start=1):
        camera = LENS.to_pycolmap()
        camera.camera_id = camera_id
        model.add_camera_with_trivial_rig(camera)
        tracks: dict[int, Any] = {}
        for number, frame in enumerate(keyframes, start=1 + len(keyframes) * (camera_id - 1)):
            points, px = film.seen(frame)
            image = pycolmap.Image(name=f"{name}/{frame:07d}", camera_id=camera_id, image_id=number)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in px])
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(film.map_from_cam[frame])[:3]))
            for feature, point in enumerate(points.tolist()):
                tracks.setdefault(point, pycolmap.Track()).add_element(number, feature)
        for point, track in tracks.items():
            if track.length() >= 2:
                model.add_point3D(film.points[point], track)
    return model


def camera_of(
    film: Film, *, known: bool = False, stated_s: float = 0.0, may_be_sideways: bool = False
) -> Any:
    return SimpleNamespace(
        name="head",
        nominal_fps=1.0 / FRAME_S,
        given=None,
        camera=replace(LENS, sideways=film.sideways and known),
        may_be_sideways=may_be_sideways,
        rolling_shutter_known=known,
        rolling_shutter_s=stated_s,
        times_ns=film.trajectory().times_ns,
    )


def misfit_px(model: Any, film: Film, true: Any = None) -> float:
    """Mean distance of a model's pixels from its points, or those of the true model, under the true poses."""
    off, true = [], model if true is None else true
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        points = np.array(
            [true.point3D(each.point3D_id).xyz for each in image.points2D if each.has_point3D()]
        )
        px = np.array([each.xy for each in image.points2D if each.has_point3D()])
        cam_from_map = invert(film.map_from_cam[int(image.name[-7:])])
        off.append(LENS.project(points @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]) - px)
    return float(np.linalg.norm(np.concatenate(off), axis=1).mean())


def rolling_model(film: Film, *, known: bool = False, stated_s: float = 0.0, posed: bool = True) -> Any:
    camera = camera_of(film, known=known, stated_s=stated_s)
    paths = {"head": film.trajectory()} if posed else {}
    return RollingShutterModel(the_map(film, range(1, FRAMES, 5)), paths, {"head": camera})


def found(readout_s: float) -> Readout:
    """Return the readout time that is found if nothing is known of it."""
    return dict(rolling_model(Film(readout_s)).find_unknown_readouts({}))["head"]


@pytest.mark.parametrize("readout_s", [0.02, -0.012])
def test_the_readout_time_is_found_in_the_keypoints_alone(readout_s: float) -> None:
    readout = found(readout_s)
    assert readout.source == "estimated"
    # Velocities are differences over two frames, 67 ms: their curvature biases by a few per cent.
    assert abs(readout.seconds - readout_s) < 0.1 * abs(readout_s)
    assert 0 < readout.sigma_s < 0.001


def test_a_global_shutter_is_left_alone() -> None:
    readout = found(0.0)
    assert (readout.seconds, readout.source) == (0.0, "none found")
    assert abs(readout.best_s) < 5 * readout.sigma_s


def test_a_known_readout_time_is_not_looked_for() -> None:
    assert rolling_model(Film(0.02)).find_unknown_readouts({"head": stated_readout(0.017)}) == {}


def test_a_readout_time_that_displaces_nothing_stays_unknown() -> None:
    film = Film(0.02)
    film.map_from_cam = np.repeat(film.map_from_cam[:1], FRAMES, axis=0)
    readout = rolling_model(film).find_unknown_readouts({})["head"]
    assert (readout.seconds, readout.determined) == (0.0, False)


def test_a_camera_with_an_impossible_readout_time_costs_no_other_its_own() -> None:
    # Rows of the torso are read for two frame intervals, which no sensor does.
    films = {"head": Film(0.02), "torso": Film(2.0 * FRAME_S)}
    rolling = RollingShutterModel(
        map_of(films, range(1, FRAMES, 5)),
        {name: replace(film.trajectory(), camera=name) for name, film in films.items()},
        {name: camera_of(film) for name, film in films.items()},
    )
    readouts = rolling.find_unknown_readouts({})
    assert abs(readouts["head"].seconds - 0.02) < 0.002
    assert (readouts["torso"].seconds, readouts["torso"].determined) == (0.0, False)


@pytest.mark.parametrize("readout_s", [0.02, -0.02, 0.0])
def test_a_turned_sensor_is_read_along_columns(readout_s: float) -> None:
    film = Film(readout_s, sideways=True)
    model = rolling_model(film).with_sideways({"head"})
    reported = model.find_unknown_readouts({})["head"]
    assert reported.source == ("estimated" if readout_s else "none found")
    assert abs(reported.seconds - readout_s) <= 0.1 * abs(readout_s)
    assert reported.sideways
    # Moved pixels lie where the true poses see their points, but for noise and the velocities' curvature.
    assert misfit_px(model.corrected({"head": reported.seconds}), film) < 1.0
    assert readout_s == 0.0 or misfit_px(model.corrected({}), film) > 1.5


def model_with_inexact_path(film: Film, sigma_rad: float = 0.002) -> Any:
    """A model whose frames have noisy poses, so their velocities are inexact."""
    path = film.trajectory()
    jitter = np.random.default_rng(2).normal(0.0, sigma_rad, (FRAMES, 3))
    inexact = path.gauge_from_cam @ make_transform(so3_exp(jitter), np.zeros((FRAMES, 3)))
    return RollingShutterModel(
        the_map(film, range(1, FRAMES, 5)),
        {"head": replace(path, gauge_from_cam=inexact)},
        {"head": camera_of(film)},
    )


def test_keyframes_are_adjusted_together_with_their_velocities() -> None:
    film = Film(0.02)
    rolling = model_with_inexact_path(film, 0.005)
    model = rolling.corrected({"head": 0.02})
    true = rolling.corrected({})
    dropped = next(iter(model.point3D_ids()))
    model.delete_point3D(dropped)
    before = misfit_px(model, film, true)
    assert rolling.adjust_with_velocities(model, {"head": stated_readout(0.02)}) is not None
    # The noise of the pixels is 0.38 px.
    assert misfit_px(model, film, true) < 0.5 < 0.8 * before
    assert not model.exists_point3D(dropped)


def test_the_readout_time_is_adjusted_together_with_the_keyframes() -> None:
    film = Film(0.02)
    rolling = model_with_inexact_path(film)
    start = {"head": judged_readout(0.015, 0.003), "other": judged_readout(0.0, 0.0001)}
    adjusted = rolling.adjust_with_velocities(rolling.corrected({"head": 0.015}), start).readouts
    assert adjusted["head"].source == "estimated"
    # The poses of the path jump by 2 mrad from frame to frame.
    assert adjusted["head"].sigma_s < 0.0005
    assert abs(adjusted["head"].seconds - 0.02) < 3.0 * adjusted["head"].sigma_s
    assert adjusted["other"] == start["other"]


@pytest.mark.parametrize("seconds", [0.0, 0.0031, -0.0031])
def test_an_adjusted_readout_time_replaces_the_earlier_one(seconds: float) -> None:
    start = Readout(0.003, 0.0008, "of the map", 0.003, sideways=True)
    found = start.adjusted(AdjustedReadout(seconds=seconds, best_s=seconds + 1e-5, sigma_s=5e-5))
    source = "estimated" if seconds else "none found"
    assert found == Readout(seconds, 5e-5, source, seconds + 1e-5, sideways=True)
    assert start.adjusted(AdjustedReadout(seconds=0.003, best_s=0.003, sigma_s=None)) == start


def test_an_adjustment_weights_readout_times_from_elsewhere() -> None:
    film = Film(0.02)
    rolling = model_with_inexact_path(film)
    start = {"head": judged_readout(0.015, 0.003)}
    elsewhere = {"head": judged_readout(0.016, 2e-4)}
    model = rolling.corrected({"head": 0.015})
    alone = rolling.adjust_with_velocities(rolling.corrected({"head": 0.015}), start).readouts["head"]
    both = rolling.adjust_with_velocities(model, start, elsewhere).readouts["head"]
    assert 0.016 < both.seconds < alone.seconds - 2e-4
    # The velocities then deviate from their path, which makes the result uncertain.
    assert both.sigma_s > alone.sigma_s


def test_a_camera_without_a_trajectory_tells_no_readout_time() -> None:
    film = Film(0.02)
    model, cameras = the_map(film, range(1, FRAMES, 5)), {"head": camera_of(film)}
    assert RollingShutterModel(model, {"head": film.trajectory()}, cameras)._uninformative_cameras() == set()
    assert RollingShutterModel(model, {}, cameras)._uninformative_cameras() == {"head"}


def test_velocities_of_a_smooth_path_are_exact_enough() -> None:
    film = Film(0.02)
    rolling = rolling_model(film)
    model = rolling.corrected({"head": 0.02})
    before = misfit_px(model, film)
    assert rolling.adjust_with_velocities(model, {"head": stated_readout(0.02)}) is None
    assert misfit_px(model, film) == before


def test_without_a_readout_time_keypoints_stay_where_they_are() -> None:
    film = Film(0.02)
    rolling = rolling_model(film)
    model, before = rolling.corrected({}), rolling.corrected({})
    assert rolling.adjust_with_velocities(model, {}) is None
    for number in model.reg_image_ids():
        pairs = zip(model.image(number).points2D, before.image(number).points2D, strict=True)
        assert all(one.xy == pytest.approx(other.xy, abs=1e-6) for one, other in pairs)


def test_velocities_are_not_fitted_to_a_map_that_has_absorbed_the_displacements() -> None:
    # Pixels, poses and points agree without a correction, as they do in a map of uncorrected keypoints.
    film = Film(0.0)
    rolling, readout_s = rolling_model(film), {"head": 0.02}
    moved = misfit_px(rolling.with_exact_rates(readout_s, ()).corrected(readout_s), film)
    fitted = misfit_px(rolling.with_exact_rates(readout_s, {"head"}).corrected(readout_s), film)
    assert moved == pytest.approx(misfit_px(rolling.corrected(readout_s), film), rel=0.1)
    assert fitted < 0.8 * moved


def test_a_map_says_which_way_its_sensors_are_read() -> None:
    scene = Map(
        gauge="a",
        cameras={"head": LENS, "torso": LENS},
        keyframe_camera=(),
        keyframe_frame=np.zeros(0, np.int64),
        map_from_cam=np.zeros((0, 4, 4)),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_error_px=np.zeros(0),
        obs_keyframe=np.zeros(0, np.int64),
        obs_point=np.zeros(0, np.int64),
        obs_feature=np.zeros(0, np.int64),
        obs_px=np.zeros((0, 2)),
    )
    reported = {
        "head": Readout(0.02, 0.0, "stated", 0.02, True),
        "torso": Readout(0.0, 1.0, "none found", 0.0, True),
    }
    read = map_with_readouts(scene, reported)
    assert read.readout_s == {"head": 0.02}
    assert {name: lens.sideways for name, lens in read.cameras.items()} == {"head": True, "torso": False}


def test_a_camera_whose_frames_lie_in_another_map_is_left_alone() -> None:
    rolling = rolling_model(Film(0.02), posed=False)
    assert rolling.find_unknown_readouts({}) == {}
    before, after = the_map(Film(0.02), range(1, FRAMES, 5)), rolling.corrected({"head": 0.02})
    for image_id in before.reg_image_ids():
        pairs = zip(before.image(image_id).points2D, after.image(image_id).points2D, strict=True)
        assert all((one.xy == other.xy).all() for one, other in pairs)


def test_a_camera_whose_frames_lie_in_another_map_is_corrected_by_its_rotation() -> None:
    film = Film(0.02)
    turned = film.map_from_cam[:, :3, :3]
    steps = np.swapaxes(turned[1:], 1, 2) @ turned[:-1]
    rotation = RotationPath.from_steps(film.trajectory().times_ns, steps, np.ones(FRAMES - 1, dtype=bool))
    rolling = RollingShutterModel(
        the_map(film, range(1, FRAMES, 5)), {}, {"head": camera_of(film)}, rotations={"head": rotation}
    )
    # What remains is the motion of the position: 2 m/s at a distance of 3 to 6 m.
    for model in (rolling, rolling.with_exact_rates({"head": 0.02}, ["head"])):
        assert misfit_px(model.corrected({"head": 0.02}), film) < 0.6 * misfit_px(model.corrected({}), film)


def test_the_fastest_keyframes_are_looked_at() -> None:
    film = Film(0.0)
    rolling = RollingShutterModel(
        the_map(film, range(1, FRAMES, 2)),
        {"head": film.trajectory()},
        {"head": SimpleNamespace(rolling_shutter_known=False, rolling_shutter_s=0.0)},  # type: ignore[dict-item]
    )
    part = rolling._most_dynamic_part()._model
    frames = sorted(int(part.image(number).name[-7:]) for number in part.reg_image_ids())
    assert len(frames) == 24
    assert set(np.diff(frames)) == {2}, "one run of successive keyframes"


def test_errors_are_reported_where_the_poses_hold() -> None:
    film = Film(0.02)
    frame = 40
    points, px = film.seen(frame)
    count = len(points)
    scene = Map(
        gauge="a",
        cameras={"head": LENS},
        keyframe_camera=("head",),
        keyframe_frame=np.array([frame]),
        map_from_cam=film.map_from_cam[frame : frame + 1],
        points=film.points[points],
        colors=np.zeros((count, 3), np.uint8),
        point_error_px=np.zeros(count),
        obs_keyframe=np.zeros(count, np.int64),
        obs_point=np.arange(count),
        obs_feature=np.arange(count),
        obs_px=px,
    )
    bent = observation_errors(scene, [film.trajectory()]).mean()
    right = observation_errors(replace(scene, readout_s={"head": 0.02}), [film.trajectory()]).mean()
    assert bent > 1.5
    # The mean length of noise of 0.3 px along two axes is 0.38 px; velocities are differences of two frames.
    assert right < 0.5


def test_pixels_move_to_where_they_are_at_the_middle_row() -> None:
    film = Film(0.02)
    frame = 40
    points, px = film.seen(frame)
    before, there, after = (
        seen_from(film.map_from_cam[frame + step], film.points[points]) for step in (-1, 0, 1)
    )
    velocity = (after - before) / (2.0 * FRAME_S)
    moved = px_at_mid_row(LENS, px, velocity, 0.02)
    displaced, left = (np.sqrt(((each - there) ** 2).sum(1).mean()) for each in (px, moved))
    assert displaced > 2.0
    assert left < 2.0 * NOISE_PX, "little but the pixels' own noise (√2 σ) is left"


def seen_from(map_from_cam: FloatArray, points: FloatArray) -> FloatArray:
    """Return the pixels (N,2) of points (N,3) from a pose."""
    cam_from_map = invert(map_from_cam)
    return LENS.project(points @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])
