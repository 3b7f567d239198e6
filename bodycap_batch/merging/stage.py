"""The merging stage: select cameras, calibrate the body, solve its motion, place it in the world, report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.merging.body.bones import Bone, graph_bones
from bodycap_batch.merging.body.completion import complete_body, observed_joints
from bodycap_batch.merging.body.initial_poses import provisional_scale
from bodycap_batch.merging.body_calibration.calibrate_body import (
    BodyCalibration,
    CalibrationInput,
    calibrate_body,
    map_points_of,
)
from bodycap_batch.merging.body_calibration.calibration_covariance import PoseSigma
from bodycap_batch.merging.camera_paths import trajectory_in_world, with_solved_centres
from bodycap_batch.merging.camera_selection import select_cameras
from bodycap_batch.merging.cameras.track import Track, clean, loosened, make_track
from bodycap_batch.merging.graph.foot_contact import accounts, during, find_contacts, standing_joints
from bodycap_batch.merging.graph.joint_covariance import joints_in_axes, sigma_summary
from bodycap_batch.merging.graph.joint_limits import soft_rules
from bodycap_batch.merging.graph.motion_graph import MotionGraph, Solution, hinge_errors, joint_gaps
from bodycap_batch.merging.graph.motion_noise import adapt_psd
from bodycap_batch.merging.graph.windows import MAX_ITERATIONS, longest_stretch, solve_motion
from bodycap_batch.merging.reporting.report import MotionFacts, build_report
from bodycap_batch.merging.world.floor import (
    WALKING_HEIGHT,
    Floor,
    feet_floor,
    find_floor,
    heading,
    place,
    standing_height,
    upright,
    walked_floor,
)
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import CameraClock, MergeInputs, MergeResult
from bodycap_batch.model.merge_report import AlignedCameraReport
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import SkeletonModel

_EXPECTED_ITERATIONS = 80
"""Iterations of a whole stage from which the progress starts to count; it grows if there are more.

Evidence: none.
"""


class _Progress:
    """Count the optimiser's iterations, report them, and stop the work if it is cancelled.

    Attributes:
        what: Name of the running step.
    """

    def __init__(self, context: StageContext) -> None:
        self._context, self._done, self._total = context, 0, _EXPECTED_ITERATIONS
        self.what = "calibrating"

    def __call__(self) -> None:
        self._context.check_cancelled()
        self._done += 1
        self._total = max(self._total, self._done + MAX_ITERATIONS)
        self._context.progress(self._done, self._total, self.what)

    def finish(self) -> None:
        """Report that all work is done."""
        self._context.progress(self._total, self._total, "merged")


def merge(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """Run the stage. See `bodycap_batch.merging.merge_trajectories`."""
    step = _Progress(context)
    inputs, aligned = select_cameras(inputs, step, options)
    used = aligned.trajectories
    bones = graph_bones(inputs.skeleton, {inputs.mount_of(each.camera).role for each in used})
    fps = options.fps or inputs.clocks[used[0].camera].nominal_fps
    tick_times = timeline(inputs.clocks, used, fps)
    prepared = _prepare_tracks(inputs, used, bones)
    tracks = prepared.tracks
    calibration = calibrate_body(
        inputs,
        options,
        bones,
        CalibrationInput(
            tracks,
            prepared.provisional,
            {camera: PoseSigma(*sigmas) for camera, sigmas in aligned.sigmas.items()},
            aligned.places,
        ),
        step,
    )
    step.what = "solving"
    scale = calibration.scale.metres_per_unit
    metric = [track.scaled(scale) for track in tracks]
    rules = soft_rules(inputs.skeleton, bones, inputs.activity)
    loose = tuple(replace(bone, off_hinge_m=calibration.off_hinge_m.get(bone.role, 0.0)) for bone in bones)
    psd_bones = adapt_psd(loose, metric)
    mounts = {mount.camera: mount.joint_from_cam for mount in calibration.mounts}
    contact_tracks = metric if options.foot_contact else ()
    contacts = find_contacts(
        inputs.skeleton, bones, contact_tracks, mounts, calibration.vertical.up, tick_times
    )
    solution = solve_motion(
        lambda ticks, seen: MotionGraph(
            inputs.skeleton, psd_bones, ticks, seen, mounts, (*rules, *during(contacts, tick_times, ticks))
        ),
        tick_times,
        [loosened(track, mount) for track, mount in zip(metric, calibration.mounts, strict=True)],
        step,
        chunk_ticks=longest_stretch(len(bones), tracks, tick_times),
        spread=calibration.error_modes,
    )
    # The first mount is that of the reference camera, which the first window of a long capture may lack.
    points = map_points_of(inputs, calibration.mounts[0].camera)
    placed = _place_in_world(inputs.skeleton, bones, solution, calibration, scale * points, fps)
    to_world = placed.world_from_solved
    world_from_map = Similarity(scale, to_world.rotation, to_world.translation)
    paths = tuple(trajectory_in_world(each, world_from_map, prepared.dropped[each.camera]) for each in used)
    if options.camera_paths == "joint":
        own = {track.camera: track for track in metric}
        solved_mounts = {mount.camera: mount for mount in calibration.mounts}
        paths = tuple(
            with_solved_centres(path, own[path.camera], solved_mounts[path.camera], solution, to_world)
            for path in paths
        )
    observed = observed_joints(inputs.skeleton, bones, tracks, tick_times, options.max_gap_s)
    covariance = joints_in_axes(to_world.rotation, bones, solution.joint_covariance, len(placed.solved))
    step.finish()
    return MergeResult(
        skeleton=inputs.skeleton,
        fps=fps,
        start_ns=int(tick_times[0]),
        world_from_joint=placed.world_from_joint,
        solved=placed.solved,
        observed=observed,
        world_from_map={gauge: world_from_map.after(main) for gauge, main in aligned.places.items()},
        trajectories=paths,
        mounts=calibration.mounts,
        unused_cameras=aligned.unused,
        report=build_report(
            inputs,
            calibration,
            solution,
            tracks,
            MotionFacts(
                start_ns=int(tick_times[0]),
                end_ns=int(tick_times[-1]),
                dropped=prepared.dropped,
                floor=placed.floor,
                unused=aligned.unused,
                aligned={name: AlignedCameraReport(**sigmas) for name, sigmas in aligned.report().items()},
                joint_sigma_m=sigma_summary(inputs.skeleton.roles, covariance, observed),
                joint_gap_m=joint_gaps(bones, solution.world_from_bone),
                hinge_off_plane_m=hinge_errors(inputs.skeleton, bones, solution.world_from_bone),
                contacts=accounts(contacts, solution.world_from_bone, fps),
                rule_violation_m={rule.name: rule.violation_m(solution.world_from_bone) for rule in rules},
            ),
        ),
        joint_covariance_m2=covariance,
        standing=standing_joints(contacts, len(tick_times), len(placed.solved)),
    )


def timeline(clocks: Mapping[str, CameraClock], used: Sequence[Trajectory], fps: float) -> IntArray:
    """Return the common times (T,) of the ticks, from the first timestamp of the used cameras to the last.

    Args:
        clocks: By camera.
        used: Trajectories of the used cameras.
        fps: Rate of the timeline.
    """
    times = [clocks[each.camera].common_times_ns(each.times_ns) for each in used]
    start, end = min(int(each.min()) for each in times), max(int(each.max()) for each in times)
    count = int(np.floor((end - start) * 1e-9 * fps + 1e-6)) + 1
    return np.asarray(start + np.round(np.arange(count) * (1e9 / fps)), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class _PreparedTracks:
    """Tracks without gross errors.

    Attributes:
        tracks: One per camera.
        provisional: Provisional scale, metres per map unit.
        dropped: By camera, (N,) frames with gross errors.
    """

    tracks: list[Track]
    provisional: float
    dropped: dict[str, IntArray]


def _prepare_tracks(
    inputs: MergeInputs, used: Sequence[Trajectory], bones: Sequence[Bone]
) -> _PreparedTracks:
    """Put the trajectories onto the common clock, drop gross errors, and estimate a provisional scale."""
    index = {bone.role: number for number, bone in enumerate(bones)}
    mounts = inputs.mount_by_camera()
    tracks = [make_track(inputs, each, index[mounts[each.camera].role]) for each in used]
    provisional = provisional_scale(bones, tracks, mounts)
    cleaned, dropped = [], {}
    for track in tracks:
        kept, _ = clean(track, provisional, inputs.clocks[track.camera].nominal_fps)
        dropped[track.camera] = np.setdiff1d(track.frames, kept.frames)
        cleaned.append(kept)
    return _PreparedTracks(cleaned, provisional_scale(bones, cleaned, mounts), dropped)


@dataclass(frozen=True, slots=True)
class _PlacedBody:
    """The whole body in the world.

    Attributes:
        world_from_solved: Rigid transform from the frame of the solution.
        world_from_joint: (T,J,4,4) pose of every joint.
        solved: (J,) True if the joint was a variable of the graph.
        floor: The floor.
    """

    world_from_solved: Similarity
    world_from_joint: FloatArray
    solved: BoolArray
    floor: Floor


def _place_in_world(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    solution: Solution,
    calibration: BodyCalibration,
    points_m: FloatArray,
    fps: float,
) -> _PlacedBody:
    """Complete the body, find the floor, and transform the body to the world.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        solution: The solved motion.
        calibration: The calibration of the body.
        points_m: (P,3) points of the map of the reference camera, metres, in the frame of the solution.
        fps: Rate of the timeline.
    """
    up = calibration.vertical
    rotation = upright(up.up)
    joints, solved = complete_body(skeleton, bones, _rotate_poses(rotation, solution.world_from_bone))
    hips = joints[:, 0, :3, 3]
    standing = standing_height(skeleton, 0)
    path_m = solution.world_from_bone[:, 0, :3, 3]
    expected = float(np.median(hips[:, 2])) - WALKING_HEIGHT * standing
    floor = walked_floor(points_m, path_m, up, expected, standing) or find_floor(
        points_m @ rotation[2], up, expected, standing
    )
    if floor.source != "map":
        floor = feet_floor(skeleton, joints, solved) or floor
    forward = -joints[:, 0, :3, 1]
    world_from_solved = place(rotation, hips[0], floor.height_m, heading(forward, hips, fps))
    to_world = Similarity(1.0, world_from_solved.rotation @ rotation.T, world_from_solved.translation)
    return _PlacedBody(world_from_solved, to_world.apply_to_poses(joints), solved, floor)


def _rotate_poses(rotation: FloatArray, poses: FloatArray) -> FloatArray:
    return Similarity(1.0, rotation, np.zeros(3)).apply_to_poses(poses)
