"""Time and memory of the merge stage by duration and size of the body, each case in a process of its own.

``python -m tests.bench solving``: simulated captures (see `simulation`) of 1,000 and 10,000 frames with the
nine bones of chest and arms, and of 10,000 frames with fifteen bones. Prints CPU seconds of one core for the
whole stage and for its motion, and the largest resident memory including libraries and simulation.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import posed
from tests.bench.simulation import PALMS

BODIES = {
    9: PALMS,
    15: (*PALMS, "hips", "left_thigh", "right_thigh", "left_shin", "right_shin"),
}
CASES = ((1_000, 9), (10_000, 9), (10_000, 15))
ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TBB_NUM_THREADS"), "1")


class _Phases:
    """CPU seconds at the start of each phase."""

    def __init__(self) -> None:
        self.began: dict[str, float] = {}

    def __call__(self, _done: int, _total: int, what: str) -> None:
        self.began.setdefault(what, time.process_time())


def measure(frames: int, bones: int) -> dict[str, Any]:
    """Merge one simulated capture in this process."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    options = SynthOptions(seconds=frames / 30, cameras=BODIES[bones], seed=1, poses_only=True, t_pose_s=2.0)
    capture = posed(options)
    phases = _Phases()
    with tempfile.TemporaryDirectory(prefix="bodycap-solving-") as folder:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        started = time.process_time()
        result = merge_trajectories(
            capture.inputs, MergeOptions(), StageContext(work_dir=Path(folder), progress=phases)
        )
        ended = time.process_time()
    return {
        "frames": len(result.graph_world_from_joint),
        "bones": int(result.solved.sum()),
        "cameras": len(result.trajectories),
        "seconds": ended - started,
        "motion_seconds": ended - phases.began["solving"],
        "before_mb": before / 1024,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def lines_of(case: dict[str, Any], first: dict[str, Any] | None) -> str:
    """Return one case as a line of text, compared with the first case of the same body."""
    text = (
        f"{case['frames']:6} frames x {case['bones']} bones, {case['cameras']} cameras: "
        f"{case['seconds']:.1f} s ({case['motion_seconds']:.1f} for the motion), peak "
        f"{case['peak_mb']:.0f} MB ({case['before_mb']:.0f} before)"
    )
    if first is None or first is case or first["bones"] != case["bones"]:
        return text
    longer, more = case["frames"] / first["frames"], case["seconds"] / first["seconds"]
    return f"{text}; {more:.1f} times the seconds of the first, for {longer:.1f} times its frames"


def main(arguments: Sequence[str]) -> int:
    """Run all cases; print one line per case."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench solving", description=__doc__)
    parser.add_argument("--frames", type=int, help="run a single case in this process and print JSON")
    parser.add_argument("--bones", type=int, choices=sorted(BODIES), default=9)
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    if options.frames:
        sys.stdout.write(json.dumps(measure(options.frames, options.bones)) + "\n")
        return 0
    done: list[dict[str, Any]] = []
    for frames, bones in CASES:
        command = [
            sys.executable,
            "-m",
            "tests.bench",
            "solving",
            "--frames",
            str(frames),
            "--bones",
            str(bones),
        ]
        child = subprocess.run(
            command, env={**os.environ, **ONE_CORE}, check=True, stdout=subprocess.PIPE, text=True
        )
        done.append(json.loads(child.stdout))
        sys.stdout.write(lines_of(done[-1], done[0]) + "\n")
        sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(done, indent=1), encoding="utf-8")
    return 0
