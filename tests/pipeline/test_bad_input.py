"""Bad input: each case gives its typed error and exit code, names the file, and says what to do."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.check import check_path, require_ready
from bodycap_batch.cli import main
from bodycap_batch.config.job import load_job
from bodycap_batch.errors import BodycapError
from tests.videos import textured_frame, write_tone, write_video

FRAMES = [textured_frame(index) for index in range(40)]
LENS = {"model": "PINHOLE", "params": [40, 40, 32, 24], "width": 64, "height": 48}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A sound job of two cameras; each test then breaks one thing."""
    for name in ("torso", "head"):
        write_video(tmp_path / f"{name}.mp4", FRAMES)
    cameras = "".join(f"    - {{name: {name}, video: {name}.mp4}}\n" for name in ("torso", "head"))
    (tmp_path / "calib.json").write_text(json.dumps(LENS))
    (tmp_path / "job.yaml").write_text(f"capture:\n  calibration: calib.json\n  cameras:\n{cameras}")
    return tmp_path


def missing(root: Path) -> None:
    (root / "torso.mp4").unlink()


def empty(root: Path) -> None:
    (root / "torso.mp4").write_bytes(b"")


def not_a_video(root: Path) -> None:
    (root / "torso.mp4").write_bytes(np.random.default_rng(0).bytes(5000))


def truncated_index_last(root: Path) -> None:
    """The camera lost power: the index, written last, is not there."""
    data = (root / "torso.mp4").read_bytes()
    (root / "torso.mp4").write_bytes(data[: len(data) // 2])


def truncated_index_first(root: Path) -> None:
    """A copy that broke off, of a file whose index stands first."""
    import av

    with (
        av.open(str(root / "torso.mp4")) as source,
        av.open(str(root / "fast.mp4"), "w", options={"movflags": "faststart"}) as target,
    ):
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    data = (root / "fast.mp4").read_bytes()
    start = data.index(b"mdat")
    (root / "torso.mp4").write_bytes(data[: start + (len(data) - start) // 2])


def zero_frames(root: Path) -> None:
    """A container with a video stream and nothing in it."""
    import av

    with av.open(str(root / "torso.mp4"), "w", format="avi") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()


def audio_only(root: Path) -> None:
    write_tone(root / "torso.mp4")


def black(root: Path) -> None:
    rng = np.random.default_rng(1)
    # A covered lens is not quite black: sensor noise of a few grey levels.
    write_video(root / "torso.mp4", [rng.integers(0, 8, (48, 64)).astype(np.uint8) for _ in range(20)])


def corrupt_in_the_middle(root: Path) -> None:
    """Zeroes over whole access units: no frame can come of them."""
    path = root / "torso.mp4"
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    length = struct.unpack(">I", data[start - 8 : start - 4])[0] - 8
    data[start + length // 3 : start + length] = bytes(length - length // 3)
    path.write_bytes(bytes(data))


def wrong_aspect(root: Path) -> None:
    (root / "calib.json").write_text(json.dumps({**LENS, "width": 64, "height": 36}))


def no_calibration_file(root: Path) -> None:
    (root / "calib.json").unlink()


def few_timestamps(root: Path) -> None:
    (root / "torso.timestamps.txt").write_text("0.0\n0.1\n")


def edit(old: str, new: str) -> Callable[[Path], None]:
    """Change the job's text."""

    def change(root: Path) -> None:
        path = root / "job.yaml"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


VIDEO = "torso.mp4"
CASES = [
    (missing, 3, VIDEO, "no such video"),
    (empty, 3, VIDEO, "empty"),
    (not_a_video, 3, VIDEO, "not a readable video"),
    (truncated_index_last, 3, VIDEO, "not a readable video"),
    (truncated_index_first, 3, VIDEO, "cut short"),
    (zero_frames, 3, VIDEO, "no frame"),
    (audio_only, 3, VIDEO, "sound only"),
    (black, 3, VIDEO, "black pictures only"),
    (corrupt_in_the_middle, 3, VIDEO, "decod"),
    (wrong_aspect, 3, VIDEO, "another aspect"),
    (no_calibration_file, 3, "calib.json", "cannot read"),
    (few_timestamps, 3, "torso.timestamps.txt", "2 timestamps for 40 frames"),
    (edit("name: torso", "mount: trso, name: torso"), 2, "job.yaml", "unknown mount"),
    (edit("name: head", "name: torso"), 2, "job.yaml", "two cameras"),
    (edit("  cameras", "\tcameras"), 2, "job.yaml", "tab"),
    (edit("capture:", "height_m: [1]\ncapture:"), 2, "job.yaml", "should be a number"),
    (edit("capture:", "hight_m: 1\ncapture:"), 2, "job.yaml", "unknown key"),
    (edit("capture:", "name: a\nname: b\ncapture:"), 2, "job.yaml", "twice"),
    (edit("capture:", "capture:\n  start_s: 100"), 3, VIDEO, "no frame between"),
    (edit("video: head.mp4", "video: head.mp4, offset_s: 60"), 3, VIDEO, "shares no time"),
]


@pytest.mark.parametrize(("break_it", "code", "file", "message"), CASES)
def test_bad_input(
    capture: Path, break_it: Callable[[Path], None], code: int, file: str, message: str
) -> None:
    assert check_path(capture / "job.yaml").ready
    break_it(capture)
    report = check_path(capture / "job.yaml")
    error = report.errors[0]
    assert report.exit_code == error.exit_code == code
    assert message in error.message
    assert Path(str(error.path)).name == file
    assert error.hint
    with pytest.raises(BodycapError):
        require_ready(load_job(capture / "job.yaml"))


@pytest.mark.parametrize(
    ("break_it", "code", "message"),
    [
        (black, 3, "torso.mp4: camera torso shows black pictures only"),
        (edit("capture:", "hight_m: 1\ncapture:"), 2, "job.yaml:1: hight_m: unknown key"),
    ],
)
def test_a_refused_run_leaves_earlier_results(
    capture: Path,
    break_it: Callable[[Path], None],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(capture)
    results = {"motion.bvh": b"earlier", "trajectories/torso.tum": b"0 0 0 0 0 0 0 1\n"}
    for name, data in results.items():
        (capture / "results" / name).parent.mkdir(parents=True, exist_ok=True)
        (capture / "results" / name).write_bytes(data)
    break_it(capture)
    assert main(["run", "job.yaml", "--out", "results"]) == code
    told = capsys.readouterr().err
    assert message in told
    assert "hint: " in told
    assert {name: (capture / "results" / name).read_bytes() for name in results} == results
    assert main(["check", "job.yaml"]) == code
