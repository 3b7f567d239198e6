"""Correct a map for rolling shutters. This repeats a part of stage 2 after registration."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.inertial.camera_rotation import related_to_poses
from bodycap_batch.mapping.inputs import calibrated_camera_ids, make_mapping_context
from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    RollingShutterModel,
    groups_of_equal_cameras,
    map_with_readouts,
    sideways_cameras,
    stated_readout,
)
from bodycap_batch.mapping.intrinsics.recalibration import with_map_intrinsics
from bodycap_batch.mapping.intrinsics.shutters import read_shutters, readouts_of_maps
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import read_camera_ids, read_detected_px
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.conversion import observed_px
from bodycap_batch.mapping.reconstruction.model_files import read_model, write_models
from bodycap_batch.mapping.reconstruction.two_step_adjustment import adjust_in_two_steps
from bodycap_batch.mapping.results import make_result
from bodycap_batch.mapping.validation.dominant_points import remove_dominant_points
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import Map, MapResult, Trajectory

_MAX_KEYFRAMES = 300
"""Maximum number of keyframes of a model whose velocities are adjusted. Origin: 160 MB for the reduced
system, and some seconds for each step."""

_MIN_POINT_SHARE = 0.5
"""Share of its points that a model keeps if its lenses can be refined. A model that bends refines them to
lenses that do not exist, which few points fit. Then the lenses stay. Evidence: docs/decisions/tracks.md."""


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

    Readout times that neither the job nor the matches of adjacent frames determine are estimated from the
    keyframes. Poses, points, velocities and readout times of the keyframes are adjusted together. Their
    expected values are the velocities of the path through the poses of all frames. A keypoint is then at its
    position at the instant of the image's middle row. If the velocities of the path are exact enough, or the
    model is large, only poses and points are adjusted. In the result, the observations are at their detected
    positions again. `Map.readout_s` holds the readout times with which the correction can be repeated.

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
    every_id = sorted(read_camera_ids(workspace).values())
    with_constant_lenses = make_mapping_context(
        workspace, capture, options, every_id, context, skeletal_above
    )
    cameras = {camera.name: camera for camera in capture.cameras}
    equal_cameras = groups_of_equal_cameras(capture.cameras)
    entries = previous.log.get("readouts_from_matches", {})
    from_matches = {name: _readout_of(entry) for name, entry in entries.items()}
    models, all_readouts, adjusted_px, motions = [], [], [], []
    removed = 0
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
        refinement = _Refinement(model, rolling, scene_map, cameras, equal_cameras, from_matches, mapping)
        refined = refinement.run()
        if refined.model.num_points3D() < _MIN_POINT_SHARE * model.num_points3D():
            refined = replace(refinement, mapping=with_constant_lenses).run()
        readouts, corrected_px = refined.readouts, refined.corrected_px
        removed += refined.removed
        motions.append(refined.rolling.motions(readouts, refined.error_scales))
        models.append(refined.model)
        adjusted_px.append(observed_px(refined.model) if corrected_px is None else corrected_px)
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
        details={**previous.log, **log},
    )
    result = make_result(models, workspace, diagnostics.to_log(), adjusted_px, motions)
    maps = [
        map_with_readouts(item, readouts) for item, readouts in zip(result.maps, all_readouts, strict=True)
    ]
    return replace(result, maps=tuple(maps))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Refined:
    """A refined model.

    Attributes:
        rolling: The model before, with the row directions that were used.
        model: The model, with all observations at their detected positions.
        readouts: Readout times by camera name.
        corrected_px: Pixels to which the model was adjusted, by image id; None without a rolling shutter.
        removed: Number of dominant points that were removed.
        error_scales: (N,3) factors of the expected errors of the velocities of each frame, by camera name;
            None if the velocities were not adjusted.
    """

    rolling: RollingShutterModel
    model: Any
    readouts: dict[str, Readout]
    corrected_px: dict[int, FloatArray] | None
    removed: int
    error_scales: Mapping[str, FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class _Refinement:
    """The correction of one model for its rolling shutters.

    Attributes:
        model: The model; not changed.
        rolling: The model with the motion of its keypoints.
        scene_map: The map of the model.
        cameras: The capture's cameras by name.
        equal_cameras: Groups of names of cameras that may be of one model.
        from_matches: Readout times from matches between adjacent frames, by camera name.
        mapping: Workspace, mapper options.
    """

    model: Any
    rolling: RollingShutterModel
    scene_map: Map
    cameras: Mapping[str, CaptureCamera]
    equal_cameras: Sequence[Sequence[str]]
    from_matches: Mapping[str, Readout]
    mapping: MappingContext

    def run(self) -> _Refined:
        """Return the model after the adjustment with the most exact motion."""
        known = self._known_readouts()
        sideways = {name for name, readout in {**self.from_matches, **known}.items() if readout.sideways}
        sideways |= sideways_cameras(self.cameras, self.scene_map)
        rolling = self.rolling.with_sideways(sideways)
        readouts = {**known, **rolling.find_unknown_readouts(known, self.equal_cameras)}
        if not (readout_s := _seconds(readouts)):
            return self._unchanged(rolling, readouts)
        if (refined := self._with_velocities(rolling, readouts)) is not None:
            is_corrected = _seconds(refined.readouts) or self.scene_map.readout_s
            return refined if is_corrected else self._unchanged(rolling, refined.readouts)
        model = rolling.with_exact_rates(readout_s, self.scene_map.readout_s.keys()).corrected(readout_s)
        removed = remove_dominant_points(model)
        settings, calibrated_ids = self.mapping.mapper_options(), list(self.mapping.calibrated_ids)
        if self.mapping.is_large(model.num_reg_images()):
            adjust_in_two_steps(model, settings, calibrated_ids)
        else:
            adjust_and_filter(model, settings, calibrated_ids)
            adjust_robustly(model, settings, calibrated_ids)
        return self._finished(rolling, model, readouts, removed)

    def _known_readouts(self) -> dict[str, Readout]:
        """Return the readout times that are stated, of the map or from matches, by camera name."""
        of_map, out = readouts_of_maps([self.scene_map]), {}
        for name in self.scene_map.cameras:
            camera, matched = self.cameras[name], self.from_matches.get(name)
            if camera.rolling_shutter_known:
                stated = stated_readout(camera.rolling_shutter_s)
                out[name] = replace(stated, sideways=camera.camera.sideways)
            elif name in of_map:
                out[name] = of_map[name]
            elif matched is not None and matched.determined:
                out[name] = matched
        return out

    def _with_velocities(
        self, rolling: RollingShutterModel, readouts: Mapping[str, Readout]
    ) -> _Refined | None:
        """Return the model after an adjustment with velocities and readout times; None if none is of use."""
        readout_s = _seconds(readouts)
        largest = min(_MAX_KEYFRAMES, self.mapping.skeletal_above)
        if len(self.scene_map.keyframe_camera) > largest or not is_on(Mechanism.JOINT_VELOCITIES):
            return None
        model = rolling.with_exact_rates(readout_s, self.scene_map.readout_s.keys()).corrected(readout_s)
        removed = remove_dominant_points(model)
        adjusted = rolling.adjust_with_velocities(model, readouts, self.from_matches, self.equal_cameras)
        if adjusted is None:
            return None
        record_act(Mechanism.JOINT_VELOCITIES)
        adjust_robustly(model, self.mapping.mapper_options(), self.mapping.calibrated_ids)
        refined = self._finished(rolling, model, adjusted.readouts, removed)
        return replace(refined, error_scales=adjusted.error_scales)

    def _unchanged(self, rolling: RollingShutterModel, readouts: dict[str, Readout]) -> _Refined:
        """Return the model as it is: no rolling shutter is found."""
        return _Refined(rolling=rolling, model=self.model, readouts=readouts, corrected_px=None, removed=0)

    @staticmethod
    def _finished(
        rolling: RollingShutterModel, model: Any, readouts: Mapping[str, Readout], removed: int
    ) -> _Refined:
        """Return a result with the observations of the model at their detected positions."""
        corrected_px = observed_px(model)
        rolling.move_keypoints(model, {})
        return _Refined(
            rolling=rolling,
            model=model,
            readouts=dict(readouts),
            corrected_px=corrected_px,
            removed=removed,
        )


def _readout_of(entry: Mapping[str, Any]) -> Readout:
    """Return the readout time of a log entry. Logs are stored as JSON, which has no infinite numbers."""
    return Readout(**{**entry, "sigma_s": math.inf if entry["sigma_s"] is None else entry["sigma_s"]})


def _seconds(readouts: Mapping[str, Readout]) -> dict[str, float]:
    """Return the readout times (seconds) of the cameras with a rolling shutter, by camera name."""
    return {name: readout.seconds for name, readout in readouts.items() if readout.seconds}


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
