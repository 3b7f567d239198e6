"""Search lost frames again in a small window around the poses that the inertial sensor gives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bodycap_batch.config import RegistrationOptions
from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.inertial import use_sensor
from bodycap_batch.model.geometry import invert, so3_log
from bodycap_batch.model.scene import Registration, Trajectory
from bodycap_batch.registration.poses.contradicted import contradicted_frames
from bodycap_batch.registration.poses.keyframe_requests import lost_intervals
from bodycap_batch.registration.poses.map_error import with_map_error, without_map_error
from bodycap_batch.registration.poses.turning_tracks import with_rotation
from bodycap_batch.registration.recovery.accepted_poses import accepted_pose, with_poses
from bodycap_batch.registration.recovery.guided_localisation import (
    GuidedLocaliser,
    NeighbourPose,
    PoseEstimate,
    SearchFrame,
    fuse,
)
from bodycap_batch.registration.recovery.recover import (
    RecoveryInputs,
    independent_localiser,
    make_localiser,
)
from bodycap_batch.registration.recovery.search_images import read_pyramids
from bodycap_batch.telemetry.streams import CameraTelemetry

_MAX_DISTANCE = 22.5
"""Maximum squared Mahalanobis distance between the found pose and that of the sensor. Origin: the 99.9 %
quantile of χ² with six degrees of freedom."""
_ONLY_GAPS = TelemetryOptions(gravity=False, smoothing=False)


def search_near_sensor(
    registration: Registration,
    inputs: RecoveryInputs,
    telemetry: CameraTelemetry,
    options: RegistrationOptions,
    context: StageContext,
    others: Iterable[tuple[Trajectory, CameraTelemetry]] = (),
) -> Registration:
    """Search the lost frames of a camera near the poses that its inertial sensor gives.

    A found pose is accepted if enough points agree, if its sigma is small, and if it agrees with the pose of
    the sensor. It rests on the frame's own observations: its status is `REGISTERED`. The other frames stay
    lost.

    Args:
        registration: Registration of the camera, after the search without a sensor.
        inputs: The camera, the maps and the keyframes. The registrations are not read.
        telemetry: The telemetry of the camera.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        context: Progress and cancellation.
        others: Poses and telemetry of other cameras. They help to find the vertical and the scale of the map.
    """
    path = without_map_error(registration.trajectory, inputs.maps)
    scene_map = next((scene for scene in inputs.maps if scene.gauge == path.gauge), None)
    if scene_map is None or path.localised.all():
        return registration
    filled = use_sensor(path, telemetry, _ONLY_GAPS, others).trajectory
    if (filled.localised == path.localised).all():
        return registration
    camera = inputs.capture.cameras[0]
    own = with_rotation(camera, registration, [scene_map], inputs.selection)
    localiser = make_localiser(scene_map, inputs.capture, path, options, context, own.rotation)
    independent = independent_localiser(localiser, camera.name)
    doubtful = contradicted_frames(path, inputs.maps, inputs.misplaced)
    rows = scene_map.keyframes_of(camera.name)
    keyframe_rows = dict(zip(scene_map.keyframe_frame[rows].tolist(), rows.tolist(), strict=True))
    found: dict[int, PoseEstimate] = {}
    for start, stop in lost_intervals(~filled.localised | path.localised):
        context.check_cancelled()
        context.progress(start, len(path.status), "frames searched near the poses of the sensor")
        pyramids = read_pyramids(camera, start, stop, list(range(start, stop)))
        for frame in range(start, stop):
            if frame in pyramids:
                search_frame = SearchFrame(frame, pyramids[frame], keyframe_rows.get(frame, -1))
                used = independent if doubtful[frame] else localiser
                estimate = _pose_near(used, search_frame, filled)
                if estimate is not None:
                    found[frame] = estimate
    if not found:
        return registration
    return replace(registration, trajectory=with_map_error(with_poses(path, found), inputs.maps))


def _pose_near(
    localiser: GuidedLocaliser, search_frame: SearchFrame, filled: Trajectory
) -> PoseEstimate | None:
    """Return the pose of a frame near the pose of the sensor; None if it is not accepted."""
    frame = search_frame.index
    expected = PoseEstimate.from_trajectory(filled, frame)
    prior = expected.cam_from_map
    before, after = frame - 1, frame + 1
    if before >= 0 and filled.localised[before]:
        neighbour = NeighbourPose(invert(filled.gauge_from_cam[before]))
    elif after < len(filled.status) and filled.localised[after]:
        neighbour = NeighbourPose(invert(filled.gauge_from_cam[after]), -1)
    else:
        neighbour = NeighbourPose(prior)
    found = localiser.localise(search_frame, [prior], neighbour, expected.position)
    if found is None:
        return None
    found = found.with_start_error(localiser.start_dependence(search_frame, found, neighbour))
    if _distance(found, expected) > _MAX_DISTANCE:
        return None
    return accepted_pose(found, fuse(found.position, expected.position)[0], localiser, frame)


def _distance(found: PoseEstimate, expected: PoseEstimate) -> float:
    """Return the squared Mahalanobis distance between two poses."""
    turn = so3_log(expected.cam_from_map[:3, :3] @ found.cam_from_map[:3, :3].T)
    shift = invert(found.cam_from_map)[:3, 3] - invert(expected.cam_from_map)[:3, 3]
    difference: FloatArray = np.concatenate([np.ravel(turn), found.cam_from_map[:3, :3] @ shift])
    return float(difference @ np.linalg.solve(found.covariance + expected.covariance, difference))
