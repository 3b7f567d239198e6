"""Determine the frame rate, the start and the timecode of the files for animation."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.take import Take, Timecode, exact_rate


def take_of_motion(inputs: ExportInputs, motion: Motion) -> Take:
    """Return the name and the time of the frames of a motion."""
    return _take(inputs, motion.fps, motion.start_ns)


def frames_without_motion(inputs: ExportInputs, cameras: list[str], fps: float | None) -> tuple[Take, int]:
    """Return the time of the frames of a scene without a body, and the number of frames.

    The frames are those of the reference camera, else of the camera with most poses. They continue at the
    same rate until the end of all cameras.

    Args:
        inputs: The results of the earlier stages.
        cameras: Names of the cameras of the scene.
        fps: Frames per second; None for the rate of that camera.
    """
    paths = {path.camera: path for path in inputs.trajectories if path.camera in cameras}
    main = max(paths, key=lambda name: (name == inputs.reference_camera, paths[name].localised.sum()))
    times = {name: inputs.clocks[name].common_times_ns(path.times_ns) for name, path in paths.items()}
    take = _take(inputs, fps or inputs.clocks[main].nominal_fps, int(times[main][0]))
    tick_ns = 1e9 / take.fps
    before = max(0, round((take.start_ns - min(int(each[0]) for each in times.values())) / tick_ns))
    start_ns = take.start_ns - round(before * tick_ns)
    count = round((max(int(each[-1]) for each in times.values()) - start_ns) / tick_ns) + 1
    return _take(inputs, take.fps, start_ns), count


def frame_times_ns(take: Take, count: int) -> IntArray:
    """Return the common times (count,) of the frames of a take, nanoseconds."""
    return np.asarray(take.start_ns + np.round(np.arange(count) * (1e9 / take.fps)), dtype=np.int64)


def _take(inputs: ExportInputs, fps: float, start_ns: int) -> Take:
    rate = exact_rate(fps)
    code = _timecode_at(inputs, start_ns)
    return Take(
        name=inputs.take,
        rate=rate,
        start_ns=start_ns,
        timecode=None if code is None else code.at_rate(rate),
    )


def _timecode_at(inputs: ExportInputs, common_ns: int) -> Timecode | None:
    """Return the timecode at a common time: that of the reference camera, else of the first with one."""
    names = sorted(inputs.videos, key=lambda name: name != inputs.reference_camera)
    for name in names:
        video, clock = inputs.videos[name], inputs.clocks.get(name)
        if video.timecode is not None and clock is not None and clock.is_known:
            first_ns = int(clock.common_ns(np.array([video.first_frame_ns]))[0])
            return video.timecode.later((common_ns - first_ns) * 1e-9)
    return None
