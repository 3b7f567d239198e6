"""The metric scale with a height alone: its error against its stated sigma, over drawn captures.

``python -m tests.bench scale --number 40 --seed 1``: camera poses of torso and palms with 5 mm and 0.3° of
noise, gross errors and gaps, in a map of a drawn scale; no rendering and no points. Motion (built-in walks
and recorded motions), duration, stature, posture, proportions and mounts are drawn. The merge knows the
stature alone. The target is that 35 of 40 scales are inside 2 sigma.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import GAUGE, posed
from tests.bench.rows import DATA

_WALKS = ("simple", "gait")
_LEAST_S, _MOST_S = 4.0, 10.0
"""Limits of the drawn duration of a capture, seconds. A shorter recording is used as a whole."""
_LOWEST_M, _HIGHEST_M = 1.55, 1.92
"""Limits of the drawn stature, metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The scale of one drawn capture.

    Attributes:
        name: Motion and seed.
        seconds: Duration of the capture.
        error: Logarithm of the ratio: estimated scale / true scale.
        sigma: Stated sigma of the logarithm of the scale.
    """

    name: str
    seconds: float
    error: float
    sigma: float


def drawn_options(number: int, seed: int, motions: Path) -> Iterator[tuple[str, SynthOptions]]:
    """Yield the name and the options of each capture; a capture does not depend on their number."""
    lengths = {path: length_s(path) for path in sorted(motions.glob("*.bvh"))}
    kinds: list[str | Path] = [*_WALKS, *lengths]
    for index in range(number):
        rng = np.random.default_rng([seed, index])
        kind = kinds[int(rng.integers(len(kinds)))]
        longest_s = lengths[kind] if isinstance(kind, Path) else _MOST_S
        seconds = longest_s if longest_s < _LEAST_S else float(rng.uniform(_LEAST_S, longest_s))
        settings = {
            "poses_only": True,
            "seconds": seconds,
            "seed": int(rng.integers(1 << 20)),
            "subject_height_m": float(rng.uniform(_LOWEST_M, _HIGHEST_M)),
        }
        if isinstance(kind, Path):
            start_s = float(rng.uniform(0.0, longest_s - seconds))
            settings |= {"motion": kind, "motion_start_s": start_s}
        else:
            settings |= {"walk": kind, "posture_spread": 1.0}
        name = f"{seed}_{index:02}_{kind.stem if isinstance(kind, Path) else kind}"
        yield name, SynthOptions.model_validate(settings)


def scale_of(name: str, options: SynthOptions) -> Outcome:
    """Merge one capture with the stature alone, and compare its scale with the truth."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    capture = posed(options)
    skeleton = load_skeleton("upper_body", options.subject_height_m)
    inputs = replace(
        capture.inputs,
        skeleton=skeleton,
        skeleton_is_measured=False,
        mounts=tuple(nominal_mount(mount.camera, mount.role, skeleton) for mount in capture.mounts),
    )
    with tempfile.TemporaryDirectory(prefix="bodycap-scale-") as folder:
        result = merge_trajectories(inputs, MergeOptions(), StageContext(work_dir=Path(folder)))
    return Outcome(
        name=name,
        seconds=options.seconds,
        error=float(np.log(result.world_from_map[GAUGE].scale * capture.gauges[GAUGE].scale)),
        sigma=float(result.report.scale.relative_sigma),
    )


def summary(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return one line about some captures."""
    error = np.array([each.error for each in outcomes])
    ratio = error / [each.sigma for each in outcomes]
    return (
        f"{name:8}: {int((np.abs(ratio) <= 2.0).sum())} of {len(error)} inside 2 sigma; error mean "
        f"{100 * error.mean():+.1f} %, rms {100 * np.sqrt((error**2).mean()):.1f} %; stated median "
        f"{100 * np.median([each.sigma for each in outcomes]):.1f} %; rms of error / sigma "
        f"{np.sqrt((ratio**2).mean()):.2f}, largest {np.abs(ratio).max():.1f}\n"
    )


def main(arguments: Sequence[str]) -> int:
    """Print one line per capture, per motion, and for all."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench scale", description=__doc__)
    parser.add_argument("--number", type=int, default=40, help="number of captures (40)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draws (1)")
    parser.add_argument("--motions", type=Path, default=DATA / "motions", help="folder of BVH files")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    kinds: dict[str, list[Outcome]] = {}
    for name, settings in drawn_options(options.number, options.seed, options.motions):
        found = scale_of(name, settings)
        kinds.setdefault(name.split("_", 2)[2], []).append(found)
        sys.stdout.write(
            f"    {found.name}: {found.seconds:.1f} s, {settings.subject_height_m:.2f} m, off "
            f"{100 * found.error:+.1f} %, states {100 * found.sigma:.1f} %, "
            f"{found.error / found.sigma:+.1f} sigma\n"
        )
        sys.stdout.flush()
    every = [each for outcomes in kinds.values() for each in outcomes]
    for kind, outcomes in sorted(kinds.items()):
        sys.stdout.write(summary(kind, outcomes))
    sys.stdout.write(summary("all", every))
    if options.json:
        options.json.write_text(json.dumps([asdict(each) for each in every], indent=1), encoding="utf-8")
    return 0


def length_s(path: Path) -> float:
    """Return the usable duration of a recorded motion, seconds."""
    motion = read_bvh(path)[1]
    return 0.0 if motion is None else (len(motion.root_in_world_m) - 2) / motion.fps - 0.1
