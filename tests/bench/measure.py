"""How well `bodycap evaluate --video` judges: true poses must be right, and injected errors must be found.

The true poses of each camera are given to the measure as if a job had delivered them. Then errors are drawn
into them. A case is found if not both sides of the error keep more than half of their frames right: at least
half of the frames of one side are then not said to be right together with the other side. A case is drawn
only where the measure calls more than half of each side right with the true poses, and where the error moves
the camera. Leaps and scale jumps where the pictures do not measure positions (the camera turns on the spot,
or sees too little) are counted apart, in brackets.

EuRoC's pictures are not among the captures, only a part of its inertial samples and poses.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import CaptureCamera, open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.evaluate.picture_check import read_pictures
from bodycap_batch.evaluate.right_frames import Pictures, RightFrames, find_right_frames
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.geometry import invert, make_transform, poses_at, so3_exp
from tests.bench.rows import DATA

CAPTURES = ("walk12", "room12", "room131", "walk131", "walk131_02", "roll131", "clocks05", "tum_fr1_xyz")
FRAMES = 300
"""Number of frames of each camera, from the first one on."""
CASES = 3
"""Number of drawn cases of each kind of error, per camera."""
_SIDE_FRAMES = 15
"""Minimum number of frames on each side of an error that lasts until the end."""
_SPANS = 3
"""Number of right triples that must span an error, with the true poses, for positions to be measurable."""
_MAX_DRAWS = 40
"""Number of draws after which a case is given up: the camera hardly moves, or is not measurable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Harm:
    """Delivered poses with one error.

    Attributes:
        world_from_cam: (N,4,4) poses; NaN for lost frames.
        moved: (N,) True on one side of the error.
        what: The parameters of the error.
    """

    world_from_cam: FloatArray
    moved: BoolArray
    what: str


def steps_m(path: FloatArray) -> FloatArray:
    """Return the distance from each frame (N,) to the next; the last one is repeated."""
    lengths = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    return np.append(lengths, lengths[-1:])


def fold(path: FloatArray, rng: np.random.Generator) -> Harm | None:
    """Turn the path by 90 or 180 degrees, and move it by up to 30 steps, from a frame on or for a stretch."""
    moved = _rest(path, rng) if rng.random() < 0.5 else _stretch(path, rng, (15, 60))
    return None if moved is None or not _is_posed(path, moved) else _folded(path, moved, rng)


def lost_fold(path: FloatArray, rng: np.random.Generator) -> Harm | None:
    """Fold the path after 10 to 40 frames that have no pose."""
    moved, lost = _rest(path, rng), int(rng.integers(10, 41))
    start = int(np.argmax(moved))
    if start - lost < _SIDE_FRAMES or not _is_posed(path, moved):
        return None
    harm = _folded(path, moved, rng)
    harm.world_from_cam[start - lost : start] = np.nan
    return Harm(world_from_cam=harm.world_from_cam, moved=moved, what=f"{harm.what}, {lost} frames lost")


def _folded(path: FloatArray, moved: BoolArray, rng: np.random.Generator) -> Harm:
    axis = rng.normal(size=3)
    angle = float(rng.choice([90, 180]))
    turn = so3_exp(np.deg2rad(angle) * axis / np.linalg.norm(axis))
    shift = _shift(path, rng, (0, 30))
    start = path[int(np.argmax(moved))]
    out = path.copy()
    about = make_transform(np.eye(3), start[:3, 3])
    out[moved] = about @ make_transform(turn, shift) @ invert(about) @ path[moved]
    return Harm(world_from_cam=out, moved=moved, what=f"turned by {angle:.0f} degrees")


def leap(path: FloatArray, rng: np.random.Generator) -> Harm | None:
    """Move a stretch of 10 to 60 frames by 5 to 30 usual steps."""
    moved = _stretch(path, rng, (10, 60))
    if moved is None or not _is_posed(path, moved):
        return None
    shift = _shift(path, rng, (5, 30))
    out = path.copy()
    out[moved, :3, 3] += shift
    return Harm(world_from_cam=out, moved=moved, what=f"{np.count_nonzero(moved)} frames moved")


def scale_jump(path: FloatArray, rng: np.random.Generator) -> Harm | None:
    """Lengthen or shorten all steps from a frame on; the path has no gap."""
    moved = _rest(path, rng)
    start = int(np.argmax(moved))
    if not _is_posed(path, moved):
        return None
    steps = steps_m(path)
    beside = steps[max(0, start - 30) : start + 30]
    # A camera that stands still on either side has no scale there.
    if min(
        np.nanmedian(steps[max(0, start - 30) : start]), np.nanmedian(steps[start : start + 30])
    ) < 0.5 * max(np.nanmedian(beside), np.nanmedian(steps)):
        return None
    factor = float(rng.uniform(0.5, 0.8) if rng.random() < 0.5 else rng.uniform(1.25, 2.0))
    out = path.copy()
    out[moved, :3, 3] = path[start, :3, 3] + factor * (path[moved, :3, 3] - path[start, :3, 3])
    return Harm(world_from_cam=out, moved=moved, what=f"steps times {factor:.2f}")


KINDS: Mapping[str, Callable[[FloatArray, np.random.Generator], Harm | None]] = {
    "fold": fold,
    "fold across lost frames": lost_fold,
    "leap": leap,
    "scale jump": scale_jump,
}


def _rest(path: FloatArray, rng: np.random.Generator) -> BoolArray:
    start = int(rng.integers(_SIDE_FRAMES, len(path) - _SIDE_FRAMES))
    return np.arange(len(path)) >= start


def _stretch(path: FloatArray, rng: np.random.Generator, lengths: tuple[int, int]) -> BoolArray | None:
    length = int(rng.integers(lengths[0], lengths[1] + 1))
    if length + 2 > len(path):
        return None
    start = int(rng.integers(1, len(path) - length))
    return (np.arange(len(path)) >= start) & (np.arange(len(path)) < start + length)


def _is_posed(path: FloatArray, moved: BoolArray) -> bool:
    """Return True if the first moved frame has a true pose."""
    return bool(np.isfinite(path[int(np.argmax(moved)), 0, 3]))


def _shift(path: FloatArray, rng: np.random.Generator, steps: tuple[int, int]) -> FloatArray:
    direction = rng.normal(size=3)
    length = rng.uniform(*steps) * np.nanmedian(steps_m(path))
    return np.asarray(length * direction / np.linalg.norm(direction))


def is_found(right: BoolArray, harm: Harm) -> bool:
    """Return True if at least half of the frames of one side are not right."""
    posed = np.isfinite(harm.world_from_cam[:, 0, 3])
    return not all(np.mean(right[side & posed]) > 0.5 for side in (harm.moved, ~harm.moved))


def is_measurable(harm: Harm, spans: Sequence[tuple[int, int]]) -> bool:
    """Return True if the pictures measure positions across the error, with the true poses.

    Each end of the moved stretch must be spanned by `_SPANS` right triples. Else the camera turns on the spot
    or sees too little there, and nothing in the pictures tells its position.
    """
    ends = 1 + np.flatnonzero(np.diff(harm.moved.astype(int)))
    return all(sum(first < end <= last for first, last in spans) >= _SPANS for end in ends)


def _right(found: RightFrames) -> BoolArray:
    return np.array([outcome is Outcome.RIGHT for outcome in found.outcome])


def true_poses(truth: Path, camera: CaptureCamera) -> FloatArray:
    """Return the true pose (N,4,4) of each frame; NaN where the truth has a gap."""
    poses = read_tum(truth)
    found, known = poses_at(
        poses.times_ns, poses.world_from_cam, camera.times_ns, max_gap_ns=40_000_000, snap_ns=1_000_000
    )
    found[~known] = np.nan
    return found


def true_readout_s(folder: Path) -> float:
    """Return the true readout time of a capture's cameras; 0 if the truth names none."""
    clocks = folder / "gt" / "clocks.json"
    return float(json.loads(clocks.read_bytes())["rolling_shutter_s"]) if clocks.exists() else 0.0


def judge(pictures: Pictures, world_from_cam: FloatArray) -> RightFrames:
    """Judge poses by the pictures."""
    return find_right_frames(pictures, world_from_cam)


def run_camera(name: str, pictures: Pictures, path: FloatArray, cases: int) -> dict[str, Any]:
    """Return the figures of one camera: with the true poses, and with each drawn error."""
    begun = time.process_time()
    base = judge(pictures, path)
    seconds = time.process_time() - begun
    right = _right(base)
    spans = [frames for frames, outcome in base.legs.items() if outcome is Outcome.RIGHT]
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    drawn = []
    for kind, draw in KINDS.items():
        for _ in range(cases):
            harm = next(_usable(path, right, draw, rng), None)
            if harm is None:
                continue
            found = _right(judge(pictures, harm.world_from_cam))
            larger = harm.moved if 2 * np.count_nonzero(harm.moved) > len(path) else ~harm.moved
            drawn.append(
                {
                    "kind": kind,
                    "what": harm.what,
                    "start": int(np.argmax(harm.moved)),
                    "measurable": "fold" in kind or is_measurable(harm, spans),
                    "found": is_found(found, harm),
                    "kept": float(np.mean(found[larger & right & np.isfinite(harm.world_from_cam[:, 0, 3])])),
                }
            )
    return {
        "camera": name,
        "frames": len(path),
        "cpu_s": seconds,
        "outcome": {outcome.name: base.count(outcome) for outcome in Outcome},
        "links": {outcome.name: base.links.get(outcome, 0) for outcome in Outcome},
        "positions": {outcome.name: base.positions.get(outcome, 0) for outcome in Outcome},
        "cases": drawn,
    }


def _usable(
    path: FloatArray,
    right: BoolArray,
    draw: Callable[[FloatArray, np.random.Generator], Harm | None],
    rng: np.random.Generator,
) -> Iterator[Harm]:
    for _ in range(_MAX_DRAWS):
        harm = draw(path, rng)
        if harm is not None and not is_found(right, harm):
            yield harm


def lines_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table: a line for each capture, and the sum."""
    groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["camera"].partition("/")[0]].append(row)
    kinds = "".join(f"{kind:>26}" for kind in KINDS)
    lines = [
        f"{'capture':14}{'right':>7}{'wrong':>7}{'unknown':>9}{'links wrong':>16}{'legs wrong':>14}{kinds}"
    ]
    for name, members in [*groups.items(), ("sum", list(rows))]:
        total = {
            key: {outcome.name: sum(row[key][outcome.name] for row in members) for outcome in Outcome}
            for key in ("outcome", "links", "positions")
        }
        counts = total["outcome"]
        line = f"{name:14}{counts['RIGHT']:>7}{counts['WRONG']:>7}{counts['UNMEASURABLE']:>9}"
        for key, width in (("links", 16), ("positions", 14)):
            wrong, right = total[key]["WRONG"], total[key]["RIGHT"]
            line += f"{f'{wrong} of {wrong + right}':>{width}}"
        for kind in KINDS:
            cases = [case for row in members for case in row["cases"] if case["kind"] == kind]
            seen = [case["found"] for case in cases if case["measurable"]]
            rest = [case["found"] for case in cases if not case["measurable"]]
            text = f"{sum(seen)} of {len(seen)}" + (f" ({sum(rest)} of {len(rest)})" if rest else "")
            line += f"{text:>26}"
        lines.append(line)
    return lines


def main(arguments: Sequence[str]) -> int:
    """Print the table of all captures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench measure", description=__doc__)
    parser.add_argument("captures", nargs="*", help=f"names or folders (default: {' '.join(CAPTURES)})")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of each camera (%(default)s)")
    parser.add_argument("--cases", type=int, default=CASES, help="cases of a kind per camera (%(default)s)")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for capture in options.captures or CAPTURES:
        folder = Path(capture) if Path(capture).is_dir() else options.data / capture
        if options.frames <= 3 * _SIDE_FRAMES:
            parser.error(f"--frames must exceed {3 * _SIDE_FRAMES}")
        if not folder.is_dir():
            print(f"{capture}: no such capture in {options.data}, left out")
            continue
        for camera in open_capture(load_job(folder).capture).cameras:
            single = folder / "groundtruth.txt"
            truth = single if single.exists() else folder / "gt" / f"{camera.name}.tum"
            path = true_poses(truth, camera)[: options.frames]
            first = replace(
                camera,
                frame_numbers=camera.frame_numbers[: len(path)],
                times_ns=camera.times_ns[: len(path)],
            )
            pictures = read_pictures(first, camera.camera, true_readout_s(folder), lambda _: None)
            row = run_camera(f"{folder.name}/{camera.name}", pictures, path, options.cases)
            rows.append(row)
            print(json.dumps(row), flush=True)
    print("\n".join(lines_of(rows)))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 0 if rows else 1
