"""Serve the report on this computer, together with the job's original videos."""

from __future__ import annotations

import json
import re
import shutil
import sys
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
_CONTENT_TYPES = {".mp4": "video/mp4", ".m4v": "video/mp4", ".mov": "video/mp4", ".mkv": "video/x-matroska"}
_CONTENT_TYPES |= {".webm": "video/webm", ".avi": "video/x-msvideo", ".html": "text/html; charset=utf-8"}
FRAMES_PER_PART = 60
"""Number of frames in each part ``/marks/<camera>/<part>.json``.

This is one or two seconds of video. The page loads each part before it shows the part's frames.
"""
OverlaySource = Callable[[str, int], list[dict[str, Any]]]
"""Function that returns the overlays of successive frames of a camera.

The arguments are the camera name and the index of the first frame.
"""
_RANGE = re.compile(r"bytes=(\d+)-(\d*)")
"""Pattern of a Range header that requests one range of bytes.

A request with any other form of this header is answered with the whole file.
"""
_OVERLAY_ADDRESS = re.compile(r"/marks/(\d{1,4})/(\d{1,7})\.json", re.ASCII)
_CHUNK_BYTES = 1 << 18
"""Maximum number of bytes of a file that are read at once. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServedContent:
    """The content that the server provides.

    Attributes:
        files: Path of each file, by address. The addresses include ``/report.html``.
        videos: The answer to ``/videos.json``: the chapters of each camera, by camera name. A chapter has an
            address, the index of its first frame in the camera, and half a frame's duration (seconds). Each
            frame of a chapter has a common time and a time in the video file (seconds). The time in the file
            is the middle of the frame's duration.
        overlays: Function that returns the status and the overlays of up to `FRAMES_PER_PART` frames; None if
            overlays are not available.
    """

    files: dict[str, Path]
    videos: dict[str, list[dict[str, Any]]]
    overlays: OverlaySource | None = None


def make_served_content(
    report: Path, capture: Capture, overlays: OverlaySource | None = None
) -> ServedContent:
    """Assign an address to the report and to each video of a capture.

    Args:
        report: Path of the report page.
        capture: The capture with the videos.
        overlays: Function that returns overlays, as described in `ServedContent.overlays`.
    """
    files, videos = {"/report.html": report}, {}
    for number, camera in enumerate(capture.cameras):
        chapters = _chapters(camera)
        for index, chapter in enumerate(chapters):
            chapter["url"] = f"video/{number}/{index}"
            files[f"/{chapter['url']}"] = camera.videos[index].path
        videos[camera.name] = [chapter for chapter in chapters if chapter["common"]]
    return ServedContent(files=files, videos=videos, overlays=overlays)


def make_server(content: ServedContent, port: int = 0) -> ThreadingHTTPServer:
    """Return a server on the loopback address. With port 0 the server uses a free port.

    Raises:
        StoreError: The port is in use.
    """

    class Handler(_Handler):
        served = content

    try:
        return _Server((LOOPBACK, port), Handler)
    except OSError as error:
        raise StoreError(
            f"port {port} cannot be used: {error.strerror}", hint="choose another port with --port"
        ) from error


def _chapters(camera: CaptureCamera) -> list[dict[str, Any]]:
    """Return, for each chapter, the common time and the time in the file of each used frame, seconds.

    See `ServedContent.videos`.
    """
    common = camera.common_times_ns() * 1e-9
    chapters, chapter_start = [], 0
    for video in camera.videos:
        numbers = camera.frame_numbers - chapter_start
        in_chapter = (numbers >= 0) & (numbers < len(video.pts))
        seconds = (video.pts[numbers[in_chapter]] - video.pts[0]) * float(video.time_base)
        # At the start of a frame's duration a player may still show the previous frame. In the middle of the
        # duration it shows the right frame.
        half = 0.5 / video.fps if video.fps else 0.0
        chapters.append(
            {
                "first": int(np.argmax(in_chapter)),
                "half": half,
                "common": np.round(common[in_chapter], 5).tolist(),
                "container": np.round(seconds + half, 5).tolist(),
            }
        )
        chapter_start += len(video.pts)
    return chapters


class _Server(ThreadingHTTPServer):
    """A server that reports no closed connection as an error."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, except if the browser has closed the connection.

        Browsers close connections when a page is left, and video players close them whenever they seek.
        """
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD requests for known addresses.

    Byte ranges are supported, because video players need them to seek.
    """

    served: ServedContent
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with headers and content."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer with headers only."""
        self._answer(with_body=False)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base class's name
        """Log nothing."""

    def _answer(self, *, with_body: bool) -> None:
        # A web page from the internet can send requests to this server if the page's own host name is
        # resolved to this computer (DNS rebinding). Therefore only requests to local host names are allowed.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (LOOPBACK, "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        address = self.path.partition("?")[0]
        if address == "/videos.json":
            videos = {"each": FRAMES_PER_PART, "cameras": self.served.videos}
            self._send_json(json.dumps(videos), with_body=with_body)
        elif address in self.served.files:
            self._send_file(self.served.files[address], with_body=with_body)
        elif (part := _OVERLAY_ADDRESS.fullmatch(address)) and self.served.overlays is not None:
            self._send_overlays(self.served.overlays, int(part[1]), int(part[2]), with_body=with_body)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_overlays(self, overlays: OverlaySource, camera: int, part: int, *, with_body: bool) -> None:
        names = list(self.served.videos)
        found = overlays(names[camera], part * FRAMES_PER_PART) if camera < len(names) else []
        if found:
            self._send_json(json.dumps(found, allow_nan=False), with_body=with_body)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send_json(self, text: str, *, with_body: bool) -> None:
        data = text.encode()
        self._send_headers(HTTPStatus.OK, "application/json", len(data))
        if with_body:
            self.wfile.write(data)

    def _send_file(self, path: Path, *, with_body: bool) -> None:
        try:
            stream = path.open("rb")
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with stream:
            size = path.stat().st_size
            content_type = _CONTENT_TYPES.get(path.suffix.lower(), "application/octet-stream")
            requested = _RANGE.fullmatch(self.headers.get("Range", ""))
            if requested is None:
                self._send_headers(HTTPStatus.OK, content_type, size)
                if with_body:
                    shutil.copyfileobj(stream, self.wfile)
                return
            start = int(requested[1])
            stop = min(int(requested[2] or size - 1), size - 1) + 1
            if start >= stop:
                self.send_error(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                return
            content_range = f"bytes {start}-{stop - 1}/{size}"
            self._send_headers(HTTPStatus.PARTIAL_CONTENT, content_type, stop - start, content_range)
            stream.seek(start)
            left = stop - start if with_body else 0
            while left and (chunk := stream.read(min(left, _CHUNK_BYTES))):
                self.wfile.write(chunk)
                left -= len(chunk)

    def _send_headers(
        self, status: HTTPStatus, content_type: str, length: int, content_range: str = ""
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(length))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("X-Content-Type-Options", "nosniff")
        if content_range:
            self.send_header("Content-Range", content_range)
        self.end_headers()
