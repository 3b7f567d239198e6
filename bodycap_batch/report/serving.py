"""The report with the job's real videos, served on this machine alone."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.capture.cameras import CaptureCamera
from bodycap_batch.core.errors import StoreError

LOOPBACK = "127.0.0.1"
_TYPES = {".mp4": "video/mp4", ".m4v": "video/mp4", ".mov": "video/mp4", ".mkv": "video/x-matroska"}
_TYPES |= {".webm": "video/webm", ".avi": "video/x-msvideo", ".html": "text/html; charset=utf-8"}
MARKS_EACH = 60
"""Frames in each ``/marks/<camera>/<part>.json``: one or two seconds, loaded ahead of what plays."""
MarksOf = Callable[[str, int], list[dict[str, Any]]]
_RANGE = re.compile(r"bytes=(\d+)-(\d*)")
_MARKS = re.compile(r"/marks/(\d{1,4})/(\d{1,7})\.json", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """What may be asked for, and nothing else.

    Attributes:
        files: File by address, ``/report.html`` among them.
        videos: What ``/videos.json`` answers: by camera, each chapter's address, the index of its first
            frame in the camera, half a frame's time, and of every frame the common time and the time in
            the file, at the middle of what a player shows it for.
        marks: What is known of frames of a camera, from the first index on, and what is drawn over them;
            None where that is not to be had. Asked in parts of `MARKS_EACH` frames.
    """

    files: dict[str, Path]
    videos: dict[str, list[dict[str, Any]]]
    marks: MarksOf | None = None


def what_to_serve(report: Path, capture: Capture, marks: MarksOf | None = None) -> Served:
    """The report and the videos of a capture, each under an address of its own.

    Args:
        report: The page.
        capture: Whose videos.
        marks: As `Served.marks`.
    """
    files, videos = {"/report.html": report}, {}
    for number, camera in enumerate(capture.cameras):
        chapters = _chapters(camera)
        for index, chapter in enumerate(chapters):
            chapter["url"] = f"video/{number}/{index}"
            files[f"/{chapter['url']}"] = camera.chapters[index]
        videos[camera.name] = [chapter for chapter in chapters if chapter["common"]]
    return Served(files=files, videos=videos, marks=marks)


def make_server(served: Served, port: int = 0) -> ThreadingHTTPServer:
    """A server on the loopback address; port 0 takes a free one.

    Raises:
        StoreError: The port is taken.
    """

    class Handler(_Handler):
        content = served

    try:
        return ThreadingHTTPServer((LOOPBACK, port), Handler)
    except OSError as error:
        raise StoreError(
            f"port {port} cannot be used: {error.strerror}", hint="name another one with --port"
        ) from error


def _chapters(camera: CaptureCamera) -> list[dict[str, Any]]:
    """By chapter, common time and time in the file of each used frame, seconds."""
    common = camera.common_times_ns() * 1e-9
    out, first = [], 0
    for video in camera.videos:
        numbers = camera.frame_numbers - first
        mine = (numbers >= 0) & (numbers < len(video.pts))
        seconds = (video.pts[numbers[mine]] - video.pts[0]) * float(video.time_base)
        # The middle of a frame's time: at its very start a player may still show the one before.
        half = 0.5 / video.fps if video.fps else 0.0
        out.append(
            {
                "first": int(np.argmax(mine)),
                "half": half,
                "common": np.round(common[mine], 5).tolist(),
                "container": np.round(seconds + half, 5).tolist(),
            }
        )
        first += len(video.pts)
    return out


class _Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD for known addresses, with byte ranges: players seek by them."""

    content: Served
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with the content."""
        self._answer_patiently(body=True)

    def do_HEAD(self) -> None:
        """Answer without it."""
        self._answer_patiently(body=False)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the name the base class gives it
        """Keep quiet."""

    def _answer_patiently(self, *, body: bool) -> None:
        # Players break off what they are being sent whenever they seek.
        try:
            self._answer(body=body)
        except ConnectionError:
            self.close_connection = True

    def _answer(self, *, body: bool) -> None:
        # Another page's name can be made to point at this machine: only the machine's own names are served.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (LOOPBACK, "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        address = self.path.partition("?")[0]
        if address == "/videos.json":
            videos = {"each": MARKS_EACH, "cameras": self.content.videos}
            self._send_text(json.dumps(videos), body=body)
        elif address in self.content.files:
            self._send_file(self.content.files[address], body=body)
        elif (part := _MARKS.fullmatch(address)) and self.content.marks is not None:
            self._send_marks(self.content.marks, int(part[1]), int(part[2]), body=body)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_marks(self, marks: MarksOf, camera: int, part: int, *, body: bool) -> None:
        names = list(self.content.videos)
        found = marks(names[camera], part * MARKS_EACH) if camera < len(names) else []
        if found:
            self._send_text(json.dumps(found, allow_nan=False), body=body)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_text(self, text: str, *, body: bool) -> None:
        data = text.encode()
        self._begin(HTTPStatus.OK, "application/json", len(data))
        if body:
            self.wfile.write(data)

    def _send_file(self, path: Path, *, body: bool) -> None:
        try:
            stream = path.open("rb")
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with stream:
            size = path.stat().st_size
            kind = _TYPES.get(path.suffix.lower(), "application/octet-stream")
            wanted = _RANGE.fullmatch(self.headers.get("Range", ""))
            if wanted is None:
                self._begin(HTTPStatus.OK, kind, size)
                if body:
                    shutil.copyfileobj(stream, self.wfile)
                return
            start = int(wanted[1])
            stop = min(int(wanted[2] or size - 1), size - 1) + 1
            if start >= stop:
                self.send_error(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                return
            self._begin(HTTPStatus.PARTIAL_CONTENT, kind, stop - start, f"bytes {start}-{stop - 1}/{size}")
            stream.seek(start)
            left = stop - start if body else 0
            while left and (part := stream.read(min(left, 1 << 18))):
                self.wfile.write(part)
                left -= len(part)

    def _begin(self, status: HTTPStatus, kind: str, length: int, content_range: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("X-Content-Type-Options", "nosniff")
        if content_range:
            self.send_header("Content-Range", content_range)
        self.end_headers()
