"""The stage that uses inertial samples goes on without samples that cannot be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.capture import open_capture
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.scene import Registration
from bodycap_batch.tasks.inertial import InertialTask, run_inertial
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import read_summary
from tests.inertial import Hand, solved
from tests.videos import textured_frame, write_video


def test_poses_are_kept_if_the_samples_cannot_be_read(tmp_path: Path) -> None:
    video = write_video(tmp_path / "left_palm.mp4", [textured_frame(index) for index in range(30)])
    samples = tmp_path / "left_palm.gcsv"
    samples.write_text("<html>")
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
    save_registration(registration, open_capture(spec).cameras[0], before, rolling=False)
    task = InertialTask(
        options=TelemetryOptions(),
        cameras=("left_palm",),
        capture=CaptureRef(config=spec, digests={}),
        registrations={"left_palm": ArtefactRef(path=before, digest="")},
        samples={},
    )
    run_inertial(task, StageContext(work_dir=tmp_path), after)
    kept = load_registration(after).trajectory
    assert np.array_equal(kept.gauge_from_cam, registration.trajectory.gauge_from_cam)
    (note,) = read_summary(after)["notes"]
    assert "does not start with GYROFLOW IMU LOG" in note
    assert note.endswith("its samples are not used")
