"""What is constant over a capture: mounts, metric scale, the vertical; and what each of them rests on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.body.t_pose import arm_span, find_t_pose
from bodycap_batch.merging.body.trunk_lean import trunk_orientation, trunk_orientation_from_prior
from bodycap_batch.merging.body_calibration.anthropometry import (
    PROPORTION_SIGMA,
    bone_length_modes,
    joint_placement_modes,
)
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.camera_roll import (
    RollSearch,
    reference_roll,
    search_rolls,
    with_roll,
)
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.limb_scales import limb_scales
from bodycap_batch.merging.body_calibration.marker_board import LocatedBoard, locate_board
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.body_calibration.scale import (
    ScaleEstimate,
    ScaleSource,
    estimate_scale,
    scale_from_floor,
    weighted_mean,
)
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
MIN_WALKING_SAMPLES = 10
STATURE_SIGMA = 0.055
"""Spread of adults' stature about one mean for both sexes (7 cm within each, means 14 cm apart)."""


@dataclass(frozen=True, slots=True)
class CalibrationInput:
    """Cleaned tracks in one gauge.

    Attributes:
        tracks: The trunk's camera first.
        provisional: A scale near the right one, metres per map unit.
        placed: By camera whose map the body joined, sigmas (rad, m) of where it lies.
        places: By gauge, where each used map lies in the tracks' gauge; None where all are in one map.
    """

    tracks: Sequence[CameraTrack]
    provisional: float
    placed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    places: Mapping[str, Similarity] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyCalibration:
    """What is constant over the capture.

    Attributes:
        scale: Metres per map unit.
        sigma_log: Sigma of its logarithm.
        estimate: What the bones alone say.
        sources: All that know the scale, used or not.
        limbs: The scale at which each limb alone fits.
        mounts: Solved mounts with their sigmas.
        trunk: The prior of the leading camera's, the way up it sits.
        spread: How far off all of this may be, and what passing postures add.
        up: The vertical.
        height_over_floor_m: Of the trunk's joint, where a walked floor was seen.
        t_pose_ns: From when to when a T-pose stands, None without one.
        rolls: Which way up each limb's camera was tried.
        off_hinge_m: By role, sigma by which a bone's far end leaves its hinge's plane; those that do.
    """

    scale: float
    sigma_log: float
    estimate: ScaleEstimate
    sources: tuple[ScaleSource, ...]
    limbs: tuple[ScaleSource, ...]
    mounts: tuple[Mount, ...]
    trunk: Mount
    spread: ErrorModes
    up: Vertical
    height_over_floor_m: float | None
    t_pose_ns: tuple[int, int] | None
    rolls: tuple[RollSearch, ...]
    off_hinge_m: Mapping[str, float] = field(default_factory=dict)


def calibrate_body(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    cleaned: CalibrationInput,
    step: Callable[[], None],
) -> BodyCalibration:
    """Solve mounts and scale from the body's free motion, weighed with whatever else knows the scale."""
    tracks, provisional = cleaned.tracks, cleaned.provisional
    points = map_points_of(inputs, tracks[0].camera)
    t_pose_ns = _t_pose_interval(inputs, options, bones, cleaned)
    board = locate_board(inputs, options, cleaned.places)
    says = stated_verticals(options, board)
    inputs, known_up, rolls = _resolve_camera_rolls(inputs, bones, cleaned, (t_pose_ns, says), step)
    priors = {mount.camera: mount for mount in inputs.mounts}
    samples = take_samples(tracks, provisional, _SAMPLES, known_up, t_pose_ns)
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, priors, provisional, step)
    calibration.solve(provisional)
    calibration.widen_postures()
    estimate = estimate_scale(calibration, provisional)
    if calibration.test_hinges():
        estimate = estimate_scale(calibration, estimate.scale)
    poses = calibration.poses()
    path_m = estimate.scale * tracks[0].map_from_cam[:, :3, 3]
    around = SceneContext(
        points_m=estimate.scale * points,
        path_m=path_m,
        standing_m=standing_height(inputs.skeleton, bones[0].joint),
        walks=not split_side(bones[0].role)[0] and is_mostly_walking(tracks[0].scaled(estimate.scale)),
    )
    up = estimate_vertical(
        trunk_orientation(inputs.skeleton, bones, poses), around, np.random.default_rng(0), says
    )
    walking = samples.posture.walking
    # Who bends down or sits is not as tall as who walks.
    erect = poses[walking] if walking.sum() >= MIN_WALKING_SAMPLES else poses
    height = _height_over_floor(inputs, bones, erect, up, (estimate.scale * points, path_m))
    stated = (known_distance(inputs, options, cleaned.places), board.scale if board else None)
    known = tuple(source for source in stated if source is not None)
    sources = _sources(inputs, bones, estimate, height, known)
    scale, sigma = weighted_mean(sources)
    if not inputs.skeleton_is_measured and inputs.height_m is None and sources[0].used:
        sigma = float(np.hypot(sigma, STATURE_SIGMA))
    if scale != estimate.scale:
        calibration.solve(scale)
    bodies = () if inputs.skeleton_is_measured else (_skeleton_error_modes(inputs, bones, samples.cameras),)
    constant, passing = calibration.spread(sigma, estimate.mount_slope, cleaned.placed, bodies)
    return BodyCalibration(
        scale=scale,
        sigma_log=sigma,
        estimate=estimate,
        sources=sources,
        limbs=limb_scales(inputs, tracks, scale, (known_up, t_pose_ns), step),
        mounts=calibration.solved_mounts(constant),
        trunk=priors[tracks[0].camera],
        spread=stack_modes([constant, passing]),
        up=up,
        height_over_floor_m=height,
        t_pose_ns=t_pose_ns,
        rolls=rolls,
        off_hinge_m=calibration.off_hinge_m(),
    )


def _skeleton_error_modes(
    inputs: MergeInputs, bones: Sequence[Bone], cameras: Sequence[str]
) -> tuple[ErrorModes, ErrorModes]:
    """How people, and rigs, of one stature differ."""
    stature_m = MEAN_HEIGHT_M if inputs.height_m is None else inputs.height_m
    return bone_length_modes(bones, cameras), joint_placement_modes(bones, cameras, stature_m)


def _resolve_camera_rolls(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    cleaned: CalibrationInput,
    known: tuple[tuple[int, int] | None, Sequence[VerticalHypothesis]],
    step: Callable[[], None],
) -> tuple[MergeInputs, FloatArray | None, tuple[RollSearch, ...]]:
    """The priors with each camera the way up it sits, the vertical where it is known, and what was tried."""
    t_pose_ns, stated = known
    roll, found = reference_camera_roll(inputs, bones, cleaned.tracks, cleaned.provisional, stated)
    up = None if found is None else found.up
    inputs = with_rolls(inputs, {cleaned.tracks[0].camera: roll})
    rolls = search_rolls(inputs, cleaned.tracks, cleaned.provisional, (up, t_pose_ns), step)
    return with_rolls(inputs, {each.camera: each.chosen_deg for each in rolls}), up, rolls


def reference_camera_roll(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    provisional: float,
    stated: Sequence[VerticalHypothesis],
) -> tuple[float, Vertical | None]:
    """Roll (degrees) of the leading camera of a map's tracks, and the vertical where it is known early."""
    trunk = tracks[0].scaled(provisional)
    points_m = provisional * map_points_of(inputs, trunk.camera)
    prior = inputs.mount_of(trunk.camera)
    ways: dict[float, Vertical] = {}

    def up_of(degrees: float) -> FloatArray | None:
        found = preliminary_vertical(
            inputs.skeleton, bones, (trunk, with_roll(prior, degrees)), points_m, stated
        )
        if found is None:
            return None
        ways[degrees] = found
        return found.up

    def own_up(degrees: float) -> FloatArray | None:
        if split_side(bones[trunk.bone].role)[0]:
            return None
        return trunk_orientation_from_prior(bones, trunk, with_roll(prior, degrees)).upright_up()

    roll, _ = reference_roll(inputs, tracks, up_of, own_up)
    return roll, ways.get(roll)


def stated_verticals(options: MergeOptions, board: LocatedBoard | None) -> tuple[VerticalHypothesis, ...]:
    """What the job itself says of up."""
    if board is None or options.marker_board is None:
        return ()
    return board.ups(options.marker_board.placed)


def with_rolls(inputs: MergeInputs, degrees: Mapping[str, float]) -> MergeInputs:
    """The priors with cameras turned about their optical axes."""
    mounts = tuple(with_roll(mount, degrees.get(mount.camera, 0.0)) for mount in inputs.mounts)
    return replace(inputs, mounts=mounts)


def map_points_of(inputs: MergeInputs, camera: str) -> FloatArray:
    """Points (P,3) of the map a camera is in, none where it is not known."""
    gauge_name = next(each.gauge for each in inputs.trajectories if each.camera == camera)
    return inputs.map_points.get(gauge_name, np.zeros((0, 3)))


def _t_pose_interval(
    inputs: MergeInputs, options: MergeOptions, bones: Sequence[Bone], cleaned: CalibrationInput
) -> tuple[int, int] | None:
    """Where a T-pose stands: where the job says, else where one is seen."""
    if options.t_pose_s is not None:
        start = min(int(track.times_ns[0]) for track in cleaned.tracks)
        return (start, start + round(options.t_pose_s * 1e9)) if options.t_pose_s > 0.0 else None
    return find_t_pose(bones, cleaned.tracks, arm_span(bones, inputs.skeleton) / cleaned.provisional)


def preliminary_vertical(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    worn: tuple[CameraTrack, Mount],
    points_m: FloatArray,
    stated: Sequence[VerticalHypothesis] = (),
) -> Vertical | None:
    """The vertical where the job, planes or the walk tell it, before anything is solved.

    None from a limb's camera: a swinging arm tells neither the vertical nor the way the body faces.
    """
    trunk, prior = worn
    if split_side(bones[trunk.bone].role)[0]:
        return None
    around = SceneContext(
        points_m=points_m,
        path_m=trunk.map_from_cam[:, :3, 3],
        standing_m=standing_height(skeleton, bones[trunk.bone].joint),
    )
    found = estimate_vertical(
        trunk_orientation_from_prior(bones, trunk, prior), around, np.random.default_rng(0), stated
    )
    return None if found.source == "body" or not found.is_determined() else found


def _height_over_floor(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    poses: FloatArray,
    up: Vertical,
    around: tuple[FloatArray, FloatArray],
) -> float | None:
    """Median height of the trunk's first solved joint over the walked floor, None if none was seen."""
    points_m, path_m = around
    if split_side(bones[0].role)[0]:
        return None
    height = float(np.median(poses[:, 0, :3, 3] @ up.up))
    standing = standing_height(inputs.skeleton, bones[0].joint)
    floor = floor_beside_path(points_m, path_m, up, height - WALKING_HEIGHT_RATIO * standing, standing)
    return None if floor is None else height - floor.height_m


def _sources(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    estimate: ScaleEstimate,
    height_m: float | None,
    known: Sequence[ScaleSource],
) -> tuple[ScaleSource, ...]:
    """The bones, the floor, and what was measured (a distance, a board), which overrules the others."""
    name, spread = "skeleton", 0.0
    if not inputs.skeleton_is_measured:
        name, spread = "height" if inputs.height_m is not None else "mean stature", PROPORTION_SIGMA
    body = ScaleSource(
        name=name,
        scale=estimate.scale,
        sigma_log=float(np.hypot(estimate.sigma_log, spread)),
        used=not known,
    )
    out = [body]
    if height_m is not None:
        standing = standing_height(inputs.skeleton, bones[0].joint)
        floor = scale_from_floor(body, height_m, standing)
        out.append(
            floor
            if not known
            else ScaleSource(name="floor", scale=floor.scale, sigma_log=floor.sigma_log, used=False)
        )
    return (*out, *known)
