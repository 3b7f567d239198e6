"""The fill stage on true bodies and true paths of a torso and two hands: errors of the filled legs.

``python -m tests.bench body``: no map and no merge. Each row is a recorded body whose legs are known. The
stage gets the true poses of trunk and arms and the body's own skeleton, as from a merge without error. With
``--errors``, the trunk has drawn errors of scale, floor and mount, as from a merge of real pictures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.export.layout.resampling import resample
from bodycap_batch.fill import fill_motion
from bodycap_batch.fill.leg_geometry import leg_geometry
from bodycap_batch.fill.standing_height import HeightSigmas
from bodycap_batch.fill.trunk_signals import low_pass
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.completion import complete_skeleton
from bodycap_batch.model.fill_data import SIDES, FillMode, FillReport
from bodycap_batch.model.geometry import interpolate_pose, nearest_rotation
from bodycap_batch.model.skeleton import Motion, SkeletonModel
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions
from bodycap_batch.synthetic.gait import WalkStyle
from bodycap_batch.synthetic.stance_walk import StanceWalk
from tests.bench.rows import DATA

MOUNTED = ("Spine1", "LeftHand", "RightHand")
CMU_UNIT_CM = 5.644
"""Centimetres per unit of length of a recording of the CMU Graphics Lab Motion Capture Database: 1/0.45
inch."""
FPS = 30.0
TUNED_ON = ("02_01",)
"""Recordings that constants of the stage may be chosen on. All others are only reported."""
DRAWN = range(8)
"""Seeds of the drawn walks."""
HEIGHTS = HeightSigmas(0.01, 0.08)
"""Sigmas (metres) of floor and pelvis as for a merge with a skeleton that is scaled from the stature."""
_ROLES = {
    "Hips": "root", "Spine1": "torso",
    **{f"{s}{part}": f"{s.lower()}_{name}" for s in SIDES for part, name in (
        ("Arm", "shoulder"), ("ForeArm", "elbow"), ("Hand", "palm"), ("UpLeg", "hip"), ("Leg", "knee"),
        ("Foot", "ankle"),
    )},
}  # fmt: skip
_STANCE_SPEED = 0.3
"""Speed (m/s) of an ankle below which the truth's foot stands, on a path smoothed over three frames."""
_STANCE_HEIGHT_M = 0.08
_STANCE_S = 0.1
_TRIM_S = 0.1
_STEP_TOLERANCE_S = 0.1
_MIN_SLOPE_M = 1.5
_SCALE_ERROR = 0.06
"""Largest drawn error of the metric scale, relative. Origin: merges of walks state a sigma of 4 to 5 %."""
_FLOOR_ERROR_M = 0.03
"""Largest drawn error (metres) of the height of the floor. Origin: the slab in which a floor is found."""
_MOUNT_ERROR_M = 0.03
"""Largest drawn error (metres) of the mount of the trunk's camera along each axis. Origin: merges of walks
state a sigma of 2 to 3 cm."""
_CROUCHED_DEG = 30.0
"""Flexion (degrees) of the straighter knee beyond which the person looks crouched."""
_JERK_HZ = 10.0
"""Cutoff frequency (Hz) of the knees before the third derivative."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """A recorded body: joints (T,3) by role in the world, and what a merge would give.

    `path_scale` is the scale of the merged path, as a ratio to that of the truth.
    """

    name: str
    joints: Mapping[str, FloatArray]
    merged: Motion
    solved: BoolArray
    path_scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Stance:
    """How straight a body stands and how smoothly its knees move.

    Attributes:
        crouched_share: Share of the time in which the straighter knee is bent by more than `_CROUCHED_DEG`.
        straightest_deg: Smallest flexion of a knee.
        peak_deg: Largest flexion of a knee.
        pelvis_share: Mean height of the hips over the floor, as a share of that on straight legs.
        knee_deg_per_s: Largest rate of a knee, from one tick to the next.
        knee_jerk: Root mean square of the third derivative of the knees below `_JERK_HZ`, degrees/s³.
    """

    crouched_share: float
    straightest_deg: float
    peak_deg: float
    pelvis_share: float
    knee_deg_per_s: float
    knee_jerk: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Errors of the filled legs, and the figures of the truth that they are compared with."""

    name: str
    frames: int
    ankle_m: float
    true_stance_speed: float
    own_stance_speed: float
    own_stance_share: float
    true_stance_share: float
    steps: int
    recalled: int
    claimed: int
    false: int
    unsure_share: float
    knee_correlation: float
    stance: Stance
    true_stance: Stance
    twist_deg: float
    true_twist_deg: float
    sole_low_m: float
    sole_stance_m: tuple[float, float]
    seconds_per_minute: float


def capture_body(folder: Path, name: str) -> Body:
    """Return the body of a rendered capture from its joints and its torso camera's path."""
    truth = np.load(folder / "gt" / "joints.npz")
    names = [str(each) for each in truth["names"]]
    joints = {role: truth["world"][:, names.index(short)] for role, short in _ROLES.items()}
    skeleton, _ = read_bvh(folder / "skeleton.bvh")
    camera = read_tum(folder / "gt" / "torso.tum")
    offset_s = 0.0
    clocks = folder / "gt" / "clocks.json"
    if clocks.exists():
        offset_s = json.loads(clocks.read_text())["offsets_s"]["torso"]
    times = camera.times_ns * 1e-9 + offset_s
    before = np.clip(np.searchsorted(times, truth["t"]) - 1, 0, len(times) - 2)
    alpha = np.clip((truth["t"] - times[before]) / np.diff(times)[before], 0.0, 1.0)
    poses = interpolate_pose(camera.world_from_cam[before], camera.world_from_cam[before + 1], alpha)
    chest = _chest_rotation(skeleton, joints, poses[:, :3, :3])
    return _merged(
        name, skeleton, joints, chest, _arms(skeleton, joints, chest), 1.0 / np.diff(truth["t"])[0]
    )


def recorded_body(path: Path, name: str, *, rate: float = 1.0, mirrored: bool = False) -> Body:
    """Return the body of a recording in CMU units: played at a rate, and mirrored left to right."""
    _, motion = read_bvh(path, units="cm")
    assert motion is not None
    skeleton = replace(
        motion.skeleton,
        offsets_m=motion.skeleton.offsets_m * CMU_UNIT_CM,
        end_offsets_m=motion.skeleton.end_offsets_m * CMU_UNIT_CM,
    )
    motion = replace(
        motion, skeleton=skeleton, root_in_world_m=motion.root_in_world_m * CMU_UNIT_CM, fps=motion.fps * rate
    )
    motion = resample(motion, FPS)
    if mirrored:
        motion = mirror(motion)
    return motion_body(motion, name)


def drawn_body(seed: int, seconds: float = 20.0) -> Body:
    """Return a body that walks as `bodycap_batch.synthetic.stance_walk` draws it, of a drawn stature."""
    rng = np.random.default_rng(seed)
    skeleton = load_skeleton("full_body", float(rng.uniform(1.55, 1.95)))
    walk = StanceWalk(skeleton, seconds, WalkStyle(), rng)
    times = np.arange(round(seconds * FPS)) / FPS
    root, local = walk.pose(times)
    motion = Motion(
        skeleton=skeleton, fps=FPS, start_ns=0, root_in_world_m=root, local_rotation=local,
        observed=np.ones(local.shape[:2], dtype=bool),
    )  # fmt: skip
    return motion_body(motion, f"drawn_{seed}")


def with_errors(body: Body, seed: int) -> Body:
    """Return a body whose merge has drawn errors of scale, floor and mount.

    The path of the trunk is longer or shorter by the error of the scale, and so is its height. The trunk is
    off by the error of the mount in its own axes. The feet are compared with a truth whose path has the same
    scale, so that their distance does not grow along the path.
    """
    rng = np.random.default_rng(seed)
    scale = 1.0 + float(rng.uniform(-_SCALE_ERROR, _SCALE_ERROR))
    floor_m = float(rng.uniform(-_FLOOR_ERROR_M, _FLOOR_ERROR_M))
    mount_m = rng.uniform(-_MOUNT_ERROR_M, _MOUNT_ERROR_M, 3)
    merged = body.merged
    trunk = merged.world_from_joint()[:, int(np.argmax(body.solved))]
    moved = scale * trunk[:, :3, 3] + trunk[:, :3, :3] @ mount_m + [0.0, 0.0, floor_m]
    root = merged.root_in_world_m + moved - trunk[:, :3, 3]
    return replace(
        body,
        merged=replace(merged, root_in_world_m=root),
        path_scale=scale,
    )


def motion_body(motion: Motion, name: str) -> Body:
    """Return the body of a motion whose legs are known."""
    poses = motion.world_from_joint()
    roles = motion.skeleton.roles
    joints = {role: poses[:, roles.index(role), :3, 3] for role in _ROLES}
    arms = {
        role: poses[:, roles.index(role), :3, :3]
        for role in roles
        if role.endswith(("Shoulder", "Arm", "ForeArm", "Hand"))
    }
    chest = poses[:, roles.index("Spine1"), :3, :3]
    return _merged(name, motion.skeleton, joints, chest, arms, motion.fps)


def mirror(motion: Motion) -> Motion:
    """Return a motion mirrored at the plane x = 0, with left and right joints exchanged."""
    skeleton = motion.skeleton
    flip = np.diag([-1.0, 1.0, 1.0])
    swap = {"Left": "Right", "Right": "Left"}
    order, names = [], list(skeleton.joints)
    for name in names:
        other = next((swap[s] + name.removeprefix(s) for s in swap if name.startswith(s)), name)
        if other == name and name[:1] in "LR" and name[1:2].isupper():
            other = ("R" if name[0] == "L" else "L") + name[1:]
        order.append(names.index(other))
    return replace(
        motion,
        skeleton=replace(
            skeleton,
            offsets_m=skeleton.offsets_m[order] @ flip,
            end_offsets_m=skeleton.end_offsets_m[order] @ flip,
        ),
        root_in_world_m=motion.root_in_world_m @ flip,
        local_rotation=flip @ motion.local_rotation[:, order] @ flip,
    )


def _chest_rotation(
    skeleton: SkeletonModel, joints: Mapping[str, FloatArray], camera: FloatArray
) -> FloatArray:
    """Return the orientation (T,3,3) of the chest: the camera's, turned so that it fits the shoulders."""
    rest = rest_positions(skeleton)
    chest = rest[skeleton.roles.index("Spine1")]
    moment = np.zeros((3, 3))
    for role, weight in (("LeftArm", 1.0), ("RightArm", 1.0), ("Hips", 0.5)):
        seen = np.einsum("tji,tj->ti", camera, joints[role] - joints["Spine1"]).mean(axis=0)
        moment += weight * np.outer(seen, rest[skeleton.roles.index(role)] - chest)
    return camera @ nearest_rotation(moment)


def _arms(
    skeleton: SkeletonModel, joints: Mapping[str, FloatArray], chest: FloatArray
) -> dict[str, FloatArray]:
    """Return orientations (T,3,3) of the joints of the arms that put shoulders, elbows and hands in place."""
    rest = rest_positions(skeleton)
    index = skeleton.roles.index
    out: dict[str, FloatArray] = {}
    for side in SIDES:
        above = chest
        for role, following in (("Arm", "ForeArm"), ("ForeArm", "Hand")):
            bone = rest[index(side + following)] - rest[index(side + role)]
            seen = joints[side + following] - joints[side + role]
            above = _swing_to(above, bone, seen)
            out[side + role] = above
        out[side + "Hand"] = above
        out[side + "Shoulder"] = chest
    return out


def _swing_to(rotation: FloatArray, bone: FloatArray, seen: FloatArray) -> FloatArray:
    start = rotation @ (bone / np.linalg.norm(bone))
    end = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    half = start + end
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    turn = 2.0 * np.einsum("ti,tj->tij", half, half) - np.eye(3)
    flip = 2.0 * np.einsum("ti,tj->tij", start, start) - np.eye(3)
    return np.asarray(turn @ flip @ rotation)


def _merged(
    name: str,
    skeleton: SkeletonModel,
    joints: Mapping[str, FloatArray],
    chest: FloatArray,
    arms: Mapping[str, FloatArray],
    fps: float,
) -> Body:
    """Return the body with the motion of a merge without error, standing on a floor at z = 0."""
    joints = _on_floor(skeleton, joints, fps)
    bones = kinematic_chain(skeleton, set(MOUNTED))
    poses = np.tile(np.eye(4), (len(chest), len(bones), 1, 1))
    for number, bone in enumerate(bones):
        poses[:, number, :3, :3] = chest if bone.role == "Spine1" else arms[bone.role]
        if bone.role == "Spine1":
            poses[:, number, :3, 3] = joints["Spine1"]
        else:
            above = poses[:, bone.parent]
            poses[:, number, :3, 3] = above[:, :3, 3] + above[:, :3, :3] @ bone.offset_m
    world, solved = complete_skeleton(skeleton, bones, poses)
    rotation = world[..., :3, :3]
    local = rotation.copy()
    local[:, 1:] = np.swapaxes(rotation[:, skeleton.parents[1:]], -1, -2) @ rotation[:, 1:]
    observed = np.tile(solved, (len(chest), 1))
    merged = Motion(
        skeleton=skeleton, fps=fps, start_ns=0, root_in_world_m=world[:, 0, :3, 3], local_rotation=local,
        observed=observed,
    )  # fmt: skip
    return Body(name=name, joints=joints, merged=merged, solved=solved)


def _on_floor(skeleton: SkeletonModel, joints: Mapping[str, FloatArray], fps: float) -> dict[str, FloatArray]:
    """Return the joints as on a level floor at z = 0.

    The joints are moved up or down by the height of the standing ankles. The floor of a recording may slope
    by some per cent, because its vertical is not exact: the slope along the path is removed if the path is
    at least `_MIN_SLOPE_M` long.
    """
    legs = leg_geometry(skeleton)
    assert legs is not None
    heights, along = [], []
    way = joints["Hips"][:, :2] - joints["Hips"][0, :2]
    length = float(np.linalg.norm(way[-1]))
    travel = way @ (way[-1] / max(length, 1e-9))
    for side, leg in zip(SIDES, legs, strict=True):
        ankle = joints[side + "Foot"]
        standing = _low_speed(ankle, fps) & (ankle[:, 2] < np.percentile(ankle[:, 2], 10) + _STANCE_HEIGHT_M)
        heights += (ankle[standing, 2] - leg.ankle_height_m).tolist()
        along += travel[standing].tolist()
    slope = float(np.polyfit(along, heights, 1)[0]) if length > _MIN_SLOPE_M else 0.0
    level = float(np.percentile(np.array(heights) - slope * np.array(along), 40))
    floor = np.column_stack([np.zeros((len(travel), 2)), level + slope * travel])
    return {role: path - floor for role, path in joints.items()}


def _speed(path: FloatArray, fps: float) -> FloatArray:
    return np.asarray(np.linalg.norm(np.gradient(path, axis=0)[:, :2], axis=1) * fps)


def _low_speed(path: FloatArray, fps: float) -> BoolArray:
    return np.asarray(_speed(path, fps) < _STANCE_SPEED)


def _runs(mask: BoolArray) -> Iterator[tuple[int, int]]:
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    yield from zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)


def true_stances(ankle: FloatArray, fps: float) -> list[tuple[int, int]]:
    """Return the periods in which a true ankle stands: slow, low, and not shorter than 0.1 s."""
    low = ankle[:, 2] < np.percentile(ankle[:, 2], 10) + _STANCE_HEIGHT_M
    return [(a, b) for a, b in _runs(_low_speed(ankle, fps) & low) if (b - a) / fps >= _STANCE_S]


def swings(stances: Sequence[tuple[int, int]], fps: float, path: FloatArray) -> list[float]:
    """Return the landing (s) of each step between two periods of standing that are 10 cm or more apart."""
    out = []
    for (first, end), (start, last) in itertools.pairwise(stances):
        apart = np.median(path[start:last], axis=0) - np.median(path[first:end], axis=0)
        if np.hypot(*apart[:2]) > 0.1:
            out.append(start / fps)
    return out


def score(body: Body, mode: FillMode, heights: HeightSigmas = HEIGHTS) -> Score:
    """Fill the legs of a body and compare them with the truth."""
    started = time.perf_counter()
    filled = fill_motion(
        body.merged, body.solved, heights=heights, mode=mode, context=StageContext(work_dir=Path())
    )  # fmt: skip
    seconds = time.perf_counter() - started
    motion, report, fps = filled.motion, filled.report, body.merged.fps
    poses = motion.world_from_joint()
    roles = motion.skeleton.roles
    own = {role: poses[:, roles.index(role), :3, 3] for role in _ROLES}
    ankle, in_true, in_own, share, true_share = [], [], [], [], []
    steps = recalled = claimed = false = 0
    for side, name in enumerate(SIDES):
        foot = f"{name}Foot"
        scaled = body.joints[foot] * [body.path_scale, body.path_scale, 1.0]
        ankle.append(np.linalg.norm(own[foot] - scaled, axis=1))
        speed = _speed(own[foot], fps)
        stances = true_stances(body.joints[foot], fps)
        trim = round(_TRIM_S * fps)
        in_true += [speed[a + trim : b - trim] for a, b in stances]
        true_share.append(sum(b - a for a, b in stances) / len(speed))
        in_own.append(_contact_speed(poses, motion, report, side))
        share.append(report.standing[:, side].mean() if mode == "plausible" else 0.0)
        wanted = swings(stances, fps, body.joints[foot])
        found = own_swings(report, side, fps)
        steps += len(wanted)
        claimed += len(found)
        recalled += sum(any(abs(a - b) <= _STEP_TOLERANCE_S + 1e-9 for b in found) for a in wanted)
        moving = _true_swing_mask(stances, len(speed))
        early = round(_STEP_TOLERANCE_S * fps)
        false += sum(
            not moving[max(round(b * fps) - 2 * early, 0) : round(b * fps) + early].any() for b in found
        )
    moving_ticks = _speed(body.joints["Hips"], fps) > 0.3
    unsure = float((~report.is_sure)[moving_ticks].mean()) if moving_ticks.any() else 0.0
    knees = [(_knee_deg(own, side), _knee_deg(body.joints, side)) for side in SIDES]
    correlations = [np.corrcoef(a, b)[0, 1] if a.std() > 1e-6 else 0.0 for a, b in knees]
    soles, stance_soles = _soles(motion, report)
    return Score(
        name=body.name,
        frames=len(poses),
        ankle_m=float(np.mean(ankle)),
        true_stance_speed=_percentile(in_true, 95),
        own_stance_speed=_percentile(in_own, 95),
        own_stance_share=float(np.mean(share)),
        true_stance_share=float(np.mean(true_share)),
        steps=steps,
        recalled=recalled,
        claimed=claimed,
        false=false,
        unsure_share=unsure,
        knee_correlation=float(np.mean(correlations)),
        stance=_stance(own, motion.skeleton, fps, report.floor_m),
        true_stance=_stance(body.joints, body.merged.skeleton, fps, 0.0),
        twist_deg=_twist_deg(own, fps),
        true_twist_deg=_twist_deg(body.joints, fps),
        sole_low_m=soles,
        sole_stance_m=stance_soles,
        seconds_per_minute=seconds / (len(poses) / fps / 60.0),
    )


def own_swings(report: FillReport, side: int, fps: float) -> list[float]:
    """Return the landing (s) of each certain step of a filled foot."""
    steps = report.footsteps
    own = np.flatnonzero(steps.side == side)
    out = []
    for first, second in itertools.pairwise(own):
        middle = 0.5 * (steps.end_tick[first] + steps.start_tick[second])
        if report.is_sure[int(middle)]:
            out.append(float(steps.start_tick[second] / fps))
    return out


def _true_swing_mask(stances: Sequence[tuple[int, int]], ticks: int) -> BoolArray:
    out = np.ones(ticks, dtype=bool)
    for a, b in stances:
        out[a:b] = False
    return out


def _percentile(parts: Sequence[FloatArray], percent: float) -> float:
    values = np.concatenate([*parts, np.zeros(0)])
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def _contact_speed(poses: FloatArray, motion: Motion, report: FillReport, side: int) -> FloatArray:
    """Return the speed of the slower one of ankle and toes where the filled foot stands."""
    legs = leg_geometry(motion.skeleton)
    if legs is None:
        return np.zeros(0)
    leg = legs[side]
    standing = report.standing[:, side]
    both = standing & np.roll(standing, 1) & np.roll(standing, -1)
    both[[0, -1]] = False
    ankle = poses[:, leg.ankle, :3, 3]
    ball = ankle + poses[:, leg.ankle, :3, :3] @ leg.ball_m
    heel = ankle + poses[:, leg.ankle, :3, :3] @ leg.heel_m
    return np.minimum.reduce([_speed(p, motion.fps) for p in (ankle, ball, heel)])[both]


def _knee_deg(joints: Mapping[str, FloatArray], side: str) -> FloatArray:
    upper = joints[side + "Leg"] - joints[side + "UpLeg"]
    lower = joints[side + "Foot"] - joints[side + "Leg"]
    cosine = (upper * lower).sum(axis=1) / np.linalg.norm(upper, axis=1) / np.linalg.norm(lower, axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _stance(joints: Mapping[str, FloatArray], skeleton: SkeletonModel, fps: float, floor_m: float) -> Stance:
    legs = leg_geometry(skeleton)
    assert legs is not None
    knees = np.column_stack([_knee_deg(joints, side) for side in SIDES])
    straight_m = np.mean([leg.length_m + leg.ankle_height_m for leg in legs])
    hips_m = np.mean([joints[side + "UpLeg"][:, 2].mean() for side in SIDES]) - floor_m
    return Stance(
        crouched_share=float((knees.min(axis=1) > _CROUCHED_DEG).mean()),
        straightest_deg=float(knees.min()),
        peak_deg=float(knees.max()),
        pelvis_share=float(hips_m / straight_m),
        knee_deg_per_s=float(np.abs(np.diff(knees, axis=0)).max() * fps),
        knee_jerk=float(np.sqrt((np.diff(low_pass(knees, _JERK_HZ, fps), 3, axis=0) ** 2).mean()) * fps**3),
    )


def _twist_deg(joints: Mapping[str, FloatArray], fps: float) -> float:
    """Return the range (5th to 95th percentile) of the pelvis's yaw against the shoulders."""
    yaw = []
    for part in ("UpLeg", "Arm"):
        across = joints["Left" + part] - joints["Right" + part]
        yaw.append(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))
    twist = np.degrees(yaw[0] - yaw[1])
    low, high = np.percentile(twist, [5, 95])
    return float(high - low)


def _soles(motion: Motion, report: FillReport) -> tuple[float, tuple[float, float]]:
    """Return the lowest point of the feet over the floor, and its range where a foot stands, metres."""
    legs = leg_geometry(motion.skeleton)
    if legs is None:
        return float("nan"), (float("nan"), float("nan"))
    poses = motion.world_from_joint()
    lowest, standing = [], []
    for side, leg in enumerate(legs):
        points = [poses[:, leg.ankle, 2, 3] + poses[:, leg.ankle, 2, :3] @ leg.heel_m]
        for joint in (leg.ankle, *leg.below):
            points.append(poses[:, joint, 2, 3])
            end = motion.skeleton.end_offsets_m[joint]
            if np.isfinite(end).all():
                points.append(poses[:, joint, 2, 3] + poses[:, joint, 2, :3] @ end)
        low = np.min(points, axis=0) - report.floor_m
        lowest.append(low.min())
        standing.append(low[report.standing[:, side]])
    flat = np.concatenate(standing)
    span = (float(flat.min()), float(flat.max())) if len(flat) else (float("nan"), float("nan"))
    return float(min(lowest)), span


def bodies(data: Path) -> Iterator[Body]:
    """Yield all recorded bodies."""
    for folder in sorted(data.iterdir()):
        if (folder / "gt" / "joints.npz").exists() and (folder / "skeleton.bvh").exists():
            yield capture_body(folder, folder.name)
    for path in sorted((data / "motions").glob("*.bvh")):
        yield recorded_body(path, path.stem)
        yield recorded_body(path, f"{path.stem}_mirrored", mirrored=True)
    walk = data / "motions" / "02_01.bvh"
    if walk.exists():
        for rate in (0.7, 0.85, 1.15):
            yield recorded_body(walk, f"02_01_at_{rate}", rate=rate)
    for seed in DRAWN:
        yield drawn_body(seed)


def line_of(result: Score) -> str:
    """Return the two lines of one body in the table."""
    own, true = result.stance, result.true_stance
    return (
        f"{result.name:18s} ankle {100 * result.ankle_m:5.1f} cm | speed in true stance"
        f" {result.true_stance_speed:5.2f} own {result.own_stance_speed:5.3f} m/s | stance"
        f" {100 * result.own_stance_share:3.0f} % (true still {100 * result.true_stance_share:3.0f}) | steps"
        f" {result.recalled:2d}/{result.steps:2d} false {result.false:2d}/{result.claimed:2d} unsure"
        f" {100 * result.unsure_share:3.0f} % | knee r {result.knee_correlation:5.2f} | twist"
        f" {result.twist_deg:4.1f} ({result.true_twist_deg:4.1f})° | soles"
        f" {100 * result.sole_low_m:5.1f}, stance {100 * result.sole_stance_m[0]:4.1f}.."
        f"{100 * result.sole_stance_m[1]:4.1f} cm | {result.seconds_per_minute:4.1f} s/min"
        f"\n{'':18s} crouched {100 * own.crouched_share:3.0f} ({100 * true.crouched_share:3.0f}) % | knee"
        f" straightest {own.straightest_deg:4.1f} ({true.straightest_deg:4.1f})° peak {own.peak_deg:3.0f}"
        f" ({true.peak_deg:3.0f})° speed {own.knee_deg_per_s:4.0f} ({true.knee_deg_per_s:4.0f}) °/s jerk"
        f" {own.knee_jerk / true.knee_jerk:4.2f} of the truth's | pelvis {100 * own.pelvis_share:5.1f}"
        f" ({100 * true.pelvis_share:5.1f}) % of standing"
    )


def main(arguments: list[str]) -> int:
    """Print the table. The exit code is 0 if there was a body."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=body", description=__doc__)
    parser.add_argument("only", nargs="*", help="names of rows (default: all)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--rest", action="store_true", help="the rest pose instead of the plausible motion")
    parser.add_argument("--no-floor", action="store_true", help="the floor is not measured")
    parser.add_argument("--floor", action="store_true", help="the floor takes up the errors")
    parser.add_argument(
        "--errors", type=int, metavar="SEED", help="draw errors of scale, floor and mount from this seed on"
    )
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), help="only these drawn walks")
    options = parser.parse_args(arguments)
    heights = HeightSigmas(0.06, 0.0) if options.floor else HEIGHTS
    if options.no_floor:
        heights = replace(heights, floor_m=np.inf)
    mode: FillMode = "rest" if options.rest else "plausible"
    count = 0
    drawn = (drawn_body(seed) for seed in range(*options.seeds)) if options.seeds else bodies(options.data)
    for body in drawn:
        if options.only and body.name not in options.only:
            continue
        merged = body if options.errors is None else with_errors(body, options.errors + count)
        result = score(merged, mode, heights)
        held_out = "" if body.name.startswith(TUNED_ON) else "held out"
        sys.stdout.write(f"{line_of(result)} {held_out}\n")
        sys.stdout.flush()
        count += 1
    return 0 if count else 1
