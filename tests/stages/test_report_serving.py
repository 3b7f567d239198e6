"""`bodycap view`: the report, the real videos and their overlays, served on this computer only."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.report.frame_overlays import FrameOverlays
from bodycap_batch.report.serving import (
    FRAMES_PER_PART,
    LOOPBACK,
    ServedContent,
    make_served_content,
    make_server,
)
from tests.reports import report_inputs
from tests.videos import textured_frame, write_video

OFFSET_S = 2.5


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    (tmp_path / "report.html").write_text("<p>the report</p>")
    frames = [textured_frame(index) for index in range(12)]
    for name in ("a.mp4", "b.mp4"):
        write_video(tmp_path / name, frames)
    lens = {"model": "PINHOLE", "params": [60.0, 60.0, 32.0, 24.0], "width": 64, "height": 48}
    camera = {
        "name": "torso",
        "video": [str(tmp_path / "a.mp4"), str(tmp_path / "b.mp4")],
        "calibration": lens,
    }
    (opened,) = open_capture(CaptureConfig.model_validate({"cameras": [camera]})).cameras
    capture = Capture(cameras=(replace(opened, clock=ClockRelation(offset_s=OFFSET_S)),))
    server = make_server(make_served_content(tmp_path / "report.html", capture))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


def get(port: int, path: str, headers: dict[str, str] | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=10)
    connection.request("GET", path, headers=headers or {})
    return connection.getresponse()


def test_report_and_videos_are_served_with_ranges(port: int, tmp_path: Path) -> None:
    assert get(port, "/report.html?videos").read() == b"<p>the report</p>"
    (chapters,) = json.loads(get(port, "/videos.json").read())["cameras"].values()
    assert [chapter["url"] for chapter in chapters] == ["video/0/0", "video/0/1"]
    whole = (tmp_path / "a.mp4").read_bytes()
    answer = get(port, "/video/0/0")
    assert (answer.status, answer.headers["Content-Type"], answer.read()) == (200, "video/mp4", whole)
    answer = get(port, "/video/0/0", {"Range": "bytes=10-19"})
    assert (answer.status, answer.read()) == (206, whole[10:20])
    assert answer.headers["Content-Range"] == f"bytes 10-19/{len(whole)}"
    assert get(port, "/video/0/0", {"Range": f"bytes={len(whole)}-"}).status == 416


def test_a_player_that_closes_the_connection_causes_no_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = tmp_path / "torso.mts"
    large.write_bytes(bytes(30_000_000))
    server = make_server(ServedContent(files={"/video/0/0": large}, videos={}))
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    connection = http.client.HTTPConnection(LOOPBACK, server.server_port, timeout=10)
    connection.request("GET", "/video/0/0")
    answer = connection.getresponse()
    # A video that no browser plays must not be served as a page.
    assert answer.headers["Content-Type"] == "application/octet-stream"
    answer.read(1000)
    answer.close()
    connection.close()
    server.shutdown()
    thread.join()
    server.server_close()  # waits for the thread that answers
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("when", ["waiting", "in a request", "answered"])
def test_a_browser_that_leaves_causes_no_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], when: str
) -> None:
    page = tmp_path / "report.html"
    page.write_text("<p>the report</p>")
    server = make_server(ServedContent(files={"/report.html": page}, videos={}))
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    with socket.create_connection((LOOPBACK, server.server_port), timeout=10) as connection:
        if when == "in a request":
            connection.sendall(b"GET /report.html HTTP/1.1\r\n")
        if when == "answered":
            connection.sendall(b"GET /report.html HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            connection.recv(1000)
        # Close with a reset instead of a normal end.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    server.shutdown()
    thread.join()
    server.server_close()
    assert capsys.readouterr().err == ""


def test_a_bug_of_the_server_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(*_: object) -> list[dict[str, object]]:
        raise ZeroDivisionError

    server = make_server(ServedContent(files={}, videos={"torso": []}, overlays=fail))
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    with pytest.raises(http.client.HTTPException):
        get(server.server_port, "/marks/0/0.json")
    server.shutdown()
    thread.join()
    server.server_close()
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_times_of_both_chapters_are_common_times(port: int) -> None:
    (chapters,) = json.loads(get(port, "/videos.json").read())["cameras"].values()
    assert [chapter["first"] for chapter in chapters] == [0, 12]
    for index, chapter in enumerate(chapters):
        # Each chapter has 12 frames at 30 fps. The time in the file starts at the middle of its first frame.
        np.testing.assert_allclose(chapter["common"][0], OFFSET_S + index * 0.4, atol=1e-4)
        np.testing.assert_allclose(chapter["container"], (np.arange(12) + 0.5) / 30, atol=1e-4)


@pytest.mark.parametrize("path", ["/", "/a.mp4", "/video/0/2", "/../report.html", "/etc/passwd"])
def test_nothing_else_is_served(port: int, path: str) -> None:
    assert get(port, path).status == 404


def test_another_host_name_is_refused(port: int) -> None:
    assert get(port, "/report.html", {"Host": f"evil.example:{port}"}).status == 403


def test_overlays_of_every_frame_are_served_in_parts(tmp_path: Path) -> None:
    requested: list[tuple[str, int]] = []

    def overlays(camera: str, first: int) -> list[dict[str, object]]:
        requested.append((camera, first))
        return [{"i": first}] if first < 2 * FRAMES_PER_PART else []

    served = ServedContent(files={}, videos={"torso": [], "head": []}, overlays=overlays)
    server = make_server(served)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        answer = get(server.server_port, "/marks/1/1.json")
        assert (answer.status, json.loads(answer.read())) == (200, [{"i": FRAMES_PER_PART}])
        assert get(server.server_port, "/marks/1/2.json").status == 404
        assert get(server.server_port, "/marks/2/0.json").status == 404
        assert get(server.server_port, "/marks/x/0.json").status == 404
        assert json.loads(get(server.server_port, "/videos.json").read())["each"] == FRAMES_PER_PART
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    assert requested == [("head", FRAMES_PER_PART), ("head", 2 * FRAMES_PER_PART)]


def test_no_overlays_are_served_if_the_store_has_none(port: int) -> None:
    assert get(port, "/marks/0/0.json").status == 404


def test_overlays_of_a_part_are_those_of_its_frames() -> None:
    inputs = report_inputs(70)
    overlays = FrameOverlays(inputs)
    part = overlays.describe_part("torso", 60, 60)
    assert [each["i"] for each in part] == list(range(60, 70))
    assert part == overlays.describe("torso", range(60, 70))
    assert overlays.describe_part("torso", 120, 60) == []
    path = inputs.path("torso")
    assert path is not None
    assert [each["inliers"] for each in part] == path.inliers[60:].tolist()
    assert all(each["inliersAt"]["shape"][0] for each in part)
