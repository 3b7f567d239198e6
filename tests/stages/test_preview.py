"""``preview.mp4`` of a small capture: it can be played, marks lost frames and has reproducible bytes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import av
import numpy as np
import pytest

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled, StoreError
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.overlay import BoneMotion, bones_from_motion, make_camera_views
from bodycap_batch.preview import PreviewInputs, render_preview
from bodycap_batch.preview.layout import lay_out_videos
from tests.bodies import reaching
from tests.stages.conftest import DARK, Estimated, context


def preview_inputs(estimated: Estimated, path: Path, bone_motion: BoneMotion | None = None) -> PreviewInputs:
    scene = estimated.result.maps[0]
    clocks = {
        camera.name: CameraClock(nominal_fps=camera.nominal_fps, offset_s=camera.clock.offset_s)
        for camera in estimated.capture.cameras
    }
    return PreviewInputs(
        path=path,
        capture=estimated.capture,
        views=make_camera_views(estimated.registrations, estimated.result.maps, clocks),
        reference_frame=scene.gauge,
        points=scene.points,
        colours=scene.colors,
        bone_motion=bone_motion,
    )


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def preview(estimated: Estimated, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("preview")
    return render_preview(preview_inputs(estimated, folder / "preview.mp4"), context(folder))


def test_browsers_can_play_it_before_it_is_loaded_completely(preview: Path, estimated: Estimated) -> None:
    with av.open(str(preview)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.codec_context.width, stream.codec_context.height) == (1280, 720)
        assert stream.frames == -(-len(estimated.capture.cameras[0].times_ns) // 2), "15 of 30 a second"
    data = preview.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "the index comes first"


def test_the_same_results_give_the_same_bytes(preview: Path, estimated: Estimated, tmp_path: Path) -> None:
    again = render_preview(preview_inputs(estimated, tmp_path / "preview.mp4"), context(tmp_path))
    assert again.read_bytes() == preview.read_bytes()


def test_a_lost_frame_has_a_red_text(preview: Path, estimated: Estimated) -> None:
    shown = decode(preview)
    cameras = estimated.capture.cameras
    boxes = lay_out_videos([camera.camera.width_px / camera.camera.height_px for camera in cameras])
    palm = [camera.name for camera in cameras].index("left_palm")
    bar = boxes[palm][1]
    status = estimated.registrations[palm].trajectory.status
    lost = [index for index in DARK if not status[index].localised]
    assert len(lost) >= 4, "frames without light"
    lost = [index // 2 for index in lost if index % 2 == 0]  # every second frame is shown

    def reddish(index: int) -> int:
        line = shown[index][bar.y : bar.y + bar.height, bar.x + bar.width // 3 : bar.x + bar.width]
        return int(((line[..., 0] > 120) & (line[..., 0] > line[..., 1] + 50)).sum())

    assert min(reddish(index) for index in lost) > 50
    assert reddish(5) < 10, "a localised frame has no red text"


def test_the_body_moves_in_its_room(estimated: Estimated, tmp_path: Path) -> None:
    """A body is drawn and moves if the views are declared to be in the world."""
    motion = reaching(ticks=20)
    start = int(estimated.capture.cameras[0].common_times_ns()[0])
    bone_motion = bones_from_motion(
        dataclasses.replace(motion, start_ns=start, observed=np.ones_like(motion.observed))
    )
    inputs = preview_inputs(estimated, tmp_path / "preview.mp4", bone_motion)
    world = tuple(dataclasses.replace(view, reference_frame="world") for view in inputs.views)
    inputs = dataclasses.replace(inputs, views=world, reference_frame="world")
    shown = decode(render_preview(inputs, context(tmp_path)))
    assert len(shown) == 10, "as long as the motion, every second tick"
    first, last = (shown[index][:, :640].astype(int) for index in (0, 9))
    orange = (first[..., 0] > 180) & (np.abs(first[..., 1] - 150) < 50) & (first[..., 2] < 90)
    blue = (first[..., 2] > 180) & (first[..., 0] < 140)
    assert orange.sum() > 200, "the right side"
    assert blue.sum() > 200, "the left side"
    assert (np.abs(first - last).max(axis=2) > 60).sum() > 1000


def test_it_can_be_cancelled_and_leaves_no_partial_file(estimated: Estimated, tmp_path: Path) -> None:
    stopping = StageContext(work_dir=tmp_path, cancelled=lambda: True)
    with pytest.raises(Cancelled):
        render_preview(preview_inputs(estimated, tmp_path / "out" / "preview.mp4"), stopping)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_an_error(estimated: Estimated, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(StoreError, match="cannot be written"):
        render_preview(preview_inputs(estimated, tmp_path / "file" / "preview.mp4"), context(tmp_path))
