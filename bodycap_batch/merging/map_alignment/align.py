"""Maps that share no view: the body whose cameras made them puts them into one.

A joint's centre is the same point of both segments that meet there, whichever map each segment's camera is
in; so the body's own calibration, with a similarity per further map among its unknowns, places the maps. It
starts from the walk, which all cameras share once their swinging is averaged out, and from the body at ease.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import Bone, kinematic_chain
from bodycap_batch.merging.body_calibration.calibrate_body import (
    map_points_of,
    reference_camera_roll,
    with_rolls,
)
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.cameras.track import (
    CameraTrack,
    make_track,
    remove_outliers,
    transform_track,
    transform_trajectory,
)
from bodycap_batch.merging.map_alignment.gauss_newton import MapAlignmentProblem
from bodycap_batch.merging.map_alignment.initial_alignment import (
    InitialAlignment,
    align_maps_initially,
    require_common_time,
)
from bodycap_batch.merging.map_alignment.scale_sources import (
    StatedConstraints,
    scale_from_walked_floor,
    stated_constraints,
)
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

MAX_SIGMA_M = 0.06
"""A map whose cameras are known less well than this, per axis, is not placed."""
_MAX_SAMPLES = 240
_REACH_SIGMA = 0.05
"""Of the log of the scale that the limbs' reach gives: walking elbows keep 15 to 30 degrees of flexion. With
maps of their own, mounts and scale can make up for each other."""
_SEPARATE_MAPS_SIGMA = 0.15
"""The same where no map holds the trunk and a limb's end: mounts are off by a tenth of half an arm. On 12
walks with cameras on upper arms and palms it was 0 to 27 % too small, 12 % in the mean square."""
_UNOBSERVABLE_SIGMA = 0.4
"""The same where nothing tells it but that, or two cameras that sit close together: palms alone gave 0.69
and 0.72 of the true scale, and lay 20 to 30 cm too low at 5 cm stated."""
_MAX_STRAIN = 2.0
"""Sigmas between that scale and the solved one above which the body does not tell where the maps lie."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedMap:
    """A further map's place.

    Attributes:
        gauge: The map.
        cameras: Its cameras.
        main_from_gauge: Where it lies in the main map.
        sigma_rad: How well its rotation is known there, per axis.
        sigma_m: How well its cameras' positions are, per axis.
        reason: Why it is not used; None where it is.
    """

    gauge: str
    cameras: tuple[str, ...]
    main_from_gauge: Similarity
    sigma_rad: float
    sigma_m: float
    reason: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class UsableCameras:
    """The cameras that can be used together.

    Attributes:
        trajectories: In the main map's gauge, the trunk's first.
        places: By gauge, where each used map lies in the main one.
        sigmas: By camera of a further map, how well its place is known: rotation (rad), position (m).
        unused: By camera, why it is left out.
    """

    trajectories: tuple[Trajectory, ...]
    main_from_gauge: Mapping[str, Similarity]
    sigmas: Mapping[str, tuple[float, float]]
    unused: Mapping[str, str]

    def report(self) -> dict[str, Any]:
        """Plain JSON values: how well each joined camera is placed."""
        return {
            camera: {"sigma_deg": round(float(np.degrees(turn)), 3), "sigma_m": round(shift, 5)}
            for camera, (turn, shift) in self.sigmas.items()
        }


def align_cameras(
    inputs: MergeInputs,
    main: Sequence[Trajectory],
    further: Sequence[Trajectory],
    step: Callable[[], None],
    options: MergeOptions | None = None,
) -> UsableCameras:
    """Bring the cameras of further maps into the main one, as far as the body tells where they are.

    Args:
        inputs: Skeleton, mounts and clocks.
        main: The main map's cameras, the trunk's first.
        further: Cameras of other maps.
        step: Called after each iteration; may raise to stop.
        options: What the job states of the scale.
    """
    here = Similarity(1.0, np.eye(3), np.zeros(3))
    if not further:
        return UsableCameras(
            trajectories=tuple(main), main_from_gauge={main[0].gauge: here}, sigmas={}, unused={}
        )
    bones = kinematic_chain(
        inputs.skeleton, {inputs.mount_of(each.camera).role for each in (*main, *further)}
    )
    index = {bone.role: place for place, bone in enumerate(bones)}
    tracks: dict[str, list[CameraTrack]] = {}
    for each in (*main, *further):
        track = make_track(inputs, each, index[inputs.mount_of(each.camera).role])
        tracks.setdefault(each.gauge, []).append(track)
    joined, unused = _align_all(inputs, options or MergeOptions(), bones, tracks, step)
    good = {item.gauge: item for item in joined if item.reason is None}
    moved_here = [
        transform_trajectory(each, good[each.gauge].main_from_gauge, main[0].gauge)
        for each in further
        if each.gauge in good
    ]
    return UsableCameras(
        trajectories=(*main, *moved_here),
        main_from_gauge={main[0].gauge: here} | {gauge: item.main_from_gauge for gauge, item in good.items()},
        sigmas={camera: (item.sigma_rad, item.sigma_m) for item in good.values() for camera in item.cameras},
        unused=unused
        | {
            camera: _exclusion_reason(item.gauge, (main[0].camera, main[0].gauge), item.reason)
            for item in joined
            if item.reason is not None
            for camera in item.cameras
        },
    )


def _align_all(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    tracks: dict[str, list[CameraTrack]],
    step: Callable[[], None],
) -> tuple[tuple[AlignedMap, ...], dict[str, str]]:
    """The further maps' places, and by camera why others were not even tried."""
    (main, (trunk, *_)), *others = tracks.items()
    unused: dict[str, str] = {}

    def leave(gauge: str, why: str) -> None:
        for track in tracks.pop(gauge):
            unused[track.camera] = _exclusion_reason(gauge, (trunk.camera, main), why)

    for gauge, group in others:
        try:
            require_common_time(trunk, group)
        except EstimationError as error:
            leave(gauge, error.message)
    if len(tracks) == 1:
        return (), unused
    try:
        return align_maps(inputs, options, bones, tracks, step), unused
    except EstimationError as error:
        if len(tracks) == 2:
            leave(next(name for name in tracks if name != main), error.message)
            return (), unused
    # One map that fits no body spoils all of the others' places: each on its own.
    found: tuple[AlignedMap, ...] = ()
    for gauge in [name for name in tracks if name != main]:
        try:
            found += align_maps(inputs, options, bones, {main: tracks[main], gauge: tracks[gauge]}, step)
        except EstimationError as error:
            leave(gauge, error.message)
    return found, unused


def _exclusion_reason(gauge: str, trunk: tuple[str, str], why: str) -> str:
    """Why a camera is left out whose map is not the trunk's (camera, gauge)."""
    return f"its map {gauge} shares no view with {trunk[0]}'s {trunk[1]}, and the body cannot place it: {why}"


def _initialise(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    main: Sequence[CameraTrack],
    others: Sequence[tuple[str, Sequence[CameraTrack]]],
    stated: StatedConstraints,
) -> tuple[MergeInputs, InitialAlignment, Vertical | None]:
    """The trunk's camera the way up it sits, where the maps start then, and the vertical if known."""
    start = align_maps_initially(bones, main, others, {mount.camera: mount for mount in inputs.mounts})
    own = _without_outliers(inputs, main, start.metres_per_unit)
    roll, up = reference_camera_roll(inputs, bones, own, start.metres_per_unit, stated.verticals)
    if roll:
        inputs = with_rolls(inputs, {main[0].camera: roll})
        start = align_maps_initially(bones, main, others, {mount.camera: mount for mount in inputs.mounts})
    return inputs, start, up


def _require_one_scale(strain: float, reach_sigma: float) -> None:
    if strain > _MAX_STRAIN:
        raise EstimationError(
            f"the limbs' reach and the way the cameras move disagree on the scale by "
            f"{100 * strain * reach_sigma:.0f} %",
            hint="a longer walk with turns tells more",
        )


def _without_outliers(inputs: MergeInputs, tracks: Sequence[CameraTrack], scale: float) -> list[CameraTrack]:
    return [remove_outliers(each, scale, inputs.clocks[each.camera].nominal_fps) for each in tracks]


def align_maps(
    inputs: MergeInputs,
    options: MergeOptions,
    bones: Sequence[Bone],
    tracks: Mapping[str, Sequence[CameraTrack]],
    step: Callable[[], None],
) -> tuple[AlignedMap, ...]:
    """Place further maps in the main one.

    Args:
        inputs: Skeleton and mounts.
        options: What the job states of the scale.
        bones: The graph's bones, those of all cameras.
        tracks: By gauge, its cameras' tracks; the main map's first, the trunk's camera first in it.
        step: Called after each iteration; may raise to stop.

    Raises:
        EstimationError: The cameras' distances or their movement fit no person, or they were hardly localised
            together.
    """
    (here, main), *others = tracks.items()
    stated = stated_constraints(inputs, options, here)
    inputs, start, up = _initialise(inputs, bones, main, others, stated)
    mounts = {mount.camera: mount for mount in inputs.mounts}
    starts, provisional = start.main_from_gauge, start.metres_per_unit
    together = [*main, *(transform_track(track, starts[gauge]) for gauge, group in others for track in group)]
    together = _without_outliers(inputs, together, provisional)
    samples = take_samples(together, provisional, _MAX_SAMPLES, None if up is None else up.up)
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, provisional, step)
    names = {gauge: tuple(track.camera for track in group) for gauge, group in others}
    known = _REACH_SIGMA if start.one_map_spans_a_limb else _SEPARATE_MAPS_SIGMA
    reach_sigma = known if start.scale_observable else _UNOBSERVABLE_SIGMA
    problem = MapAlignmentProblem(
        calibration, list(names.values()), provisional, reach_sigma=reach_sigma, stated=stated.scales
    )
    problem.solve()
    # Reach and movement may disagree on what the job states.
    if not stated.scales:
        _require_one_scale(abs(problem.scale_residual()), reach_sigma)
        points = map_points_of(inputs, together[0].camera)
        floor = scale_from_walked_floor(inputs, (together[0], up), problem.scale(), points)
        problem.add_scale_sources(() if floor is None else (floor,))
    out = []
    for index, (gauge, cameras) in enumerate(names.items()):
        sigma_rad, sigma_m = problem.sigmas(index)
        why = None
        if not sigma_m <= MAX_SIGMA_M:
            why = (
                f"the body tells it only to {100 * sigma_m:.0f} cm; bending forward and aside, turns in the "
                "walk, an upper arm's camera, a common view, a known distance or a marker board settle it"
            )
        out.append(
            AlignedMap(
                gauge=gauge,
                cameras=cameras,
                main_from_gauge=problem.corrections[index].after(starts[gauge]),
                sigma_rad=sigma_rad,
                sigma_m=sigma_m,
                reason=why,
            )
        )
    return tuple(out)
