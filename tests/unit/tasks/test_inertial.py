"""The stage that uses inertial samples goes on without samples that cannot be read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bodycap_batch.capture import open_capture
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass
from bodycap_batch.formats.gpmf_writer import append_settings
from bodycap_batch.model.inertial_camera import InertialCamera
from bodycap_batch.model.scene import Registration
from bodycap_batch.tasks.inertial import InertialTask, run_inertial
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.registered_cameras import INERTIAL_CAMERA
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import read_summary
from bodycap_batch.telemetry.picture_orientation import UNRECORDED_SIGMA_RAD
from tests.inertial import Hand, solved
from tests.videos import textured_frame, write_video


def test_poses_are_kept_if_the_samples_cannot_be_read(tmp_path: Path) -> None:
    samples = tmp_path / "left_palm.gcsv"
    samples.write_text("<html>")
    after = _run(tmp_path, samples=samples, settings={"EISE": "Y"})
    (note,) = read_summary(after)["notes"]
    assert "does not start with GYROFLOW IMU LOG" in note
    assert note.endswith("its samples are not used")
    # What the video states is still known.
    assert read_dataclass(InertialCamera, after, INERTIAL_CAMERA).turns is not None


def test_a_stabilised_video_without_a_record_has_slack_and_is_not_refused(tmp_path: Path) -> None:
    after = _run(tmp_path, stabilised=True)
    (note,) = read_summary(after)["notes"]
    assert note.startswith("left_palm: the camera stabilised the video; ")
    assert "without a record" in note
    turns = read_dataclass(InertialCamera, after, INERTIAL_CAMERA).turns
    assert turns is not None
    np.testing.assert_array_equal(turns.sigma_rad, np.full(30, UNRECORDED_SIGMA_RAD))


def test_a_note_of_the_check_is_not_repeated(tmp_path: Path) -> None:
    after = _run(tmp_path, settings={"EISE": "Y", "EISA": "HS High"})
    assert read_summary(after)["notes"] == []
    assert read_dataclass(InertialCamera, after, INERTIAL_CAMERA).turns is not None


def test_the_job_can_contradict_the_settings(tmp_path: Path) -> None:
    after = _run(tmp_path, settings={"EISE": "Y", "EISA": "HS High"}, stabilised=False)
    assert read_dataclass(InertialCamera, after, INERTIAL_CAMERA).turns is None


def _run(
    tmp_path: Path,
    *,
    samples: Path | None = None,
    settings: Mapping[str, str] | None = None,
    stabilised: bool | None = None,
) -> Path:
    """Run the task on a video of 30 frames, check that the poses are kept, and return its folder."""
    video = write_video(tmp_path / "left_palm.mp4", [textured_frame(index) for index in range(30)])
    if settings is not None:
        append_settings(video, settings)
    config = CameraConfig(name="left_palm", video=(video,), samples=samples, calibration="auto", offset_s=0.0)
    spec = CaptureConfig(cameras=(config,))
    none = np.zeros(0)
    registration = Registration(
        trajectory=solved(Hand(1), 1.0),
        obs_frame=none,
        obs_keyframe=none,
        obs_feature=none,
        obs_px=np.zeros((0, 2)),
        wanted_keyframes=none,
        tried_keyframes=none,
    )
    before, after = tmp_path / "before", tmp_path / "after"
    before.mkdir()
    after.mkdir()
    save_registration(registration, open_capture(spec).cameras[0], before)
    task = InertialTask(
        options=TelemetryOptions(),
        cameras=("left_palm",),
        capture=CaptureRef(config=spec, digests={}),
        registrations={"left_palm": ArtefactRef(path=before, digest="")},
        samples={},
        stabilised=stabilised,
    )
    run_inertial(task, StageContext(work_dir=tmp_path), after)
    kept = load_registration(after).trajectory
    assert np.array_equal(kept.gauge_from_cam, registration.trajectory.gauge_from_cam)
    return after
