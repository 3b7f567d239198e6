"""Elbows with three cameras and a height alone: the error of their flexion against its stated sigma.

``python -m tests.bench elbows``: camera poses with noise, no rendering and no map. The walkers have
proportions of another source than the prior's, drawn postures, and mounts that are off by 15° and 5 cm in all
(3 cm for each axis). The recorded bodies are those of the motions and captures beside the repository. Mounts
of the motions are drawn alike.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.mounts import mount_of
from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.merge_data import MergeInputs, MergeResult
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Motion, SkeletonModel, forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions, split_side
from bodycap_batch.synthetic.gait import Walk, WalkStyle
from bodycap_batch.synthetic.person import draw_mounts, draw_posture
from bodycap_batch.synthetic.stance_walk import StanceWalk
from tests.bench.body import CMU_UNIT_CM
from tests.bench.rows import DATA

CAMERAS = ("torso", "left_palm", "right_palm")
FPS = 30.0
NOISE_RAD, NOISE_M = float(np.radians(0.3)), 0.005
MOUNT_SIGMAS = 15.0, 0.05
SIDES = ("left", "right")
KINDS = ("simple", "gait", "held")
_UPPER_ARM, _FOREARM = 0.160, 0.153
"""Lengths, as parts of the stature, of upper arm and forearm between joint centres. Source: P. de Leva,
"Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters", J. Biomech. 29, 1996; mean of both sexes.
"""
_SHOULDER = 0.105
"""Half of the distance of the shoulder joints, as part of the stature. Origin: half of the distance of the
acromia of both sexes (0.115), less 1.0 % for the joint centre."""
_SPREAD, _RATIO_SPREAD = 0.03, 0.02
"""Relative sigma, between people, of the length of the arm, and of each of its two bones against the arm.
Evidence: none."""
_HELD_SIGMA_DEG = {"Arm": 20.0, "Out": 15.0, "Spin": 22.5, "Elbow": 20.0}
"""Standard deviations (degrees) of the angles of held arms: half of the everyday ranges of the priors."""
_HELD_FLEXION_DEG = 20.0
"""Mean flexion (degrees) of the elbows of the walker ``gait``. Held elbows do not bend backward."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """A body with three cameras: true flexions (T,2) in degrees and true camera poses on a common clock."""

    name: str
    height_m: float
    flexion_deg: FloatArray
    world_from_cam: dict[str, FloatArray]
    skeleton: SkeletonModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Errors of both elbows of a capture over its measured ticks, and the sigmas that are stated, degrees."""

    name: str
    side: str
    true_deg: float
    bias_deg: float
    moving_deg: float
    sigma_deg: float
    inside: float
    log_scale: float


def other_body(height_m: float, rng: np.random.Generator) -> SkeletonModel:
    """Draw a body whose arms and shoulders do not come from the source of the preset."""
    body = load_skeleton("full_body", height_m)
    arm, ratio, wide = rng.normal(0.0, [_SPREAD, _RATIO_SPREAD, _SPREAD])
    lengths = {
        "Arm": None,
        "ForeArm": _UPPER_ARM * (1.0 + arm + ratio),
        "Hand": _FOREARM * (1.0 + arm - ratio),
    }
    offsets = body.offsets_m.copy()
    for joint, role in enumerate(body.roles):
        side, part = split_side(role)
        outward = 1.0 if side == "Left" else -1.0
        if part == "Arm":
            shoulder = outward * height_m * _SHOULDER * (1.0 + wide)
            offsets[joint, 0] = shoulder - offsets[body.parents[joint], 0]
        elif side and part in lengths:
            offsets[joint] = (outward * height_m * lengths[part], 0.0, 0.0)
    spine = body.roles.index("Spine1")
    shift = height_m * rng.normal(0.0, 0.015)
    offsets[spine, 2] += shift
    for joint in np.flatnonzero(body.parents == spine):
        offsets[joint, 2] -= shift
    return replace(body, offsets_m=offsets)


def drawn_capture(seed: int, seconds: float, kind: str) -> Capture:
    """Return a walker of seed `seed`.

    The kind ``simple`` reaches out, ``gait`` swings the arms only, and ``held`` walks as ``gait`` but holds
    the arms in a drawn posture, as a person who carries something.
    """
    rng = np.random.default_rng([seed, 77])
    height_m = float(rng.uniform(1.55, 1.92))
    skeleton = other_body(height_m, rng)
    posture = draw_posture(1.0, rng)
    if kind == "held":
        for side in SIDES:
            for part, sigma_deg in _HELD_SIGMA_DEG.items():
                posture[side.title() + part] = float(rng.normal(0.0, sigma_deg))
            posture[f"{side.title()}Elbow"] = abs(posture[f"{side.title()}Elbow"] + _HELD_FLEXION_DEG)
            posture[f"{side.title()}Elbow"] -= _HELD_FLEXION_DEG
            posture[f"{side.title()}Out"] = abs(posture[f"{side.title()}Out"])
    style = WalkStyle(posture=posture)
    walk = (Walk if kind == "simple" else StanceWalk)(skeleton, seconds, style, rng)
    root, local = walk.pose(np.arange(round(seconds * FPS)) / FPS)
    return _capture(f"{kind}_{seed}", skeleton, forward_kinematics(skeleton, root, local), height_m, rng)


def recorded_capture(path: Path, draw: int) -> Capture:
    """Return a recorded body with drawn mounts. Its stature follows from the height of its hips."""
    _, motion = read_bvh(path, units="cm")
    assert motion is not None
    skeleton = replace(
        motion.skeleton,
        offsets_m=motion.skeleton.offsets_m * CMU_UNIT_CM,
        end_offsets_m=motion.skeleton.end_offsets_m * CMU_UNIT_CM,
    )
    step = round(motion.fps / FPS)
    motion = Motion(
        skeleton=skeleton, fps=motion.fps / step, start_ns=0,
        root_in_world_m=motion.root_in_world_m[::step] * CMU_UNIT_CM,
        local_rotation=motion.local_rotation[::step], observed=motion.observed[::step],
    )  # fmt: skip
    rng = np.random.default_rng([draw, 78])
    return _capture(
        f"{path.stem}_{draw}", skeleton, motion.world_from_joint(), _stature_m(skeleton), rng, motion.fps
    )


def rendered_capture(folder: Path) -> Capture:
    """Return a rendered capture's true body and camera paths of torso and palms."""
    skeleton, _ = read_bvh(folder / "skeleton.bvh")
    with np.load(folder / "gt" / "joints.npz") as truth:
        names, world = truth["names"].tolist(), truth["world"]
    flexion = np.stack(
        [_angle_deg(*(world[:, names.index(f"{side}_{part}")] for part in ("shoulder", "elbow", "palm")))
         for side in SIDES], axis=1,
    )  # fmt: skip
    paths = {camera: read_tum(folder / "gt" / f"{camera}.tum").world_from_cam for camera in CAMERAS}
    return Capture(
        name=folder.name, height_m=_stature_m(skeleton), flexion_deg=flexion, world_from_cam=paths,
        skeleton=skeleton,
    )  # fmt: skip


def _stature_m(skeleton: SkeletonModel) -> float:
    """Return the stature that the preset has at the length of the skeleton's legs."""

    def leg_m(body: SkeletonModel) -> float:
        return sum(
            float(np.linalg.norm(rest_positions(body)[body.roles.index(f"Left{low}")]
                                 - rest_positions(body)[body.roles.index(f"Left{high}")]))
            for high, low in (("UpLeg", "Leg"), ("Leg", "Foot"))
        )  # fmt: skip

    return leg_m(skeleton) / leg_m(load_skeleton("full_body", 1.0))


def _capture(
    name: str, skeleton: SkeletonModel, poses: FloatArray, height_m: float, rng: np.random.Generator,
    fps: float = FPS,
) -> Capture:  # fmt: skip
    mounts = draw_mounts(CAMERAS, skeleton, MOUNT_SIGMAS, rng)
    role = skeleton.roles.index
    flexion = np.stack(
        [_angle_deg(*(poses[:, role(side.title() + part), :3, 3] for part in ("Arm", "ForeArm", "Hand")))
         for side in SIDES], axis=1,
    )  # fmt: skip
    paths = {mount.camera: poses[:, role(mount.role)] @ mount.joint_from_cam for mount in mounts}
    return Capture(name=name, height_m=height_m, flexion_deg=flexion, world_from_cam=paths, skeleton=skeleton)


def _angle_deg(shoulder: FloatArray, elbow: FloatArray, hand: FloatArray) -> FloatArray:
    upper, lower = elbow - shoulder, hand - elbow
    cosine = (upper * lower).sum(axis=-1) / np.linalg.norm(upper, axis=-1) / np.linalg.norm(lower, axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def merge_capture(capture: Capture, *, own_skeleton: bool = False, noise_seed: int = 0) -> MergeResult:
    """Merge the camera poses of a capture, with noise, and with the height of the body alone."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    rng = np.random.default_rng(noise_seed)
    skeleton = capture.skeleton if own_skeleton else load_skeleton("upper_body", capture.height_m)
    tracks = []
    for camera, path in capture.world_from_cam.items():
        count = len(path)
        noise = make_transform(
            so3_exp(rng.normal(0.0, NOISE_RAD, (count, 3))), rng.normal(0.0, NOISE_M, (count, 3))
        )
        tracks.append(
            Trajectory(
                camera=camera, gauge="map-0", frame_numbers=np.arange(count),
                times_ns=np.round(np.arange(count) * (1e9 / FPS)).astype(np.int64),
                gauge_from_cam=path @ noise,
                covariance=np.tile(np.diag(np.repeat([NOISE_RAD, NOISE_M], 3) ** 2), (count, 1, 1)),
                status=(FrameStatus.REGISTERED,) * count, inliers=np.full(count, 60),
                error_px=np.full(count, 0.5),
            )
        )  # fmt: skip
    mounts = []
    for camera in CAMERAS:
        place = mount_of(camera)
        assert place is not None
        mounts.append(nominal_mount(camera, place[1], skeleton))
    inputs = MergeInputs(
        trajectories=tuple(tracks),
        clocks={camera: CameraClock(nominal_fps=FPS) for camera in CAMERAS},
        skeleton=skeleton, mounts=tuple(mounts), skeleton_is_measured=own_skeleton,
        height_m=None if own_skeleton else capture.height_m,
    )  # fmt: skip
    return merge_trajectories(inputs, MergeOptions(), StageContext(work_dir=Path()))


def outcomes(capture: Capture, result: MergeResult) -> list[Outcome]:
    """Compare the flexion of both elbows with the truth."""
    assert result.flexion_sigma_rad is not None
    roles = result.skeleton.roles
    poses = result.graph_world_from_joint
    out = []
    for number, side in enumerate(SIDES):
        joints = [roles.index(side.title() + part) for part in ("Arm", "ForeArm", "Hand")]
        count = min(len(poses), len(capture.flexion_deg))
        seen = result.observed[:count, joints[1]]
        found = _angle_deg(*(poses[:count, joint, :3, 3] for joint in joints))[seen]
        true = capture.flexion_deg[:count, number][seen]
        sigma = np.degrees(result.flexion_sigma_rad[:count, joints[1]])[seen]
        error = found - true
        out.append(
            Outcome(
                name=capture.name, side=side, true_deg=float(true.mean()), bias_deg=float(error.mean()),
                moving_deg=float(error.std()), sigma_deg=float(np.median(sigma)),
                inside=float((np.abs(error) < 2.0 * sigma).mean()),
                log_scale=float(np.log(result.world_from_map["map-0"].scale)),
            )
        )  # fmt: skip
    return out


def captures(data: Path, options: argparse.Namespace) -> Iterator[Capture]:
    """Yield the walkers and the recorded bodies."""
    for kind in options.kinds:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            yield drawn_capture(seed, options.seconds, kind)
    if not options.recorded:
        return
    for path in sorted((data / "motions").glob("*.bvh")):
        for draw in range(options.recorded):
            yield recorded_capture(path, draw)
    for name in ("walk12", "room12", "walk131", "walk131_02"):
        yield rendered_capture(data / name)


def summary(name: str, rows: Sequence[Outcome]) -> str:
    """Return one line: the bias, and how well the sigmas state it."""
    bias = np.array([row.bias_deg for row in rows])
    ratio = np.array([row.bias_deg / row.sigma_deg for row in rows])
    scale = 100 * np.array([row.log_scale for row in rows])
    stated = np.median([row.sigma_deg for row in rows])
    ticks, elbows = np.mean([row.inside for row in rows]), (np.abs(ratio) < 2.0).mean()
    return (
        f"{name:8s} {len(rows):3d} elbows: too bent by {bias.mean():+5.1f}°, |error| "
        f"{np.abs(bias).mean():4.1f}°, stated {stated:4.1f}°, rms error/sigma "
        f"{np.sqrt((ratio**2).mean()):4.2f}, elbows inside 2 sigma {100 * elbows:3.0f} %, "
        f"ticks {100 * ticks:3.0f} %, scale {scale.mean():+5.1f} ± {scale.std():3.1f} %\n"
    )


def main(arguments: list[str]) -> int:
    """Print one line per elbow and one per kind of motion."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench elbows", description=__doc__)
    parser.add_argument("--seeds", type=int, default=8, help="walkers of each kind")
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS, help="kinds of walkers")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--recorded", type=int, default=2, help="draws of mounts for each recorded motion")
    parser.add_argument("--own-skeleton", action="store_true", help="use the skeleton and not the height")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    kinds: dict[str, list[Outcome]] = {}
    for capture in captures(options.data, options):
        rows = outcomes(capture, merge_capture(capture, own_skeleton=options.own_skeleton))
        first = capture.name.split("_")[0]
        kind = first if first in KINDS else "recorded"
        kinds.setdefault(kind, []).extend(rows)
        for row in rows:
            sys.stdout.write(
                f"    {row.name:12s} {row.side:5s} true {row.true_deg:5.1f}° error {row.bias_deg:+5.1f}° ± "
                f"{row.moving_deg:4.1f}° stated {row.sigma_deg:4.1f}° inside {100 * row.inside:3.0f} % scale "
                f"{100 * row.log_scale:+5.1f} %\n"
            )
        sys.stdout.flush()
    for kind, rows in kinds.items():
        sys.stdout.write(summary(kind, rows))
    if options.json:
        text = {kind: [{name: getattr(row, name) for name in Outcome.__slots__} for row in rows]
                for kind, rows in kinds.items()}  # fmt: skip
        options.json.write_text(json.dumps(text, indent=1), encoding="utf-8")
    return 0
