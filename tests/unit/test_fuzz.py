"""For any content of a file, its reader gives an answer or raises one of our errors.

The fast tests take a few hundred inputs, the slow tests some thousands, ``make fuzz`` 52,000.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, CaptureError, JobError
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.model.camera import CAMERA_MODELS
from tests.bodies import BVH_PAIR
from tests.fuzzing import DEFAULT_FRACTION, FRACTION_VARIABLE

FAST = settings(
    deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip

JOB = """name: walk
skeleton: upper_body
height_m: 1.75
activity: walk
capture:
  calibration: calib.json
  start_s: 1.0
  cameras:
    - {name: torso, video: torso.mp4}
    - name: left_palm
      video: [a.mp4, b.mp4]
      mount: left_palm
      offset_s: 0.12
      joint_from_cam: {translation_m: [0, 0, 0], quat_xyzw: [0, 0, 0, 1]}
      calibration: {model: PINHOLE, params: [840.0, 840.0, 640.0, 360.0], width: 1280, height: 720}
keyframes: {parallax_px: 15.0}
map: {features: 512, init_frames: [torso:10, torso:85]}
export: {formats: [ply, bvh]}
"""
CALIBRATION = {
    "cameras": {
        "torso": {"model": "OPENCV", "params": [500.0, 500, 320, 240, 0.1, 0, 0, 0]},
        "head": {"model": "PINHOLE", "params": [500.0, 500, 320, 240], "width": 640, "height": 480},
    },
    "width": 640,
    "height": 480,
    "offsets_s": {"torso": 0.5},
    "rolling_shutter_s": 0.02,
    "pixel_origin": "opencv",
}

UNUSUAL = [
    *(
        "",
        "~",
        "null",
        "[]",
        "{}",
        "-",
        ":",
        "- -",
        "? x",
        "*a",
        "&a b",
        "<<: {a: 1}",
        "'",
        '"',
        "|",
        "\t",
        "%YAML 9",
    ),
    *(
        "!!python/object:os.system x",
        "---",
        "...",
        "[" * 30,
        "{a: " * 30,
        "\x00",
        "\ufeff",
        "\u2028",
        "\ud7ff",
        "💥",
    ),
    *(
        "1e999",
        ".nan",
        ".inf",
        "-0",
        "0x1F",
        "9" * 400,
        "1_000",
        "nan",
        "inf",
        "-1",
        "1e-320",
        "../../etc/passwd",
    ),
    *("End Site", "}", "JOINT", "CHANNELS 400", "Frames: 1e9", "Frames: -1", "Frame Time: 0", "torso"),
]


def mutations(text: str) -> st.SearchStrategy[str]:
    """Generate a valid file with pieces removed, doubled, swapped or replaced by unusual ones."""
    edit = st.tuples(
        st.integers(0, len(text)),
        st.integers(0, 40),
        st.one_of(st.sampled_from(UNUSUAL), st.text(max_size=12)),
    )

    def apply(edits: list[tuple[int, int, str]]) -> str:
        out = text
        for start, length, piece in edits:
            out = out[:start] + piece + out[start + length :]
        return out

    return st.lists(edit, min_size=1, max_size=4).map(apply)


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        [*CAMERA_MODELS, "torso", "auto", "walk", "LeftHand", "torso.mp4", "torso:10", 0, -1, 1e308]
    ),
)
RANDOM_VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=6), st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)


def replaced(document: Any) -> st.SearchStrategy[Any]:
    """Generate a valid document with some values replaced by random ones."""
    places = list(_places(document, ()))

    def apply(changes: list[tuple[tuple[Any, ...], Any]]) -> Any:
        out = json.loads(json.dumps(document))
        for place, value in changes:
            _put(out, place, value)
        return out

    return st.lists(st.tuples(st.sampled_from(places), RANDOM_VALUES), min_size=1, max_size=3).map(apply)


def _places(value: Any, at: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    children = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    return [(*at, key) for key, _ in children] + [
        place for key, inner in children for place in _places(inner, (*at, key))
    ]


def _put(document: Any, place: tuple[Any, ...], value: Any) -> None:
    for key in place[:-1]:
        try:
            document = document[key]
        except (KeyError, IndexError, TypeError):
            return
    if isinstance(document, dict) or (isinstance(document, list) and place[-1] in range(len(document))):
        document[place[-1]] = value


def all_job_blocks() -> dict[str, Any]:
    """Return a job with every block of options."""
    options = Job.model_validate({"capture": {"cameras": [{"name": "torso", "video": ["torso.mp4"]}]}})
    return {**yaml.safe_load(JOB), **{
        name: getattr(options, name).model_dump(mode="json", exclude_none=True)
        for name in ("keyframes", "map", "registration", "merge", "export")
    }}  # fmt: skip


FOLDER = Path(tempfile.mkdtemp(prefix="bodycap-fuzz-"))
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)


def reads_or_refuses(
    content: bytes, name: str, reader: Callable[[Path], object], *errors: type[BodycapError]
) -> None:
    """Check that the reader answers, or raises a documented error with a message and a path or field."""
    path = FOLDER / name
    path.write_bytes(content)
    refused: BodycapError | None = None
    try:
        reader(path)
    except errors as error:
        refused = error
    if refused is not None:
        assert refused.message
        assert refused.path or refused.field
        assert len(str(refused)) < 4000, "a message, not the file"


def job(content: bytes) -> None:
    reads_or_refuses(content, "job.yaml", load_job, JobError, CaptureError)


def bvh(content: bytes) -> None:
    reads_or_refuses(content, "subject.bvh", read_bvh, JobError)


def calibration(content: bytes) -> None:
    def read(path: Path) -> None:
        found = read_calibration(path, "torso").calibration.camera()
        assert np.isfinite(found.params).all()
        assert found.focal_px > 0

    reads_or_refuses(content, "calib.json", read, CaptureError)


def yaml_of(document: Any) -> bytes:
    return yaml.safe_dump(document, allow_unicode=True).encode("utf-8", "surrogatepass")


def json_of(document: Any) -> bytes:
    return json.dumps(document).encode()


def utf8(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


CASES = {
    "job text": (job, mutations(JOB).map(utf8), 8_000),
    "job values": (job, replaced(all_job_blocks()).map(yaml_of), 3_000),
    "job bytes": (job, st.binary(max_size=300), 2_000),
    "bvh text": (bvh, mutations(BVH_PAIR).map(utf8), 20_000),
    "bvh bytes": (bvh, st.binary(max_size=300), 5_000),
    "calibration values": (calibration, replaced(CALIBRATION).map(json_of), 6_000),
    "calibration text": (calibration, mutations(json.dumps(CALIBRATION, indent=1)).map(utf8), 8_000),
}
"""Reader, inputs, and their number in ``make fuzz``: 52,000 in all, chosen by the cost of one input."""


def run(name: str, count: int) -> None:
    reader, contents, _ = CASES[name]

    @settings(FAST, max_examples=count)
    @given(contents)
    def attempt(content: bytes) -> None:
        reader(content)

    attempt()


@pytest.mark.parametrize("name", CASES)
def test_readers_answer_or_refuse(name: str) -> None:
    run(name, 25)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_readers_answer_or_refuse_thousands_of_inputs(name: str) -> None:
    run(name, round(float(os.environ.get(FRACTION_VARIABLE, DEFAULT_FRACTION)) * CASES[name][2]))


def test_the_valid_files_are_read() -> None:
    """The unmutated files are valid, so that mutations are tested beyond the first check."""
    (FOLDER / "torso.mp4").write_bytes(b"")
    for name in ("a.mp4", "b.mp4"):
        (FOLDER / name).write_bytes(b"")
    (FOLDER / "calib.json").write_bytes(json_of(CALIBRATION))
    (FOLDER / "sound.yaml").write_text(JOB)
    assert [camera.name for camera in load_job(FOLDER / "sound.yaml").capture.cameras] == [
        "torso",
        "left_palm",
    ]
    assert len(read_calibration(FOLDER / "calib.json", "torso").calibration.params) == 8
    (FOLDER / "sound.bvh").write_text(BVH_PAIR)
    skeleton, motion = read_bvh(FOLDER / "sound.bvh")
    assert skeleton.joints == ("Hips", "LeftArm")
    assert motion is not None
    assert len(motion.root_in_world_m) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: " * 50, "not valid YAML"),
        ("[" * 10_000, "deep"),
        ("a: &x [1]\nb: *x", "anchor"),
        ("a: !!python/object/apply:os.system ['true']", "tag"),
        ("# " + "x" * (1 << 21), "large"),
    ],
)
def test_traps_are_refused_at_once(text: str, message: str) -> None:
    path = FOLDER / "trap.yaml"
    path.write_text(text)
    with pytest.raises(JobError, match=message):
        load_job(path)
