"""Check the stated uncertainty of the joints: normalised squared errors over simulated captures.

``python -m tests.bench uncertainty``: for each joint, the squared error of its centre relative to the first
solved joint, over the stated covariance and the three dimensions, so that 1 is ideal. Ticks at which every
camera that determines the joint was measured are separate from ticks in a gap of one of them. The errors
within a capture share mounts and scale, so each seed counts as one draw; the 95 % band is that of a
chi-squared distribution with three times as many degrees of freedom. Below the band the stated sigmas are too
large, above it too small.

The stated uncertainty covers the variation between people, so each seed's walker has a posture of its own
(``--posture-spread 1``). Walkers with the mean posture (``--posture-spread 0``) do not test most of the
stated uncertainty of shoulders and elbows, and lie far below the band. In a T-pose all walkers stretch out
their arms; the trunk and shoulders keep their posture, and some arms are a few degrees off the horizontal.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.merge_data import MergeResult
from tests.bench.posed import GAUGE, Posed, posed
from tests.bench.simulation import CAMERAS, Case

Scores = dict[str, dict[str, list[float]]]
KINDS = ("observed", "gap")


def band(seeds: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean normalised squared error of that many captures."""
    low, high = chi2.ppf((0.025, 0.975), 3 * seeds) / (3 * seeds)
    return float(low), float(high)


def normalised_errors(capture: Posed, result: MergeResult) -> dict[str, FloatArray]:
    """Return, per role, the squared error (T,) over covariance and dimensions; 1 is ideal."""
    assert result.joint_covariance_m2 is not None
    true = capture.world_from_joint()[: len(result.graph_world_from_joint), :, :3, 3]
    mine = result.graph_world_from_joint[: len(true), :, :3, 3]
    # The uncertainty does not include the world's axes, so both are compared in the axes of the truth.
    turn = capture.gauges[GAUGE].inverse().rotation @ result.world_from_map[GAUGE].inverse().rotation
    root, *others = np.flatnonzero(result.solved).tolist()
    covariance = turn @ result.joint_covariance_m2[: len(true)] @ turn.T
    out = {}
    for joint in others:
        error = (mine[:, joint] - mine[:, root]) @ turn.T - (true[:, joint] - true[:, root])
        weighed = np.linalg.solve(covariance[:, joint], error[..., None])[..., 0]
        out[result.skeleton.roles[joint]] = (error * weighed).sum(axis=1) / 3.0
    return out


def in_gap(capture: Posed, result: MergeResult, role: str) -> BoolArray:
    """Return the ticks (T,) at which a camera that determines a joint was not measured.

    These are the cameras of the root, and those of the joint's own limb: above it, on it, or below it.
    """
    skeleton = result.skeleton
    joint, root = skeleton.roles.index(role), int(np.flatnonzero(result.solved)[0])

    def above(index: int) -> set[int]:
        chain = {index}
        while skeleton.parents[index] >= 0 and index != root:
            index = int(skeleton.parents[index])
            chain.add(index)
        return chain

    times = result.times_ns()
    out = np.zeros(len(times), dtype=bool)
    for mount, trajectory in zip(result.mounts, capture.by_mount(result.mounts), strict=True):
        bone = skeleton.roles.index(mount.role)
        if bone in above(joint) or joint in above(bone):
            clock = capture.inputs.clocks[mount.camera]
            seen = clock.common_times_ns(trajectory.times_ns[trajectory.localised])
            nearest = np.abs(seen[np.clip(np.searchsorted(seen, times), 0, len(seen) - 1)] - times)
            before = np.abs(seen[np.clip(np.searchsorted(seen, times) - 1, 0, len(seen) - 1)] - times)
            out |= np.minimum(nearest, before) > 0.75e9 / clock.nominal_fps
    return out


def run_case(case: Case, scores: Scores) -> None:
    """Simulate and merge; add each joint's mean normalised squared errors to `scores`."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    capture = posed(case.options())
    with tempfile.TemporaryDirectory(prefix="bodycap-uncertainty-") as folder:
        result = merge_trajectories(capture.inputs, MergeOptions(), StageContext(work_dir=Path(folder)))
    for role, errors in normalised_errors(capture, result).items():
        gap = in_gap(capture, result, role)[: len(errors)]
        for kind, mask in zip(KINDS, (~gap, gap), strict=True):
            if mask.any():
                scores.setdefault(role, {}).setdefault(kind, []).append(float(errors[mask].mean()))


def lines_of(scores: Scores) -> list[str]:
    """Return the table: the mean per joint and kind, and whether it is in its band."""
    text, inside, total = [], 0, 0
    for role, kinds in scores.items():
        parts = []
        for kind in KINDS:
            values = kinds.get(kind, [])
            if values:
                low, high = band(len(values))
                mean = float(np.mean(values))
                good = low <= mean <= high
                inside, total = inside + good, total + 1
                parts.append(f"{kind} {mean:.2f} {'in ' if good else 'OUT'} [{low:.2f}, {high:.2f}]")
        text.append(f"    {role:14} " + "   ".join(parts))
    text.append(f"    {inside} of {total} in their 95 % band")
    return text


def main(arguments: Sequence[str]) -> int:
    """Run all cases; print one table per set of cameras."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench uncertainty", description=__doc__)
    parser.add_argument("--cameras", type=int, nargs="*", default=sorted(CAMERAS), choices=sorted(CAMERAS))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=1000 / 30)
    parser.add_argument("--only", choices=("t-pose", "no-t-pose"), nargs="*", default=["t-pose", "no-t-pose"])
    parser.add_argument("--posture-spread", type=float, default=1.0)
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    figures: dict[str, Scores] = {}
    for cameras in options.cameras:
        for kind in options.only:
            name = f"{cameras:2} cameras, {kind}, {options.seeds} seeds"
            for seed in range(options.seeds):
                case = Case(
                    cameras=cameras,
                    seed=seed,
                    t_pose=kind == "t-pose",
                    seconds=options.seconds,
                    posture_spread=options.posture_spread,
                )
                run_case(case, figures.setdefault(name, {}))
            sys.stdout.write("\n".join([f"{name}: squared error over covariance", *lines_of(figures[name])]))
            sys.stdout.write("\n")
            sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return 0
