"""Alignment of maps without common views, by the body: errors of the cameras over random walks.

``python -m tests.bench joining``: the walker of ``bodycap synth --poses`` with camera poses in three maps,
each with its own scale and axes; mounts and noise as in ``simulation``. A camera counts as placed if the
median distance of its path from the true path, in the main map, is below 5 cm. A run can be split: ``--seeds
0-5 --json FILE``, then ``--seeds 6-11`` with the same file; the last summary covers both.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import Posed, posed
from tests.bench.simulation import ARMS, PALMS

SPLITS: Mapping[str, Mapping[str, str]] = {
    "an arm each": {
        "torso": "a",
        "left_palm": "b",
        "left_upper_arm": "b",
        "right_palm": "c",
        "right_upper_arm": "c",
    },
    "upper arms, palms": {
        "torso": "a",
        "left_upper_arm": "b",
        "right_upper_arm": "b",
        "left_palm": "c",
        "right_palm": "c",
    },
    "a palm each": {"torso": "a", "left_palm": "b", "right_palm": "c"},
}
PLACED_M = 0.05


def run_case(split: str, seed: int, seconds: float) -> dict[str, Any]:
    """Simulate one walk, align its maps, and compare with the truth."""
    from bodycap_batch.merging.main_map import candidate_main_maps  # gtsam takes a second to import
    from bodycap_batch.merging.map_alignment.align import align_cameras

    cameras = ARMS if len(SPLITS[split]) == len(ARMS) else PALMS
    options = SynthOptions(seconds=seconds, cameras=cameras, seed=seed, poses_only=True)
    capture = posed(options, SPLITS[split])
    started = time.process_time()
    main, further = candidate_main_maps(capture.inputs, ())[0]
    together = align_cameras(capture.inputs, main, further, lambda: None)
    return {
        "seconds": time.process_time() - started,
        "off_m": _off(capture, together.main_from_gauge, main[0].gauge),
        "sigma_m": {camera: shift for camera, (_, shift) in together.sigmas.items()},
        "refused": dict(together.unused),
    }


def _off(capture: Posed, places: Mapping[str, Any], main: str) -> dict[str, float]:
    """Return, per camera of a further map, the median distance (m) of its path from the true path."""
    out = {}
    for each in capture.inputs.trajectories:
        if each.gauge != main and each.gauge in places:
            true = capture.gauges[main].after(capture.gauges[each.gauge].inverse())
            centres = each.gauge_from_cam[each.localised, :3, 3]
            apart = np.linalg.norm(places[each.gauge].apply(centres) - true.apply(centres), axis=1)
            out[each.camera] = float(np.median(apart)) / capture.gauges[main].scale
    return out


def summary(outcomes: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the fraction of cameras placed and refused, and the ratio of errors to stated sigmas."""
    off = [value for each in outcomes for value in each["off_m"].values()]
    stated = [each["sigma_m"][camera] for each in outcomes for camera in each["off_m"]]
    refused = sum(len(each["refused"]) for each in outcomes)
    total = len(off) + refused
    ratio = np.array(off) / (np.sqrt(3.0) * np.array(stated))
    return {
        "cameras": total,
        "placed": float(np.mean([*(value < PLACED_M for value in off), *[False] * refused])),
        "misplaced": sum(value >= PLACED_M for value in off),
        "refused": refused,
        "median_m": float(np.median(off)) if off else float("nan"),
        "worst_m": max(off, default=float("nan")),
        "stated_sigma_m": float(np.median(stated)) if stated else float("nan"),
        "error_over_sigma": float(np.sqrt((ratio**2).mean())) if off else float("nan"),
        "seconds": float(np.mean([each["seconds"] for each in outcomes])),
    }


def main(arguments: Sequence[str]) -> int:
    """Run all cases; print one line per seed and one per split."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench joining", description=__doc__)
    parser.add_argument("--splits", nargs="*", default=list(SPLITS), choices=list(SPLITS))
    parser.add_argument(
        "--seeds", type=_seeds, default=range(24), help="number of seeds, or FIRST-LAST, both included"
    )
    parser.add_argument("--seconds", type=float, default=1000 / 30)
    parser.add_argument(
        "--json", type=Path, help="file for all outcomes; those of earlier runs in it are kept and counted"
    )
    options = parser.parse_args(arguments)
    path: Path | None = options.json
    known = json.loads(path.read_text(encoding="utf-8")) if path is not None and path.exists() else {}
    for split in options.splits:
        outcomes = known.setdefault(split, {})
        for seed in options.seeds:
            outcomes[str(seed)] = run_case(split, seed, options.seconds)
            _write_line(f"    {split}, seed {seed}: {_one_line(outcomes[str(seed)])}")
            if path is not None:
                path.write_text(json.dumps(known, indent=1), encoding="utf-8")
        _write_line(f"{split}: {_all_lines(list(outcomes.values()))}")
    return 0


def _seeds(text: str) -> range:
    first, dash, last = text.partition("-")
    return range(int(first), int(last) + 1) if dash else range(int(first))


def _one_line(outcome: Mapping[str, Any]) -> str:
    errors = " ".join(f"{name} {100 * off:.1f}" for name, off in outcome["off_m"].items())
    sigma = max(outcome["sigma_m"].values(), default=float("nan"))
    refused = "; ".join(sorted(set(outcome["refused"].values())))
    return f"cm off: {errors} (sigma {100 * sigma:.1f}) {refused}"


def _all_lines(outcomes: Sequence[Mapping[str, Any]]) -> str:
    found = summary(outcomes)
    return (
        f"{100 * found['placed']:.0f} % of {found['cameras']:.0f} cameras of {len(outcomes)} walks placed "
        f"within 5 cm, {found['misplaced']:.0f} beyond, {found['refused']:.0f} refused; median "
        f"{100 * found['median_m']:.1f} cm, worst {100 * found['worst_m']:.1f}; stated sigma "
        f"{100 * found['stated_sigma_m']:.1f} cm per axis, error over it "
        f"{found['error_over_sigma']:.2f}; {found['seconds']:.1f} s"
    )


def _write_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
