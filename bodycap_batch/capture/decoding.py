"""Decode frames of a video by index, seeking over what is not wanted."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.capture.video import COPY_AGAIN, VideoFile, error_reason, open_container, video_stream
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream


def decode_frames(video: VideoFile, indices: IntArray, threads: int = 0) -> Iterator[tuple[int, VideoFrame]]:
    """Decode the frames with these increasing indices.

    Frames between them that no other frame is built on (most B-frames of H.264) are not decoded.

    Raises:
        CaptureError: A frame cannot be decoded.
    """
    import av

    cursor = _ForwardDecoder(video, indices, threads)
    try:
        for wanted in map(int, indices):
            frame = cursor.advance(wanted)
            if frame is None and not cursor.sequential:
                # Some containers seek badly (MPEG program streams): the plain way, from the start.
                cursor.close()
                cursor = _ForwardDecoder(video, None, threads)
                frame = cursor.advance(wanted)
            if frame is None:
                raise _undecodable_frame(video, wanted)
            yield wanted, frame
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"decoding fails after frame {cursor.position} ({error_reason(error)})",
            path=video.path,
            hint=COPY_AGAIN,
        ) from error
    finally:
        cursor.close()


def first_frame(video: VideoFile, threads: int = 0) -> tuple[VideoFrame, bool]:
    """The first frame that decodes, and whether the codec reorders frames.

    Raises:
        CaptureError: There is none.
    """
    import av

    with open_container(video.path) as container:
        stream = open_stream(container, video, threads)
        try:
            for frame in container.decode(stream):
                return frame, bool(stream.codec_context.has_b_frames)
        except av.error.FFmpegError as error:
            raise CaptureError(
                f"no frame of it can be decoded ({error_reason(error)})", path=video.path, hint=COPY_AGAIN
            ) from error
    raise CaptureError("no frame of it can be decoded", path=video.path, hint=COPY_AGAIN)


def open_stream(container: InputContainer, video: VideoFile, threads: int = 0) -> VideoStream:
    """The video's stream, decoded on as many threads as there are for it."""
    stream = video_stream(container, video.path)
    stream.thread_type = "AUTO"
    # The task's threads, else the process's, else all processors. (In a task's process the libraries' own
    # pools are pinned to one.)
    stream.codec_context.thread_count = threads or int(os.environ.get("OMP_NUM_THREADS") or "0")
    return stream


class _ForwardDecoder:
    """A decoder's place in a video, moving forwards only.

    Args:
        video: The video.
        indices: The frames that will be asked for: others may be passed over. Without them all are decoded.
    """

    def __init__(self, video: VideoFile, indices: IntArray | None, threads: int) -> None:
        self.position = -1  # index of the last decoded frame, −1 before the first
        self.sequential = indices is None or video.counted
        self._video = video
        self._container = open_container(video.path)
        self._stream = open_stream(self._container, video, threads)
        # The halves of an interlaced frame may come one by one; AV1's decoder loses the first frame by it.
        skips = indices is not None and not self.sequential and not video.interlaced
        skips = skips and self._stream.codec_context.name == "h264"
        self._wanted = frozenset(video.pts[indices].tolist()) if skips else None
        self._frames = self._decoded()
        self._key_index = np.searchsorted(video.pts, video.key_pts)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def advance(self, wanted: int) -> VideoFrame | None:
        """Decode up to a frame; None where it does not come."""
        if not self.sequential:
            keys = self._key_index[: int(np.searchsorted(self._key_index, wanted, side="right"))]
            if len(keys) and keys[-1] > self.position + 1:
                self._seek(int(keys[-1]))
        for frame in self._frames:
            if self._video.counted:
                self.position += 1
            else:
                if frame.pts is None:
                    continue
                self.position = int(np.searchsorted(self._video.pts, frame.pts))
            if self.position >= wanted:
                exact = self._video.counted or frame.pts == self._video.pts[wanted]
                return frame if exact and self.position == wanted else None
        return None

    def _seek(self, index: int) -> None:
        """Go to a key frame, or to an earlier one where the container cannot do better."""
        self._container.seek(int(self._video.pts[index]), stream=self._stream, backward=True)
        self._frames = self._decoded()

    def _decoded(self) -> Iterator[VideoFrame]:
        """Frames as they are shown, from here on; those to be passed over may be missing."""
        for packet in self._container.demux(self._stream):
            if self._wanted is not None:
                needed = packet.pts is None or packet.pts in self._wanted
                self._stream.codec_context.skip_frame = "DEFAULT" if needed else "NONREF"
            yield from self._stream.decode(packet)


def _undecodable_frame(video: VideoFile, index: int) -> CaptureError:
    seconds = float((int(video.pts[index]) - int(video.pts[0])) * video.time_base)
    return CaptureError(
        f"frame {index} (at {seconds:.2f} s) cannot be decoded",
        path=video.path,
        hint="re-encode it (ffmpeg -i in.mp4 -fps_mode passthrough out.mp4), or cut before it with end_s",
    )
