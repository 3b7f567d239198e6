"""A job's results as a recording for the Rerun viewer (``.rrd``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.palette import Colour, camera_colours
from bodycap_batch.model.geometry import quat_xyzw_from_rotation
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.marks import solved_body
from bodycap_batch.report.placing import Placed, PlacedPath, place

if TYPE_CHECKING:
    import rerun as rr

_AXES_M = 0.1


def write_recording(inputs: ReportInputs, target: Path) -> None:
    """Write a job's results as one recording: points, camera paths, the solved skeleton.

    All of it is in the world (without a body: in the largest map, set upright) and on the common clock. The
    motion is the one that was solved, whatever root, rate or names the files of the motion have.

    Args:
        inputs: The results, as far as the job came.
        target: The ``.rrd`` file.

    Raises:
        JobError: rerun-sdk is not installed, or there is nothing to show.
        StoreError: The file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise JobError(
            "rerun-sdk is not installed", hint="install the extra: pip install 'bodycap_batch[viewer]'"
        ) from error
    placed = place(inputs)
    if not placed.drawn:
        failure = inputs.failure or {}
        lacking = failure.get("message", f"the store holds neither map nor camera paths of {inputs.name}")
        raise JobError(lacking, hint=failure.get("hint") or "run the job again")
    stream = rr.RecordingStream("bodycap", recording_id=inputs.name)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_maps(stream, placed)
    colours = camera_colours(inputs.cameras)
    for path in placed.paths:
        _log_path(stream, path, colours[path.camera])
    if inputs.merge is not None:
        _log_body(stream, inputs.merge)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream.save(target)
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error}", path=target, hint="name another file with --rerun"
        ) from error


def _log_maps(stream: rr.RecordingStream, placed: Placed) -> None:
    import rerun as rr

    for number, scene in enumerate(placed.maps):
        points = placed.drawn_from_map[scene.gauge].apply(scene.points)
        cloud = rr.Points3D(points, colors=scene.colors, radii=rr.Radius.ui_points(1.5))
        stream.log(f"world/map_{number}", cloud, static=True)


def _log_path(stream: rr.RecordingStream, path: PlacedPath, colour: Colour) -> None:
    """The stretches of a path between its gaps, and the camera moving along it."""
    import rerun as rr

    posed = np.isfinite(path.poses).all(axis=(1, 2))
    if not posed.any():
        return
    centres, name = path.poses[posed, :3, 3], f"world/cameras/{path.camera}"
    gaps = np.flatnonzero(np.diff(np.flatnonzero(posed)) > 1) + 1
    stretches = [each for each in np.split(centres, gaps) if len(each)]
    stream.log(f"{name}/path", rr.LineStrips3D(stretches, colors=[colour]), static=True)
    stream.send_columns(
        f"{name}/now",
        indexes=[rr.TimeColumn("time", duration=path.times_s[posed])],
        columns=rr.Transform3D.columns(
            translation=centres, quaternion=quat_xyzw_from_rotation(path.poses[posed, :3, :3])
        ),
    )
    stream.log(f"{name}/now", rr.TransformAxes3D(_AXES_M), static=True)


def _log_body(stream: rr.RecordingStream, merge: MergeResult) -> None:
    import rerun as rr

    body = solved_body(merge)
    for time_ns, ends in zip(body.times_ns.tolist(), body.ends_in_world, strict=True):
        stream.set_time("time", duration=1e-9 * time_ns)
        stream.log("world/body", rr.LineStrips3D(list[FloatArray](ends)))
