"""Correct a map for rolling shutters. This repeats a part of stage 2 after registration."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.inertial.camera_rotation import related_to_poses
from bodycap_batch.mapping.inputs import calibrated_camera_ids, make_mapping_context
from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    RollingShutterModel,
    estimate_readouts,
    map_with_readouts,
)
from bodycap_batch.mapping.intrinsics.recalibration import with_map_intrinsics
from bodycap_batch.mapping.intrinsics.shutters import (
    MAX_DISPLACEMENT_PX,
    read_shutters,
    readouts_of_maps,
)
from bodycap_batch.mapping.matching.database import read_camera_ids, read_detected_px
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.conversion import observed_px
from bodycap_batch.mapping.reconstruction.model_files import read_model, write_models
from bodycap_batch.mapping.reconstruction.two_step_adjustment import adjust_in_two_steps
from bodycap_batch.mapping.results import make_result
from bodycap_batch.mapping.validation.dominant_points import remove_dominant_points
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import MapResult, Trajectory

_MAX_KEYFRAMES = 300
"""Maximum number of keyframes of a model whose velocities are adjusted. Origin: 160 MB for the reduced
system, and some seconds for each step."""


def refine_map(
    capture: Capture,
    previous: MapResult,
    trajectories: Sequence[Trajectory],
    options: MapOptions,
    context: StageContext,
    *,
    skeletal_above: int = SKELETAL_ABOVE,
) -> MapResult:
    """Correct a map for rolling shutters, with the camera motion that registration estimated.

    Readout times that are not given in the job are estimated from the keyframes. The velocity of each
    keypoint in the image is computed from the poses of neighbouring frames. With this velocity, the keypoint
    is moved to its position at the instant of the image's middle row. Then each model is adjusted. If the
    model was built from corrected keypoints and the velocities from the poses are not exact enough, poses,
    points and velocities of the keyframes are adjusted together, and the velocities from the poses are their
    expected values. In the result, the observations are at their detected positions again. `Map.readout_s`
    holds the readout times with which the correction can be repeated. `MapDiagnostics.distorted_cameras`
    names the cameras for which the map should be built again from corrected keypoints.

    Args:
        capture: All cameras.
        previous: The map so far. Its workspace is copied, not changed.
        trajectories: Trajectories of the cameras, each in the gauge of one of the previous models.
        options: The stage's options.
        context: Work folder, progress, cancellation.
        skeletal_above: Maximum number of keyframes of a model that is adjusted in one step. A larger model
            is adjusted in two steps (`adjust_in_two_steps`).

    Returns:
        The models. Each corrected model has a new gauge. Models in which no camera has a rolling shutter are
        unchanged.

    Raises:
        EstimationError: The adjustment failed.

    Source: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012, for the idea.
    """
    capture = with_map_intrinsics(capture, previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    calibrated_ids = calibrated_camera_ids(capture, read_camera_ids(workspace))
    mapping = make_mapping_context(workspace, capture, options, calibrated_ids, context, skeletal_above)
    settings = mapping.mapper_options()
    cameras = {camera.name: camera for camera in capture.cameras}
    from_matches = {
        name: readout
        for name, entry in previous.log.get("readouts_from_matches", {}).items()
        if (readout := Readout(**entry)).seconds and readout.source != "stated"
    }
    models, all_readouts, adjusted_px, motions = [], [], [], []
    removed = 0
    distorted: set[str] = set()
    for number, scene_map in enumerate(previous.maps):
        context.check_cancelled()
        context.progress(number, len(previous.maps), "maps refined")
        model = read_model(workspace, number)
        paths = {path.camera: path for path in trajectories if path.gauge == scene_map.gauge}
        detected = {
            image_id: px
            for image_id in model.reg_image_ids()
            if (px := read_detected_px(workspace, image_id)) is not None
        }
        rotations = _rotations(workspace, scene_map.cameras, paths)
        rolling = RollingShutterModel(model, paths, cameras, detected, rotations)
        rolling, estimated = estimate_readouts(
            rolling, cameras, settings, calibrated_ids, scene_map, from_matches
        )
        # A camera that was registered against another model keeps the readout time of its keyframes here.
        readouts = readouts_of_maps([scene_map]) | estimated
        readout_s = {name: readout.seconds for name, readout in readouts.items() if readout.seconds}
        corrected_px = None
        distorted |= distorted_cameras(rolling, readout_s, scene_map.readout_s.keys())
        if readout_s:
            model = rolling.with_exact_rates(readout_s, scene_map.readout_s.keys()).corrected(readout_s)
            removed += remove_dominant_points(model)
            built_for_shutters = readout_s.keys() <= scene_map.readout_s.keys()
            if (
                built_for_shutters
                and model.num_reg_images() <= min(_MAX_KEYFRAMES, skeletal_above)
                and rolling.adjust_with_velocities(model, readout_s)
            ):
                adjust_robustly(model, settings, calibrated_ids)
            elif mapping.is_large(model.num_reg_images()):
                adjust_in_two_steps(model, settings, calibrated_ids)
            else:
                adjust_and_filter(model, settings, calibrated_ids)
                adjust_robustly(model, settings, calibrated_ids)
            corrected_px = observed_px(model)
            rolling.move_keypoints(model, {})
        sigma_s = {name: readout.sigma_s for name, readout in readouts.items()}
        motions.append(rolling.motions(readout_s, sigma_s))
        models.append(model)
        adjusted_px.append(observed_px(model) if corrected_px is None else corrected_px)
        all_readouts.append(readouts)
    write_models(workspace, models)
    log = {
        "dominant_points": removed,
        "rolling_shutter": [
            {name: asdict(readout) for name, readout in readouts.items()} for readouts in all_readouts
        ],
    }
    diagnostics = replace(
        previous.diagnostics,
        distorted_cameras=tuple(sorted(distorted)),
        details={**previous.log, **log},
    )
    result = make_result(models, workspace, diagnostics.to_log(), adjusted_px, motions)
    maps = [
        map_with_readouts(item, readouts) for item, readouts in zip(result.maps, all_readouts, strict=True)
    ]
    return replace(result, maps=tuple(maps))


def distorted_cameras(
    rolling: RollingShutterModel, readout_s: Mapping[str, float], corrected: Collection[str]
) -> set[str]:
    """Return the names of the cameras for which a map should be built again from corrected keypoints.

    Args:
        rolling: The model.
        readout_s: Readout time (seconds) of each camera with a rolling shutter, by camera name.
        corrected: Names of the cameras whose keypoints were corrected before the model was built.
    """
    return {
        name
        for name in readout_s.keys() - set(corrected)
        if rolling.displacement_px(name, readout_s[name]) > MAX_DISPLACEMENT_PX
    }


def _rotations(
    workspace: Path, names: Iterable[str], paths: Mapping[str, Trajectory]
) -> dict[str, RotationPath]:
    """Return the rotation of each camera whose keyframes were corrected, by camera name.

    It comes from the camera's gyroscope if that corrected the keyframes, else from matches between frames.

    Args:
        workspace: Folder of the map's database.
        names: Names of the cameras of the map.
        paths: Trajectories against the map, by camera name.
    """
    out = {}
    for name, shutter in read_shutters(workspace, names).items():
        gyro = shutter.path.gyro
        if gyro is None or name not in paths:
            out[name] = shutter.path
        elif (related := related_to_poses(gyro, paths[name])) is not None:
            out[name] = RotationPath.from_gyro(paths[name].times_ns, related)
    return out
