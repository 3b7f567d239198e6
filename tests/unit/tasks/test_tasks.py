"""What tasks give to the stages: mounts, rows, digests of cameras."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import CaptureError, DiskAway, JobError
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.nominal_mounts import (
    NOMINAL_SIGMA_RAD,
    STATED_SIGMA_M,
    STATED_SIGMA_RAD,
    nominal_mount,
)
from bodycap_batch.model.rolling_shutter import mean_row_fraction
from bodycap_batch.model.scene import FrameStatus, MapResult, Registration, Trajectory
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.pipeline.inputs import body_input, camera_digest
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.tasks.body import mount_prior
from bodycap_batch.tasks.export import log_of
from bodycap_batch.tasks.rotations import lens_for_rotations, without_positions
from tests.scenes import small_map

QUARTER_TURN = {"translation_m": [0.1, 0.2, 0.3], "quat_xyzw": [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]}


def a_job(folder: Path, **camera: Any) -> Job:
    video = folder / "torso.mp4"
    video.write_text("frames")
    fields = {"name": "torso", "video": [str(video)], "calibration": "auto", **camera}
    return Job.model_validate({"capture": {"cameras": [fields]}, "skeleton": "upper_body", "height_m": 1.75})


def mount(folder: Path, **camera: Any) -> Mount:
    stated = body_input(a_job(folder, **camera), FileDigests(folder / "digests")).mounts[0]
    return mount_prior(stated, load_skeleton("upper_body", 1.75))


def test_a_mount_known_by_name_is_the_nominal_one(tmp_path: Path) -> None:
    found = mount(tmp_path)
    nominal = nominal_mount("torso", "Spine1", load_skeleton("upper_body", 1.75))
    assert np.array_equal(found.joint_from_cam, nominal.joint_from_cam)
    assert found.sigma_rad == NOMINAL_SIGMA_RAD
    assert found.by_name


def test_a_stated_mount_is_trusted_more(tmp_path: Path) -> None:
    found = mount(tmp_path, joint_from_cam=QUARTER_TURN)
    assert np.allclose(found.joint_from_cam[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert found.joint_from_cam[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert (found.sigma_rad, found.sigma_m) == (STATED_SIGMA_RAD, STATED_SIGMA_M)


def test_stated_sigmas_are_used(tmp_path: Path) -> None:
    found = mount(tmp_path, joint_from_cam=QUARTER_TURN, sigma_deg=1.0, sigma_m=0.002)
    assert found.sigma_rad == pytest.approx(np.radians(1.0))
    assert found.sigma_m == 0.002


@pytest.mark.parametrize("pose", [QUARTER_TURN, None])
def test_a_mount_with_a_stated_uncertainty_does_not_count_as_known_by_name(tmp_path: Path, pose: Any) -> None:
    found = mount(tmp_path, joint_from_cam=pose, sigma_deg=20.0)
    assert found.sigma_rad == pytest.approx(np.radians(20.0))
    assert not found.by_name


def test_the_mount_field_decides_on_the_place_not_the_name(tmp_path: Path) -> None:
    front, back = mount(tmp_path), mount(tmp_path, name="seven", mount="torso_back")
    assert back.camera == "seven"
    assert back.role == "Spine1"
    assert front.joint_from_cam[1, 2] < 0 < back.joint_from_cam[1, 2], "the body faces −Y"


def test_a_camera_without_a_known_place_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="seven"):
        mount(tmp_path, name="seven")


def test_the_mean_row_follows_the_observations() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2] = np.nan
    found = Registration(
        trajectory=Trajectory(
            camera="torso",
            gauge="g",
            frame_numbers=np.arange(4),
            times_ns=np.arange(4),
            gauge_from_cam=poses,
            covariance=np.full((4, 6, 6), np.nan),
            status=(
                FrameStatus.REGISTERED,
                FrameStatus.KEYFRAME,
                FrameStatus.BLUR,
                FrameStatus.REGISTERED,
            ),
            inliers=np.zeros(4, np.int64),
            error_px=np.full(4, np.nan),
        ),
        obs_frame=np.array([0, 0, 2, 3]),
        obs_keyframe=np.array([1, 1, 1, 1]),
        obs_feature=np.arange(4),
        obs_px=np.array([[5, 10], [5, 20], [5, 48], [5, 36]], dtype=np.float32),
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=np.zeros(0, np.int64),
    )
    camera = Camera(model="PINHOLE", width_px=64, height_px=48, params=np.array([50, 50, 32, 24]))
    # frame 1 has no observation of its own: the middle row; frame 2 has no pose
    expected = [15 / 48, 0.5, np.nan, 36 / 48]
    assert np.array_equal(mean_row_fraction(found, camera), expected, equal_nan=True)
    across = [5 / 64, 0.5, np.nan, 5 / 64]
    assert np.array_equal(mean_row_fraction(found, replace(camera, sideways=True)), across, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "counts"),
    [
        ({"offset_s": 0.1}, False),
        ({"drift_ppm": 10.0}, False),
        ({"rolling_shutter_s": 0.02}, True),
        ({"fov_deg": 90.0}, True),
        ({"mount": "head"}, False),
        ({"joint_from_cam": QUARTER_TURN}, False),
        ({"sigma_deg": 2.0}, False),
    ],
)
def test_the_digest_of_a_camera_covers_what_its_frames_depend_on(
    tmp_path: Path, change: dict[str, Any], counts: bool
) -> None:
    digests = FileDigests(tmp_path / "digests")
    jobs = [a_job(tmp_path), a_job(tmp_path, **change)]
    found = {camera_digest(job.capture, job.capture.cameras[0], digests) for job in jobs}
    assert (len(found) == 2) is counts


def test_the_content_of_a_sidecar_counts_and_a_missing_one_is_reported(tmp_path: Path) -> None:
    digests = FileDigests(tmp_path / "digests")
    sidecar = tmp_path / "torso.timestamps.txt"
    job = a_job(tmp_path, timestamps=[str(sidecar)])
    sidecar.write_text("0.0\n0.1\n")
    first = camera_digest(job.capture, job.capture.cameras[0], digests)
    sidecar.write_text("0.0\n0.2\n")
    assert camera_digest(job.capture, job.capture.cameras[0], digests) != first
    sidecar.unlink()
    with pytest.raises(CaptureError, match="no such file") as caught:
        camera_digest(job.capture, job.capture.cameras[0], digests)
    assert caught.value.path == str(sidecar)


@pytest.mark.parametrize("number", [errno.ESTALE, errno.EIO])
def test_a_disk_that_fails_while_footage_is_read_is_reported_instead_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def fail(*_: Any) -> str:
        raise OSError(number, os.strerror(number))  # from `read`: it names no file

    monkeypatch.setattr("bodycap_batch.store.digests.file_sha256", fail)
    job = a_job(tmp_path)
    with pytest.raises(DiskAway, match=os.strerror(number)) as caught:
        camera_digest(job.capture, job.capture.cameras[0], FileDigests(tmp_path / "digests"))
    assert caught.value.path == str(job.capture.cameras[0].video[0])


def test_positions_that_say_nothing_are_found_by_the_links_and_the_sigma() -> None:
    def camera(**changed: Any) -> dict[str, Any]:
        link = {"compared": 100, "contradicted": changed.pop("contradicted", 0)}
        return {"frame": "a", "posed": True, "sigma": 0.1, "extent": 1.0, "links": [link], **changed}

    found = {
        "right": camera(),
        "unposed": camera(posed=False, sigma=None, extent=None, links=[]),
        "wrong": camera(contradicted=6),
        "nearly": camera(contradicted=5),
        "noise": camera(frame="b", sigma=0.3),
        "small": camera(extent=0.2),  # the longest path of its map counts, as for cameras on one body
        "other": camera(frame="c", posed=True, sigma=None, extent=None),
    }
    assert without_positions(found) == ["noise", "unposed", "wrong"]


def test_rotations_use_the_lens_that_is_known_best() -> None:
    start = Camera(model="PINHOLE", width_px=64, height_px=48, params=np.array([50.0, 50.0, 32.0, 24.0]))
    unknown = replace(start, refine=True)
    selection: Any = SimpleNamespace(lens=None)
    assert lens_for_rotations(start, selection) == (start, 0.0)
    guess, sigma = lens_for_rotations(unknown, selection)
    assert guess is unknown
    assert sigma > 0.1
    found = LensEstimate(lens=start, focal_sigma=0.04, pairs=20, error_px=0.3)
    assert lens_for_rotations(unknown, SimpleNamespace(lens=found)) == (start, 0.04)  # type: ignore[arg-type]


def test_the_results_state_a_given_lens_that_is_not_used() -> None:
    scene = MapResult(maps=(small_map(),), workspace=Path("w"), log={"keyframes": 4})
    name, lens = next(iter(scene.maps[0].cameras.items()))
    given = lens.focal_px / lens.width_px / 1.04
    assert log_of(scene, {}) is scene.log
    diagnostics = MapDiagnostics.from_log(log_of(scene, {name: given, "unmapped": 0.5}))
    assert diagnostics.misfit_factors == {name: 1.04}
    assert diagnostics.recalibrated == (name,)
    assert diagnostics.details["keyframes"] == 4
