"""Move tracks of a camera with a rolling shutter to the instants of the middle rows, before poses exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.inertial import camera_rotation
from bodycap_batch.model.rotation_path import RotationPath, rotate_to_mid_row
from bodycap_batch.model.scene import KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration.poses.registered_camera import RegisteredCamera
from bodycap_batch.registration.tracking.klt import Tracks


def rotation_of_camera(
    camera: CaptureCamera, scene_map: Map, selection: KeyframeSelection, solved: Trajectory | None = None
) -> RotationPath | None:
    """Return the rotation of a camera over time, from its gyroscope or from matches of adjacent frames.

    Args:
        camera: The camera.
        scene_map: The map that the camera is registered against.
        selection: The keyframes of the camera, with the matches.
        solved: Poses of the camera from an earlier round; None if there are none.

    Returns:
        The rotation; without a gyroscope None for a camera with a global shutter, and if there are no
        matches.
    """
    readout_s = scene_map.readout_s.get(camera.name, 0.0)
    return camera_rotation(selection, scene_map.cameras[camera.name], camera.times_ns, readout_s, solved)


def with_rotation(
    camera: CaptureCamera, registration: Registration, maps: Sequence[Map], selection: KeyframeSelection
) -> RegisteredCamera:
    """Return a camera with its registration, and with its rotation if that is known.

    Args:
        camera: The camera.
        registration: The registration of the camera.
        maps: The maps that the cameras were registered against.
        selection: The keyframes of the camera, with the matches.
    """
    gauge = registration.trajectory.gauge
    own_map = next((scene_map for scene_map in maps if scene_map.gauge == gauge), None)
    rotation = (
        None if own_map is None else rotation_of_camera(camera, own_map, selection, registration.trajectory)
    )
    return RegisteredCamera(camera=camera, registration=registration, rotation=rotation)


def turn_tracks(camera: str, scene_map: Map, tracks: Tracks, rotation: RotationPath | None) -> Tracks:
    """Return tracks that are moved to the instants of the middle rows, as if the camera only rotated.

    Args:
        camera: Camera name.
        scene_map: The map, with the camera model and the readout time.
        tracks: The tracks of the camera.
        rotation: The rotation of the camera; None to return the tracks unchanged.
    """
    lens, readout_s = scene_map.cameras[camera], scene_map.readout_s.get(camera, 0.0)
    if rotation is None or not readout_s:
        return tracks
    px = rotate_to_mid_row(lens, rotation, tracks.frame, tracks.px.astype(np.float64), readout_s)
    return replace(tracks, px=px.astype(np.float32))
