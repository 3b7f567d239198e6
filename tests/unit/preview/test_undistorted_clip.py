"""The undistorted clip and the exported camera fit: points of the room lie where the camera projects them."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.clocks.container_times import read_timecode
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.export_inputs import VideoFacts
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.formats.gltf import read_camera_glb
from bodycap_batch.formats.mp4_writer import VideoWriter
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, transform_points
from bodycap_batch.model.pinhole import distorted_px, pinhole_of
from bodycap_batch.model.scene import MapResult, Trajectory
from bodycap_batch.model.take import Timecode
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.undistort import UndistortTask, run_undistort
from tests.scenes import small_map

SIZE = (640, 360)
RATE = Fraction(30000, 1001)
FRAMES = 12
BLOB_PX = 2.5
LENSES = {
    "barrel": Camera(
        model="OPENCV",
        width_px=640,
        height_px=360,
        params=np.array([430.0, 430.0, 331.0, 172.0, -0.22, 0.05, 0.001, -0.002]),
    ),
    "fisheye": Camera(
        model="OPENCV_FISHEYE",
        width_px=640,
        height_px=360,
        params=np.array([310.0, 311.0, 316.0, 185.0, 0.02, -0.01, 0.0, 0.0]),
    ),
    "pincushion": Camera(
        model="RADIAL", width_px=640, height_px=360, params=np.array([500.0, 320.0, 180.0, 0.1, 0.02])
    ),
}


def poses() -> FloatArray:
    steps = np.arange(FRAMES)[:, None]
    return make_transform(so3_exp(steps * [0.004, -0.006, 0.003]), steps * [0.01, -0.004, 0.02])


def room() -> FloatArray:
    """Return points (35,3) that are far enough apart for their pictures not to touch."""
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 7), np.linspace(-0.6, 0.6, 5))
    return np.stack([x.ravel(), y.ravel(), 2.0 + 0.2 * np.sin(5.0 * x.ravel())], axis=1)


def picture(centres: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return a picture with a bright blob at each pixel (N,2), with COLMAP's origin."""
    image = np.full((SIZE[1] + 40, SIZE[0] + 40), 30.0)
    row, column = np.mgrid[:31, :31] + 0.5
    inside = ((centres > -5.0) & (centres < np.array(SIZE) + 5.0)).all(axis=1)  # also excludes NaN
    for x, y in centres[inside] + 20.0:
        left, top = int(x) - 15, int(y) - 15
        square = (column + left - x) ** 2 + (row + top - y) ** 2
        image[top : top + 31, left : left + 31] += 200.0 * np.exp(-0.5 * square / BLOB_PX**2)
    image = image[20:-20, 20:-20]
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def blob_near(image: FloatArray, x: float, y: float) -> FloatArray:
    """Return the centre (2,) of the brightness within 7 px of a pixel, with COLMAP's origin."""
    left, top = int(x) - 7, int(y) - 7
    part = np.maximum(image[top : top + 15, left : left + 15] - 60.0, 0.0)
    column, row = np.meshgrid(np.arange(15) + left + 0.5, np.arange(15) + top + 0.5)
    return np.array([(part * column).sum(), (part * row).sum()]) / part.sum()


@pytest.mark.parametrize("name", LENSES)
def test_points_lie_in_the_clip_where_the_exported_camera_projects_them(tmp_path: Path, name: str) -> None:
    lens, path = LENSES[name], poses()
    video = tmp_path / "cam.mp4"
    with VideoWriter(video, float(RATE), SIZE, "near", timecode="01:02:03;04") as writer:
        for pose in path:
            writer.add(picture(lens.project(transform_points(invert(pose), room()))))
    capture = CaptureConfig.model_validate({"cameras": [{"name": "cam", "video": [str(video)]}]})
    (camera,) = open_capture(capture).cameras
    scene = replace(small_map(), cameras={"cam": lens}, keyframe_camera=("cam",) * 5)
    trajectory = Trajectory(
        camera="cam",
        gauge="map-0",
        frame_numbers=camera.frame_numbers,
        times_ns=camera.times_ns,
        gauge_from_cam=path,
        covariance=np.tile(1e-6 * np.eye(6), (FRAMES, 1, 1)),
        status=("REGISTERED",) * FRAMES,  # type: ignore[arg-type]
        inliers=np.full(FRAMES, 80),
        error_px=np.full(FRAMES, 0.5),
    )
    results = tmp_path / "exported" / "results"
    inputs = ExportInputs(
        out_dir=results,
        maps=(scene,),
        trajectories=(trajectory,),
        clocks={"cam": CameraClock(nominal_fps=camera.nominal_fps)},
        videos={
            "cam": VideoFacts(
                width_px=SIZE[0], height_px=SIZE[1], timecode=Timecode.parse("01:02:03;04", RATE)
            )
        },
    )
    export_results(inputs, ExportOptions(formats=("glb",)), StageContext(work_dir=tmp_path))
    (tmp_path / "map" / "workspace").mkdir(parents=True)
    found = MapResult(maps=(scene,), workspace=tmp_path / "map" / "workspace", log={})
    write_dataclass(found, tmp_path / "map", "map")
    task = UndistortTask(
        camera="cam",
        capture=CaptureRef(config=capture, digests={}),
        map=ArtefactRef(path=tmp_path / "map", digest=""),
        export=ArtefactRef(path=tmp_path / "exported", digest=""),
    )
    run_undistort(task, StageContext(work_dir=tmp_path), tmp_path / "clip")

    (clip,) = open_capture(
        CaptureConfig.model_validate(
            {"cameras": [{"name": "cam", "video": [str(tmp_path / "clip/results/cam.mp4")]}]}
        )
    ).cameras
    assert len(clip.frame_numbers) == FRAMES
    with av.open(str(clip.chapters[0])) as container:
        assert container.streams.video[0].average_rate == RATE
    assert read_timecode(clip.videos[0]) == "01:02:03;04"
    assert json.loads((results / "cameras.json").read_text())["start_timecode"] == "01:02:03;04"
    fov, scene_from_gl = read_camera_glb(results / "cameras.glb")["cam"]
    focal = 0.5 * SIZE[1] / np.tan(0.5 * fov)
    compared = 0
    for index, image in clip.read(np.array([0, 3, 5, 8, 11])):
        x, y, z = transform_points(invert(scene_from_gl[index]), room()).T
        expected = np.stack([0.5 * SIZE[0] - focal * x / z, 0.5 * SIZE[1] + focal * y / z], axis=1)
        inside = ((expected > 20.0) & (expected < np.array(SIZE) - 20.0)).all(axis=1)
        for point in expected[inside]:
            # The target is half a pixel; blobs of 2.5 px lose less than a fifth to interpolation and coding.
            assert np.abs(blob_near(image.astype(float), *point) - point).max() < 0.2
            compared += 1
    assert compared > 60


@pytest.mark.parametrize("name", LENSES)
def test_the_lens_fills_the_picture_and_its_centre_keeps_its_resolution(name: str) -> None:
    lens = LENSES[name]
    pinhole = pinhole_of(lens, *SIZE)
    assert pinhole.principal_point_px == (320.0, 180.0)
    edge = np.array([[x, y] for x in (0.0, 320.0, 640.0) for y in (0.0, 180.0, 360.0)])
    seen = distorted_px(lens, pinhole, edge)
    assert (seen > -0.01).all()
    assert (seen < np.array(SIZE) + 0.01).all()
    grown = pinhole.focal_px / lens.focal_px
    # Only the pincushion lens, and a centre that is off by 11 px, make the picture narrower than the lens.
    least, most = {"barrel": (1.0, 1.05), "fisheye": (1.0, 1.001), "pincushion": (1.05, 1.3)}[name]
    assert least <= grown < most
    if grown > 1.001:
        wider = replace(pinhole, params=pinhole.params * [0.998, 1.0, 1.0])
        seen = distorted_px(lens, wider, edge)
        assert not ((seen >= 0.0) & (seen <= np.array(SIZE))).all()


def test_a_pinhole_lens_stays_as_it_is() -> None:
    lens = Camera(model="PINHOLE", width_px=640, height_px=360, params=np.array([420.0, 420.0, 320.0, 180.0]))
    assert pinhole_of(lens, 1920, 1080).focal_px == pytest.approx(1260.0)
