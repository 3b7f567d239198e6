"""Build the report of the merging stage."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body_calibration.calibrate_body import BodyCalibration
from bodycap_batch.merging.body_calibration.calibration_covariance import PoseSigma
from bodycap_batch.merging.body_calibration.camera_roll import (
    hanging_tracks,
    has_unknown_roll,
    roll_deg,
    with_roll,
)
from bodycap_batch.merging.body_calibration.scale import ScaleSource, chi_square
from bodycap_batch.merging.cameras.side_check import swapped_sides
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.motion_graph import MotionSolution, PostureDeviation
from bodycap_batch.merging.reporting.advice import (
    describe_hinge,
    describe_inverted_cameras,
    describe_mount,
    describe_scale,
    describe_slips,
    describe_swapped_sides,
    describe_unknown_way_up,
    describe_vertical,
)
from bodycap_batch.merging.world.floor import Floor
from bodycap_batch.merging.world.vertical import angle_deg
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.merge_data import Activity, MergeInputs
from bodycap_batch.model.merge_report import (
    ActivityReport,
    AlignedCameraReport,
    BodyScaleReport,
    CameraReport,
    FloorReport,
    HingeReport,
    InvertedCamerasReport,
    MergeReport,
    MountReport,
    MountSlipReport,
    OtherVerticalReport,
    Percentiles,
    RunnerUpRollReport,
    ScaleReport,
    ScaleSourceReport,
    SlippedMountsReport,
    SolverReport,
    SpanReport,
    SwappedSidesReport,
    VerticalReport,
)
from bodycap_batch.model.skeleton import Mount, MountSlip
from bodycap_batch.model.skeleton_presets import split_side

_DOWN_WEIGHTED = 0.25
"""Threshold of the robust weight: a measurement with a smaller weight is down-weighted. Evidence: none.

The report gives the number of down-weighted measurements.
"""
_MIN_INVERTED_ROLL_DEG = 135.0
"""Minimum roll (degrees) from the usual mount of a camera that is mounted upside down. Derivation: half-way
between a camera that lies on its side (90°) and one that is upside down (180°)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionFacts:
    """Facts about the motion for the report that neither the calibration nor the solution contains.

    Attributes:
        start_ns: Common time of the first tick.
        end_ns: Common time of the last tick.
        dropped: By camera, (N,) numbers of the frames with gross errors.
        floor: The floor.
        still_ns: By camera that stands still in the room for some time while the trunk moves, the first and
            the last common time of the frames that are not used therefore.
        unused: By name of an unused camera, the reason why the camera is not used.
        aligned: By camera, uncertainty of the pose of this camera's map in the main map. The mapping contains
            only cameras whose map was aligned to the main map.
        joint_sigma_m: By role of a joint, then by ``observed`` or ``filled`` ticks, percentiles of the sigma
            of the joint's centre, metres per axis.
        flexion_sigma_deg: By role of the bone below a hinge, then by ``observed`` or ``filled`` ticks,
            percentiles of the sigma of the flexion, degrees.
        joint_gap_m: By role of a joint, (T,) distance of the joint from its place on the parent bone, metres.
        postures: By role of a joint, deviation of its rotation from the rest pose outside the T-pose.
        hinge_off_plane_m: By role of the joint at the far end of a hinged bone, (T,) distance of this joint
            from the plane of the hinge, metres.
        contacts: By foot, how often the foot stands, and how fast the foot slides while it stands.
        rule_violation_m: By name of a soft rule, (T,) amount by which the motion violates the rule, metres.
    """

    start_ns: int
    end_ns: int
    dropped: Mapping[str, IntArray]
    floor: Floor
    still_ns: Mapping[str, tuple[int, int]]
    unused: Mapping[str, str]
    aligned: Mapping[str, PoseSigma]
    joint_sigma_m: Mapping[str, Mapping[str, Percentiles]]
    flexion_sigma_deg: Mapping[str, Mapping[str, Percentiles]]
    joint_gap_m: Mapping[str, FloatArray]
    postures: Mapping[str, PostureDeviation]
    hinge_off_plane_m: Mapping[str, FloatArray]
    contacts: Mapping[str, Mapping[str, float]]
    rule_violation_m: Mapping[str, FloatArray]


def build_report(
    inputs: MergeInputs,
    calibration: BodyCalibration,
    solution: MotionSolution,
    tracks: Sequence[CameraTrack],
    facts: MotionFacts,
) -> MergeReport:
    """Build the report of the merging stage.

    Args:
        inputs: The inputs of the stage.
        calibration: The calibration of the body.
        solution: The solved motion.
        tracks: Cleaned tracks of the used cameras. The track of the reference camera is the first.
        facts: Further facts for the report.

    Returns:
        The report.
    """
    main_tracks = [track for track in tracks if track.camera not in facts.aligned]
    return MergeReport(
        scale=_scale_report(calibration),
        t_pose=None if calibration.t_pose_ns is None else _span_report(calibration.t_pose_ns, facts.start_ns),
        up=_vertical_report(inputs.mounts, calibration, main_tracks),
        floor=FloorReport(source=facts.floor.source, points=facts.floor.support),
        mounts={
            mount.camera: _mount_report(inputs.mount_of(mount.camera), mount, calibration)
            for mount in calibration.mounts
        },
        cameras={track.camera: _camera_report(track, solution, facts) for track in tracks},
        exchanged_sides=_sides_report(inputs.mounts, calibration, main_tracks),
        inverted_cameras=_inverted_cameras_report(inputs.mounts, calibration),
        slipped_mounts=_slips_report(calibration.mounts, facts.start_ns),
        still_cameras={
            camera: _span_report(span_ns, facts.start_ns) for camera, span_ns in facts.still_ns.items()
        },
        unused_cameras=dict(facts.unused),
        joined_cameras={
            camera: AlignedCameraReport(
                sigma_deg=round(float(np.degrees(sigma.rotation_rad)), 3), sigma_m=round(sigma.position_m, 5)
            )
            for camera, sigma in facts.aligned.items()
        },
        joint_gap_m=_percentiles_by_name(facts.joint_gap_m),
        posture_sigmas={role: round(posture.rms, 4) for role, posture in facts.postures.items()},
        mean_posture_sigmas={role: round(posture.mean, 4) for role, posture in facts.postures.items()},
        joint_sigma_m=facts.joint_sigma_m,
        flexion_sigma_deg=facts.flexion_sigma_deg,
        hinge_off_plane_m=_percentiles_by_name(facts.hinge_off_plane_m),
        loose_hinges={
            role: HingeReport(sigma_m=round(off_m, 5), known_to=describe_hinge(role, off_m))
            for role, off_m in calibration.off_hinge_m.items()
        },
        activity=_activity_report(inputs.activity, facts.rule_violation_m),
        foot_contact=facts.contacts,
        solver=SolverReport(
            ticks=len(solution.world_from_bone),
            bones=solution.world_from_bone.shape[1],
            iterations=solution.iterations,
            half_squared_error={kind: round(error, 4) for kind, error in solution.errors.items()},
        ),
    )


def _camera_report(track: CameraTrack, solution: MotionSolution, facts: MotionFacts) -> CameraReport:
    residuals = solution.residuals[track.camera]
    return CameraReport(
        measurements=len(track.times_ns),
        dropped_as_gross_errors=len(facts.dropped[track.camera]),
        down_weighted=int((residuals.weights < _DOWN_WEIGHTED).sum()),
        residual_m=_percentiles(residuals.distance_m),
        residual_deg=_percentiles(np.degrees(residuals.angle_rad)),
        longest_gap_s=longest_gap_s(track, facts.start_ns, facts.end_ns),
    )


def _sides_report(
    priors: Collection[Mount], calibration: BodyCalibration, tracks: Sequence[CameraTrack]
) -> SwappedSidesReport | None:
    """Report the cameras on limbs that stay on the wrong side of the body; return None without any."""
    mounts = {mount.camera: mount for mount in (*priors, calibration.reference_prior)}
    wrong = swapped_sides(tracks, mounts, calibration.vertical.up)
    if not wrong:
        return None
    limbs = {track.camera for track in tracks if split_side(mounts[track.camera].role)[0]}
    says = describe_swapped_sides(wrong, all_limbs=limbs == wrong.keys())
    return SwappedSidesReport(cameras=wrong, says=says)


def _inverted_cameras_report(
    priors: Collection[Mount], calibration: BodyCalibration
) -> InvertedCamerasReport | None:
    """Report the cameras whose solved mount is upside down relative to the usual mount.

    Cameras whose orientation is given in the job are not reported.
    """
    by_camera = {mount.camera: mount for mount in priors}
    rolls_deg = {
        solved.camera: round(roll_deg(by_camera[solved.camera], solved), 1)
        for solved in calibration.mounts
        if has_unknown_roll(by_camera[solved.camera])
    }
    inverted = {name: roll for name, roll in rolls_deg.items() if abs(roll) > _MIN_INVERTED_ROLL_DEG}
    if not inverted:
        return None
    says = describe_inverted_cameras(inverted, len(calibration.mounts))
    return InvertedCamerasReport(rolls_deg=inverted, says=says)


def _scale_report(calibration: BodyCalibration) -> ScaleReport:
    scale = calibration.scale
    chi2, freedom = chi_square(scale.sources)
    return ScaleReport(
        source=" and ".join(source.name for source in scale.sources if source.used),
        metres_per_map_unit=scale.metres_per_unit,
        relative_sigma=round(scale.sigma_log, 5),
        sources=_source_reports(scale.sources, scale.metres_per_unit),
        chi2=round(chi2, 3),
        degrees_of_freedom=freedom,
        body_alone=BodyScaleReport(
            metres_per_map_unit=calibration.bones_alone.scale,
            relative_sigma=round(calibration.bones_alone.sigma_log, 5),
            costs=tuple((tried, round(cost, 4)) for tried, cost in calibration.bones_alone.costs),
        ),
        trunk_over_floor_m=calibration.height_over_floor_m,
        known_to=describe_scale(calibration),
    )


def _source_reports(sources: Sequence[ScaleSource], scale: float) -> tuple[ScaleSourceReport, ...]:
    return tuple(
        ScaleSourceReport(
            name=source.name,
            metres_per_map_unit=source.scale,
            relative_sigma=round(source.sigma_log, 5),
            off=round(float(np.log(source.scale / scale)), 5),
            used=source.used,
        )
        for source in sources
    )


def _vertical_report(
    priors: Collection[Mount], calibration: BodyCalibration, tracks: Sequence[CameraTrack]
) -> VerticalReport:
    up = calibration.vertical
    mounts = {mount.camera: mount for mount in priors}
    reference = tracks[0].camera
    is_shown = not has_unknown_roll(mounts[reference]) or bool(hanging_tracks(mounts, tracks))
    return VerticalReport(
        source=up.source,
        sigma_deg=round(up.sigma_deg, 2),
        body_off_deg=None if up.body_off_deg is None else round(up.body_off_deg, 3),
        plane_points_share=round(up.share, 3),
        others=tuple(
            OtherVerticalReport(
                name=other.source,
                off_deg=round(angle_deg(other.up, up.up), 2),
                sigma_deg=round(other.sigma_deg, 2),
                less_likely_nats=round(other.negative_log_likelihood - up.negative_log_likelihood, 2),
            )
            for other in up.alternatives
        ),
        known_to=describe_vertical(up, "" if is_shown else describe_unknown_way_up(reference)),
    )


def _span_report(span_ns: tuple[int, int], start_ns: int) -> SpanReport:
    first, last = (round(1e-9 * (time - start_ns), 3) for time in span_ns)
    return SpanReport(from_s=first, to_s=last)


def _mount_report(prior: Mount, solved: Mount, calibration: BodyCalibration) -> MountReport:
    rotation = prior.joint_from_cam[:3, :3].T @ solved.joint_from_cam[:3, :3]
    shift = solved.joint_from_cam[:3, 3] - prior.joint_from_cam[:3, 3]
    search = next((each for each in calibration.rolls if each.camera == solved.camera), None)
    is_reference = solved.camera == calibration.reference_prior.camera
    rolled = (
        calibration.reference_prior if is_reference else with_roll(prior, search.chosen_deg if search else 0)
    )
    from_usual = rolled.joint_from_cam[:3, :3].T @ solved.joint_from_cam[:3, :3]
    runner_up = None if search is None else search.runner_up()
    return MountReport(
        role=solved.role,
        roll_deg=None if search is None else search.chosen_deg,
        roll_runner_up=None
        if runner_up is None
        else RunnerUpRollReport(roll_deg=runner_up[0], half_squared_sigmas_more=round(runner_up[1], 2)),
        joint_from_cam=tuple(tuple(row) for row in solved.joint_from_cam.tolist()),
        sigma_deg=round(float(np.degrees(solved.sigma_rad)), 3),
        sigma_m=round(solved.sigma_m, 5),
        from_prior_deg=round(float(np.degrees(rotation_angle_rad(rotation))), 3),
        from_prior_m=round(float(np.linalg.norm(shift)), 5),
        from_usual_deg=round(float(np.degrees(rotation_angle_rad(from_usual))), 3)
        if has_unknown_roll(prior)
        else None,
        known_to=describe_mount(solved, t_pose=calibration.t_pose_ns is not None),
    )


def _slips_report(mounts: Sequence[Mount], start_ns: int) -> SlippedMountsReport | None:
    slips = {
        mount.camera: _slip_report(mount, mount.slip, start_ns) for mount in mounts if mount.slip is not None
    }
    return SlippedMountsReport(cameras=slips, says=describe_slips(slips)) if slips else None


def _slip_report(mount: Mount, slip: MountSlip, start_ns: int) -> MountSlipReport:
    step = slip.before_from_after
    return MountSlipReport(
        at_s=round(1e-9 * (slip.time_ns - start_ns), 3),
        turned_deg=round(float(np.degrees(rotation_angle_rad(step[:3, :3]))), 3),
        moved_m=round(float(np.linalg.norm(step[:3, 3])), 5),
        sigma_deg=round(float(np.degrees(slip.sigma_rad)), 3),
        sigma_m=round(slip.sigma_m, 5),
        joint_from_cam=tuple(tuple(row) for row in (mount.joint_from_cam @ step).tolist()),
    )


def _activity_report(activity: Activity, violations_m: Mapping[str, FloatArray]) -> ActivityReport:
    return ActivityReport(
        name=activity,
        rules_active={name: float((violation > 0.0).mean()) for name, violation in violations_m.items()},
        rules_pressed_m={
            name: _percentiles(violation[violation > 0.0])
            for name, violation in violations_m.items()
            if (violation > 0.0).any()
        },
    )


def _percentiles_by_name(values: Mapping[str, FloatArray]) -> dict[str, Percentiles]:
    return {name: _percentiles(each) for name, each in values.items()}


def _percentiles(values: FloatArray) -> Percentiles:
    p50, p95 = (round(float(np.percentile(values, q)), 5) for q in (50, 95))
    return Percentiles(p50=p50, p95=p95)


def longest_gap_s(track: CameraTrack, start_ns: int, end_ns: int) -> float:
    """Return the longest time without poses of a camera.

    The times before the first pose and after the last pose are included.

    Args:
        track: Track of the camera.
        start_ns: Common time of the first tick.
        end_ns: Common time of the last tick.

    Returns:
        The longest time without poses, seconds.
    """
    times = np.concatenate([[start_ns], np.clip(track.times_ns, start_ns, end_ns), [end_ns]])
    return round(float(np.diff(times).max()) * 1e-9, 4)
