"""Mounts that slip: which slips are found, false alarms, and the error of the joints after a slip.

``python -m tests.bench slips``: camera poses of torso and palms in drawn takes (built-in walks and recorded
motions in turn), without pictures. The noise of the poses is drawn between that of sharp and of blurred
rendered captures; 2 % of the frames are lost and 2 % are grossly wrong. At a drawn instant between 25 and
75 % of a take, one drawn camera turns by 15° or moves by 3 cm about or along a drawn axis. Each take is also
merged untouched, with the same noise: this counts false alarms, and gives the error of the joints that the
slip should not change. A slip is found if it is within 1 s and 5° (and 2 cm) of the true one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.merging.cameras import mount_slips
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.cameras.track_outliers import remove_outliers
from bodycap_batch.model.geometry import make_transform, rotation_angle_rad, so3_exp
from bodycap_batch.model.merge_data import MergeInputs, MergeResult
from bodycap_batch.model.skeleton import MountSlip, SkeletonModel
from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.moving_body import MovingBody
from tests.bench.posed import GAUGE, Posed, posed
from tests.bench.rows import DATA
from tests.bench.scale import length_s

_WALKS = ("simple", "gait")
_LEAST_S, _MOST_S = 5.0, 9.0
"""Limits of the drawn duration of a take, seconds. A shorter recording is used as a whole."""
_NOISE_M = 0.0003, 0.003
"""Limits of the drawn noise of the poses, metres per axis: white noise of the camera paths of whole jobs on
rendered captures, sharp (0.2 to 0.7 mm) and half of them blurred (3 mm)."""
_NOISE_DEG_PER_M = 30.0
"""Noise of the rotation per noise of the position in these jobs (0.02° at 0.6 mm, 0.07° at 3 mm)."""
_TURN_RAD, _MOVE_M = float(np.radians(15.0)), 0.03
_MAX_OFF_S, _MAX_OFF_DEG, _MAX_OFF_M = 1.0, 5.0, 0.02
_LIMBS = {"torso": ("Left", "Right"), "left_palm": ("Left",), "right_palm": ("Right",)}
_JOINTS = ("ForeArm", "Hand")
_BAD_RIGHT_WRIST = "131_"
"""Recordings whose right wrist turns by up to 120° from one frame to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidRightHand:
    """A motion whose right hand does not turn against the forearm."""

    motion: MovingBody
    skeleton: SkeletonModel

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions and local rotations as the motion, with a rigid wrist."""
        root, local = self.motion.pose(t_s)
        local = local.copy()
        local[:, self.skeleton.index_of_role("RightHand")] = np.eye(3)
        return root, local


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """A drawn take, and the slip that is drawn for it.

    Attributes:
        name: Motion and number.
        capture: The simulated camera poses.
        camera: Camera that slips.
        frame: First frame after the slip.
        step: (4,4) pose of the camera after the slip, in its axes before the slip, metres.
        kind: ``turn`` or ``move``.
        noise_m: Noise of the poses, metres per axis.
    """

    name: str
    capture: Posed
    camera: str
    frame: int
    step: FloatArray
    kind: str
    noise_m: float

    def slipped(self, frames: int) -> MergeInputs:
        """Return the inputs with a slip that takes this number of frame intervals."""
        inputs, map_from_world = self.capture.inputs, self.capture.gauges[GAUGE]
        out = []
        for each in inputs.trajectories:
            poses = each.gauge_from_cam.copy()
            if each.camera == self.camera:
                for number in range(frames):
                    share = (number + 1) / frames
                    turn = so3_exp(share * _rotvec(self.step))
                    step = make_transform(turn, share * map_from_world.scale * self.step[:3, 3])
                    last = None if number == frames - 1 else self.frame + number + 1
                    poses[self.frame + number : last] = poses[self.frame + number : last] @ step
            out.append(replace(each, gauge_from_cam=poses))
        return replace(inputs, trajectories=tuple(out))


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """A take with a slip, and untouched.

    Attributes:
        name: Motion, number, camera and kind of the slip.
        found: True if the slip was found, at its instant.
        off_s: Time between the found and the true slip; NaN if none was found in this camera.
        off_deg: Angle between the found and the true step.
        off_m: Distance between the found and the true step.
        wrong: Number of other slips that were reported in this take.
        false_alarms: Number of slips that were reported in the untouched take.
        before_m: Mean error of the limb's joints before the slip.
        after_m: Mean error of these joints after the slip.
        untouched_before_m: As `before_m`, in the untouched take.
        untouched_after_m: As `after_m`, in the untouched take.
        ignored_after_m: As `after_m`, if slips are not searched.
    """

    name: str
    found: bool
    off_s: float
    off_deg: float
    off_m: float
    wrong: int
    false_alarms: int
    before_m: float = float("nan")
    after_m: float = float("nan")
    untouched_before_m: float = float("nan")
    untouched_after_m: float = float("nan")
    ignored_after_m: float = float("nan")


def drawn_takes(number: int, seed: int, motions: Path) -> Iterator[Take]:
    """Yield drawn takes; a take does not depend on their number."""
    lengths = {path: length_s(path) for path in sorted(motions.glob("*.bvh"))}
    kinds: list[str | Path] = [*_WALKS, *lengths]
    order = np.random.default_rng(seed).permutation(len(kinds))
    for index in range(number):
        rng = np.random.default_rng([seed, index])
        kind = kinds[int(order[index % len(kinds)])]
        longest_s = lengths[kind] if isinstance(kind, Path) else _MOST_S
        seconds = longest_s if longest_s < _LEAST_S else float(rng.uniform(_LEAST_S, min(longest_s, _MOST_S)))
        noise_m = float(np.exp(rng.uniform(*np.log(_NOISE_M))))
        settings = {
            "poses_only": True, "seconds": seconds, "seed": int(rng.integers(1 << 20)),
            "pose_sigma_m": noise_m, "pose_sigma_deg": _NOISE_DEG_PER_M * noise_m,
        }  # fmt: skip
        if isinstance(kind, Path):
            start_s = float(rng.uniform(0.0, longest_s - seconds))
            settings |= {"motion": kind, "motion_start_s": start_s}
        else:
            settings |= {"walk": kind, "posture_spread": 1.0}
        name = kind.stem if isinstance(kind, Path) else kind
        capture = posed(
            SynthOptions.model_validate(settings),
            move=_rigid_hand if name.startswith(_BAD_RIGHT_WRIST) else None,
        )
        yield _take(f"{seed}_{index:02}_{name}", capture, "turn" if index % 2 else "move", noise_m, rng)


def _rigid_hand(motion: MovingBody) -> MovingBody:
    return RigidRightHand(motion=motion, skeleton=motion.skeleton)


def _take(name: str, capture: Posed, kind: str, noise_m: float, rng: np.random.Generator) -> Take:
    trajectory = capture.inputs.trajectories[int(rng.integers(len(capture.inputs.trajectories)))]
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turn = so3_exp(_TURN_RAD * axis) if kind == "turn" else np.eye(3)
    move = _MOVE_M * axis if kind == "move" else np.zeros(3)
    frame = int(rng.uniform(0.25, 0.75) * len(trajectory.times_ns))
    return Take(
        name=f"{name} {trajectory.camera} {kind}", capture=capture, camera=trajectory.camera, frame=frame,
        step=make_transform(turn, move), kind=kind, noise_m=noise_m,
    )  # fmt: skip


def _rotvec(step: FloatArray) -> FloatArray:
    from bodycap_batch.model.geometry import so3_log

    return so3_log(step[None, :3, :3])[0]


def slips_of_tracks(inputs: MergeInputs, scale: float) -> dict[str, MountSlip]:
    """Return the slips by camera, from the paths alone, as the merge finds them.

    Args:
        inputs: Inputs of the merge.
        scale: Metres per map unit.
    """
    out = {}
    for each in inputs.trajectories:
        fps = inputs.clocks[each.camera].nominal_fps
        track = remove_outliers(make_track(inputs, each, 0), scale, fps)
        if slip := mount_slips.find_slip(track.scaled(scale)):
            out[each.camera] = slip
    return out


def _merge(inputs: MergeInputs, *, search: bool = True) -> MergeResult:
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    run: Callable[[], MergeResult] = lambda: merge_trajectories(  # noqa: E731
        inputs, MergeOptions(), StageContext(work_dir=Path())
    )
    if search:
        return run()
    with mock.patch("bodycap_batch.merging.stage.find_slip", return_value=None):
        return run()


def _slips(result: MergeResult) -> dict[str, MountSlip]:
    return {mount.camera: mount.slip for mount in result.mounts if mount.slip is not None}


def joint_errors(take: Take, result: MergeResult) -> tuple[float, float]:
    """Return the mean error of the limb's joints against the chest before and after the slip, metres."""
    true = take.capture.world_from_joint()
    count = min(len(true), len(result.graph_world_from_joint))
    axes = result.world_from_map[GAUGE].after(take.capture.gauges[GAUGE]).rotation
    mine = np.einsum("ji,tkj->tki", axes, result.graph_world_from_joint[:count, :, :3, 3])
    roles = result.skeleton.roles
    chest = roles.index("Spine1")
    joints = [roles.index(side + part) for side in _LIMBS[take.camera] for part in _JOINTS]
    relative = [part[:, joints] - part[:, [chest]] for part in (mine, true[:count, :, :3, 3])]
    off = np.linalg.norm(relative[0] - relative[1], axis=-1)
    seen = result.observed[:count][:, joints]
    after = result.times_ns()[:count] >= slip_ns(take)
    return float(off[~after][seen[~after]].mean()), float(off[after][seen[after]].mean())


def slip_ns(take: Take) -> int:
    """Return the common time of the first frame after the slip of a take, nanoseconds."""
    inputs = take.capture.inputs
    trajectory = next(each for each in inputs.trajectories if each.camera == take.camera)
    return int(inputs.clocks[take.camera].common_times_ns(trajectory.times_ns)[take.frame])


def outcome_of(take: Take, *, frames: int = 1, paths_only: bool = False, ignored: bool = False) -> Outcome:
    """Find the slips of a take with its slip and untouched, and compare the joints with the truth.

    Args:
        take: The take.
        frames: Number of frame intervals that the slip takes.
        paths_only: True to search the paths without merging.
        ignored: True to merge the slipped take also without the search.
    """
    scale = 1.0 / take.capture.gauges[GAUGE].scale
    slipped, untouched = take.slipped(frames), take.capture.inputs
    errors: dict[str, float] = {}
    if paths_only:
        found, alarms = slips_of_tracks(slipped, scale), slips_of_tracks(untouched, scale)
    else:
        results = _merge(slipped), _merge(untouched)
        found, alarms = _slips(results[0]), _slips(results[1])
        errors["before_m"], errors["after_m"] = joint_errors(take, results[0])
        errors["untouched_before_m"], errors["untouched_after_m"] = joint_errors(take, results[1])
        if ignored:
            errors["ignored_after_m"] = joint_errors(take, _merge(slipped, search=False))[1]
    slip = found.get(take.camera)
    off_s = off_deg = off_m = float("nan")
    if slip is not None:
        off_s = 1e-9 * (slip.time_ns - slip_ns(take))
        off_deg = float(np.degrees(rotation_angle_rad(slip.before_from_after[:3, :3].T @ take.step[:3, :3])))
        off_m = float(np.linalg.norm(slip.before_from_after[:3, 3] - take.step[:3, 3]))
    is_right = abs(off_s) <= _MAX_OFF_S and off_deg <= _MAX_OFF_DEG and off_m <= _MAX_OFF_M
    return Outcome(
        name=take.name, found=is_right, off_s=off_s, off_deg=off_deg, off_m=off_m,
        wrong=len(found) - is_right, false_alarms=len(alarms), **errors,
    )  # fmt: skip


def line_of(take: Take, outcome: Outcome) -> str:
    """Return one line about a take."""
    text = (
        f"    {outcome.name:34} noise {1e3 * take.noise_m:.1f} mm: {'found' if outcome.found else '-':5} "
        f"off {outcome.off_s:+.2f} s {outcome.off_deg:3.1f}° {100 * outcome.off_m:3.1f} cm, "
        f"wrong {outcome.wrong}, false alarms {outcome.false_alarms}"
    )
    if np.isfinite(outcome.after_m):
        text += (
            f" | before {100 * outcome.before_m:.1f} (untouched {100 * outcome.untouched_before_m:.1f}), "
            f"after {100 * outcome.after_m:.1f} (untouched {100 * outcome.untouched_after_m:.1f}, ignored "
            f"{100 * outcome.ignored_after_m:.1f}) cm"
        )
    return text


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the lines about all takes."""
    out = []
    for kind in ("turn", "move", ""):
        some = [each for each in outcomes if each.name.endswith(kind)]
        found = [each for each in some if each.found]
        line = (
            f"{kind or 'all':5}: {len(found)} of {len(some)} found, {sum(each.wrong for each in some)} "
            f"wrong; false alarms in {sum(each.false_alarms > 0 for each in some)} of {len(some)} untouched"
        )
        if found and np.isfinite(found[0].after_m):
            ratio = np.array([each.after_m / each.untouched_after_m for each in found])
            lost = np.array([each.ignored_after_m / each.untouched_after_m for each in found])
            line += (
                f"; error of the joints after a found slip, divided by that of the untouched take: median "
                f"{np.median(ratio):.2f}, {ratio.min():.2f} to {ratio.max():.2f}, "
                f"{(np.abs(ratio - 1.0) <= 0.2).sum()} of {len(ratio)} within 20 %"
            )
            if np.isfinite(lost).all():
                line += f" (slip ignored: median {np.median(lost):.2f})"
        out.append(line)
    return "\n".join(out) + "\n"


def main(arguments: list[str]) -> int:
    """Print one line per take, and a summary."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench slips", description=__doc__)
    parser.add_argument("--number", type=int, default=12, help="number of takes (12)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draws (1)")
    parser.add_argument("--frames", type=int, default=1, help="frame intervals that a slip takes (1)")
    parser.add_argument("--paths-only", action="store_true", help="search the camera paths without merging")
    parser.add_argument("--ignored", action="store_true", help="merge slipped takes also without the search")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    outcomes = []
    for take in drawn_takes(options.number, options.seed, options.data / "motions"):
        outcomes.append(
            outcome_of(take, frames=options.frames, paths_only=options.paths_only, ignored=options.ignored)
        )
        sys.stdout.write(line_of(take, outcomes[-1]) + "\n")
        sys.stdout.flush()
    sys.stdout.write(summary(outcomes))
    if options.json:
        options.json.write_text(json.dumps([asdict(each) for each in outcomes], indent=1), encoding="utf-8")
    return 0
