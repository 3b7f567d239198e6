"""Alignment of maps that share no view, through the body that wore their cameras.

The centre of a joint is one point of both segments that meet there, even if the segments' cameras are in
different maps. The calibration of the body can therefore estimate the similarity of each further map to the
main map. Initial values come from the rest pose and from the path of the body. All cameras share this path
once the swing of the limbs is averaged out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import Bone, kinematic_chain
from bodycap_batch.merging.body_calibration.calibrate_body import (
    map_points_of,
    reference_camera_roll,
    with_rolls,
)
from bodycap_batch.merging.body_calibration.calibration_covariance import PoseSigma
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.body_calibration.stated_constraints import (
    StatedConstraints,
    stated_constraints,
)
from bodycap_batch.merging.cameras.track import CameraTrack, make_track, transform_track, transform_trajectory
from bodycap_batch.merging.cameras.track_outliers import remove_outliers
from bodycap_batch.merging.map_alignment.initial_alignment import (
    InitialAlignment,
    align_maps_initially,
    require_common_time,
)
from bodycap_batch.merging.map_alignment.similarity_refinement import MapAlignmentProblem
from bodycap_batch.merging.map_alignment.walked_floor import MAX_SAMPLES, scale_from_walked_floor
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

MAX_SIGMA_M = 0.06
"""Maximum sigma (metres per axis) of the positions of a further map's cameras. A map with a larger sigma is
not used. Evidence: none."""
_REACH_SIGMA = 0.05
"""Sigma of the logarithm of the scale that follows from the limbs' reach. The sigma allows for the elbows of
a walking person, which keep 15 to 30 degrees of flexion. The limbs' reach is used as a source of the scale,
because in separate maps, errors of mounts can compensate errors of the scale."""
_SEPARATE_MAPS_SIGMA = 0.15
"""Sigma of the logarithm of the scale that follows from the limbs' reach. It is used instead of
`_REACH_SIGMA` if no map contains both a camera on the trunk and a camera at the end of a limb. Half of an arm
then determines the scale, and the error of a mount is about a tenth of this length. Evidence:
docs/decisions/merging.md."""
_UNOBSERVABLE_SIGMA = 0.4
"""Sigma of the logarithm of the scale that follows from the limbs' reach. It is used instead of
`_REACH_SIGMA` and `_SEPARATE_MAPS_SIGMA` if only the limbs' reach, or two cameras near each other, determine
the scale. Evidence: docs/decisions/merging.md."""
_MAX_STRAIN = 2.0
"""Maximum difference, in sigmas, between the log scale from the limbs' reach and the solved log scale. With a
larger difference, the alignment is rejected. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedMap:
    """The alignment of a further map with the main map.

    Attributes:
        gauge: Gauge of the further map.
        main_from_gauge: Similarity from the further map to the main map.
        sigma: Sigmas of the map's rotation, and of the positions of the map's cameras.
        reason: Reason why the map is not used; None if it is used.
    """

    gauge: str
    main_from_gauge: Similarity
    sigma: PoseSigma
    reason: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class UsableCameras:
    """The cameras that can be used together.

    Attributes:
        trajectories: Trajectories in the gauge of the main map, the trajectory of the trunk's camera first.
        main_from_gauge: By gauge of each used map, the similarity to the main map.
        sigmas: By camera of a further map, the sigmas of the map's alignment.
        unused: By name of each unused camera, the reason why it is not used.
    """

    trajectories: tuple[Trajectory, ...]
    main_from_gauge: Mapping[str, Similarity]
    sigmas: Mapping[str, PoseSigma]
    unused: Mapping[str, str]


def align_cameras(
    inputs: MergeInputs,
    main: Sequence[Trajectory],
    further: Sequence[Trajectory],
    step: Callable[[], None],
    options: MergeOptions | None = None,
) -> UsableCameras:
    """Transform the cameras of further maps into the main map, if the body determines the maps' similarities.

    Args:
        inputs: The inputs of the merge stage.
        main: Trajectories of the main map's cameras, the trajectory of the trunk's camera first.
        further: Trajectories of the cameras of other maps.
        step: Function that is called after each iteration. It may raise an exception to stop the work.
        options: Options of the merge stage. Only ``known_distance`` and ``marker_board`` are used.

    Returns:
        The cameras of the main map and of the aligned maps, and the reasons why other cameras are not used.
    """
    bones = kinematic_chain(
        inputs.skeleton, {inputs.mount_of(each.camera).role for each in (*main, *further)}
    )
    index = {bone.role: position for position, bone in enumerate(bones)}
    tracks: dict[str, list[CameraTrack]] = {}
    for each in (*main, *further):
        track = make_track(inputs, each, index[inputs.mount_of(each.camera).role])
        tracks.setdefault(each.gauge, []).append(track)
    found, failed = _align_all(inputs, options or MergeOptions(), bones, tracks, step)
    failed |= {item.gauge: item.reason for item in found if item.reason is not None}
    aligned = {item.gauge: item for item in found if item.reason is None}
    transformed = [
        transform_trajectory(each, aligned[each.gauge].main_from_gauge, main[0].gauge)
        for each in further
        if each.gauge in aligned
    ]
    return UsableCameras(
        trajectories=(*main, *transformed),
        main_from_gauge={
            main[0].gauge: Similarity(1.0, np.eye(3), np.zeros(3)),
            **{gauge: item.main_from_gauge for gauge, item in aligned.items()},
        },
        sigmas={track.camera: item.sigma for gauge, item in aligned.items() for track in tracks[gauge]},
        unused={
            track.camera: f"the map of this camera ({gauge}) has no place in common with the map of "
            f"{main[0].camera} ({main[0].gauge}), and the body's movement could not align the two maps: {why}"
            for gauge, why in failed.items()
            for track in tracks[gauge]
        },
    )


def _align_all(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    tracks: Mapping[str, Sequence[CameraTrack]],
    step: Callable[[], None],
) -> tuple[tuple[AlignedMap, ...], dict[str, str]]:
    """Align all further maps together. If this fails, align each further map separately.

    Args:
        inputs: The inputs of the merge stage.
        options: Options of the merge stage. Only ``known_distance`` and ``marker_board`` are used.
        bones: The graph's bones, for all cameras.
        tracks: By gauge, the tracks of each map. The main map is first, with the trunk's camera first.
        step: Function that is called after each iteration. It may raise an exception to stop the work.

    Returns:
        The aligned maps. Also, by gauge of each map that could not be aligned, the reason.
    """
    (main, (trunk, *_)), *others = tracks.items()
    failed: dict[str, str] = {}
    for gauge, group in others:
        try:
            require_common_time(trunk, group)
        except EstimationError as error:
            failed[gauge] = error.message
    rest = {gauge: group for gauge, group in others if gauge not in failed}
    if not rest:
        return (), failed
    try:
        return align_maps(inputs, options, bones, {main: tracks[main], **rest}, step), failed
    except EstimationError as error:
        if len(rest) == 1:
            return (), {**failed, **dict.fromkeys(rest, error.message)}
    # A single map that does not fit the body makes the alignment of all maps fail. Each map is therefore
    # aligned separately.
    found: tuple[AlignedMap, ...] = ()
    for gauge, group in rest.items():
        try:
            found += align_maps(inputs, options, bones, {main: tracks[main], gauge: group}, step)
        except EstimationError as error:
            failed[gauge] = error.message
    return found, failed


def _initialise(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    main: Sequence[CameraTrack],
    others: Sequence[tuple[str, Sequence[CameraTrack]]],
    stated: StatedConstraints,
) -> tuple[MergeInputs, InitialAlignment, Vertical | None]:
    """Estimate the roll of the trunk's camera and the initial alignment.

    Returns:
        The inputs with the mount prior of the trunk's camera rotated by this roll, the initial similarities
        and scale, and the vertical in the main map; None if it is unknown.
    """
    alignment = align_maps_initially(bones, main, others, {mount.camera: mount for mount in inputs.mounts})
    own = _without_outliers(inputs, main, alignment.metres_per_unit)
    roll, up = reference_camera_roll(inputs, bones, own, alignment.metres_per_unit, stated.verticals)
    if roll:
        inputs = with_rolls(inputs, {main[0].camera: roll})
        mounts = {mount.camera: mount for mount in inputs.mounts}
        alignment = align_maps_initially(bones, main, others, mounts)
    return inputs, alignment, up


def _without_outliers(inputs: MergeInputs, tracks: Sequence[CameraTrack], scale: float) -> list[CameraTrack]:
    return [remove_outliers(each, scale, inputs.clocks[each.camera].nominal_fps) for each in tracks]


def align_maps(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    tracks: Mapping[str, Sequence[CameraTrack]],
    step: Callable[[], None],
) -> tuple[AlignedMap, ...]:
    """Estimate the similarities of further maps to the main map.

    Args:
        inputs: The inputs of the merge stage.
        options: Options of the merge stage. Only ``known_distance`` and ``marker_board`` are used.
        bones: The graph's bones, for all cameras.
        tracks: By gauge, the tracks of each map. The main map is first, with the trunk's camera first.
        step: Function that is called after each iteration. It may raise an exception to stop the work.

    Returns:
        One alignment per further map. A map whose alignment is too uncertain has a `reason`.

    Raises:
        EstimationError: The cameras' distances or movements are impossible for a person, or too few frames of
            different cameras were localised at the same time.
    """
    (main_gauge, main), *others = tracks.items()
    # A distance or a board in another map causes an error here. After all maps are aligned, the calibration
    # uses both again and reports the remaining errors.
    own_map = {main_gauge: Similarity(1.0, np.eye(3), np.zeros(3))}
    stated = stated_constraints(inputs, options, own_map, skip_unusable=True)
    inputs, alignment, up = _initialise(inputs, bones, main, others, stated)
    mounts = {mount.camera: mount for mount in inputs.mounts}
    initial, provisional = alignment.main_from_gauge, alignment.metres_per_unit
    together = [
        *main,
        *(transform_track(track, initial[gauge]) for gauge, group in others for track in group),
    ]
    together = _without_outliers(inputs, together, provisional)
    samples = take_samples(together, provisional, MAX_SAMPLES, None if up is None else up.up)
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, provisional, step)
    cameras = [tuple(track.camera for track in group) for _, group in others]
    observable_sigma = _REACH_SIGMA if alignment.one_map_spans_a_limb else _SEPARATE_MAPS_SIGMA
    reach_sigma = observable_sigma if alignment.scale_observable else _UNOBSERVABLE_SIGMA
    problem = MapAlignmentProblem(
        calibration, cameras, provisional, reach_sigma=reach_sigma, stated=stated.scales
    )
    problem.solve()
    # A scale that the job gives may contradict the limbs' reach. Only other scales must agree with the reach.
    if not stated.scales:
        strain = abs(problem.scale_residual())
        if strain > _MAX_STRAIN:
            raise EstimationError(
                "the scale from the length of the limbs and the scale from the movement of the cameras "
                f"differ by {100 * strain * reach_sigma:.0f} %",
                hint="record a longer walk with turns",
            )
        points = map_points_of(inputs, together[0].camera)
        floor = scale_from_walked_floor(inputs, together[0], up, problem.scale(), points)
        problem.add_scale_sources(() if floor is None else (floor,))
    out = []
    for index, (gauge, _) in enumerate(others):
        sigma = problem.sigmas(index)
        why = None
        if not sigma.position_m <= MAX_SIGMA_M:
            why = (
                f"the uncertainty of the aligned camera positions is {100 * sigma.position_m:.0f} cm (1 "
                "sigma), which is too large. To reduce this, bend forward and sideways, turn while "
                "walking, wear a camera on an upper arm, film one place with cameras of both maps, or "
                "give a known distance or a marker board"
            )
        out.append(
            AlignedMap(
                gauge=gauge,
                main_from_gauge=problem.corrections[index].after(initial[gauge]),
                sigma=sigma,
                reason=why,
            )
        )
    return tuple(out)
