"""Every reader of a user's text accepts the byte-order marks that editors of Windows write."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture.sidecar_times import read_timestamps
from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.config.yaml_source import read_yaml
from bodycap_batch.core.text_encoding import decode_text
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.formats.bvh.parser import parse_bvh
from bodycap_batch.formats.file_completeness import missing_part
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.telemetry.text_files import read_imu_file
from bodycap_batch.watch.web.questions import earlier_answers, write_answers
from tests.bodies import reaching

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le")
LENS = {"model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480}


def saved(path: Path, text: str, encoding: str) -> Path:
    mark = "\ufeff" if encoding == "utf-16-le" else ""
    path.write_bytes((mark + text).encode(encoding))
    return path


def calibration(path: Path) -> object:
    return read_calibration(path, "torso").calibration


def imu(path: Path) -> object:
    return read_imu_file(path).streams["GYRO"].values.tolist()


READERS: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "job": ("job.yaml", "name: Gänge\n", lambda path: read_yaml(path).data),
    "calibration": ("calib.json", json.dumps(LENS), calibration),
    "other calibration": ("cv.yml", json.dumps(LENS).replace(",", ",\n"), calibration),
    "timestamps": ("a.timestamps.txt", "0.0\n0.5\n", read_timestamps),
    "imu": ("a.imu.csv", "t_s,gx,gy,gz,ax,ay,az\n0,1,2,3,4,5,6\n1,1,2,3,4,5,6\n", imu),
    "gcsv": ("a.gcsv", "GYROFLOW IMU LOG\ntscale,1\nt,gx,gy,gz\n0,1,2,3\n1,4,5,6\n", imu),
    "tum": ("a.tum", "0 1 2 3 0 0 0 1\n", lambda path: read_tum(path).world_from_cam.tolist()),
    "complete": ("c.json", '{"model": "PINH', lambda path: missing_part(path, frozenset())),
}


@pytest.mark.parametrize("encoding", ENCODINGS[1:])
@pytest.mark.parametrize("reader", READERS)
def test_a_reader_gives_the_same_for_every_byte_order_mark(
    tmp_path: Path, reader: str, encoding: str
) -> None:
    name, text, read = READERS[reader]
    plain = read(saved(tmp_path / name, text, "utf-8"))
    assert plain
    assert read(saved(tmp_path / name, text, encoding)) == plain


@pytest.mark.parametrize("encoding", ENCODINGS[1:])
def test_a_skeleton_is_read_with_every_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.bvh"
    write_bvh(path, reaching())
    plain = parse_bvh(path)
    marked = parse_bvh(saved(tmp_path / "b.bvh", path.read_text(), encoding))
    assert [joint.name for joint in marked.joints] == [joint.name for joint in plain.joints]
    np.testing.assert_array_equal(marked.values, plain.values)


def test_the_answers_of_the_page_are_found_after_an_edit(tmp_path: Path) -> None:
    write_answers(tmp_path, {"height": "1.75", "places": {}, "find_places": False})
    text = (tmp_path / "job.yaml").read_text()
    assert earlier_answers(tmp_path)["height"]
    saved(tmp_path / "job.yaml", text, "utf-16")
    assert earlier_answers(tmp_path)["height"]


def test_other_bytes_are_an_error() -> None:
    with pytest.raises(UnicodeDecodeError):
        decode_text(b"\xe4hm")
    assert decode_text(b"\xe4hm", "replace") == "\ufffdhm"
