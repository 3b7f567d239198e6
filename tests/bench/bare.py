"""Run whole jobs on captures in which one camera looks at plain surfaces: ``python -m tests.bench bare``.

Each capture is drawn from a seed, rendered once and kept in the output folder. For each capture the figures
are: frames with a pose, the error of all cameras under one similarity, blocks of accepted frames that are
misplaced, the grades of the page, and the share of the frames that see the map which have a pose. A frame
sees the map if its true camera sees enough points of the map without occlusion, over a large enough part of
the picture, with little blur.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bodycap_batch import Result
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import Similarity, align_points, invert, transform_points
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.report.verdict import judge
from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.making import build_renderers, draw_subject
from bodycap_batch.synthetic.raycast import RayScene
from bodycap_batch.tasks.loading import load_map
from tests.bench import poses
from tests.bench.bare_draw import command_line, draw_captures
from tests.bench.rows import BODYCAP, DATA, REPOSITORY

MISPLACED_M = 0.10
"""Minimum error (m) of an accepted frame that counts as misplaced. Origin: the target."""
_MIN_POINTS, _MIN_AREA, _MAX_BLUR_PX = 30, 0.10, 10.0
"""A frame sees the map with this number of points, over this fraction of the picture, with at most this blur
(px). Origin: the target."""
_DEPTH_TOLERANCE = 0.04
"""Maximum relative difference between the distance of a visible point and that of the surface. Evidence:
none."""
_MAX_HOLE = 3
"""Maximum number of frames between two misplaced frames of one block. Evidence: none."""
_TRIMMED = 20
"""Number of rounds of the robust alignment. Evidence: none."""
_OPTIONS_FILE = "synth.json"


@dataclass(frozen=True, slots=True)
class MisplacedBlock:
    """Successive accepted frames of one camera that are misplaced.

    Attributes:
        camera: Name of the camera.
        first: Index of the first frame.
        last: Index of the last frame.
        frames: Number of misplaced frames.
        worst_cm: Largest error, centimetres.
    """

    camera: str
    first: int
    last: int
    frames: int
    worst_cm: float


def main(arguments: Sequence[str]) -> int:
    """Draw, render, run and score captures; the exit code is 0 if no wrong result is called good."""
    parser = argparse.ArgumentParser(prog="make bench ARGS='bare …'", description=__doc__)
    parser.add_argument("--number", type=int, default=6, metavar="N", help="number of captures (6)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draws (1)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the captures and results")
    parser.add_argument("--width", type=int, default=640, metavar="PX", help="width of the pictures (640)")
    parser.add_argument("--only", nargs="*", default=[], metavar="FOLDER", help="captures with truth instead")
    parser.add_argument("--tag", default="job", help="name of the results, to compare versions (job)")
    parser.add_argument("--motions", type=Path, default=DATA / "motions", help="folder of BVH files")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    folders = map(Path, options.only) if options.only else _rendered(options)
    results = []
    for folder in folders:
        results.append(run_and_score(folder, options.out / f"{folder.name}_{options.tag}", options.motions))
        _write_line("\n".join(lines_of(results[-1])))
    _write_line(summary(results))
    (options.out / f"bare_{options.tag}.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0 if not any(result["wrong_called_good"] for result in results) else 1


def _rendered(options: argparse.Namespace) -> Iterator[Path]:
    """Yield the folder of each drawn capture; captures that exist are not rendered again."""
    for drawn in draw_captures(options.number, options.seed, options.motions, options.width):
        folder = options.out / drawn.name
        if not folder.exists():
            command = [*BODYCAP, "synth", str(folder), *command_line(drawn.settings)]
            subprocess.run(command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL)
        _write_line(
            f"{drawn.name}: {drawn.camera} at {' and '.join(drawn.settings['bare'])} for "
            f"{drawn.shares[drawn.camera]:.0%} of the time"
        )
        yield folder


def run_and_score(capture: Path, work: Path, motions: Path) -> dict[str, Any]:
    """Run a job in a store of its own, if it did not run before, and score its results."""
    work.mkdir(parents=True, exist_ok=True)
    out, store = work / "out", work / "store"
    code = work / "exit.txt"
    if not code.exists():
        command = [*BODYCAP, "run", str(capture), "--out", str(out), "--store", str(store)]
        skeleton = next(iter([*capture.glob("skeleton.bvh"), *capture.glob("gt/motion.bvh")]), None)
        command += [] if skeleton is None else ["--skeleton", str(skeleton)]
        with (work / "stderr.txt").open("w", encoding="utf-8") as errors:
            done = subprocess.run(command, cwd=REPOSITORY, stdout=errors, stderr=errors, check=False)
        code.write_text(str(done.returncode), encoding="utf-8")
    result: dict[str, Any] = {"name": capture.name, "exit": int(code.read_text(encoding="utf-8"))}
    results = next((folder for folder in (out, out / "partial") if (folder / "run.json").exists()), None)
    if results is None:
        text = (work / "stderr.txt").read_text(encoding="utf-8").strip().splitlines()
        return {**result, "error": text[-3:], "wrong_called_good": False}
    return {**result, **score(capture, results, store, motions)}


def score(capture: Path, results: Path, store: Path, motions: Path) -> dict[str, Any]:
    """Return the figures of a job's results."""
    found = Result(results)
    failure = {"stage": "merge", "message": ""} if results.name == "partial" else None
    verdict = judge(found.metrics(), failure)
    paths = poses.last_poses(results, store)
    truth = {name: read_tum(capture / "gt" / f"{name}.tum") for name in paths}
    matched = {
        name: _matched(path.poses, truth[name])
        for name, path in sorted(found.placed_trajectories().items())
        if path.localised.any()
    }
    truth_from_world = robust_alignment(matched)
    errors = {
        name: np.linalg.norm(truth_from_world.apply(mine) - true, axis=1)
        for name, (_, mine, true) in matched.items()
    }
    blocks = [block for name in matched for block in misplaced_blocks(name, matched[name][0], errors[name])]
    every = np.concatenate([*errors.values()]) if errors else np.zeros(0)
    registered = {name: np.zeros(len(path.status), bool) for name, path in paths.items()}
    for name, (frames, _, _) in matched.items():
        registered[name][frames] = True
    sees = _frames_that_see(capture, _last_map(results, store, paths), paths, truth, matched, motions)
    seen = {name: (int((mask & registered[name]).sum()), int(mask.sum())) for name, mask in sees.items()}
    total = sum(len(mask) for mask in registered.values())
    return {
        "frames": total,
        "registered": int(sum(mask.sum() for mask in registered.values())),
        "per_camera": {name: [int(mask.sum()), len(mask)] for name, mask in registered.items()},
        "ate_cm": 100 * float(np.sqrt((every**2).mean())) if len(every) else None,
        "worst_cm": 100 * float(every.max()) if len(every) else None,
        "median_cm": 100 * float(np.median(every)) if len(every) else None,
        "misplaced": [asdict(block) for block in blocks],
        "seen": seen,
        "cameras": verdict.cameras.name,
        "body": None if verdict.body is None else verdict.body.name,
        "verdict": verdict.headline,
        "wrong_called_good": bool(blocks) and verdict.cameras.name == "GOOD",
    }


def _matched(mine: TimedPoses, true: TimedPoses) -> tuple[Any, FloatArray, FloatArray]:
    """Return the frame indices, the estimated and the true centres of the frames with a pose."""
    frames = np.searchsorted(true.times_ns, mine.times_ns - 1000)
    return frames, mine.world_from_cam[:, :3, 3], true.world_from_cam[frames, :3, 3]


def robust_alignment(matched: Mapping[str, tuple[Any, FloatArray, FloatArray]]) -> Similarity:
    """Return the similarity that aligns most of the frames: misplaced cameras and blocks do not count.

    It starts from each camera alone, from pairs of cameras, and from all of them. The start with the
    smallest median error is refined with the frames that it fits.
    """
    everything = [np.concatenate([pair[side] for pair in matched.values()]) for side in (1, 2)]
    starts = [[name] for name in matched] + [[name for name in matched if name != out] for out in matched]
    best, least = align_points(*everything), np.inf
    for names in [list(matched), *starts]:
        chosen = [
            np.concatenate([matched[name][side] for name in names]) if names else np.zeros((0, 3))
            for side in (1, 2)
        ]
        if len(chosen[0]) < 3:
            continue
        found = align_points(*chosen)
        for _ in range(_TRIMMED):
            error = np.linalg.norm(found.apply(everything[0]) - everything[1], axis=1)
            keep = error <= max(3.0 * float(np.median(error)), 0.005)
            found = align_points(everything[0][keep], everything[1][keep])
        error = np.linalg.norm(found.apply(everything[0]) - everything[1], axis=1)
        if np.median(error) < least:
            best, least = found, float(np.median(error))
    return best


def misplaced_blocks(camera: str, frames: Any, error_m: FloatArray) -> list[MisplacedBlock]:
    """Return the blocks of successive frames of a camera that are misplaced."""
    wrong = np.flatnonzero(error_m > MISPLACED_M)
    if len(wrong) == 0:
        return []
    parts = np.split(wrong, np.flatnonzero(np.diff(frames[wrong]) > _MAX_HOLE + 1) + 1)
    return [
        MisplacedBlock(
            camera,
            int(frames[part[0]]),
            int(frames[part[-1]]),
            len(part),
            round(100 * float(error_m[part].max()), 1),
        )
        for part in parts
    ]


def _frames_that_see(
    capture: Path,
    scene_map: Map | None,
    paths: Mapping[str, Trajectory],
    truth: Mapping[str, TimedPoses],
    matched: Mapping[str, tuple[Any, FloatArray, FloatArray]],
    motions: Path,
) -> dict[str, BoolArray]:
    """Return for each camera a mask (N,) of the frames whose true camera sees the map.

    Without the options of a synthetic capture, no frame is counted.
    """
    file = capture / "gt" / _OPTIONS_FILE
    if scene_map is None or not file.exists():
        return {}
    settings = json.loads(file.read_text(encoding="utf-8"))
    if settings.get("motion"):
        settings["motion"] = motions / Path(settings["motion"]).name
    options = SynthOptions.model_validate(settings)
    renderer = build_renderers(options, draw_subject(options))[0]
    surfaces = renderer.scene.parts[0].scene
    own = [path for name, path in paths.items() if name in matched and path.gauge == scene_map.gauge]
    in_map = np.concatenate([path.gauge_from_cam[path.localised, :3, 3] for path in own])
    true = np.concatenate([truth[path.camera].world_from_cam[path.localised, :3, 3] for path in own])
    aligned = robust_alignment({"all": (None, in_map, true)})
    points = aligned.apply(scene_map.points)
    camera = options.camera()
    return {
        name: np.array(
            [
                _sees(
                    camera,
                    points,
                    truth[name].world_from_cam[max(0, i - 1) : i + 2],
                    min(i, 1),
                    surfaces,
                    options,
                )
                for i in range(len(truth[name].times_ns))
            ]
        )
        for name in paths
    }


def _last_map(results: Path, store: Path, paths: Mapping[str, Trajectory]) -> Map | None:
    """Return the map that most cameras were registered against last."""
    gauges = [path.gauge for path in paths.values() if path.localised.any()]
    folders = [
        store / stage["artefact"]
        for stage in Result(results).record()["stages"]
        if stage["stage"] in ("map", "extend", "refine") and stage.get("artefact")
    ]
    for folder in reversed(folders):
        for scene_map in load_map(folder).maps:
            if scene_map.gauge == max(gauges, key=gauges.count, default=""):
                return scene_map
    return None


def _sees(
    camera: Camera,
    points: FloatArray,
    near: FloatArray,
    own: int,
    surfaces: RayScene,
    options: SynthOptions,
) -> bool:
    """Return whether a true camera sees the map.

    Args:
        camera: The lens.
        points: (P,3) points of the map in the true world, m.
        near: (K,4,4) true poses world_from_camera of the frame and its neighbours.
        own: Index of the frame in `near`.
        surfaces: The surfaces of the room.
        options: Options of the capture.
    """
    in_cam = transform_points(invert(near[own]), points)
    front = in_cam[:, 2] > 0.05
    px = np.full((len(points), 2), np.nan)
    px[front] = camera.project(in_cam[front])
    with np.errstate(invalid="ignore"):
        inside = ((px >= 0) & (px <= [camera.width_px, camera.height_px])).all(axis=1)
    chosen = np.flatnonzero(inside)
    if len(chosen) < _MIN_POINTS:
        return False
    origin = near[own, :3, 3]
    rays = np.concatenate(
        [np.broadcast_to(origin, (len(chosen), 3)), points[chosen] - origin], axis=1
    ).astype(np.float32)
    visible = ~surfaces.is_occluded(rays, 1.0 - _DEPTH_TOLERANCE)
    visible &= surfaces.is_occluded(rays, 1.0 + _DEPTH_TOLERANCE)
    chosen = chosen[visible]
    if len(chosen) < _MIN_POINTS:
        return False
    hull = cv2.convexHull(px[chosen].astype(np.float32))
    if cv2.contourArea(hull) < _MIN_AREA * camera.width_px * camera.height_px:
        return False
    if options.exposure_s == 0.0 or len(near) < 2:
        return True
    other = near[own - 1 if own else own + 1]
    moved = camera.project(transform_points(invert(other), points[chosen])) - px[chosen]
    blur = np.nanmedian(np.linalg.norm(moved, axis=1)) * options.exposure_s * options.fps
    return bool(blur <= _MAX_BLUR_PX)


def lines_of(result: Mapping[str, Any]) -> list[str]:
    """Return the figures of one capture as text."""
    if "error" in result:
        return [f"{result['name']}: exit {result['exit']}, no results: {' '.join(result['error'])}"]
    ate = "none" if result["ate_cm"] is None else f"{result['ate_cm']:.2f} cm, worst {result['worst_cm']:.1f}"
    share = "".join(f"; {name} {a}/{b}" for name, (a, b) in result["per_camera"].items())
    lines = [
        f"{result['name']}: exit {result['exit']}, {result['registered']}/{result['frames']} frames, "
        f"ATE {ate}, cameras {result['cameras']}, body {result['body']}{share}"
    ]
    if result["seen"]:
        parts = [f"{name} {a}/{b}" for name, (a, b) in result["seen"].items()]
        lines.append(f"    registered of those that see the map: {', '.join(parts)}")
    for block in result["misplaced"]:
        lines.append(
            f"    misplaced: {block['camera']} frames {block['first']} to {block['last']}, "
            f"{block['frames']} frames, worst {block['worst_cm']:.0f} cm"
        )
    if result["wrong_called_good"]:
        lines.append("    a wrong result is called good")
    return lines


def summary(results: Sequence[Mapping[str, Any]]) -> str:
    """Return the figures of all captures as text."""
    scored = [result for result in results if "error" not in result]
    counts = [pair for result in scored for pair in result["seen"].values()]
    wrong = sum(block["frames"] for result in scored for block in result["misplaced"])
    done, seen = (sum(pair[side] for pair in counts) for side in (0, 1))
    share = f"{done / seen:.1%}" if seen else "unknown"
    return (
        f"{len(results)} captures, {sum(result['exit'] != 0 for result in results)} not finished; accepted "
        f"frames more than {100 * MISPLACED_M:.0f} cm off: {wrong}; registered of those that see the map: "
        f"{share}; wrong results called good: {sum(result['wrong_called_good'] for result in results)}"
    )


def _write_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
