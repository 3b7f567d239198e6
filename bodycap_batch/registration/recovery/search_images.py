"""Decode the images that recovery needs, and estimate the exposure time of the frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.core.arrays import IntArray, evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.model.sharpness import sharpness
from bodycap_batch.registration.poses.static_points import static_points
from bodycap_batch.registration.recovery.guided_localisation import GuidedLocaliser
from bodycap_batch.registration.recovery.patch_search import (
    KeyframePatches,
    PredictedView,
    Pyramid,
    SearchLevel,
    match_patches,
    select_patches,
)

_MAX_KEYFRAMES = 600
"""Maximum number of keyframes held in memory. Each keyframe needs half a megabyte. Origin: the memory limit
of the task."""
_MAX_DISTANCE_FRAMES = 90
"""Maximum distance (number of frames) between a searched frame and the nearest end of its lost interval, or
the nearest seed. Evidence: none."""
_MAX_FRAMES = 400
"""Maximum number of frames of one lost interval held in memory. The frames nearest to an end of the interval
or to a seed are selected. Origin: the memory limit of the task."""
_EXPOSURE_CANDIDATES = (0.0, 0.3, 0.6)
"""Candidates for the exposure time, as fractions of the frame interval. Evidence: none."""
_EXPOSURE_FRAMES = 4
"""Number of frames in which the candidates for the exposure time are compared. They are the frames with the
largest rotation since the frame before. Evidence: none."""
_EXPOSURE_LEVEL = SearchLevel(pyramid_level=1, patch_side=21, search_radius=4, min_score=-1.0, limit_px=6.0)
"""Size and range of the search for the comparison of exposure times. With a minimum correlation of -1 every
match is accepted. Evidence: none."""


def read_keyframe_patches(
    scene_map: Map, capture: Capture, camera: CaptureCamera, context: StageContext
) -> KeyframePatches:
    """Decode the keyframes of all cameras. At most `_MAX_KEYFRAMES` evenly spaced keyframes are decoded.

    Args:
        scene_map: The map.
        capture: All cameras.
        camera: The camera whose frames are searched. Only points that are static for this camera are
            searched.
        context: Progress and cancellation.

    Returns:
        The map with the images and the sharpness of its keyframes.
    """
    count = len(scene_map.keyframe_camera)
    chosen = evenly_spaced(count, _MAX_KEYFRAMES)
    pyramids: dict[int, Pyramid] = {}
    relative_sharpness = np.zeros(count)
    for name in sorted(set(scene_map.keyframe_camera)):
        rows = np.intersect1d(scene_map.keyframes_of(name), chosen)
        row_of = dict(zip(scene_map.keyframe_frame[rows].tolist(), rows.tolist(), strict=True))
        for frame, grey in capture.camera(name).read(sorted(row_of)):
            context.check_cancelled()
            row = row_of[frame]
            pyramids[row] = Pyramid.build(grey)
            context.progress(len(pyramids), len(chosen), "keyframes of all cameras decoded")
            relative_sharpness[row] = sharpness(pyramids[row].levels[0])
        if len(rows):
            relative_sharpness[rows] /= max(float(np.median(relative_sharpness[rows])), 1e-9)
    keyframe_count: IntArray = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return KeyframePatches(
        scene_map=scene_map,
        pyramids=pyramids,
        sharpness=relative_sharpness,
        usable=static_points(camera, scene_map),
        keyframe_count=keyframe_count,
    )


def read_pyramids(
    camera: CaptureCamera, start: int, stop: int, seed_frames: list[int], max_frames: int = _MAX_FRAMES
) -> dict[int, Pyramid]:
    """Decode the frames near the ends and the seeds of a lost interval, and one frame on either side.

    Args:
        camera: The camera.
        start: First lost frame.
        stop: One past the last lost frame.
        seed_frames: Indices of the seeds: keyframes inside the interval whose poses were not accepted.
        max_frames: Maximum number of frames. The frames nearest to an end or a seed are selected.

    Returns:
        Image pyramids, by frame index. Damaged frames are missing.
    """
    frames = np.arange(max(0, start - 1), min(len(camera.times_ns), stop + 1))
    frames = np.setdiff1d(frames, camera.damaged)
    reference_frames = np.array([start, stop - 1, *seed_frames])
    distance = np.abs(frames[:, None] - reference_frames).min(axis=1)
    nearest = np.argsort(distance, kind="stable")[:max_frames]
    frames = frames[np.sort(nearest[distance[nearest] <= _MAX_DISTANCE_FRAMES])]
    return {frame: Pyramid.build(grey) for frame, grey in camera.read(frames)}


def estimate_exposure(camera: CaptureCamera, localiser: GuidedLocaliser, path: Trajectory) -> float:
    """Estimate the exposure time from frames that have a pose and fast motion.

    The map points are searched in the frames with the fastest rotation. Their patches are blurred for each
    candidate exposure time. The candidate with the highest sum of correlations is selected. Masked pixels are
    ignored: the wearer's sleeve does not move in the image, and would suggest a short exposure.

    Args:
        camera: The camera.
        localiser: Localiser of this camera. The exposure time in it is ignored.
        path: Trajectory of this camera.

    Returns:
        Exposure time as a fraction of the frame interval.
    """
    has_pose = path.localised
    pairs = np.flatnonzero(has_pose[1:] & has_pose[:-1]) + 1
    rotations = path.gauge_from_cam[:, :3, :3]
    cosine = np.einsum("nij,nij->n", rotations[pairs - 1], rotations[pairs])
    fastest = np.sort(pairs[np.argsort(cosine, kind="stable")[:_EXPOSURE_FRAMES]])
    totals = np.zeros(len(_EXPOSURE_CANDIDATES))
    for frame, grey in camera.read(fastest):
        pose, neighbour_pose = (invert(path.gauge_from_cam[index]) for index in (frame, frame - 1))
        view = PredictedView(
            lens=localiser.lens,
            frame=frame,
            pyramid=Pyramid.build(grey),
            cam_from_map=pose,
            neighbour_pose=neighbour_pose,
            exposure_ratio=0.0,
            readout_ratio=localiser.readout_ratio,
            shutter=localiser.shutter,
        )
        rows = select_patches(localiser.patches, view)
        for number, ratio in enumerate(_EXPOSURE_CANDIDATES):
            matches = match_patches(
                localiser.patches, replace(view, exposure_ratio=ratio), rows, _EXPOSURE_LEVEL
            )
            totals[number] += matches.score[localiser.is_unmasked(matches.px)].sum()
    return _EXPOSURE_CANDIDATES[int(np.argmax(totals))]
