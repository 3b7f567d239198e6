"""The stage, step by step: select cameras, calibrate, solve, place in the world, complete, project, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.merging.body.bones import Bone, kinematic_chain
from bodycap_batch.merging.body.completion import complete_skeleton, observed_joints
from bodycap_batch.merging.body.provisional_scale import provisional_scale
from bodycap_batch.merging.body_calibration.calibrate_body import (
    BodyCalibration,
    CalibrationInput,
    calibrate_body,
    map_points_of,
)
from bodycap_batch.merging.camera_paths import trajectory_in_world, with_solved_centres
from bodycap_batch.merging.camera_selection import select_cameras
from bodycap_batch.merging.cameras.track import CameraTrack, inflate_sigmas, make_track, remove_outliers
from bodycap_batch.merging.graph.foot_contact import (
    contact_statistics,
    contacts_in_window,
    find_contacts,
    standing_joints,
)
from bodycap_batch.merging.graph.joint_covariance import sigma_percentiles, skeleton_covariance
from bodycap_batch.merging.graph.joint_limits import soft_limits
from bodycap_batch.merging.graph.motion_graph import MotionGraph, MotionSolution, hinge_deviations, joint_gaps
from bodycap_batch.merging.graph.motion_noise import scale_motion_noise
from bodycap_batch.merging.graph.windows import MAX_ITERATIONS, max_window_ticks, solve_windows
from bodycap_batch.merging.projection.project import project_motion
from bodycap_batch.merging.reporting.report import build_report
from bodycap_batch.merging.world.floor import (
    WALKING_HEIGHT_RATIO,
    Floor,
    floor_beside_path,
    floor_from_feet,
    floor_from_points,
    standing_height,
)
from bodycap_batch.merging.world.world_frame import initial_heading, rotation_to_z_up, world_from_solved_frame
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs, MergeResult, SolvedBody
from bodycap_batch.model.scene import Trajectory


class _Progress:
    """Counts the optimiser's iterations, reports them and the parts of the work, and stops it when asked."""

    def __init__(self, context: StageContext) -> None:
        self._context, self._done, self._total = context, 0, 80
        self.what = "calibrating"

    def __call__(self, what: str = "", /) -> None:
        self._context.check_cancelled()
        if what:
            self.what = what
        else:
            self._done += 1
        self._total = max(self._total, self._done + MAX_ITERATIONS)
        self._context.progress(self._done, self._total, self.what)

    def finish(self) -> None:
        """Report the whole as done."""
        self._context.progress(self._total, self._total, "merged")


def merge(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """See `bodycap_batch.merging.merge_trajectories`."""
    step = _Progress(context)
    inputs, together = select_cameras(inputs, step, options)
    used = together.trajectories
    bones = kinematic_chain(inputs.skeleton, {inputs.mount_of(each.camera).role for each in used})
    fps = options.fps or inputs.clocks[used[0].camera].nominal_fps
    tick_times = timeline(inputs, used, fps)
    tracks, provisional, dropped = _prepare_tracks(inputs, used, bones)
    cleaned = CalibrationInput(tracks, provisional, together.sigmas, together.main_from_gauge)
    calibrated = calibrate_body(inputs, options, bones, cleaned, step)
    step.what = "solving"
    metric = [track.scaled(calibrated.scale) for track in tracks]
    rules = soft_limits(inputs.skeleton, bones, inputs.activity)
    loose = tuple(replace(bone, off_hinge_m=calibrated.off_hinge_m.get(bone.role, 0.0)) for bone in bones)
    psd_bones = scale_motion_noise(loose, metric)
    mounts = {mount.camera: mount.joint_from_cam for mount in calibrated.mounts}
    asked = metric if options.foot_contact else ()
    contacts = find_contacts(inputs.skeleton, bones, asked, mounts, calibrated.up.up, tick_times)
    solution = solve_windows(
        lambda ticks, seen: MotionGraph(
            inputs.skeleton,
            psd_bones,
            ticks,
            seen,
            mounts,
            (*rules, *contacts_in_window(contacts, tick_times, ticks)),
        ),
        tick_times,
        [inflate_sigmas(track, mount) for track, mount in zip(metric, calibrated.mounts, strict=True)],
        step,
        window_ticks=max_window_ticks(len(bones), tracks, tick_times),
        error_modes=calibrated.spread,
    )
    world_from_solved, joints, solved, floor = _place_in_world(inputs, bones, solution, calibrated, fps)
    place = Similarity(calibrated.scale, world_from_solved.rotation, world_from_solved.translation)
    paths = tuple(trajectory_in_world(each, place, dropped[each.camera]) for each in used)
    if options.camera_paths == "joint":
        paths = _camera_paths(paths, metric, calibrated, solution, world_from_solved)
    observed = observed_joints(inputs.skeleton, bones, tracks, tick_times, options.max_gap_s)
    covariance = skeleton_covariance(
        world_from_solved.rotation, bones, solution.joint_covariance, len(solved)
    )
    body = SolvedBody(
        skeleton=inputs.skeleton,
        fps=fps,
        start_ns=int(tick_times[0]),
        graph_world_from_joint=joints,
        solved=solved,
        observed=observed,
        trajectories=paths,
        mounts=calibrated.mounts,
        standing=standing_joints(contacts, len(tick_times), len(solved)),
    )
    step("projecting")
    projection = project_motion(body, inputs.clocks, inputs.row_fraction)
    step.finish()
    return MergeResult(
        skeleton=body.skeleton,
        fps=body.fps,
        start_ns=body.start_ns,
        graph_world_from_joint=body.graph_world_from_joint,
        solved=body.solved,
        observed=body.observed,
        trajectories=body.trajectories,
        mounts=body.mounts,
        standing=body.standing,
        motion=projection.motion,
        projection_gap=projection.gap,
        world_from_map={gauge: place.after(here) for gauge, here in together.main_from_gauge.items()},
        unused_cameras=together.unused,
        report=build_report(
            inputs,
            calibrated,
            solution,
            tracks,
            {
                "start_ns": int(tick_times[0]),
                "end_ns": int(tick_times[-1]),
                "dropped": dropped,
                "floor": floor,
                "unused": together.unused,
                "joined": together.report(),
                "uncertainty": sigma_percentiles(inputs.skeleton.roles, covariance, observed),
                "joint_gap_m": joint_gaps(bones, solution.world_from_bone),
                "hinge_m": hinge_deviations(inputs.skeleton, bones, solution.world_from_bone),
                "contacts": contact_statistics(contacts, solution.world_from_bone, fps),
                "rules": {rule.name: rule.violation_m(solution.world_from_bone) for rule in rules},
            },
        ),
        joint_covariance_m2=covariance,
    )


def timeline(inputs: MergeInputs, used: Sequence[Trajectory], fps: float) -> IntArray:
    """Ticks (T,) on the common clock, from the earliest timestamp of the cameras in use to their latest."""
    times = [inputs.clocks[each.camera].common_times_ns(each.times_ns) for each in used]
    start, end = min(int(each.min()) for each in times), max(int(each.max()) for each in times)
    count = int(np.floor((end - start) * 1e-9 * fps + 1e-6)) + 1
    return np.asarray(start + np.round(np.arange(count) * (1e9 / fps)), dtype=np.int64)


def _prepare_tracks(
    inputs: MergeInputs, used: Sequence[Trajectory], bones: Sequence[Bone]
) -> tuple[list[CameraTrack], float, dict[str, IntArray]]:
    """Tracks without gross errors, a provisional scale, and the frames that were dropped."""
    index = {bone.role: position for position, bone in enumerate(bones)}
    mounts = {mount.camera: mount for mount in inputs.mounts}
    tracks = [make_track(inputs, each, index[mounts[each.camera].role]) for each in used]
    provisional = provisional_scale(bones, tracks, mounts)
    cleaned, dropped = [], {}
    for track in tracks:
        kept = remove_outliers(track, provisional, inputs.clocks[track.camera].nominal_fps)
        dropped[track.camera] = np.setdiff1d(track.frames, kept.frames)
        cleaned.append(kept)
    return cleaned, provisional_scale(bones, cleaned, mounts), dropped


def _rotate_poses(rotation: FloatArray, poses: FloatArray) -> FloatArray:
    return Similarity(1.0, rotation, np.zeros(3)).apply_to_poses(poses)


def _place_in_world(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    solution: MotionSolution,
    calibrated: BodyCalibration,
    fps: float,
) -> tuple[Similarity, FloatArray, Any, Floor]:
    """Find the world and put the whole body into it."""
    rotation = rotation_to_z_up(calibrated.up.up)
    turned = _rotate_poses(rotation, solution.world_from_bone)
    joints, solved = complete_skeleton(inputs.skeleton, bones, turned)
    hips = joints[:, 0, :3, 3]
    standing = standing_height(inputs.skeleton, 0)
    # The first mount is the trunk camera's: in a long capture the first stretch may lack it.
    points = map_points_of(inputs, calibrated.mounts[0].camera)
    points_m, path_m = calibrated.scale * points, solution.world_from_bone[:, 0, :3, 3]
    expected = float(np.median(hips[:, 2])) - WALKING_HEIGHT_RATIO * standing
    floor = floor_beside_path(points_m, path_m, calibrated.up, expected, standing) or floor_from_points(
        points_m @ rotation[2], calibrated.up, expected, standing
    )
    if floor.source != "map":
        floor = floor_from_feet(inputs.skeleton, joints, solved) or floor
    forward = -joints[:, 0, :3, 1]
    placed = world_from_solved_frame(rotation, hips[0], floor.height_m, initial_heading(forward, hips, fps))
    to_world = Similarity(1.0, placed.rotation @ rotation.T, placed.translation)
    return placed, to_world.apply_to_poses(joints), solved, floor


def _camera_paths(
    paths: Sequence[Trajectory],
    tracks: Sequence[CameraTrack],
    calibrated: BodyCalibration,
    solution: MotionSolution,
    world_from_solved: Similarity,
) -> tuple[Trajectory, ...]:
    """All paths as solved together with the body."""
    mounts = {mount.camera: mount for mount in calibrated.mounts}
    own = {track.camera: track for track in tracks}
    return tuple(
        with_solved_centres(path, own[path.camera], mounts[path.camera], solution, world_from_solved)
        for path in paths
    )
