"""The fill stage: compute the pose of every joint that no camera measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.fill.contacts import STAND, Contacts, find_contacts
from bodycap_batch.fill.foot_paths import REACH_SHARE, foot_path, kept_steps, reachable_steps
from bodycap_batch.fill.foot_places import place_feet
from bodycap_batch.fill.head import head_rotations
from bodycap_batch.fill.leg_geometry import LegGeometry, leg_geometry
from bodycap_batch.fill.leg_poses import pose_leg
from bodycap_batch.fill.lying import lay_legs
from bodycap_batch.fill.pelvis import following_pelvis, pelvis_rotation, reaching_pelvis, reclined_share
from bodycap_batch.fill.standing_height import HeightSigmas, StandingHeight, raised_pelvis, standing_height
from bodycap_batch.fill.trunk_signals import TrunkSignals, trunk_signals
from bodycap_batch.model.fill_data import SIDES, FillMode, FillReport, FillResult, Footsteps
from bodycap_batch.model.skeleton import Motion, SkeletonModel, bend_spine, local_rotations, pose_joint
from bodycap_batch.model.skeleton_presets import split_side

_PROGRESS_STEPS = 4
"""Number of steps that the progress counts."""

_LOW_SHARE = 0.6
"""Height of the hips over the floor, as a share of the length of the leg, below which the person may kneel,
sit on the floor or lie. Derivation: on a chair the hips are at 0.6 to 0.7, on the knees at 0.5."""
_MAX_MISS_M = 0.004
"""Distance (metres) between the ankle and its wanted place beyond which a foot does not count as standing.
Derivation: with it, the sole is within 1 cm of the floor."""


def fill_motion(
    motion: Motion,
    solved: BoolArray,
    *,
    heights: HeightSigmas,
    mode: FillMode,
    context: StageContext,
) -> FillResult:
    """Return the motion with plausible poses of the joints that no camera measured.

    Measured joints keep their poses in the world. The pelvis, the legs, the neck and the head are each filled
    only if none of their joints is measured.

    Args:
        motion: The motion from merging, with J joints at T ticks. The floor is at z = 0.
        solved: (J,) True for a measured joint.
        heights: How exactly the heights of floor and pelvis are known.
        mode: How unmeasured joints are posed.
        context: Context of the stage.
    """
    nothing = _empty_report(motion, mode)
    if mode != "plausible" or not solved.any() or len(motion.root_in_world_m) == 0:
        return FillResult(motion=motion, report=nothing)
    skeleton = motion.skeleton
    first = int(np.argmax(solved))
    hands = _hands(skeleton, solved)
    legs = _unmeasured_legs(skeleton, solved)
    floor = StandingHeight(0.0, 0.0, 0.0)
    if legs is not None:
        motion, floor = _upright(motion, first, hands, legs, heights)
    skeleton = motion.skeleton
    world, filled = motion.world_from_joint(), np.zeros(len(solved), dtype=bool)
    signals = trunk_signals(motion, first, hands)
    standing_m = None if legs is None else _standing_m(legs) + floor.floor_m
    contacts = find_contacts(signals, standing_m)
    context.check_cancelled()
    context.progress(1, _PROGRESS_STEPS, "steps")
    steps = nothing.footsteps if legs is None else place_feet(contacts, signals, legs, floor.floor_m)
    context.progress(2, _PROGRESS_STEPS, "pelvis")
    reclined = np.zeros(len(world))
    if is_on(Mechanism.LYING) and legs is not None and split_side(skeleton.roles[first])[0] == "":
        reclined = reclined_share(world[:, first], floor.floor_m, legs[0].length_m)
    if first != 0:
        pelvis = pelvis_rotation(signals, contacts, steps, legs is not None)
        pelvis = following_pelvis(pelvis, world[:, first, :3, :3], reclined)
        if legs is not None:
            pelvis = _within_reach(skeleton, first, pelvis, world, (legs, steps, signals))
        bend_spine(skeleton, first, world[:, first, :3, :3], pelvis, world)
        filled[skeleton.path_to_root(first)[1:]] = True
    missed = np.ones_like(contacts.standing)
    if legs is not None:
        steps, missed = _fill_legs(skeleton, legs, steps, signals, world, filled)
        if reclined.any():
            record_act(Mechanism.LYING, int((reclined > 0.0).sum()))
            missed |= (reclined > 0.0)[:, None]
            steps = kept_steps(steps, missed)
            for leg in legs:
                lay_legs(skeleton, leg, reclined, floor.floor_m, world)
    context.check_cancelled()
    context.progress(3, _PROGRESS_STEPS, "head")
    _fill_head(skeleton, solved, (signals, reclined), world, filled)
    _follow_parents(skeleton, solved, filled, motion.local_rotation, world)
    local = local_rotations(skeleton, world[..., :3, :3])
    # A joint whose parent was not filled keeps its local rotation.
    kept = solved & ~filled[np.maximum(skeleton.parents, 0)]
    local[:, kept] = motion.local_rotation[:, kept]
    sure = nothing.is_sure
    if legs is not None:
        known = _trunk_is_seen(motion, solved) & ~_low_hips(world, legs, floor) & (reclined == 0.0)
        sure = _sure(steps, contacts, known)
    context.progress(_PROGRESS_STEPS, _PROGRESS_STEPS, "filled")
    return FillResult(
        motion=replace(motion, root_in_world_m=world[:, 0, :3, 3], local_rotation=local),
        report=replace(
            nothing,
            filled=filled,
            standing=_standing(steps, missed),
            is_sure=sure,
            footsteps=steps,
            floor_m=floor.floor_m,
            floor_sigma_m=floor.floor_sigma_m,
            floor_source="measured" if np.isfinite(heights.floor_m) else "legs",
        ),
    )


def _empty_report(motion: Motion, mode: FillMode) -> FillReport:
    ticks, joints = motion.observed.shape
    return FillReport(
        mode=mode,
        filled=np.zeros(joints, dtype=bool),
        standing=np.zeros((ticks, len(SIDES)), dtype=bool),
        is_sure=np.zeros(ticks, dtype=bool),
        footsteps=Footsteps(
            side=np.zeros(0, dtype=np.int64),
            start_tick=np.zeros(0, dtype=np.int64),
            end_tick=np.zeros(0, dtype=np.int64),
            ankle_in_world_m=np.zeros((0, 3)),
            heading_rad=np.zeros(0),
            is_sure=np.zeros(0, dtype=bool),
        ),
        floor_m=0.0,
        floor_sigma_m=0.0,
        floor_source="measured",
    )


def _unmeasured_legs(skeleton: SkeletonModel, solved: BoolArray) -> tuple[LegGeometry, LegGeometry] | None:
    """Return both legs; None if the skeleton has none, or if a joint of the legs was measured."""
    legs = leg_geometry(skeleton)
    if legs is not None and any(solved[[leg.hip, leg.knee, leg.ankle]].any() for leg in legs):
        return None
    return legs


def _standing_m(legs: tuple[LegGeometry, LegGeometry]) -> float:
    """Return the height (metres) of the hips over the floor on straight legs."""
    return min(leg.length_m + leg.ankle_height_m for leg in legs)


def _upright(
    motion: Motion,
    first: int,
    hands: tuple[int | None, int | None],
    legs: tuple[LegGeometry, LegGeometry],
    heights: HeightSigmas,
) -> tuple[Motion, StandingHeight]:
    """Return the motion and the heights with which the standing legs are nearly straight."""
    signals = trunk_signals(motion, first, hands)
    contacts = find_contacts(signals)
    floor_m = 0.0
    if np.isinf(heights.floor_m):
        floor_m = float(np.median(signals.hips_m[:, 2])) - _standing_m(legs)
    steps = place_feet(contacts, signals, legs, floor_m)
    if first == 0:
        heights = replace(heights, pelvis_m=0.0)
    found = standing_height(steps, motion.world_from_joint(), contacts, legs, heights, floor_m)
    return (raised_pelvis(motion, first, found.pelvis_m) if found.pelvis_m else motion), found


def _hands(skeleton: SkeletonModel, solved: BoolArray) -> tuple[int | None, int | None]:
    """Return the measured joint of each arm that is farthest from the trunk."""
    found: list[int | None] = []
    for side in SIDES:
        joints = [skeleton.index_of_role(side + part) for part in ("Hand", "ForeArm")]
        measured = [joint for joint in joints if joint is not None and solved[joint]]
        found.append(measured[0] if measured else None)
    return found[0], found[1]


def _within_reach(
    skeleton: SkeletonModel,
    first: int,
    pelvis: FloatArray,
    world: FloatArray,
    feet: tuple[tuple[LegGeometry, LegGeometry], Footsteps, TrunkSignals],
) -> FloatArray:
    """Return the pelvis (T,3,3), turned so that the legs reach the feet where a small turn suffices."""
    legs, steps, signals = feet

    def hips_of(rotation: FloatArray) -> FloatArray:
        poses = world.copy()
        bend_spine(skeleton, first, world[:, first, :3, :3], rotation, poses)
        for leg in legs:
            for joint in leg.chain:
                pose_joint(skeleton, joint, poses)
        return np.stack([poses[:, leg.hip, :3, 3] for leg in legs], axis=1)

    paths = [
        foot_path(steps, side, leg, None, signals.velocity_m_per_s, signals.fps)
        for side, leg in enumerate(legs)
    ]
    if paths[0] is None or paths[1] is None:
        return pelvis
    ankles = np.stack([path.ankle_m for path in paths if path is not None], axis=1)
    limits = np.array([REACH_SHARE * leg.length_m for leg in legs])
    return reaching_pelvis(pelvis, hips_of, ankles, limits, signals.fps)


def _fill_legs(
    skeleton: SkeletonModel,
    legs: tuple[LegGeometry, LegGeometry],
    steps: Footsteps,
    signals: TrunkSignals,
    world: FloatArray,
    filled: BoolArray,
) -> tuple[Footsteps, BoolArray]:
    """Write the poses of both legs.

    Returns:
        The steps that the legs can reach, and (T,2) True where a foot is not at its wanted place.
    """
    missed = np.zeros((len(world), len(legs)), dtype=bool)
    for leg in legs:
        for joint in leg.chain:
            pose_joint(skeleton, joint, world)
    hips = np.stack([world[:, leg.hip, :3, 3] for leg in legs], axis=1)
    steps = reachable_steps(steps, legs, hips, signals.fps)
    for side, leg in enumerate(legs):
        hip = world[:, leg.hip, :3, 3]
        path = foot_path(steps, side, leg, hip, signals.velocity_m_per_s, signals.fps)
        if path is None:
            continue
        pose = pose_leg(leg, hip, path, world[:, 0, :3, :3])
        world[:, leg.hip, :3, :3] = pose.thigh
        _place_below(skeleton, leg.hip, leg.knee, world)
        world[:, leg.knee, :3, :3] = pose.shin
        _place_below(skeleton, leg.knee, leg.ankle, world)
        world[:, leg.ankle, :3, :3] = pose.foot
        filled[[*leg.chain, leg.knee, leg.ankle, *leg.below]] = True
        for joint in leg.below:
            pose_joint(skeleton, joint, world)
            if joint == leg.toe:
                world[:, joint, :3, :3] = pose.toe
        missed[:, side] = np.linalg.norm(world[:, leg.ankle, :3, 3] - path.ankle_m, axis=1) > _MAX_MISS_M
    return kept_steps(steps, missed), missed


def _fill_head(
    skeleton: SkeletonModel,
    solved: BoolArray,
    trunk: tuple[TrunkSignals, FloatArray],
    world: FloatArray,
    filled: BoolArray,
) -> None:
    """Write the poses of neck and head if neither is measured.

    `trunk` holds the signals of the trunk, and (T,) 1 where the person lies.
    """
    neck, head = skeleton.index_of_role("Neck"), skeleton.index_of_role("Head")
    if head is None or solved[head] or (neck is not None and solved[neck]):
        return
    start = skeleton.parents[head] if neck is None else skeleton.parents[neck]
    rotations = head_rotations(trunk[0], world[:, start, :3, :3], trunk[1])
    for joint, rotation in ((neck, rotations[0]), (head, rotations[1])):
        if joint is not None:
            pose_joint(skeleton, joint, world)
            world[:, joint, :3, :3] = rotation
            filled[joint] = True


def _place_below(skeleton: SkeletonModel, upper: int, lower: int, world: FloatArray) -> None:
    """Write the pose of each joint between two joints, the lower one included, without rotation."""
    path = skeleton.path_to_root(lower)
    for joint in reversed(path[: path.index(upper)]):
        pose_joint(skeleton, joint, world)


def _follow_parents(
    skeleton: SkeletonModel, solved: BoolArray, filled: BoolArray, local: FloatArray, world: FloatArray
) -> None:
    """Write the poses of all other joints: they keep their rotation relative to the parent."""
    for joint in range(1, len(solved)):
        if not solved[joint] and not filled[joint]:
            pose_joint(skeleton, joint, world, local[:, joint])


def _standing(steps: Footsteps, missed: BoolArray) -> BoolArray:
    """Return (T,2) True while the left or right foot stands and is at its wanted place."""
    out = np.zeros_like(missed)
    for side, start, end in zip(steps.side, steps.start_tick, steps.end_tick, strict=True):
        out[start:end, side] = True
    return out & ~missed


def _trunk_is_seen(motion: Motion, solved: BoolArray) -> BoolArray:
    """Return (T,) True if cameras measured the trunk at the tick.

    Where no camera is on the trunk at all, it follows from the limbs and counts as seen.
    """
    trunk = np.array([split_side(role)[0] == "" for role in motion.skeleton.roles]) & solved
    seen = motion.observed[:, trunk].any(axis=1)
    return np.asarray(seen if seen.any() else np.ones_like(seen))


def _low_hips(world: FloatArray, legs: tuple[LegGeometry, LegGeometry], floor: StandingHeight) -> BoolArray:
    """Return (T,) True if the hips are so low that the person may kneel, sit on the floor or lie."""
    height = 0.5 * (world[:, legs[0].hip, 2, 3] + world[:, legs[1].hip, 2, 3]) - floor.floor_m
    return np.asarray(height < _LOW_SHARE * 0.5 * (legs[0].length_m + legs[1].length_m))


def _sure(steps: Footsteps, contacts: Contacts, known: BoolArray) -> BoolArray:
    """Return (T,) False where it is unknown what the feet do.

    Args:
        steps: Where and when the feet stand.
        contacts: Which feet stand.
        known: (T,) False if the trunk is not measured, or too low for standing feet.
    """
    out = contacts.is_sure & known
    for start, end, sure in zip(steps.start_tick, steps.end_tick, steps.is_sure, strict=True):
        if not sure:
            out[start:end] &= contacts.state[start:end] != STAND
    return out
