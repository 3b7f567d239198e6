"""Move tracks of a camera with a rolling shutter to the instants of the middle rows, before poses exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.model.rotation_fit import fit_rotation_path
from bodycap_batch.model.rotation_path import RotationPath, rotate_to_mid_row
from bodycap_batch.model.scene import KeyframeSelection, Map, Registration
from bodycap_batch.registration.poses.rig_members import RegisteredCamera
from bodycap_batch.registration.tracking.klt import Tracks


def rotation_from_matches(
    camera: CaptureCamera, scene_map: Map, selection: KeyframeSelection
) -> RotationPath | None:
    """Return the rotation of a camera with a rolling shutter over time, from matches of adjacent frames.

    Args:
        camera: The camera.
        scene_map: The map that the camera is registered against.
        selection: The keyframes of the camera, with the matches.

    Returns:
        The rotation; None for a camera with a global shutter, and if there are no matches.
    """
    readout_s = scene_map.readout_s.get(camera.name, 0.0)
    if not readout_s or selection.matches is None:
        return None
    return fit_rotation_path(selection.matches, scene_map.cameras[camera.name], camera.times_ns, readout_s)


def with_rotation(
    camera: CaptureCamera, registration: Registration, maps: Sequence[Map], selection: KeyframeSelection
) -> RegisteredCamera:
    """Return a camera with its registration, and with its rotation from matches if it has a rolling shutter.

    Args:
        camera: The camera.
        registration: The registration of the camera.
        maps: The maps that the cameras were registered against.
        selection: The keyframes of the camera, with the matches.
    """
    gauge = registration.trajectory.gauge
    own_map = next((scene_map for scene_map in maps if scene_map.gauge == gauge), None)
    rotation = None if own_map is None else rotation_from_matches(camera, own_map, selection)
    return RegisteredCamera(camera=camera, registration=registration, rotation=rotation)


def turn_tracks(camera: str, scene_map: Map, tracks: Tracks, rotation: RotationPath | None) -> Tracks:
    """Return tracks that are moved to the instants of the middle rows, as if the camera only rotated.

    Args:
        camera: Camera name.
        scene_map: The map, with the camera model and the readout time.
        tracks: The tracks of the camera.
        rotation: The rotation of the camera; None to return the tracks unchanged.
    """
    if rotation is None:
        return tracks
    lens, readout_s = scene_map.cameras[camera], scene_map.readout_s[camera]
    px = rotate_to_mid_row(lens, rotation, tracks.frame, tracks.px.astype(np.float64), readout_s)
    return replace(tracks, px=px.astype(np.float32))
