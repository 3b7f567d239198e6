"""Decode frames of a video by index, and seek past frames that are not needed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.capture.video import (
    COPY_AGAIN,
    VideoFile,
    error_reason,
    is_frame,
    open_container,
    video_stream,
)
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream


def decode_frames(
    video: VideoFile, indices: IntArray, threads: int = 0, *, skip_lost: bool = False
) -> Iterator[tuple[int, VideoFrame]]:
    """Decode the frames with the given indices.

    A frame between the requested frames is skipped if no other frame depends on the skipped frame. In H.264,
    most B-frames can be skipped. Damaged data between the requested frames are passed over.

    Args:
        video: The video.
        indices: (N,) increasing frame indices.
        threads: Number of threads of the decoder, as in `open_stream`.
        skip_lost: Whether a requested frame that cannot be decoded is omitted, instead of raising an error.

    Yields:
        The index and the decoded frame.

    Raises:
        CaptureError: A requested frame cannot be decoded, or the file cannot be read.
    """
    import av

    frame_decoder = _ForwardDecoder(video, indices, threads)
    try:
        for index in map(int, indices):
            frame = frame_decoder.advance(index)
            if frame is None and not frame_decoder.sequential:
                # Seeking does not work well in some containers (MPEG program streams), and an error in one
                # frame loses others that several threads decode at the same time. Then all frames are decoded
                # from the start of the video in one thread, which takes longer.
                frame_decoder.close()
                frame_decoder = _ForwardDecoder(video, None, 1)
                frame = frame_decoder.advance(index)
            if frame is not None:
                yield index, frame
            elif not skip_lost:
                raise _undecodable_frame(video, index)
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"the video cannot be decoded after frame {frame_decoder.position} ({error_reason(error)})",
            path=video.path,
            hint=COPY_AGAIN,
        ) from error
    finally:
        frame_decoder.close()


def first_frame(video: VideoFile) -> tuple[VideoFrame, bool]:
    """Decode the first frame that can be decoded and that has a timestamp.

    If no frame has a timestamp, the first frame that can be decoded is returned. With several threads, an
    error in the second frame would lose the first one.

    Returns:
        The frame, and a flag: True if the codec stores the frames in an order different from the order in
        which they are shown.

    Raises:
        CaptureError: No frame can be decoded.
    """
    import av

    with open_container(video.path, video.part) as container:
        stream = open_stream(container, video, 1)
        first: VideoFrame | None = None
        try:
            for packet in container.demux(stream):
                with contextlib.suppress(av.error.InvalidDataError):
                    for frame in stream.decode(packet):
                        first = frame if first is None or frame.pts is not None else first
                        if frame.pts is not None:
                            break
                if first is not None and first.pts is not None:
                    break
        except av.error.FFmpegError as error:
            if first is None:
                raise CaptureError(
                    f"none of its frames can be decoded ({error_reason(error)})",
                    path=video.path,
                    hint=COPY_AGAIN,
                ) from error
        is_reordered = bool(stream.codec_context.has_b_frames)
    if first is None:
        raise CaptureError("none of its frames can be decoded", path=video.path, hint=COPY_AGAIN)
    return first, is_reordered


def open_stream(container: InputContainer, video: VideoFile, threads: int = 0) -> VideoStream:
    """Return the video stream of an opened file, with its decoder configured.

    Args:
        container: The opened file.
        video: The video.
        threads: Number of threads of the decoder. For 0, the number is taken from the environment variable
            OMP_NUM_THREADS. If this variable is not set, all processors are used.
    """
    stream = video_stream(container, video.path)
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = threads or int(os.environ.get("OMP_NUM_THREADS") or "0")
    return stream


class _ForwardDecoder:
    """Decoder that reads a video in the forward direction only and can skip frames.

    Args:
        video: The video.
        indices: (N,) indices of the frames that will be requested. Other frames may be skipped. None to
            decode all frames.
        threads: Number of threads of the decoder, as in `open_stream`.

    Attributes:
        position: Index of the last decoded frame; −1 before the first frame.
        sequential: True if all frames are decoded, without seeking.
    """

    def __init__(self, video: VideoFile, indices: IntArray | None, threads: int) -> None:
        self.position = -1
        # After a restart, a time in the file does not name one place in the file.
        self.sequential = indices is None or video.is_counted or bool(video.restarts)
        self._video = video
        self._container = open_container(video.path, video.part)
        self._stream = open_stream(self._container, video, threads)
        # Frames are skipped only in H.264 that is not interlaced. The two halves of an interlaced frame may
        # be in separate packets, and the decoder of AV1 loses the first frame if it skips frames.
        may_skip = indices is not None and not self.sequential and not video.is_interlaced
        may_skip = may_skip and self._stream.codec_context.name == "h264"
        self._needed_pts = frozenset(video.pts[indices].tolist()) if may_skip else None
        self._frames = self._decoded()
        self._key_index = np.searchsorted(video.pts, video.key_pts)
        self._newest: VideoFrame | None = None

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def advance(self, index: int) -> VideoFrame | None:
        """Decode the video up to the frame with this index, and return this frame.

        Returns:
            The frame; None if the decoder does not return a frame with exactly this index.
        """
        if not self.sequential:
            key_frames = self._key_index[: int(np.searchsorted(self._key_index, index, side="right"))]
            if len(key_frames) and key_frames[-1] > self.position + 1:
                self._seek(int(key_frames[-1]))
        while self._newest is None or self.position < index:
            # If a frame is missing, the frame after it is held until its index is requested.
            self._newest = next(self._frames, None)
            if self._newest is None:
                return None
            if self._video.is_counted:
                self.position += 1
            elif self._newest.pts is not None:
                # A decoded frame that is not listed, because its data are cut, is between two positions.
                self.position = int(np.searchsorted(self._video.pts, self._newest.pts, side="right")) - 1
        is_exact = self._video.is_counted or self._newest.pts == self._video.pts[index]
        return self._newest if is_exact and self.position == index else None

    def _seek(self, index: int) -> None:
        """Seek to the key frame with this index. Some containers seek to an earlier key frame instead."""
        self._newest = None
        self._container.seek(int(self._video.pts[index]), stream=self._stream, backward=True)
        self._frames = self._decoded()

    def _decoded(self) -> Iterator[VideoFrame]:
        """Yield the decoded frames from the current position on, in the order of presentation.

        Frames that may be skipped can be missing, and so can frames of packets with damaged data. If frames
        are identified by counting, damaged data are an error, because the count would be wrong.
        """
        import av

        restarts, shift, number = dict(self._video.restarts), 0, 0
        for packet in self._container.demux(self._stream):
            if restarts and is_frame(packet):
                shift = restarts.get(number, shift)
                number += 1
                packet.pts = (packet.pts or 0) + shift
            if self._needed_pts is not None:
                needed = packet.pts is None or packet.pts in self._needed_pts
                self._stream.codec_context.skip_frame = "DEFAULT" if needed else "NONREF"
            try:
                frames = self._stream.decode(packet)
            except av.error.InvalidDataError:
                if self._video.is_counted:
                    raise
                continue
            yield from frames


def _undecodable_frame(video: VideoFile, index: int) -> CaptureError:
    """Return the error for a frame that cannot be decoded."""
    seconds = float((int(video.pts[index]) - int(video.pts[0])) * video.time_base)
    return CaptureError(
        f"frame {index} (at {seconds:.2f} s) cannot be decoded",
        path=video.path,
        hint="convert the video (ffmpeg -i in.mp4 -fps_mode passthrough out.mp4), or set end_s to a time "
        "before this frame",
    )
