"""The merge stage on simulated camera poses: joints, angles, palms, scale and time.

``python -m tests.bench simulation``: captures of ``bodycap synth --poses``: a walker who reaches out, 1,000
frames at 30 Hz, cameras with mount errors of 15° and 5 cm in all, poses with 5 mm and 0.3° of noise, 2 %
gross errors in bursts, and 2 % of the frames lost in gaps of 10 to 20. The body's own proportions are given.

Errors of joints: the translation is removed at the hips if a camera measures them, else at the chest. The
axes are those of the input poses: the merge's vertical and heading are undone, its scale is not. Only
``observed`` joints and ticks count, without the joint that is held fixed. Angles are local rotations of
joints with a solved parent, after removal of each joint's constant offset; the raw angles are printed too.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.config.mounts import mount_of
from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.merge_data import MergeInputs, MergeResult
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic import SynthOptions, synthesise

PALMS = ("torso", "left_palm", "right_palm")
ARMS = (*PALMS, "left_upper_arm", "right_upper_arm")
CAMERAS = {
    3: PALMS,
    5: ARMS,
    11: (*ARMS, "hips", "head", "left_thigh", "right_thigh", "left_shin", "right_shin"),
}
GAUGE = "map-0"
SECONDS = 1000 / 30
SHIFTS_S = (0.0, 0.011, 0.022)
"""Clock offsets of the cameras in turn if they are not synchronous; the last camera runs at 24 fps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One simulated capture."""

    cameras: int
    seed: int
    t_pose: bool = True
    shifted: bool = False
    seconds: float = SECONDS
    mount_sigmas: tuple[float, float] = (15.0, 0.05)
    posture_spread: float = 0.0

    def options(self) -> SynthOptions:
        names = CAMERAS[self.cameras]
        offsets = {name: SHIFTS_S[i % 3] for i, name in enumerate(names)} if self.shifted else {}
        return SynthOptions(
            poses_only=True,
            seconds=self.seconds,
            cameras=names,
            seed=self.seed,
            t_pose_s=2.0 if self.t_pose else 0.0,
            mount_sigma_deg=self.mount_sigmas[0],
            mount_sigma_m=self.mount_sigmas[1],
            posture_spread=self.posture_spread,
            offsets_s=offsets,
            rates_fps={names[-1]: 24.0} if self.shifted else {},
        )


def load_inputs(folder: Path, height_m: float | None = None) -> MergeInputs:
    """Return the merge inputs of a ``--poses`` capture, with the body's own skeleton or one by height."""
    calibration = json.loads((folder / "calib.json").read_text(encoding="utf-8"))
    settings = json.loads((folder / "gt" / "synth.json").read_text(encoding="utf-8"))
    measured = height_m is None
    skeleton = read_bvh(folder / "skeleton.bvh")[0] if measured else load_skeleton("upper_body", height_m)
    rates = calibration.get("rates_fps", {})
    names = settings["cameras"]
    sigmas = np.repeat([np.radians(settings["pose_sigma_deg"]), settings["pose_sigma_m"]], 3)
    return MergeInputs(
        trajectories=tuple(_trajectory(folder / "poses" / f"{name}.tum", sigmas) for name in names),
        clocks={
            name: CameraClock(
                nominal_fps=rates.get(name, calibration["fps"]), offset_s=calibration["offsets_s"][name]
            )
            for name in names
        },
        skeleton=skeleton,
        mounts=tuple(_nominal(name, skeleton) for name in names),
        skeleton_is_measured=measured,
        height_m=height_m,
    )


def _nominal(camera: str, skeleton: SkeletonModel) -> Mount:
    place = mount_of(camera)
    assert place is not None
    return nominal_mount(camera, place[1], skeleton)


def _trajectory(path: Path, sigmas: FloatArray) -> Trajectory:
    poses = read_tum(path)
    count = len(poses.times_ns)
    return Trajectory(
        camera=path.stem,
        gauge=GAUGE,
        frame_numbers=np.arange(count),
        times_ns=poses.times_ns,
        gauge_from_cam=poses.world_from_cam,
        covariance=np.tile(np.diag(sigmas**2), (count, 1, 1)),
        status=(FrameStatus.REGISTERED,) * count,
        inliers=np.full(count, 60),
        error_px=np.full(count, 0.5),
    )


def score(folder: Path, result: MergeResult) -> dict[str, float]:
    """Return errors against the truth of the capture: metres, degrees, log scale."""
    _, truth = read_bvh(folder / "gt" / "motion.bvh")
    assert truth is not None
    assert abs(int(truth.times_ns()[0]) - result.start_ns) < 1_000_000
    count = min(len(truth.root_in_world_m), len(result.graph_world_from_joint))
    place = result.world_from_map[GAUGE]
    true = truth.world_from_joint()[:count]
    mine = np.array(result.graph_world_from_joint[:count])
    mine[..., :3, :] = np.einsum("ji,tkjl->tkil", place.rotation, mine[..., :3, :])
    roles = result.skeleton.roles
    # The hips where a camera measures them, else the chest.
    base = next(roles.index(role) for role in ("Hips", "Spine1") if result.solved[roles.index(role)])
    chosen = [joint for joint, solved in enumerate(result.solved) if solved]
    relative = [part[:, chosen, :3] - part[:, base : base + 1, :3] for part in (mine[..., 3], true[..., 3])]
    off = np.linalg.norm(relative[0] - relative[1], axis=-1)
    seen = result.observed[:count][:, chosen]
    others = [position for position, joint in enumerate(chosen) if joint != base]
    angle, raw = _angles(result, mine, true, chosen)
    turning = [position for position, joint in enumerate(chosen) if result.skeleton.parents[joint] in chosen]
    palms = [position for position, joint in enumerate(chosen) if roles[joint].endswith("Hand")]
    chest = chosen.index(roles.index("Spine1"))
    apart = [part[:, palms] - part[:, chest : chest + 1] for part in relative]
    return {
        "mpjpe_m": float(off[:, others][seen[:, others]].mean()),
        "angle_deg": float(angle[:, turning][seen[:, turning]].mean()),
        "raw_angle_deg": float(raw[:, turning][seen[:, turning]].mean()),
        "palm_m": float(np.linalg.norm(apart[0] - apart[1], axis=-1).mean()),
        "log_scale": float(np.log(place.scale)),
        "stated_log_scale": float(result.report.scale.relative_sigma),
        **_mount_errors(folder, result),
    }


def _angles(
    result: MergeResult, mine: FloatArray, true: FloatArray, chosen: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return angles (T,J) of local rotations: without each joint's constant offset, and raw."""
    parents = result.skeleton.parents[list(chosen)]
    local = [
        np.swapaxes(part[:, parents], -1, -2) @ part[:, list(chosen)]
        for part in (mine[..., :3, :3], true[..., :3, :3])
    ]
    offset = np.swapaxes(local[0], -1, -2) @ local[1]
    u, _, vt = np.linalg.svd(offset.sum(axis=0))
    u[..., -1] *= np.linalg.det(u @ vt)[..., None]
    free = np.swapaxes(offset, -1, -2) @ (u @ vt)
    return np.degrees(rotation_angle_rad(free)), np.degrees(rotation_angle_rad(offset))


def _mount_errors(folder: Path, result: MergeResult) -> dict[str, float]:
    truth = json.loads((folder / "gt" / "mounts.json").read_text(encoding="utf-8"))
    moved, turned = [], []
    for mount in result.mounts:
        true = np.array(truth[mount.camera]["joint_from_cam"])
        moved.append(float(np.linalg.norm(mount.joint_from_cam[:3, 3] - true[:3, 3])))
        turned.append(float(rotation_angle_rad(mount.joint_from_cam[:3, :3].T @ true[:3, :3])))
    return {"mount_m": float(np.mean(moved)), "mount_deg": float(np.degrees(np.mean(turned)))}


def run_case(case: Case, work: Path, height_m: float | None = None) -> dict[str, float]:
    """Simulate one capture, merge it and evaluate the result."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    folder = work / f"{case.cameras}-{case.seed}-{case.t_pose}-{case.shifted}"
    context = StageContext(work_dir=work)
    shutil.rmtree(folder, ignore_errors=True)
    synthesise(case.options(), folder, context)
    inputs = load_inputs(folder, height_m)
    started = time.process_time()
    result = merge_trajectories(inputs, MergeOptions(), context)
    return {**score(folder, result), "seconds": time.process_time() - started}


def main(arguments: Sequence[str]) -> int:
    """Run all cases; print one line per seed and one per set-up."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench simulation", description=__doc__)
    parser.add_argument("--cameras", type=int, nargs="*", default=sorted(CAMERAS), choices=sorted(CAMERAS))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", choices=("t-pose", "no-t-pose", "shifted"), nargs="*")
    parser.add_argument("--height-only", action="store_true", help="use the height and not the skeleton")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    kinds = {
        "t-pose": {"t_pose": True},
        "no-t-pose": {"t_pose": False},
        "shifted": {"t_pose": True, "shifted": True},
    }
    rows: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory(prefix="bodycap-simulation-") as folder:
        for cameras in options.cameras:
            for kind in options.only or kinds:
                name = f"{cameras:2} cameras, {kind}"
                for seed in range(options.first_seed, options.first_seed + options.seeds):
                    case = Case(cameras=cameras, seed=seed, **kinds[kind])
                    outcome = run_case(case, Path(folder), 1.75 if options.height_only else None)
                    rows.setdefault(name, []).append(outcome)
                    _print(f"    {name}, seed {seed}", outcome)
                _print(name, _mean(rows[name]))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 0


def _mean(outcomes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    mean = {name: float(np.mean([each[name] for each in outcomes])) for name in outcomes[0]}
    return {**mean, "log_scale": float(np.sqrt(np.mean([each["log_scale"] ** 2 for each in outcomes])))}


def _print(name: str, outcome: Mapping[str, float]) -> None:
    sys.stdout.write(
        f"{name}: joints {100 * outcome['mpjpe_m']:.2f} cm, angle {outcome['angle_deg']:.1f} "
        f"(raw {outcome['raw_angle_deg']:.1f}) deg, palm vs torso {100 * outcome['palm_m']:.2f} cm, "
        f"scale off {100 * outcome['log_scale']:+.2f} % (states {100 * outcome['stated_log_scale']:.2f}), "
        f"mounts {100 * outcome['mount_m']:.2f} cm {outcome['mount_deg']:.1f} deg, "
        f"{outcome['seconds']:.1f} s\n"
    )
    sys.stdout.flush()
