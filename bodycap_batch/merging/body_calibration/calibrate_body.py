"""Calibrate the body: mounts, metric scale and vertical, with their uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.body.t_pose import arm_span, find_t_pose
from bodycap_batch.merging.body.trunk_lean import trunk_orientation, trunk_orientation_from_prior
from bodycap_batch.merging.body_calibration.calibration_covariance import (
    PoseSigma,
    error_modes,
    mounts_with_sigmas,
)
from bodycap_batch.merging.body_calibration.camera_roll import (
    RollSearch,
    reference_roll,
    search_rolls,
    with_roll,
)
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import PostureHints, take_samples
from bodycap_batch.merging.body_calibration.scale import (
    MetricScale,
    ScaleEstimate,
    combine_sources,
    estimate_scale,
    scale_from_bones,
    scale_from_floor,
)
from bodycap_batch.merging.body_calibration.stated_constraints import stated_constraints
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.error_modes import ErrorModes, stack_modes
from bodycap_batch.merging.graph.posture import is_mostly_walking
from bodycap_batch.merging.world.floor import WALKING_HEIGHT_RATIO, floor_beside_path, standing_height
from bodycap_batch.merging.world.vertical import SceneContext, Vertical, VerticalHypothesis, estimate_vertical
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import MEAN_HEIGHT_M, split_side

_SAMPLES = 80
"""Maximum number of sampled times in the calibration of the whole body. Evidence: none.

Times of a T-pose and times for rarely measured cameras are added to these.
"""
MIN_WALKING_SAMPLES = 10
"""Minimum number of samples at which the person walks. Evidence: none.

If there are enough such samples, only these samples determine the height over the floor. With fewer walking
samples, all samples determine it.
"""


@dataclass(frozen=True, slots=True)
class CalibrationInput:
    """The measured data of the calibration: cleaned camera tracks and facts about their maps.

    Attributes:
        tracks: Tracks without gross errors, in the gauge of the main map. The track of the reference camera
            is the first.
        provisional: Approximate scale, metres per map unit.
        alignment: Uncertainty of the pose of each camera's map in the main map. The key is the camera's
            name. It contains only cameras whose map was aligned to the main map.
        main_from_gauge: Similarity from each used map to the main map. The key is the gauge of the used map.
    """

    tracks: Sequence[CameraTrack]
    provisional: float
    alignment: Mapping[str, PoseSigma]
    main_from_gauge: Mapping[str, Similarity]


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyCalibration:
    """The result of the body calibration: the quantities that are constant over a capture.

    Attributes:
        scale: The metric scale, combined from all of its sources.
        bones_alone: The scale from the bones without other sources. At this scale the calibration graph has
            the lowest cost.
        mounts: The solved mounts with their sigmas. The mount of the reference camera is the first.
        reference_prior: Mount prior of the reference camera, rotated by the roll that was found.
        error_modes: Error modes of scale, mounts and body. Some are constant over the capture, the others
            are transient.
        vertical: The vertical in the gauge of the main map.
        height_over_floor_m: Height of the reference camera's joint over the floor, metres. None if no floor
            was found, or if the reference camera is on a limb.
        t_pose_ns: First and last common time of the T-pose; None if the capture has no T-pose.
        rolls: For each camera whose roll was searched, the costs of all rolls. The reference camera is not
            among these cameras.
        off_hinge_m: Size of each hinge violation. The key is the role of the bone below the hinge. The value
            is the sigma of the distance between the bone's far end and the plane of the hinge, metres.
    """

    scale: MetricScale
    bones_alone: ScaleEstimate
    mounts: tuple[Mount, ...]
    reference_prior: Mount
    error_modes: ErrorModes
    vertical: Vertical
    height_over_floor_m: float | None
    t_pose_ns: tuple[int, int] | None
    rolls: tuple[RollSearch, ...]
    off_hinge_m: Mapping[str, float] = field(default_factory=dict)


def calibrate_body(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    data: CalibrationInput,
    step: Callable[[], None],
) -> BodyCalibration:
    """Estimate mounts, metric scale and vertical.

    The calibration graph estimates the mounts and a first scale from the motion of the body. This scale is
    then combined with the other sources of scale, see ``scale.py``.

    Args:
        inputs: Skeleton, mount priors, trajectories and map points.
        options: T-pose, known distance and marker board that the job gives.
        bones: Bones of the graph.
        data: Camera tracks without gross errors, and their alignment.
        step: Function that is called after each iteration. It may raise an exception to stop the work.

    Returns:
        The calibration of the body.

    Raises:
        JobError: The known distance names a frame that does not exist, or two cameras in different maps.
        EstimationError: The data do not determine the calibration.
    """
    tracks, provisional = data.tracks, data.provisional
    t_pose_ns = _t_pose_interval(inputs.skeleton, options.t_pose_s, bones, data)
    stated = stated_constraints(inputs, options, data.main_from_gauge)
    inputs, hints, rolls = _resolve_camera_rolls(inputs, bones, data, t_pose_ns, stated.verticals, step)
    priors = inputs.mount_by_camera()
    samples = take_samples(tracks, provisional, _SAMPLES, hints.vertical, t_pose_ns)
    graph = CalibrationGraph(inputs.skeleton, bones, samples, priors, provisional, step)
    graph.solve(provisional)
    graph.widen_joint_priors()
    estimate = estimate_scale(graph, provisional)
    if graph.test_hinges():
        estimate = estimate_scale(graph, estimate.scale)
    poses = graph.poses()
    scene = SceneContext(
        points_m=estimate.scale * map_points_of(inputs, tracks[0].camera),
        path_m=estimate.scale * tracks[0].map_from_cam[:, :3, 3],
        standing_m=standing_height(inputs.skeleton, bones[0].joint),
        walks=not split_side(bones[0].role)[0] and is_mostly_walking(tracks[0].scaled(estimate.scale)),
    )
    up = estimate_vertical(
        trunk_orientation(inputs.skeleton, bones, poses), scene, np.random.default_rng(0), stated.verticals
    )
    walking = graph.samples.posture.walking
    # A person who bends or sits lowers the trunk. Only walking gives the trunk's height over the floor.
    upright = poses[walking] if walking.sum() >= MIN_WALKING_SAMPLES else poses
    height_m = _height_over_floor(bones[0], upright, up, scene)
    bones_alone = scale_from_bones(
        estimate,
        is_measured=inputs.skeleton_is_measured,
        has_height=inputs.height_m is not None,
    )
    scale = combine_sources(
        bones_alone,
        None if height_m is None else scale_from_floor(bones_alone, height_m, scene.standing_m),
        stated.scales,
    )
    if scale.metres_per_unit != estimate.scale:
        graph.solve(scale.metres_per_unit)
    stature_m = MEAN_HEIGHT_M if inputs.height_m is None else inputs.height_m
    constant, transient = error_modes(
        graph,
        scale.sigma_log,
        estimate.mount_slope,
        data.alignment,
        None if inputs.skeleton_is_measured else stature_m,
    )
    return BodyCalibration(
        scale=scale,
        bones_alone=estimate,
        mounts=mounts_with_sigmas(graph, constant),
        reference_prior=priors[tracks[0].camera],
        error_modes=stack_modes([constant, transient]),
        vertical=up,
        height_over_floor_m=height_m,
        t_pose_ns=t_pose_ns,
        rolls=rolls,
        off_hinge_m=graph.hinge_violation_m(),
    )


def _resolve_camera_rolls(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    data: CalibrationInput,
    t_pose_ns: tuple[int, int] | None,
    stated: Sequence[VerticalHypothesis],
    step: Callable[[], None],
) -> tuple[MergeInputs, PostureHints, tuple[RollSearch, ...]]:
    """Find the roll of the reference camera, then the rolls of the other cameras.

    Returns:
        The inputs with rotated mount priors, the facts about the posture, and the searches.
    """
    roll_deg, found = reference_camera_roll(inputs, bones, data.tracks, data.provisional, stated)
    hints = PostureHints(vertical=None if found is None else found.up, t_pose_ns=t_pose_ns)
    inputs = with_rolls(inputs, {data.tracks[0].camera: roll_deg})
    searches = search_rolls(
        inputs.skeleton, inputs.mount_by_camera(), data.tracks, data.provisional, hints, step
    )
    inputs = with_rolls(inputs, {search.camera: search.chosen_deg for search in searches})
    return inputs, hints, searches


def reference_camera_roll(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    provisional: float,
    stated: Sequence[VerticalHypothesis],
) -> tuple[float, Vertical | None]:
    """Find the roll of the reference camera, and the vertical if the job, the map or the walk gives it.

    Args:
        inputs: Skeleton, mount priors and map points.
        bones: Bones of the graph.
        tracks: Cleaned tracks in one map. The track of the reference camera is the first.
        provisional: Approximate scale, metres per map unit.
        stated: Possible verticals from the marker board that the job describes, and from accelerometers.

    Returns:
        The roll about the optical axis, degrees, and the vertical in the gauge of the tracks' map. The
        vertical is None if neither the job nor the map nor the walk determines it, or if the reference
        camera is on a limb.
    """
    reference = tracks[0].scaled(provisional)
    points_m = provisional * map_points_of(inputs, reference.camera)
    prior = inputs.mount_of(reference.camera)
    found: dict[float, Vertical] = {}

    def vertical_of(roll_deg: float) -> FloatArray | None:
        vertical = preliminary_vertical(
            inputs.skeleton, bones, reference, with_roll(prior, roll_deg), points_m, stated
        )
        if vertical is None:
            return None
        found[roll_deg] = vertical
        return vertical.up

    def trunk_up_of(roll_deg: float) -> FloatArray | None:
        if split_side(bones[reference.bone].role)[0]:
            return None
        return trunk_orientation_from_prior(bones, reference, with_roll(prior, roll_deg)).upright_up()

    roll_deg = reference_roll(inputs.mount_by_camera(), tracks, vertical_of, trunk_up_of)
    return roll_deg, found.get(roll_deg)


def preliminary_vertical(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    reference: CameraTrack,
    mount: Mount,
    points_m: FloatArray,
    stated: Sequence[VerticalHypothesis] = (),
) -> Vertical | None:
    """Estimate the vertical before the calibration, from the job, the planes of the map, or the walk.

    Args:
        skeleton: The skeleton of the body.
        bones: Bones of the graph.
        reference: Track of the reference camera, metres.
        mount: Mount prior of the reference camera.
        points_m: (P,3) points of the reference camera's map, metres.
        stated: Possible verticals from the marker board that the job describes, and from accelerometers.

    Returns:
        The vertical. None if the vertical is ambiguous, or if it could be estimated only from the posture of
        the body. None also if the reference camera is on a limb, because a swinging arm shows neither the
        vertical nor the facing direction of the body.
    """
    if split_side(bones[reference.bone].role)[0]:
        return None
    scene = SceneContext(
        points_m=points_m,
        path_m=reference.map_from_cam[:, :3, 3],
        standing_m=standing_height(skeleton, bones[reference.bone].joint),
    )
    found = estimate_vertical(
        trunk_orientation_from_prior(bones, reference, mount), scene, np.random.default_rng(0), stated
    )
    return None if found.source == "body" or not found.is_determined() else found


def with_rolls(inputs: MergeInputs, rolls_deg: Mapping[str, float]) -> MergeInputs:
    """Return the inputs with mount priors rotated about the optical axes.

    Args:
        inputs: The inputs of the stage.
        rolls_deg: By camera, roll about the optical axis, degrees. The mount priors of all other cameras
            remain unchanged.

    Returns:
        The inputs with the rotated mount priors.
    """
    mounts = tuple(with_roll(mount, rolls_deg.get(mount.camera, 0.0)) for mount in inputs.mounts)
    return replace(inputs, mounts=mounts)


def map_points_of(inputs: MergeInputs, camera: str) -> FloatArray:
    """Return the points (P,3) of a camera's map in the gauge of this map.

    Args:
        inputs: Trajectories and map points.
        camera: Camera name.

    Returns:
        (P,3) points in map units. P is 0 if the points of the map are unknown.
    """
    gauge = next(each.gauge for each in inputs.trajectories if each.camera == camera)
    return inputs.map_points.get(gauge, np.zeros((0, 3)))


def _t_pose_interval(
    skeleton: SkeletonModel, stated_s: float | None, bones: Sequence[Bone], data: CalibrationInput
) -> tuple[int, int] | None:
    """Return the first and last common time of the T-pose.

    If the job gives the time of a T-pose, this time is used. If the job says nothing about a T-pose, the
    function tries to detect a T-pose in the motion.

    Returns:
        The two times. None if the job says that there is no T-pose, or if no T-pose is detected.
    """
    if stated_s is not None:
        start = min(int(track.times_ns[0]) for track in data.tracks)
        return (start, start + round(stated_s * 1e9)) if stated_s > 0.0 else None
    return find_t_pose(bones, data.tracks, arm_span(bones, skeleton) / data.provisional)


def _height_over_floor(first: Bone, poses: FloatArray, up: Vertical, scene: SceneContext) -> float | None:
    """Return the median height of the reference camera's joint over the floor that the person walks on.

    Args:
        first: The first bone, on which the reference camera is mounted.
        poses: (K,B,4,4) bone poses in metres, at walking samples if there are enough of them, else at all
            samples.
        up: The vertical.
        scene: Map points and path of the reference camera.

    Returns:
        The height in metres. None if no floor was found, or if the reference camera is on a limb.
    """
    if split_side(first.role)[0]:
        return None
    height = float(np.median(poses[:, 0, :3, 3] @ up.up))
    expected = height - WALKING_HEIGHT_RATIO * scene.standing_m
    floor = floor_beside_path(scene.points_m, scene.path_m, up, expected, scene.standing_m)
    return None if floor is None else height - floor.height_m
