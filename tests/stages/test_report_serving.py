"""`bodycap view`: the report and the real videos, on this machine alone; and the Rerun recording."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.errors import JobError
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.report.recording import write_recording
from bodycap_batch.report.serving import LOOPBACK, Served, make_server, what_to_serve
from tests.bodies import reaching
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
        "offset_s": OFFSET_S,
    }
    capture = open_capture(CaptureConfig.model_validate({"cameras": [camera]}))
    server = make_server(what_to_serve(tmp_path / "report.html", capture))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


def ask(port: int, path: str, headers: dict[str, str] | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=10)
    connection.request("GET", path, headers=headers or {})
    return connection.getresponse()


def test_report_and_videos_are_served_with_ranges(port: int, tmp_path: Path) -> None:
    assert ask(port, "/report.html?videos").read() == b"<p>the report</p>"
    (chapters,) = json.loads(ask(port, "/videos.json").read()).values()
    assert [chapter["url"] for chapter in chapters] == ["video/0/0", "video/0/1"]
    whole = (tmp_path / "a.mp4").read_bytes()
    answer = ask(port, "/video/0/0")
    assert (answer.status, answer.headers["Content-Type"], answer.read()) == (200, "video/mp4", whole)
    answer = ask(port, "/video/0/0", {"Range": "bytes=10-19"})
    assert (answer.status, answer.read()) == (206, whole[10:20])
    assert answer.headers["Content-Range"] == f"bytes 10-19/{len(whole)}"
    assert ask(port, "/video/0/0", {"Range": f"bytes={len(whole)}-"}).status == 416


def test_a_player_that_breaks_off_is_no_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = tmp_path / "torso.mts"
    large.write_bytes(bytes(30_000_000))
    server = make_server(Served(files={"/video/0/0": large}, videos={}))
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    connection = http.client.HTTPConnection(LOOPBACK, server.server_port, timeout=10)
    connection.request("GET", "/video/0/0")
    answer = connection.getresponse()
    # What no browser plays is at least not shown to it as a page.
    assert answer.headers["Content-Type"] == "application/octet-stream"
    answer.read(1000)
    answer.close()
    connection.close()
    server.shutdown()
    thread.join()
    server.server_close()  # waits for the answer's thread
    assert "Traceback" not in capsys.readouterr().err


def test_times_of_both_chapters_are_on_the_common_clock(port: int) -> None:
    (chapters,) = json.loads(ask(port, "/videos.json").read()).values()
    for index, chapter in enumerate(chapters):
        # 12 frames at 30 fps a chapter; the file's own time starts anew, in the middle of the first frame
        np.testing.assert_allclose(chapter["common"][0], OFFSET_S + index * 0.4, atol=1e-4)
        np.testing.assert_allclose(chapter["container"], (np.arange(12) + 0.5) / 30, atol=1e-4)


@pytest.mark.parametrize("path", ["/", "/a.mp4", "/video/0/2", "/../report.html", "/etc/passwd"])
def test_nothing_else_is_served(port: int, path: str) -> None:
    assert ask(port, path).status == 404


def test_another_name_for_this_machine_is_refused(port: int) -> None:
    assert ask(port, "/report.html", {"Host": f"evil.example:{port}"}).status == 403


def test_a_recording_for_rerun_holds_the_motion(tmp_path: Path) -> None:
    (tmp_path / "trajectories").mkdir()
    lines = "".join(f"{0.1 * i:.3f} {i} 0 1 0 0 0 1\n" for i in range(5))
    (tmp_path / "trajectories" / "torso.tum").write_text(lines)
    write_bvh(tmp_path / "motion.bvh", reaching(10))
    write_recording(tmp_path, tmp_path / "out" / "walk.rrd")
    assert (tmp_path / "out" / "walk.rrd").read_bytes()[:3] == b"RRF"


def test_a_recording_puts_cameras_and_body_on_the_common_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rerun as rr

    (tmp_path / "trajectories").mkdir()
    (tmp_path / "trajectories" / "torso.tum").write_text("1.0 0 0 1 0 0 0 1\n1.1 0 0 1 0 0 0 1\n")
    (tmp_path / "frames.csv").write_text("camera,frame,time,common_time\ntorso,30,1.0,3.5\n")
    (tmp_path / "metrics.json").write_text(json.dumps({"motion": {"start_s": 4.0}}))
    (tmp_path / "job.yaml").write_text("export: {tpose: true}\n")
    write_bvh(tmp_path / "motion.bvh", reaching(3))
    told: dict[str, list[float]] = {"cameras": [], "body": []}
    column, set_time = rr.TimeColumn, rr.RecordingStream.set_time

    def spy_column(name: str, *, duration: np.ndarray) -> object:
        told["cameras"] += duration.tolist()
        return column(name, duration=duration)

    def spy_time(stream: object, name: str, *, duration: float) -> None:
        told["body"].append(duration)
        set_time(stream, name, duration=duration)

    monkeypatch.setattr(rr, "TimeColumn", spy_column)
    monkeypatch.setattr(rr.RecordingStream, "set_time", spy_time)
    write_recording(tmp_path, tmp_path / "walk.rrd")
    np.testing.assert_allclose(told["cameras"], [3.5, 3.6])
    # the T-pose stands one frame before the motion
    np.testing.assert_allclose(told["body"], 4.0 + np.array([-1, 0, 1]) / reaching(3).fps, atol=1e-5)


def test_a_folder_without_results_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="no results"):
        write_recording(tmp_path, tmp_path / "x.rrd")
