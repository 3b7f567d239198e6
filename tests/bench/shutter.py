"""Rolling shutters: rendered captures with a drawn readout time, and their twins with a global shutter.

``python -m tests.bench shutter --number 6 --seed 1 --out FOLDER``: each capture is rendered twice, with a
drawn readout time and with a global shutter. The rest is the same: body, mounts, room, motion, noise. The
readout time is stated in neither calibration. Finished captures and jobs in the folder are used again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch import Result
from tests.bench import ours
from tests.bench.rows import BODYCAP, DATA, REPOSITORY, row_of

MAX_READOUT_S = 0.030
"""Largest drawn readout time, seconds."""
_GLOBAL_S = 0.002
"""A readout time below this one (seconds) may be taken for a global shutter."""
_MAX_RATIO = 1.5
"""Allowed ratio of the error with a rolling shutter to the error of the twin."""
_WALKS = ("simple", "gait")
_MAPPING = ("keyframes", "map", "registration", "extend", "refine", "recover")
"""Stages whose time depends on the shutter."""
Readout = tuple[float, float, str, float]
"""Readout time (s; 0: none is used), standard deviation (s), source, and most likely readout time (s)."""
_LAST_START = 0.5
"""Latest start in a recording, as a ratio of the time that the capture leaves free."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One drawn capture.

    Attributes:
        name: Name of its folder.
        readout_s: Readout time, seconds.
        options: Options of `bodycap synth` except folder and readout time.
    """

    name: str
    readout_s: float
    options: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The figures of a capture and its twin.

    Attributes:
        case: The capture.
        rolling: The result of `ours.run` for the capture.
        twin: The same for the twin.
        readouts: The readout time of each camera that the job found; see `readouts_in`.
        twin_readouts: The same for the twin.
    """

    case: Case
    rolling: dict[str, Any]
    twin: dict[str, Any]
    readouts: dict[str, Readout]
    twin_readouts: dict[str, Readout]


def main(argv: Sequence[str]) -> int:
    """Render, run the jobs and print the figures; the exit code is 0 if every job ran."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench shutter", description=__doc__)
    parser.add_argument("--number", type=int, default=6, help="number of captures with a twin each (6)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drawn captures (1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for captures and jobs, kept")
    parser.add_argument("--seconds", type=float, default=3.0, help="duration of each video (3)")
    parser.add_argument("--size", default="640x360", help="image size (640x360)")
    parser.add_argument("--motions", type=Path, default=DATA / "motions", help="folder of BVH files")
    parser.add_argument("--only", nargs="*", type=int, help="numbers of the captures to run (all)")
    parser.add_argument("--render-only", action="store_true", help="render the captures, run no job")
    parser.add_argument("--jobs", default="jobs", help="name of the folder of the jobs (jobs)")
    options = parser.parse_args(argv)
    size = ("--seconds", f"{options.seconds:g}", "--size", options.size)
    cases = drawn_cases(options.number, options.seed, options.motions, options.seconds)
    outcomes = []
    for number, case in enumerate(cases):
        if options.only is not None and number not in options.only:
            continue
        folders = [
            _rendered(options.out / name, readout_s, (*case.options, *size))
            for name, readout_s in ((case.name, case.readout_s), (f"{case.name}_twin", 0.0))
        ]
        if options.render_only:
            continue
        results = [_run(folder, options.out / options.jobs) for folder in folders]
        twice = [readouts_in(options.out / options.jobs / folder.name / "out") for folder in folders]
        outcomes.append(
            Outcome(
                case=case,
                rolling=results[0],
                twin=results[1],
                readouts=twice[0],
                twin_readouts=twice[1],
            )
        )
        _write(lines_of(outcomes[-1]))
    _write(summary(outcomes))
    return 0 if all(each.rolling["exit"] == each.twin["exit"] == 0 for each in outcomes) else 1


def drawn_cases(number: int, seed: int, motions: Path, seconds: float) -> list[Case]:
    """Draw captures: the readout times are spread evenly, the motions take turns.

    Args:
        number: Number of captures.
        seed: Seed of the draw.
        motions: Folder of recorded motions, BVH files.
        seconds: Duration of each video.
    """
    rng = np.random.default_rng(seed)
    readout_s = MAX_READOUT_S * (rng.permutation(number) + rng.random(number)) / number
    recorded = [path for path in sorted(motions.glob("*.bvh")) if _duration_s(path) >= seconds]
    files: list[Path | str] = [*recorded, *_WALKS]
    order = [files[index] for index in rng.permutation(len(files))]
    out = []
    for index in range(number):
        kind = order[index % len(order)]
        room = int(rng.integers(1, 100_000))
        start = float(rng.uniform(0.0, _LAST_START))
        if isinstance(kind, Path):
            start_s = start * (_duration_s(kind) - seconds)
            motion = ("--motion", str(kind), "--set", f"motion_start_s={start_s:.2f}")
        else:
            motion = ("--set", f"walk={kind}")
        name = f"s{seed}_{index}_{kind.stem if isinstance(kind, Path) else kind}"
        options = (*motion, "--seed", str(room))
        out.append(Case(name=name, readout_s=round(float(readout_s[index]), 5), options=options))
    return out


def _duration_s(motion: Path) -> float:
    """Return the duration of the motion in a BVH file, seconds."""
    words: dict[str, float] = {}
    for line in motion.read_text(encoding="utf-8").splitlines():
        if line.startswith(("Frames:", "Frame Time:")):
            key, value = line.split(":")
            words[key] = float(value)
        if len(words) == 2:
            break
    return words["Frames"] * words["Frame Time"]


def _rendered(folder: Path, readout_s: float, options: Sequence[str]) -> Path:
    """Render a capture unless it exists, without its readout time in the calibration."""
    if not folder.exists():
        command = [*BODYCAP, "synth", str(folder), "--set", f"rolling_shutter_s={readout_s}", *options]
        subprocess.run(
            command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        shutil.copy(folder / "gt" / "motion.bvh", folder / "skeleton.bvh")
    calibration = folder / "calib.json"
    content = json.loads(calibration.read_text(encoding="utf-8"))
    if content.pop("rolling_shutter_s", None) is not None:
        calibration.write_text(json.dumps(content, indent=1), encoding="utf-8")
    return folder


def _run(capture: Path, jobs: Path) -> dict[str, Any]:
    """Run the job of a capture unless its result exists."""
    file = jobs / f"{capture.name}.json"
    if not file.exists():
        result = ours.run(row_of(capture), jobs / capture.name)
        record = jobs / capture.name / "out" / "run.json"
        if record.exists():
            stages = Result(record.parent).record()["stages"]
            result["mapping_cpu_s"] = sum(
                stage["cpu_seconds"] or 0.0 for stage in stages if stage["stage"] in _MAPPING
            )
        file.write_text(json.dumps(result), encoding="utf-8")
    return dict(json.loads(file.read_text(encoding="utf-8")))


def readouts_in(results: Path) -> dict[str, Readout]:
    """Return the readout times in a job's results, by camera name.

    They are those that were found last: in the refined map, else from matches.
    """
    if not (results / "metrics.json").exists():
        return {}
    mapping = Result(results).metrics()["mapping"]
    found = dict(mapping.get("readouts_from_matches", {}))
    for part in mapping.get("rolling_shutter", [])[:1]:
        found.update(part)
    return {
        name: (
            each["seconds"],
            float("inf") if each["sigma_s"] is None else each["sigma_s"],
            each["source"],
            each["best_s"],
        )
        for name, each in sorted(found.items())
    }


def rms_and_worst_cm(result: dict[str, Any]) -> tuple[float, float]:
    """Return the error of all frames under one similarity, and that of the worst frame, cm; NaN: unknown."""
    error_m = _total(result).get("ate_m") or {}
    return 100.0 * error_m.get("rmse", np.nan), 100.0 * error_m.get("max", np.nan)


def frames_of(result: dict[str, Any]) -> tuple[int, int]:
    """Return the number of frames with a pose and of all frames."""
    return int(_total(result).get("registered", 0)), int(_total(result).get("frames", 0))


def _total(result: dict[str, Any]) -> dict[str, Any]:
    return dict(result.get("report", {}).get("trajectories", {}).get("total", {}))


def ratio(outcome: Outcome) -> float:
    """Return the error with a rolling shutter divided by the error of the twin; NaN if one is unknown."""
    return rms_and_worst_cm(outcome.rolling)[0] / rms_and_worst_cm(outcome.twin)[0]


def lines_of(outcome: Outcome) -> list[str]:
    """Return the figures of a capture and its twin as text."""
    case = outcome.case
    lines = [f"{case.name}: readout {1e3 * case.readout_s:.2f} ms, {ratio(outcome):.2f} times the error"]
    for name, result, readouts, true_s in (
        ("rolling", outcome.rolling, outcome.readouts, case.readout_s),
        ("global", outcome.twin, outcome.twin_readouts, 0.0),
    ):
        rms, worst = rms_and_worst_cm(result)
        posed, frames = frames_of(result)
        lines.append(
            f"    {name:7} exit {result['exit']}  {posed}/{frames}  ATE {rms:.2f} cm, worst {worst:.1f}  "
            f"map and registration {result.get('mapping_cpu_s', np.nan):.1f} s"
        )
        lines += [f"        {each}" for each in _readout_lines(readouts, true_s)]
    return lines


def _readout_lines(readouts: dict[str, Readout], true_s: float) -> list[str]:
    return [
        f"{name}: {1e3 * seconds:.2f} ± {1e3 * sigma_s:.2f} ms ({source}), "
        f"{(best_s - true_s) / sigma_s if sigma_s else np.nan:+.1f} sigma"
        for name, (seconds, sigma_s, source, best_s) in readouts.items()
    ]


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the figures of all captures together, beside the targets."""
    if not outcomes:
        return ["no job was run"]
    ratios = np.array([ratio(each) for each in outcomes])
    found = [
        (seconds, sigma_s, source, best_s, true_s)
        for each in outcomes
        for readouts, true_s in ((each.readouts, each.case.readout_s), (each.twin_readouts, 0.0))
        for seconds, sigma_s, source, best_s in readouts.values()
    ]
    rolling = [each for each in found if each[4]]
    deviation = np.array([abs(best_s - true_s) / sigma_s for _, sigma_s, _, best_s, true_s in rolling])
    sigma_ms = 1e3 * np.array([sigma_s for _, sigma_s, _, _, _ in rolling])
    missed = sum(source == "none found" and true_s >= _GLOBAL_S for _, _, source, _, true_s in found)
    false = sum(seconds != 0.0 and true_s == 0.0 for seconds, _, _, _, true_s in found)
    return [
        f"{len(outcomes)} captures: error at most {_MAX_RATIO} times that of the twin in "
        f"{int((ratios <= _MAX_RATIO).sum())}; ratios median {np.median(ratios):.2f}, "
        f"largest {ratios.max():.2f}",
        f"readouts of {len(rolling)} cameras: {(deviation <= 2.0).mean():.0%} inside 2 sigma "
        f"(90 to 98 %), median sigma {np.median(sigma_ms):.2f} ms (at most 0.5)",
        f"none found although 2 ms or more: {missed}; found although global: {false}",
    ]


def _write(lines: Sequence[str]) -> None:
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
