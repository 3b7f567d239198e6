"""Broken captures and jobs: how each is made, and the message that a user gets."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.videos import textured_frame, write_tone, write_video

FRAMES = [textured_frame(index) for index in range(40)]
MIRRORED = [frame[:, ::-1] for frame in FRAMES]
LENS = {"model": "PINHOLE", "params": [40, 40, 32, 24], "width": 64, "height": 48}
BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 30 0
  }
}
"""


def sound(root: Path) -> Path:
    """Make a valid job of two cameras in a folder; return its file."""
    write_video(root / "torso.mp4", FRAMES)
    write_video(root / "head.mp4", MIRRORED)
    cameras = "".join(f"    - {{name: {name}, video: {name}.mp4}}\n" for name in ("torso", "head"))
    (root / "calib.json").write_text(json.dumps(LENS))
    (root / "job.yaml").write_text(
        f"capture:\n  clocks: common\n  calibration: calib.json\n  cameras:\n{cameras}"
    )
    return root / "job.yaml"


@dataclass(frozen=True)
class Case:
    """One way to break the valid job.

    Attributes:
        name: Title of the test.
        break_it: Called with the job's folder.
        code: Exit code.
        file: Name of the file that the message names.
        message: Part of the message.
    """

    name: str
    break_it: Callable[[Path], None]
    code: int
    file: str
    message: str


def missing(root: Path) -> None:
    (root / "torso.mp4").unlink()


def empty(root: Path) -> None:
    (root / "torso.mp4").write_bytes(b"")


def not_a_video(root: Path) -> None:
    (root / "torso.mp4").write_bytes(np.random.default_rng(0).bytes(5000))


def truncated_index_last(root: Path) -> None:
    """Cut off the index at the end of the file, as after a power failure of the camera."""
    data = (root / "torso.mp4").read_bytes()
    (root / "torso.mp4").write_bytes(data[: len(data) // 2])


def truncated_index_first(root: Path) -> None:
    """Cut off a file with its index at the start, as after an interrupted copy."""
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
    """Write a container with a video stream and without frames."""
    import av

    with av.open(str(root / "torso.mp4"), "w", format="avi") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()


def audio_only(root: Path) -> None:
    write_tone(root / "torso.mp4")


def black(root: Path) -> None:
    rng = np.random.default_rng(1)
    # The picture of a covered lens has sensor noise of a few grey levels.
    write_video(root / "torso.mp4", [rng.integers(0, 8, (48, 64)).astype(np.uint8) for _ in range(20)])


def overwrite(path: Path, first: float, last: float) -> None:
    """Overwrite whole access units of a video with zeroes, so that no frame can be decoded from them.

    Args:
        path: Path of the video.
        first: Start of the zeroes, as a fraction of the video's data.
        last: End of the zeroes, as a fraction of the video's data.
    """
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    length = struct.unpack(">I", data[start - 8 : start - 4])[0] - 8
    low, high = start + int(first * length), start + int(last * length)
    data[low:high] = bytes(high - low)
    path.write_bytes(bytes(data))


def damaged_from_the_start(root: Path) -> None:
    overwrite(root / "torso.mp4", 0.0, 1.0)


def wrong_aspect(root: Path) -> None:
    (root / "calib.json").write_text(json.dumps({**LENS, "width": 64, "height": 36}))


def no_calibration_file(root: Path) -> None:
    (root / "calib.json").unlink()


def few_timestamps(root: Path) -> None:
    (root / "torso.timestamps.txt").write_text("0.0\n0.1\n")


def edit(old: str, new: str) -> Callable[[Path], None]:
    """Return a function that replaces text in the job file."""

    def change(root: Path) -> None:
        path = root / "job.yaml"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


def replace_text(name: str, text: str | bytes) -> Callable[[Path], None]:
    """Return a function that replaces the content of a file."""

    def change(root: Path) -> None:
        (root / name).write_bytes(text.encode() if isinstance(text, str) else text)

    return change


def calibrated(**changes: object) -> Callable[[Path], None]:
    """Return a function that changes values of the calibration."""
    return replace_text("calib.json", json.dumps({**LENS, **changes}))


def unknown_codec(root: Path) -> None:
    """Change the codec to one that the decoder does not know."""
    data = (root / "torso.mp4").read_bytes()
    (root / "torso.mp4").write_bytes(data.replace(b"avc1", b"zz99"))


def identical(root: Path) -> None:
    shutil.copy(root / "torso.mp4", root / "head.mp4")


def one_frame(root: Path) -> None:
    write_video(root / "torso.mp4", FRAMES[:1])


def a_photo(root: Path) -> None:
    import cv2

    cv2.imwrite(str(root / "torso.png"), FRAMES[0])
    (root / "torso.png").rename(root / "torso.mp4")


def chapters(*names: str, size: tuple[int, int] = (64, 48)) -> Callable[[Path], None]:
    """Return a function that makes the torso's video a folder of chapters; all but the first have `size`."""

    def change(root: Path) -> None:
        (root / "torso.mp4").unlink()
        for index, name in enumerate(names):
            width, height = size if index else (64, 48)
            frames = [textured_frame(number, width, height) for number in range(20)]
            write_video(root / "card" / name, frames)
        edit("video: torso.mp4", "video: card")(root)

    return change


def empty_folder(root: Path) -> None:
    (root / "card").mkdir()
    edit("video: torso.mp4", "video: card")(root)


def out_is_a_file(root: Path) -> None:
    (root / "results").write_text("mine")
    edit("capture:", "out: results\ncapture:")(root)


def skeleton(text: str) -> Callable[[Path], None]:
    """Return a function that makes the job use a skeleton file with this content."""

    def change(root: Path) -> None:
        (root / "subject.bvh").write_text(text)
        edit("capture:", "skeleton: subject.bvh\ncapture:")(root)

    return change


def mask(root: Path) -> None:
    (root / "mask.png").write_text("no picture")
    edit("video: torso.mp4", "video: torso.mp4, mask: mask.png")(root)


VIDEO, JOB, CALIB, TIMES = "torso.mp4", "job.yaml", "calib.json", "torso.timestamps.txt"
CASES = (
    Case("missing video", missing, 3, VIDEO, "no such"),
    Case("empty file", empty, 3, VIDEO, "empty"),
    Case("no video at all", not_a_video, 3, VIDEO, "cannot be read as a video"),
    Case("power lost", truncated_index_last, 3, VIDEO, "cannot be read as a video"),
    Case("copy broken off", truncated_index_first, 3, VIDEO, "is incomplete"),
    Case("zero frames", zero_frames, 3, VIDEO, "no frame"),
    Case("sound only", audio_only, 3, VIDEO, "only sound"),
    Case("lens covered", black, 3, VIDEO, "only black pictures"),
    Case("damaged from the start", damaged_from_the_start, 3, VIDEO, "decod"),
    Case("unknown codec", unknown_codec, 3, VIDEO, "cannot decode this kind"),
    Case("one frame", one_frame, 3, VIDEO, "only one frame"),
    Case("a photo", a_photo, 3, VIDEO, "only one frame"),
    Case("two identical videos", identical, 3, "head.mp4", "the same video as"),
    Case("calibrated at another aspect", calibrated(height=36), 3, VIDEO, "aspect ratios differ"),
    Case("calibrated sideways", calibrated(width=48, height=64), 3, VIDEO, "aspect ratios differ"),
    Case("calibration missing", lambda root: (root / CALIB).unlink(), 3, CALIB, "cannot be read"),
    Case("calibration cut off", replace_text(CALIB, '{"model": "PINHO'), 3, CALIB, "JSON"),
    Case("NaN in the calibration", calibrated(params=[float("nan"), 40, 32, 24]), 3, CALIB, "fx is nan px"),
    Case("infinity in the calibration", calibrated(params=[40, float("inf"), 32, 24]), 3, CALIB, "fy is inf"),
    Case("focal length 1e300", calibrated(params=[1e300, 40, 32, 24]), 3, CALIB, "plausible is 1.28 to 3200"),
    Case("focal length zero", calibrated(params=[40, 0, 32, 24]), 3, CALIB, "fy is 0 px"),
    Case("principal point far away", calibrated(params=[40, 40, 32, 1e6]), 3, CALIB, "cy is 1e+06 px"),
    Case(
        "absurd distortion",
        calibrated(model="OPENCV", params=[40, 40, 32, 24, 0, 1e9, 0, 0]),
        *(3, CALIB, "the distortion k2 is 1e+09"),
    ),
    Case(
        "absurd angle of the FOV model",
        calibrated(model="FOV", params=[40, 40, 32, 24, 7]),
        *(3, CALIB, "the distortion omega is 7"),
    ),
    Case(
        "focal length 1e300 in the job",
        edit(
            "calibration: calib.json",
            "calibration: {model: PINHOLE, width: 64, height: 48, params: [1.0e+300, 40, 32, 24]}",
        ),
        *(3, JOB, "the focal length fx is 1e+300 px"),
    ),
    Case("negative focal length", calibrated(params=[-40, 40, 32, 24]), 3, CALIB, "fx is -40 px"),
    Case("too few parameters", calibrated(params=[40, 32, 24]), 3, CALIB, "needs 4 params (fx, fy"),
    Case("unknown lens model", calibrated(model="PINHOLLE"), 3, CALIB, "did you mean PINHOLE"),
    Case("calibration of other cameras", replace_text(CALIB, '{"cameras": {"left": {}}}'), 3, CALIB, "torso"),
    Case("too few timestamps", few_timestamps, 3, TIMES, "2 timestamps for 40 frames"),
    Case("timestamps go back", replace_text(TIMES, "0.0\n0.2\n0.1\n"), 3, TIMES, "is not later than"),
    Case("timestamps are words", replace_text(TIMES, "0.0\nnoon\n"), 3, TIMES, "is not a time in seconds"),
    Case(
        "timestamps are binary",
        replace_text(TIMES, b"\xff\xfe\x00"),
        3,
        TIMES,
        "the timestamps cannot be read",
    ),
    Case("window after the end", edit("capture:", "capture:\n  start_s: 100"), 3, VIDEO, "no frame between"),
    Case(
        "clocks apart", edit("head.mp4", "head.mp4, offset_s: 60"), 3, VIDEO, "but the other cameras recorded"
    ),
    Case("missing chapter", chapters("GX010042.MP4", "GX030042.MP4"), 3, "GX030042.MP4", "chapter 2"),
    Case(
        "chapter of another size",
        chapters("GX010042.MP4", "GX020042.MP4", size=(48, 64)),
        3,
        "GX020042.MP4",
        "the first chapter has pictures of 64×48",
    ),
    Case("folder without videos", empty_folder, 3, "card", "no video"),
    Case("mask is no picture", mask, 3, "mask.png", "mask"),
    Case("results' name is a file", out_is_a_file, 5, "results", "cannot be written"),
    Case("skeleton cut off", skeleton(BVH[:60]), 2, "subject.bvh", "CHANNELS 6"),
    Case("skeleton without hands", skeleton(BVH), 2, "subject.bvh", "has the role"),
    Case("skeleton missing", edit("capture:", "skeleton: no.bvh\ncapture:"), 2, JOB, "no such skeleton file"),
    Case("unknown mount", edit("name: torso", "mount: trso, name: torso"), 2, JOB, "no mount"),
    Case("no mount", edit("name: head", "name: c4"), 2, JOB, "c4"),
    Case("two cameras of one name", edit("name: head", "name: torso"), 2, JOB, "two cameras"),
    Case("camera's name is a path", edit("name: head", "name: ../head, mount: head"), 2, JOB, "name"),
    Case("name of 300 letters", edit("capture:", f"name: {'n' * 300}\ncapture:"), 2, JOB, "at most 100"),
    Case("tab in the job", edit("  cameras", "\tcameras"), 2, JOB, "tab"),
    Case("a list for a number", edit("capture:", "height_m: [1]\ncapture:"), 2, JOB, "should be a number"),
    Case("a height of a giant", edit("capture:", "height_m: 17.5\ncapture:"), 2, JOB, "17.5: should be less"),
    Case("a key misspelt", edit("capture:", "hight_m: 1\ncapture:"), 2, JOB, "unknown key"),
    Case("a key twice", edit("capture:", "name: a\nname: b\ncapture:"), 2, JOB, "twice"),
    Case("window turned round", edit("capture:", "capture:\n  start_s: 2\n  end_s: 1"), 2, JOB, "end_s"),
    Case(
        "first frames of no camera",
        edit("capture:", "map: {init_frames: [a:1, b:2]}\ncapture:"),
        2,
        JOB,
        "no camera",
    ),
    Case("no cameras", replace_text(JOB, "capture: {cameras: []}\n"), 2, JOB, "list is empty"),
    Case("nothing in it", replace_text(JOB, ""), 2, JOB, "empty"),
    Case("a list of jobs", replace_text(JOB, "- a\n- b\n"), 2, JOB, "not a block of"),
    Case("not text", replace_text(JOB, bytes(range(128, 256))), 2, JOB, "the job cannot be read"),
    Case("aliases", replace_text(JOB, "a: &x [1]\nb: *x\n"), 2, JOB, "anchor"),
    Case("a Python object", replace_text(JOB, "capture: !!python/object:os.system {}\n"), 2, JOB, "tag"),
    Case("nested without end", replace_text(JOB, "[" * 5000), 2, JOB, "deep"),
)
"""The valid job, broken in every way that we know."""
