"""Clocks that are known before the map select the frames between start_s and end_s."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.clocks import measure_sound
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.tasks.sound import SOUND_NAME, known_from_sound, load_sound
from tests.sounds import heard, scene, write_video_with_sound

SECONDS = 6.0
PALM_S = 1.25


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> CaptureConfig:
    """A palm that started 1.25 s after the torso, and a camera without sound."""
    folder = tmp_path_factory.mktemp("take")
    room = scene(33, SECONDS)
    write_video_with_sound(folder / "torso.mp4", heard(room, 1, SECONDS))
    write_video_with_sound(folder / "left_palm.mp4", heard(room, 2, SECONDS, PALM_S))
    write_video_with_sound(folder / "head.mp4", None, seconds=SECONDS)
    cameras = tuple(
        CameraConfig(name=name, video=(folder / f"{name}.mp4",), offset_s=0.0 if name == "torso" else None)
        for name in ("torso", "left_palm", "head")
    )
    return CaptureConfig(cameras=cameras, start_s=2.0, end_s=4.0)


def test_the_sound_selects_the_frames_of_a_camera(capture: CaptureConfig, tmp_path: Path) -> None:
    write_dataclass(measure_sound(capture), tmp_path, SOUND_NAME)
    known = known_from_sound(capture, tmp_path)
    torso, palm, head = known.cameras
    assert torso.offset_s == 0.0
    assert palm.offset_s == pytest.approx(PALM_S, abs=0.004)
    assert head.offset_s is None
    first = {camera.name: 1e-9 * camera.times_ns[0] for camera in open_capture(known).cameras}
    assert first["torso"] == pytest.approx(2.0, abs=0.11)
    assert first["left_palm"] == pytest.approx(2.0 - PALM_S, abs=0.11)
    assert first["head"] == 0.0, "nothing says which of its frames are between start_s and end_s"


def test_one_camera_has_no_sound_to_compare() -> None:
    assert load_sound(None).recordings == ()
    alone = CaptureConfig(cameras=(CameraConfig(name="torso", video=(Path("torso.mp4"),), offset_s=0.0),))
    assert known_from_sound(alone, None).cameras[0].offset_s == 0.0
