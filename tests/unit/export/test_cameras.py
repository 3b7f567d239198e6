"""The animated cameras in files: what a program projects with them is what our own pinhole camera sees."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.export_inputs import VideoFacts
from bodycap_batch.formats.chan import read_chan
from bodycap_batch.formats.gltf import read_camera_glb
from bodycap_batch.formats.usd_cameras import read_camera_usd
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, invert, transform_points
from bodycap_batch.model.pinhole import pinhole_of
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.take import Timecode, exact_rate
from tests.bodies import merged, reaching
from tests.scenes import small_map

FORMATS = ("glb", "usd", "chan")
SIZE = (1280, 720)
LOST = range(20, 25)
TURNED = Similarity(0.7, np.eye(3), np.array([0.2, -0.4, 1.1]))
Read = dict[str, tuple[float, FloatArray]]


def lenses() -> dict[str, Camera]:
    fisheye = Camera(
        model="OPENCV_FISHEYE",
        width_px=640,
        height_px=360,
        params=np.array([300.0, 301.0, 318.0, 183.0, 0.03, -0.01, 0.0, 0.0]),
    )
    wide = Camera(
        model="OPENCV",
        width_px=640,
        height_px=360,
        params=np.array([420.0, 420.0, 322.0, 178.0, -0.2, 0.05, 0.0, 0.0]),
    )
    return {"torso": fisheye, "left_palm": wide}


def body_inputs(folder: Path, fps: float = 30.0, offset_s: float = 0.0) -> ExportInputs:
    result, clocks = merged(
        reaching(60, fps=fps), offset_s=offset_s, world_from_map={"map-0": TURNED}, projected=False
    )
    clocks = {name: replace(clock, nominal_fps=fps) for name, clock in clocks.items()}
    return ExportInputs(
        out_dir=folder,
        maps=(replace(small_map(), cameras=lenses()),),
        trajectories=result.trajectories,
        clocks=clocks,
        merge=result,
        take="walk",
        videos={name: VideoFacts(width_px=SIZE[0], height_px=SIZE[1]) for name in clocks},
    )


def export(inputs: ExportInputs, **options: object) -> dict[str, Any]:
    chosen = ExportOptions.model_validate({"formats": FORMATS, **options})
    export_results(inputs, chosen, StageContext(work_dir=inputs.out_dir))
    content = json.loads((inputs.out_dir / "cameras.json").read_text())
    assert isinstance(content, dict)
    return content


def read_chans(folder: Path, count: int) -> Read:
    """Return the cameras of all .chan files; NaN for frames without a line."""
    out = {}
    for path in sorted((folder / "cameras").glob("*.chan")):
        frames, fov, poses = read_chan(path)
        every = np.full((count, 4, 4), np.nan)
        every[frames] = poses
        out[path.stem] = (fov, every)
    return out


def pixels_in_program(fov_rad: float, scene_from_gl: FloatArray, points: FloatArray) -> FloatArray:
    """Project as computer graphics do: by the vertical field of view, looking along −Z, with Y up."""
    x, y, z = transform_points(invert(scene_from_gl), points).T
    focal = 0.5 * SIZE[1] / np.tan(0.5 * fov_rad)
    return np.stack([0.5 * SIZE[0] + focal * x / -z, 0.5 * SIZE[1] - focal * y / -z], axis=1)


def points_before(pose: FloatArray) -> FloatArray:
    """Return points (60,3) in front of a camera, in the scene."""
    rng = np.random.default_rng(3)
    return transform_points(pose, rng.uniform([-0.6, -0.4, 0.8], [0.6, 0.4, 3.0], size=(60, 3)))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> ExportInputs:
    inputs = body_inputs(tmp_path_factory.mktemp("results"))
    export(inputs)
    return inputs


READERS: dict[str, Callable[[Path, int], Read]] = {
    "glb": lambda folder, _: read_camera_glb(folder / "cameras.glb"),
    "usd": lambda folder, _: read_camera_usd(folder / "cameras.usd"),
    "chan": read_chans,
}


@pytest.mark.parametrize("name", READERS)
def test_a_program_sees_map_points_where_our_pinhole_sees_them(exported: ExportInputs, name: str) -> None:
    inputs = exported
    found = READERS[name](inputs.out_dir, 60)
    assert sorted(found) == ["left_palm", "torso"]  # the map has no lens for the right palm
    assert inputs.merge is not None
    for path in (each for each in inputs.merge.trajectories if each.camera in found):
        fov, poses = found[path.camera]
        pinhole = pinhole_of(lenses()[path.camera], *SIZE)
        for tick in (0, 13, 29, 44, 59):
            pose = path.gauge_from_cam[tick]
            points = points_before(pose)
            ours = pinhole.project(transform_points(invert(pose), points))
            # Target: half a pixel. Rounding of the formats is below a hundredth at these distances.
            assert np.abs(pixels_in_program(fov, poses[tick], points) - ours).max() < 0.05


def test_lost_frames_are_absent_or_marked(exported: ExportInputs) -> None:
    from pxr import Usd, UsdGeom

    folder = exported.out_dir
    facts = json.loads((folder / "cameras.json").read_text())
    frames, _, _ = read_chan(folder / "cameras" / "torso.chan")
    assert frames.tolist() == [tick for tick in range(60) if tick not in LOST]
    assert facts["cameras"]["torso"]["valid_frames"] == [[0, 19], [25, 59]]
    assert facts["cameras"]["torso"]["sigma_position"][22] is None
    assert facts["cameras"]["torso"]["sigma_position"][5] == pytest.approx(0.01)
    stage = Usd.Stage.Open(str(folder / "cameras.usd"))
    camera = UsdGeom.Camera.Get(stage, "/Cameras/torso")
    shown = [camera.GetVisibilityAttr().Get(float(tick)) == "inherited" for tick in range(60)]
    assert [tick for tick in range(60) if not shown[tick]] == list(LOST)
    primvars = UsdGeom.PrimvarsAPI(camera)
    assert [bool(primvars.GetPrimvar("valid").Get(float(tick))) for tick in (19, 20, 25)] == [
        True,
        False,
        True,
    ]
    assert primvars.GetPrimvar("sigmaPosition").Get(5.0) == pytest.approx(0.01)
    # The pose is held: the picture does not move while nothing is known.
    _, poses = read_camera_glb(folder / "cameras.glb")["torso"]
    np.testing.assert_array_equal(poses[19:25], np.broadcast_to(poses[19], (6, 4, 4)))


def test_the_lens_has_usds_units(exported: ExportInputs) -> None:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(exported.out_dir / "cameras.usd"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    camera = UsdGeom.Camera.Get(stage, "/Cameras/torso").GetCamera(0.0)
    pinhole = pinhole_of(lenses()["torso"], *SIZE)
    # A tenth of a scene unit is 100 mm; the sensor is 36 mm wide.
    assert camera.horizontalAperture == pytest.approx(0.36)
    assert camera.focalLength == pytest.approx(0.36 * pinhole.focal_px / SIZE[0])
    assert camera.aspectRatio == pytest.approx(SIZE[0] / SIZE[1])
    assert camera.horizontalApertureOffset == camera.verticalApertureOffset == 0.0


def test_each_frame_has_the_pose_of_the_picture_that_is_shown(tmp_path: Path) -> None:
    """With pictures 12 ms after the ticks, the pose is that of a picture, not one between two pictures."""
    inputs = body_inputs(tmp_path, offset_s=0.007)
    facts = export(inputs)
    camera = facts["cameras"]["torso"]
    assert camera["video_frame"][:3] == [0, 1, 2]
    assert camera["shift_s"][:2] == [0.0, 0.0]
    later = {name: replace(clock, offset_s=clock.offset_s + 0.012) for name, clock in inputs.clocks.items()}
    facts = export(replace(inputs, clocks=later))
    camera = facts["cameras"]["torso"]
    assert camera["shift_s"][5] == pytest.approx(0.012, abs=1e-6)
    _, poses = read_camera_glb(tmp_path / "cameras.glb")["torso"]
    assert inputs.merge is not None
    path = next(each for each in inputs.merge.trajectories if each.camera == "torso")
    np.testing.assert_allclose(poses[5][:3, 3], path.gauge_from_cam[5][:3, 3], atol=1e-5)


def rising(name: str, first_ns: int, count: int, fps: float) -> Trajectory:
    """Return the path of a camera that rises, in the gauge of the small map."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = -0.01 * np.arange(count)
    return Trajectory(
        camera=name,
        gauge="map-0",
        frame_numbers=np.arange(count),
        times_ns=first_ns + np.round(np.arange(count) * 1e9 / fps).astype(np.int64),
        gauge_from_cam=poses,
        covariance=np.tile(1e-6 * np.eye(6), (count, 1, 1)),
        status=("REGISTERED",) * count,  # type: ignore[arg-type]
        inliers=np.full(count, 80),
        error_px=np.full(count, 0.5),
    )


def test_cameras_without_a_body_are_in_the_gauge_of_the_map(tmp_path: Path) -> None:
    fps = 30000 / 1001
    inputs = ExportInputs(
        out_dir=tmp_path,
        maps=(small_map(),),
        trajectories=(rising("torso", 0, 40, fps), rising("left_palm", -100_000_000, 30, fps)),
        clocks={name: CameraClock(nominal_fps=fps) for name in ("torso", "left_palm")},
        reference_camera="torso",
        videos={
            "torso": VideoFacts(
                width_px=640, height_px=480, timecode=Timecode.parse("10:00:00;10", exact_rate(fps))
            )
        },
    )
    facts = export(inputs)
    assert facts["frame_of_reference"] == "gauge map-0, its scale and axes are arbitrary"
    assert facts["rate"] == "30000/1001"
    # The other camera starts 100 ms earlier: 3 frames, in which the reference camera has no picture.
    assert facts["frames"] == 43
    assert facts["start_timecode"] == "10:00:00;07"
    assert facts["cameras"]["torso"]["valid_frames"] == [[3, 42]]
    assert facts["cameras"]["torso"]["video_frame"][2:5] == [-1, 0, 1]
    assert facts["cameras"]["left_palm"]["valid_frames"] == [[0, 29]]
    frames, _, poses = read_chan(tmp_path / "cameras" / "torso.chan")
    np.testing.assert_allclose(poses[:, 1, 3], -0.01 * (frames - 3), atol=1e-7)


def test_the_same_cameras_give_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        export(body_inputs(tmp_path / name))
        files = sorted((tmp_path / name).rglob("cameras*"))
        contents.append([path.read_bytes() for path in files if path.is_file()])
    assert contents[0] == contents[1]
    assert len(contents[0]) == 3
