"""The merging stage: select cameras, calibrate the body, solve its motion, place it in the world, report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.merging.body.bones import Bone, kinematic_chain
from bodycap_batch.merging.body.completion import complete_skeleton, observed_joints
from bodycap_batch.merging.body.provisional_scale import provisional_scale
from bodycap_batch.merging.body_calibration.calibrate_body import (
    BodyCalibration,
    CalibrationInput,
    calibrate_body,
    map_points_of,
)
from bodycap_batch.merging.body_calibration.calibration_covariance import PoseSigma
from bodycap_batch.merging.camera_paths import trajectory_in_world, with_solved_centres
from bodycap_batch.merging.cameras.camera_axes import with_axes_of_cameras
from bodycap_batch.merging.cameras.excluded_cameras import MIN_LOCALISED_FRAMES, excluded_cameras
from bodycap_batch.merging.cameras.mount_slips import find_slip, without_slip
from bodycap_batch.merging.cameras.still_parts import still_parts
from bodycap_batch.merging.cameras.track import (
    CameraTrack,
    inflate_sigmas,
    make_track,
    transform_trajectory,
)
from bodycap_batch.merging.cameras.track_outliers import remove_outliers
from bodycap_batch.merging.graph.adaptive_motion_noise import scale_motion_noise
from bodycap_batch.merging.graph.foot_contact import (
    contact_statistics,
    contacts_in_window,
    find_contacts,
    standing_joints,
)
from bodycap_batch.merging.graph.joint_covariance import on_skeleton, sigma_percentiles
from bodycap_batch.merging.graph.joint_distance_limits import soft_limits
from bodycap_batch.merging.graph.motion_graph import (
    MotionGraph,
    MotionSolution,
    hinge_deviations,
    joint_gaps,
    posture_deviations,
)
from bodycap_batch.merging.graph.windows import MAX_ITERATIONS, max_window_ticks, solve_windows
from bodycap_batch.merging.main_map import align_usable_cameras
from bodycap_batch.merging.projection.project import project_motion
from bodycap_batch.merging.reporting.report import MotionFacts, build_report
from bodycap_batch.merging.rig_priors import correlate_mount_priors
from bodycap_batch.merging.unfit_camera import merge_without_unfit_camera
from bodycap_batch.merging.world.floor import (
    WALKING_HEIGHT_RATIO,
    Floor,
    floor_beside_path,
    floor_from_feet,
    floor_from_points,
    standing_height,
)
from bodycap_batch.merging.world.world_frame import initial_heading, rotation_to_z_up, world_from_solved_frame
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES, CameraClock
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs, MergeResult, SolvedBody
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import MountSlip, SkeletonModel

_EXPECTED_ITERATIONS = 80
"""Expected number of optimiser iterations in the whole stage. Evidence: none.

The progress display starts with this total. The total grows if more iterations are needed.
"""

_T_POSE_MARGIN_S = 1.0
"""Time (seconds) before and after a T-pose in which the arms rise or fall. Evidence: none."""


class _Progress:
    """Count the optimiser's iterations, report them, and stop the work if it is cancelled.

    Attributes:
        what: Name of the current step, for the progress display.
    """

    def __init__(self, context: StageContext) -> None:
        self._context, self._done, self._total = context, 0, _EXPECTED_ITERATIONS
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
        """Report that all work is done."""
        self._context.progress(self._total, self._total, "merged")


def merge(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """Run the merging stage. `bodycap_batch.merging.merge_trajectories` describes arguments and result.

    If the distances between the cameras fit no person, the body is solved without the camera that does not
    fit (`merge_without_unfit_camera`).

    The body is solved with the axes of the cameras, and the paths of the result have those of the pictures.
    The two differ in stabilised videos.
    """
    step, turns = _Progress(context), inputs.picture_turns
    of_cameras = with_axes_of_cameras(inputs)

    def solve(left_out: Mapping[str, str]) -> MergeResult:
        return _solve_body(of_cameras, options, step, left_out)

    result = merge_without_unfit_camera([each.camera for each in inputs.trajectories], solve)
    paths = [
        turns[path.camera].picture_path(path) if path.camera in turns else path
        for path in result.trajectories
    ]
    not_worn = [
        transform_trajectory(path, result.world_from_map[path.gauge], "world")
        for path in inputs.not_worn
        if path.gauge in result.world_from_map
    ]
    return replace(result, trajectories=(*paths, *not_worn))


def _solve_body(
    inputs: MergeInputs, options: MergeOptions, step: _Progress, left_out: Mapping[str, str]
) -> MergeResult:
    """Solve the motion of the body without some cameras.

    Args:
        inputs: The inputs of the stage.
        options: Options of the stage.
        step: The progress.
        left_out: By name of a camera that must not be used, the reason.

    Raises:
        ImplausibleBody: The distances between the cameras fit no person.
        EstimationError: The data do not determine the motion.
    """
    excluded = {**excluded_cameras(inputs), **left_out}
    inputs = correlate_mount_priors(inputs, excluded)
    aligned = align_usable_cameras(inputs, step, options, excluded)
    used = aligned.trajectories
    bones = kinematic_chain(inputs.skeleton, {inputs.mount_of(each.camera).role for each in used})
    fps = options.fps or inputs.clocks[used[0].camera].nominal_fps
    prepared = _prepare_tracks(inputs, used, bones)
    tracks = prepared.tracks
    tick_times = timeline(inputs.clocks, used, fps, tracks)
    calibration = calibrate_body(
        inputs,
        options,
        bones,
        CalibrationInput(
            tracks,
            prepared.provisional,
            _pose_sigmas(aligned.sigmas, prepared.slips),
            aligned.main_from_gauge,
        ),
        step,
    )
    step.what = "solving"
    scale = calibration.scale.metres_per_unit
    slips = {camera: slip.scaled(scale / prepared.provisional) for camera, slip in prepared.slips.items()}
    calibration = replace(
        calibration,
        mounts=tuple(replace(mount, slip=slips.get(mount.camera)) for mount in calibration.mounts),
    )
    tracks = [within_ticks(track, tick_times) for track in tracks]
    metric = [track.scaled(scale) for track in tracks]
    rules = soft_limits(inputs.skeleton, bones, inputs.activity)
    loose = tuple(replace(bone, off_hinge_m=calibration.off_hinge_m.get(bone.role, 0.0)) for bone in bones)
    psd_bones = scale_motion_noise(loose, metric)
    mounts = {mount.camera: mount.joint_from_cam for mount in calibration.mounts}
    contact_tracks = metric if options.foot_contact else ()
    contacts = find_contacts(
        inputs.skeleton, bones, contact_tracks, mounts, calibration.vertical.up, tick_times
    )
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
        [inflate_sigmas(track, mount) for track, mount in zip(metric, calibration.mounts, strict=True)],
        step,
        window_ticks=max_window_ticks(len(bones), tracks, tick_times),
        error_modes=calibration.error_modes,
    )
    # The first mount of the calibration always belongs to the reference camera. In a long capture,
    # the first window of the solution may not contain the reference camera.
    points = map_points_of(inputs, calibration.mounts[0].camera)
    placed = _place_in_world(inputs.skeleton, bones, solution, calibration, scale * points, fps)
    to_world = placed.world_from_solved
    world_from_map = Similarity(scale, to_world.rotation, to_world.translation)
    paths = tuple(trajectory_in_world(each, world_from_map, prepared.dropped[each.camera]) for each in used)
    if options.camera_paths == "joint":
        own = {track.camera: track for track in metric}
        by_camera = {mount.camera: mount for mount in calibration.mounts}
        paths = tuple(
            with_solved_centres(path, own[path.camera], by_camera[path.camera], solution, to_world)
            for path in paths
        )
    observed = observed_joints(inputs.skeleton, bones, tracks, tick_times, options.max_gap_s)
    assert solution.uncertainty is not None
    turned_m2 = to_world.rotation @ solution.uncertainty.centre_m2 @ to_world.rotation.T
    covariance = on_skeleton(bones, turned_m2, len(placed.solved))
    sigma_m = np.sqrt(np.trace(covariance, axis1=2, axis2=3) / 3.0)
    flexion_rad = on_skeleton(bones, np.sqrt(solution.uncertainty.flexion_rad2), len(placed.solved))
    body = SolvedBody(
        skeleton=inputs.skeleton,
        fps=fps,
        start_ns=int(tick_times[0]),
        graph_world_from_joint=placed.world_from_joint,
        solved=placed.solved,
        observed=observed,
        trajectories=paths,
        mounts=calibration.mounts,
        standing=standing_joints(contacts, len(tick_times), len(placed.solved)),
    )
    step("projecting")
    projection = project_motion(body, inputs.clocks, inputs.row_fraction)
    step.finish()
    return MergeResult(
        **{item.name: getattr(body, item.name) for item in fields(body)},
        motion=projection.motion,
        projection_gap=projection.gap,
        world_from_map={gauge: world_from_map.after(main) for gauge, main in aligned.main_from_gauge.items()},
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
                still_ns=prepared.still_ns,
                unused=aligned.unused,
                aligned=aligned.sigmas,
                joint_sigma_m=sigma_percentiles(inputs.skeleton.roles, sigma_m, observed, digits=5),
                flexion_sigma_deg=sigma_percentiles(
                    inputs.skeleton.roles, np.degrees(flexion_rad), observed, digits=2
                ),
                joint_gap_m=joint_gaps(bones, solution.world_from_bone),
                postures=posture_deviations(
                    bones, solution.world_from_bone[_outside_t_pose(tick_times, calibration.t_pose_ns)]
                ),
                hinge_off_plane_m=hinge_deviations(inputs.skeleton, bones, solution.world_from_bone),
                contacts=contact_statistics(contacts, solution.world_from_bone, fps),
                rule_violation_m={rule.name: rule.violation_m(solution.world_from_bone) for rule in rules},
            ),
        ),
        joint_covariance_m2=covariance,
        flexion_sigma_rad=flexion_rad,
    )


def _outside_t_pose(tick_times: IntArray, t_pose_ns: tuple[int, int] | None) -> BoolArray:
    """Return (T,) True for ticks (T,) outside the T-pose, which is no everyday posture.

    All ticks count if the T-pose lasts as long as the motion.
    """
    if t_pose_ns is None:
        return np.ones(len(tick_times), dtype=np.bool_)
    margin_ns = round(1e9 * _T_POSE_MARGIN_S)
    outside = (tick_times < t_pose_ns[0] - margin_ns) | (tick_times > t_pose_ns[1] + margin_ns)
    return np.asarray(outside if outside.any() else ~outside, dtype=np.bool_)


_MAX_TRIM_NS = 10_000_000_000
"""Maximum time, nanoseconds, that is left out at the start and at the end of the motion because not all
cameras run. Origin: the time in which a person starts some cameras by hand. Evidence: none."""


def timeline(
    clocks: Mapping[str, CameraClock],
    used: Sequence[Trajectory],
    fps: float,
    tracks: Sequence[CameraTrack] = (),
) -> IntArray:
    """Return the ticks of the motion.

    They extend from the first to the last timestamp of all used cameras. If the cameras were started by hand,
    so that their clocks were estimated, the motion begins when the last camera starts and ends when the first
    one stops. At an end where this would leave out more than `_MAX_TRIM_NS`, nothing is left out.

    Args:
        clocks: By camera, the clock that converts its timestamps to common time.
        used: Trajectories of the used cameras.
        fps: Number of ticks per second.
        tracks: Localised frames of the used cameras. Nothing is left out if a camera would keep fewer
            localised frames than `MIN_LOCALISED_FRAMES`.

    Returns:
        (T,) common time of each tick, nanoseconds.
    """
    times = [clocks[each.camera].common_times_ns(each.times_ns) for each in used]
    start, end = min(int(each.min()) for each in times), max(int(each.max()) for each in times)
    if any(clocks[each.camera].source in ESTIMATED_SOURCES for each in used):
        late, early = max(int(each.min()) for each in times), min(int(each.max()) for each in times)
        late = late if late - start <= _MAX_TRIM_NS else start
        early = early if end - early <= _MAX_TRIM_NS else end
        kept = [int(((track.times_ns >= late) & (track.times_ns <= early)).sum()) for track in tracks]
        if early > late and min(kept, default=MIN_LOCALISED_FRAMES) >= MIN_LOCALISED_FRAMES:
            start, end = late, early
    count = int(np.floor((end - start) * 1e-9 * fps + 1e-6)) + 1
    return np.asarray(start + np.round(np.arange(count) * (1e9 / fps)), dtype=np.int64)


def within_ticks(track: CameraTrack, tick_times: IntArray) -> CameraTrack:
    """Return the frames of a track from the first to the last tick (T,), with one frame beyond each end.

    The last tick is up to one tick before the end of the motion. A track that ends within this time is
    returned as it is.
    """
    step_ns = (tick_times[-1] - tick_times[0]) / max(1, len(tick_times) - 1)
    if track.times_ns[0] >= tick_times[0] and track.times_ns[-1] <= tick_times[-1] + step_ns:
        return track
    first = int(np.searchsorted(track.times_ns, tick_times[0], side="right")) - 1
    last = int(np.searchsorted(track.times_ns, tick_times[-1]))
    index = np.arange(len(track.times_ns))
    return track.keep((index >= first) & (index <= last))


@dataclass(frozen=True, slots=True)
class _PreparedTracks:
    """Tracks without gross errors, ready for the calibration of the body.

    Attributes:
        tracks: The cleaned tracks, one per camera. The track of the reference camera is the first.
        provisional: Provisional scale, metres per map unit.
        dropped: By camera, (N,) numbers of the frames with gross errors.
        still_ns: By camera that stands still in the room for some time while the trunk moves, the first and
            the last common time of the frames that are not used therefore.
        slips: By camera whose mount slips, the slip, in metres at the provisional scale. The poses in
            `tracks` are those at the place before the slip.
    """

    tracks: list[CameraTrack]
    provisional: float
    dropped: dict[str, IntArray]
    still_ns: dict[str, tuple[int, int]]
    slips: dict[str, MountSlip]


def _prepare_tracks(
    inputs: MergeInputs, used: Sequence[Trajectory], bones: Sequence[Bone]
) -> _PreparedTracks:
    """Convert the trajectories to common time, remove unusable frames, and estimate a provisional scale.

    Frames with gross errors are removed, and frames of cameras that fell off and stand still in the room.
    """
    index = {bone.role: number for number, bone in enumerate(bones)}
    mounts = inputs.mount_by_camera()
    tracks = [make_track(inputs, each, index[mounts[each.camera].role]) for each in used]
    provisional = provisional_scale(bones, tracks, mounts)
    still_ns, found = {}, still_parts(tracks, mounts, provisional)
    for position, track in enumerate(tracks):
        still = found.get(track.camera)
        if still is not None and int((~still).sum()) >= MIN_LOCALISED_FRAMES:
            times_ns = track.times_ns[still]
            still_ns[track.camera] = int(times_ns[0]), int(times_ns[-1])
            tracks[position] = track.keep(~still)
    if still_ns:
        provisional = provisional_scale(bones, tracks, mounts)
    cleaned, dropped, slips = [], {}, {}
    for track in tracks:
        kept = remove_outliers(track, provisional, inputs.clocks[track.camera].nominal_fps)
        dropped[track.camera] = np.setdiff1d(track.frames, kept.frames)
        slip = find_slip(kept.scaled(provisional)) if is_on(Mechanism.MOUNT_SLIPS) else None
        if slip is not None:
            record_act(Mechanism.MOUNT_SLIPS)
            slips[track.camera] = slip
            kept = without_slip(kept, slip, provisional)
        cleaned.append(kept)
    scale = provisional_scale(bones, cleaned, mounts)
    slips = {camera: slip.scaled(scale / provisional) for camera, slip in slips.items()}
    return _PreparedTracks(cleaned, scale, dropped, still_ns, slips)


def _pose_sigmas(aligned: Mapping[str, PoseSigma], slips: Mapping[str, MountSlip]) -> dict[str, PoseSigma]:
    """Return the uncertainty of the pose of a camera's map, or of a camera after a slip, by camera."""
    slipped = {camera: (slip.sigma_rad, slip.sigma_m) for camera, slip in slips.items()}
    none = (0.0, 0.0)
    return {
        camera: PoseSigma(*np.hypot(aligned.get(camera, none), slipped.get(camera, none)).tolist())
        for camera in sorted({*aligned, *slipped})
    }


@dataclass(frozen=True, slots=True)
class _PlacedBody:
    """The whole body in the world.

    Attributes:
        world_from_solved: Rigid transform from the solved frame of reference to the world, metres.
        world_from_joint: (T,J,4,4) pose of every joint of the skeleton in the world, metres.
        solved: (J,) True if the motion graph solved the joint.
        floor: The floor.
    """

    world_from_solved: Similarity
    world_from_joint: FloatArray
    solved: BoolArray
    floor: Floor


def _place_in_world(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    solution: MotionSolution,
    calibration: BodyCalibration,
    points_m: FloatArray,
    fps: float,
) -> _PlacedBody:
    """Complete the body, find the floor, and transform the body to the world.

    Args:
        skeleton: The skeleton of the body.
        bones: Bones of the graph.
        solution: The solved motion.
        calibration: The calibration of the body.
        points_m: (P,3) points of the reference camera's map in the solved frame of reference, metres.
        fps: Number of ticks per second.

    Returns:
        The body in the world, and the floor.
    """
    up = calibration.vertical
    rotation = rotation_to_z_up(up.up)
    to_z_up = Similarity(1.0, rotation, np.zeros(3))
    joints, solved = complete_skeleton(skeleton, bones, to_z_up.apply_to_poses(solution.world_from_bone))
    hips = joints[:, 0, :3, 3]
    standing = standing_height(skeleton, 0)
    path_m = solution.world_from_bone[:, 0, :3, 3]
    expected = float(np.median(hips[:, 2])) - WALKING_HEIGHT_RATIO * standing
    floor = floor_beside_path(points_m, path_m, up, expected, standing) or floor_from_points(
        points_m @ rotation[2], up, expected, standing
    )
    if floor.source != "map":
        floor = floor_from_feet(skeleton, joints, solved) or floor
    forward = -joints[:, 0, :3, 1]
    world_from_solved = world_from_solved_frame(
        rotation, hips[0], floor.height_m, initial_heading(forward, hips, fps)
    )
    to_world = Similarity(1.0, world_from_solved.rotation @ rotation.T, world_from_solved.translation)
    return _PlacedBody(world_from_solved, to_world.apply_to_poses(joints), solved, floor)
