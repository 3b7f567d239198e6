"""Write a job's results as a recording for the Rerun viewer (``.rrd``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.palette import Colour, camera_colours
from bodycap_batch.model.geometry import quat_xyzw_from_rotation
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.overlay import bones_from_motion
from bodycap_batch.report.drawn_scene import DrawnPath, DrawnScene, make_drawn_scene
from bodycap_batch.report.report_inputs import ReportInputs

if TYPE_CHECKING:
    import rerun as rr

_AXIS_LENGTH_M = 0.1
"""Length of the axes that mark a camera's pose, metres. Evidence: none."""


def write_recording(inputs: ReportInputs, target: Path) -> None:
    """Write points, camera paths and the solved skeleton of a job as one recording.

    The frame of reference is the world. Without a body it is the gauge of the largest map, rotated upright.
    Times are common times. The motion is the solved motion: the export options about root, rate and names are
    not applied.

    Args:
        inputs: The results of the job.
        target: Path of the ``.rrd`` file.

    Raises:
        JobError: rerun-sdk is not installed, or there is nothing to show.
        StoreError: The file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise JobError(
            "the library rerun-sdk is not installed",
            hint="install the library: pip install 'bodycap_batch[viewer]'",
        ) from error
    scene = make_drawn_scene(inputs)
    if not scene.has_content:
        failure = inputs.failure or {}
        message = failure.get(
            "message", f"the store contains neither the map nor the camera paths of {inputs.name}"
        )
        raise JobError(message, hint=failure.get("hint") or "run the job again")
    stream = rr.RecordingStream("bodycap", recording_id=inputs.name)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_maps(stream, scene)
    colours = camera_colours(inputs.cameras)
    for path in scene.paths:
        _log_path(stream, path, colours[path.camera])
    if inputs.merge is not None:
        _log_body(stream, inputs.merge)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream.save(target)
    except OSError as error:
        raise StoreError(
            f"the recording cannot be written: {error}", path=target, hint="choose another file with --rerun"
        ) from error


def _log_maps(stream: rr.RecordingStream, scene: DrawnScene) -> None:
    import rerun as rr

    for number, one_map in enumerate(scene.maps):
        points = scene.drawn_from_map[one_map.gauge].apply(one_map.points)
        cloud = rr.Points3D(points, colors=one_map.colors, radii=rr.Radius.ui_points(1.5))
        stream.log(f"world/map_{number}", cloud, static=True)


def _log_path(stream: rr.RecordingStream, path: DrawnPath, colour: Colour) -> None:
    """Log the path and the moving pose of a camera. The path is a line that is interrupted at lost frames."""
    import rerun as rr

    localised = np.asarray(np.isfinite(path.poses).all(axis=(1, 2)))
    if not localised.any():
        return
    entity = f"world/cameras/{path.camera}"
    lines = [path.poses[start:stop, :3, 3] for start, stop in runs(localised)]
    stream.log(f"{entity}/path", rr.LineStrips3D(lines, colors=[colour]), static=True)
    stream.send_columns(
        f"{entity}/now",
        indexes=[rr.TimeColumn("time", duration=path.times_s[localised])],
        columns=rr.Transform3D.columns(
            translation=path.poses[localised, :3, 3],
            quaternion=quat_xyzw_from_rotation(path.poses[localised, :3, :3]),
        ),
    )
    stream.log(f"{entity}/now", rr.TransformAxes3D(_AXIS_LENGTH_M), static=True)


def _log_body(stream: rr.RecordingStream, merge: MergeResult) -> None:
    import rerun as rr

    bones = bones_from_motion(merge.motion, merge.solved)
    for time_ns, ends in zip(bones.times_ns.tolist(), bones.ends_in_world, strict=True):
        stream.set_time("time", duration=1e-9 * time_ns)
        stream.log("world/body", rr.LineStrips3D(list[FloatArray](ends)))
