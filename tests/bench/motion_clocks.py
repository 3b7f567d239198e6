"""Measure the clocks from motion: ``python -m tests.bench clocks --only motion``.

Camera paths of generated walks and of recorded motions, with noise, gross errors, gaps and frame rates of
their own, cut so that each camera starts at another time. An offset is wrong if it is accepted and more than
100 ms off. Besides: pairs of different motions, and stored registrations of captures, cut the same way.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.clocks.motion_offsets import motion_clocks
from bodycap_batch.clocks.motion_signals import CameraPath
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.synthetic.making import Subject, draw_subject
from bodycap_batch.synthetic.measured import disturb_poses
from bodycap_batch.synthetic.moving_body import camera_poses_at
from bodycap_batch.synthetic.options import SynthOptions

WRONG_S = 0.100
LONG_S = 6.0
CAMERAS = (
    ("torso", "left_palm", "right_palm"),
    ("torso", "left_palm", "right_palm"),
    ("torso", "head", "left_upper_arm"),
    ("torso", "right_thigh", "left_forearm"),
)
DEVELOPED_ON = ("walk", "spot", "131_01", "131_02")


@dataclass(frozen=True)
class Outcome:
    """What was found for one camera; the error is estimate − truth."""

    kind: str
    camera: str
    common_s: float
    accepted: bool
    error_s: float
    sigma_s: float


def run(data: Path, share: float, seed: int, stored: Sequence[Path]) -> tuple[list[str], int]:
    """Run all trials.

    Returns:
        The lines of the table, and the number of wrong or unrelated offsets that were accepted.
    """
    motions = {path.stem: path for path in sorted((data / "motions").glob("*.bvh"))}
    lines, wrong = [], 0
    outcomes: list[Outcome] = []
    for kind in ("walk", "posture", "spot", *motions):
        most_s = length_s(motions[kind]) if kind in motions else 20.0
        if most_s < 5.0:
            continue
        for index in range(max(1, round(40 * share))):
            paths, starts = trial(kind, seed + index, most_s, motions)
            outcomes += solved(kind, paths, starts)
    for folder in stored:
        paths = stored_paths(folder)
        for index in range(max(1, round(20 * share))):
            outcomes += solved(folder.parent.name, *cut(paths, np.random.default_rng([seed, index])))
    for kind in [*dict.fromkeys(each.kind for each in outcomes), None]:
        some = [each for each in outcomes if kind in (None, each.kind)]
        note = "" if kind is None or kind not in DEVELOPED_ON else " (developed on)"
        lines.append(f"{'all' if kind is None else kind:10} {_row(some)}{note}")
    wrong = sum(each.accepted and abs(each.error_s) > WRONG_S for each in outcomes)
    names = [name for name in motions if length_s(motions[name]) > 5.0]
    found = []
    for one, two in itertools.permutations(["walk", *names], 2):
        for index in range(max(1, round(4 * share))):
            torso = trial(one, seed + 500 + index, 6.0, motions)[0][0]
            limb = trial(two, seed + 900 + index, 6.0, motions)[0][1]
            found.append(limb.camera in motion_clocks([torso, limb], torso.camera).clocks)
    accepted = sum(found)
    lines.append(f"different motions: {accepted} of {len(found)} accepted")
    return lines, wrong + accepted


def solved(kind: str, paths: Sequence[CameraPath], starts_s: Mapping[str, float]) -> Iterator[Outcome]:
    """Yield the outcome of each camera but the first one."""
    found = motion_clocks(paths, paths[0].camera)
    for path in paths[1:]:
        spans = [
            (each.times_ns[[0, -1]] * 1e-9 + starts_s[each.camera]).tolist() for each in (paths[0], path)
        ]
        common_s = min(spans[0][1], spans[1][1]) - max(spans[0][0], spans[1][0])
        clock = found.clocks.get(path.camera)
        true_s = starts_s[path.camera] - starts_s[paths[0].camera]
        yield Outcome(
            kind=kind,
            camera=path.camera,
            common_s=common_s,
            accepted=clock is not None,
            error_s=float("nan") if clock is None else clock.offset_s - true_s,
            sigma_s=float("nan") if clock is None else clock.sigma_s,
        )


def trial(
    kind: str, seed: int, longest_s: float, motions: Mapping[str, Path]
) -> tuple[list[CameraPath], dict[str, float]]:
    """Return measured paths in one map of any scale, and the common time at which each camera started."""
    rng = np.random.default_rng(seed)
    seconds = float(rng.uniform(5.0, longest_s))
    options: dict[str, object] = {"seed": seed, "seconds": seconds, "cameras": CAMERAS[seed % len(CAMERAS)]}
    if kind in motions:
        start_s = float(rng.uniform(0.0, length_s(motions[kind]) - seconds))
        options |= {"motion": motions[kind], "motion_start_s": start_s}
    options |= {"on_the_spot": True} if kind == "spot" else {}
    options |= {"posture_spread": 1.0} if kind == "posture" else {}
    subject = draw_subject(SynthOptions.model_validate(options))
    latest_s = min(3.0, seconds / 4)
    scale = float(np.exp(rng.uniform(np.log(0.1), np.log(10.0))))
    noise = float(np.exp(rng.uniform(np.log(0.1), np.log(1.5))))
    gauge = make_transform(so3_exp(rng.normal(size=3)), 3.0 * rng.normal(size=3))
    paths, starts = [], {}
    for index, mount in enumerate(subject.mounts):
        start_s = float(rng.uniform(0.0, latest_s))
        end_s = seconds - float(rng.uniform(0.0, latest_s)) * (rng.uniform() < 0.5)
        times_s, poses = _measured(subject, index, start_s, end_s, noise, rng)
        poses[:, :3, 3] *= scale
        paths.append(_path(mount.camera, np.round(times_s * 1e9), gauge @ poses))
        starts[mount.camera] = start_s
    return paths, starts


def _measured(
    subject: Subject, index: int, start_s: float, end_s: float, noise: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the times (N,) of the localised frames since the start, seconds, and poses (N,4,4)."""
    fps = float(rng.choice([15.0, 24.0, 25.0, 30.0, 30.0, 30.0, 50.0, 60.0]))
    times_s = (np.arange(int((end_s - start_s) * fps)) + rng.uniform()) / fps
    if rng.uniform() < 0.3:  # a variable frame rate
        times_s = times_s + rng.uniform(-0.3, 0.3, len(times_s)) / fps
        times_s = times_s[rng.uniform(size=len(times_s)) > 0.1]
    options = SynthOptions(
        pose_sigma_m=0.004 * noise,
        pose_sigma_deg=0.3 * noise,
        lost=float(rng.choice([0.0, 0.05, 0.15])),
        gap_frames=(3, max(4, int(0.6 * fps))),
    )
    true = camera_poses_at(subject.motion, subject.mounts[index], times_s + start_s)
    measured, present = disturb_poses(true, options, rng)
    return times_s[present], measured[present].copy()


def stored_paths(folder: Path) -> list[CameraPath]:
    """Return the paths of a results folder ``trajectories``, of cameras with a common clock."""
    paths = [
        _path(file.stem, poses.times_ns, poses.world_from_cam)
        for file in sorted(folder.glob("*.tum"))
        if mount_of(file.stem) is not None and len((poses := read_tum(file)).times_ns) > 1
    ]
    return sorted(paths, key=lambda path: path.camera != "torso")


def cut(paths: Sequence[CameraPath], rng: np.random.Generator) -> tuple[list[CameraPath], dict[str, float]]:
    """Cut paths as clips are cut: their clocks start at the first frame that is left."""
    seconds = max(float(path.times_ns[-1]) for path in paths) * 1e-9
    out, starts = [], {}
    for path in paths:
        at = float(rng.uniform(0.0, min(3.0, seconds / 4)))
        keep = path.times_ns >= at * 1e9
        first = int(path.times_ns[keep][0])
        out.append(_path(path.camera, path.times_ns[keep] - first, path.map_from_cam[keep]))
        starts[path.camera] = first * 1e-9
    return out, starts


def _path(camera: str, times_ns: FloatArray, poses: FloatArray) -> CameraPath:
    place = mount_of(camera)
    assert place is not None
    return CameraPath(
        camera=camera, role=place[1], times_ns=np.asarray(times_ns, np.int64), map_from_cam=poses
    )


def length_s(path: Path) -> float:
    """Return the duration of a recorded motion, seconds; 0 without motion."""
    motion = read_bvh(path)[1]
    return 0.0 if motion is None else (len(motion.root_in_world_m) - 2) / motion.fps


def _row(some: Sequence[Outcome]) -> str:
    """Return the figures of some outcomes."""
    parts = []
    for name, group in (
        (f">={LONG_S:g} s", [each for each in some if each.common_s >= LONG_S]),
        (f"<{LONG_S:g} s", [each for each in some if each.common_s < LONG_S]),
    ):
        near = sum(each.accepted and abs(each.error_s) <= 0.05 for each in group)
        accepted = sum(each.accepted for each in group)
        parts.append(f"{name}: {accepted:3}/{len(group):3} accepted, {near:3} within 50 ms")
    done = [each for each in some if each.accepted]
    error = np.abs([each.error_s for each in done])
    if not done:
        return "; ".join(parts)
    inside = np.mean(error <= 2 * np.array([each.sigma_s for each in done]))
    median, most = 1e3 * np.quantile(error, [0.5, 0.95])
    return (
        f"{'; '.join(parts)}; wrong {np.sum(error > WRONG_S)}; error {median:.0f} ms, 95 % {most:.0f} ms; "
        f"in 2 sigma {100 * inside:.0f} %"
    )
