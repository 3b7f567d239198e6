"""`bodycap evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.terminal import print_json, print_line, print_lines
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.percent import format_percent

TUM_SUFFIXES = (".tum", ".txt")
_MOTION_FILE = "motion.bvh"
_TRUTH_FILES = ("joints.npz", "motion.bvh")
_PICTURE_COUNTS = ("frames", "delivered", "right", "wrong", "not_measurable")
"""Keys of the numbers of frames that are compared with the pictures, in the order of the table."""


@app.command(short_help="Compare results with the truth or with the pictures.")
def evaluate(
    estimate: Annotated[
        Path,
        typer.Argument(
            metavar="ESTIMATE",
            help="Results folder of a job, a folder of .tum files, or a .tum or .bvh file.",
        ),
    ],
    truth: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TRUTH]", help="The true values: a gt/ folder, or a .tum, .bvh or joints.npz file."
        ),
    ] = None,
    align: Annotated[
        Literal["sim3", "se3", "none"],
        typer.Option(
            help="How the estimate is aligned with the truth: sim3 (rotation, translation and scale), se3 "
            "(rotation and translation) or none. All cameras get the same alignment."
        ),
    ] = "sim3",
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="CAMERA",
            help="Also compare the position of every other camera relative to this camera. These "
            "positions are compared in metres and are not scaled.",
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder or job file of the videos: count the delivered frames that the pictures confirm. No "
            "truth is needed.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all numbers as JSON.")] = False,
) -> None:
    """Compare results with the truth, or with the pictures themselves.

    For camera paths, the command prints ATE, RPE and coverage. For a motion, the command prints the errors of
    the joints. The files of a camera are found by their name, and all cameras are aligned together. A frame
    without a pose reduces the coverage. Rotations without positions are turned by a rotation of their own.

    With --video, features that the job did not use are matched in frames that are 1, 5, 15 and 45 apart, and
    across lost frames. A frame is right if the matches join it to the largest set of frames whose relative
    rotations and positions they confirm. It is wrong if they contradict it by more than 5 degrees, or if the
    path leaps; across lost frames, only the turn that points of the video show contradicts it. Where they say
    nothing, the frame is not measurable.

    \b
    Examples:
      bodycap evaluate out/my_walk --video my_walk/
      bodycap evaluate out/my_walk my_walk/gt
      bodycap evaluate camera.tum groundtruth.txt
      bodycap evaluate out/my_walk/motion.bvh mocap.bvh
    """  # noqa: D301 - \b keeps lines as they are
    if video is not None:
        _evaluate_with_pictures(estimate, video, as_json=as_json)
        return
    if truth is None:
        raise JobError("neither the truth nor the videos are given", hint="add the truth, or --video FOLDER")
    pairs, motions = _trajectory_pairs(estimate, truth), _motion_pair(estimate, truth)
    reports: dict[str, Any] = {}
    if pairs:
        reports |= _evaluate_trajectories(pairs, estimate, align, reference)
    if motions is not None:
        reports |= _evaluate_motion(*motions)
    if not reports:
        raise JobError(
            f"{estimate} contains nothing that can be compared with {truth}",
            hint="give two .tum files, two .bvh files, or two folders in which .tum files have the same "
            "names",
        )
    values = {name: report.to_dict() for name, report in reports.items()}
    if as_json:
        print_json(values, indent=1)
        return
    print_lines(_table_lines(values))


def _evaluate_with_pictures(results: Path, video: Path, *, as_json: bool) -> None:
    """Print how many delivered frames of each camera the pictures confirm."""
    from bodycap_batch.cli.progress_display import make_progress_display
    from bodycap_batch.config.job import load_job
    from bodycap_batch.config.overrides import Overrides
    from bodycap_batch.core.progress import Event
    from bodycap_batch.evaluate.picture_check import check_with_pictures, read_delivered, to_dict
    from bodycap_batch.job_places import capture_of_results, find_job

    delivered = read_delivered(results)
    capture = capture_of_results(load_job(find_job(video).file, Overrides()), results)
    cameras = {camera.name: camera for camera in capture.cameras}
    with make_progress_display(as_json=False) as display:

        def show(name: str, done: int, total: int) -> None:
            display(
                Event(kind="progress", stage="evaluate", camera=name, done=done, total=total, what="frames")
            )

        found = to_dict(check_with_pictures(delivered, cameras, show))
    if as_json:
        print_json(found, indent=1)
        return
    for name, *counts, unmeasured in (
        ("camera", "frames", "posed", "right", "wrong", "not measurable"),
        *((name, *(each[key] for key in _PICTURE_COUNTS)) for name, each in found.items()),
    ):
        print_line(f"{name:14}{''.join(f'{count:>8}' for count in counts)}{unmeasured:>16}")


def _evaluate_trajectories(
    pairs: dict[str, tuple[Path, Path]], results: Path, align: str, reference: str | None
) -> dict[str, Any]:
    from bodycap_batch.evaluate import relative_camera_error, score_trajectories
    from bodycap_batch.formats.tum import read_tum

    estimates = {name: read_tum(pair[0]) for name, pair in pairs.items()}
    truths = {name: read_tum(pair[1]) for name, pair in pairs.items()}
    frames = _frame_counts(results) if results.is_dir() else {}
    reports: dict[str, Any] = {
        "trajectories": score_trajectories(estimates, truths, align, frames)  # type: ignore[arg-type]
    }
    if reference is not None:
        for name in sorted(set(pairs) - {reference}):
            reports[f"{name} from {reference}"] = relative_camera_error(estimates, truths, name, reference)
    return reports


def _evaluate_motion(estimate: Path, truth: Path) -> dict[str, Any]:
    """Evaluate all joints. Also evaluate only the joints that the run's metrics.json lists as measured."""
    from bodycap_batch.evaluate import MotionOptions, evaluate_motion

    try:
        figures = json.loads((estimate.parent / "metrics.json").read_bytes())["motion"]
    except (OSError, ValueError, KeyError, TypeError):
        figures = {}
    # The times in the estimated BVH file start at zero; the times of true joints (.npz) are on the common
    # clock.
    offset_s = float(figures.get("start_s", 0.0)) if truth.suffix == ".npz" else 0.0
    reports = {"motion": evaluate_motion(estimate, truth, MotionOptions(offset_s=offset_s))}
    joints = figures.get("joints", {}).values()
    roles = tuple(joint["role"] for joint in joints if joint["observed"] and joint["role"])
    if roles:
        options = MotionOptions(offset_s=offset_s, roles=roles)
        reports["motion, measured joints"] = evaluate_motion(estimate, truth, options)
    return reports


def _frame_counts(results: Path) -> dict[str, int]:
    """Return the number of video frames of each camera, by camera name, from frames.csv in the results."""
    from bodycap_batch.formats.frame_table import read_frame_table

    table = results / "frames.csv"
    if not table.is_file():
        return {}
    return {camera: len(frames.status) for camera, frames in read_frame_table(table).items()}


def _table_lines(reports: dict[str, Any]) -> list[str]:
    """Return the results of the evaluation as lines of text for the user."""
    lines: list[str] = []
    for name, report in reports.items():
        if name == "trajectories":
            lines.append(f"{'camera':14}{'frames':>8}{'posed':>8}{'share':>8}{_CAMERA_COLUMNS}")
            rows = {**report["cameras"], "all": report["total"]}
            lines += [_camera_line(camera, score) for camera, score in rows.items()]
            lines.append(f"scale of the alignment: {report['scale']:.6g}")
        elif name.startswith("motion"):
            lines.append(f"{name}: {report['frames']} frames, {len(report['joints'])} joints")
            lines += [
                f"  {label:32}{_statistics_text(report[key], factor)}"
                for key, label, factor in _MOTION_ROWS
                if report[key]
            ]
        else:
            lines.append(f"{name}: {report['frames']} frames")
            lines += [f"  {label:32}{_statistics_text(report[key], 100)}" for key, label in _RELATIVE_ROWS]
    return lines


_CAMERA_COLUMNS = f"{'ATE rmse':>10}{'max':>8}{'cm':>4}{'turn rmse':>11}{'deg':>5}{'RPE rmse':>10}{'cm/s':>6}"
_MOTION_ROWS = (
    ("mpjpe_m", "joints, cm", 100),
    ("root_relative_m", "joints relative to the root, cm", 100),
    ("procrustes_m", "joints, each pose aligned, cm", 100),
    ("angle_deg", "angles, degrees", 1),
    ("angle_offset_free_deg", "angles, offset removed, degrees", 1),
)
"""Rows of the table of joint errors. Each row holds the key of a value, the label with the unit, and the
factor that converts the value to this unit."""
_RELATIVE_ROWS = (("vector_m", "vector, cm"), ("in_reference_m", "in reference camera's frame, cm"))
"""Rows of the table for a pair of cameras. Each row holds the key of a value, and the label with the unit."""


def _camera_line(name: str, score: dict[str, Any]) -> str:
    frames = "?" if score["frames"] is None else str(score["frames"])
    share = "?" if score["coverage"] is None else format_percent(score["coverage"], 1)
    line = f"{name:14}{frames:>8}{score['registered']:>8}{share:>8}"
    if score["ate_m"] is None and score["rotation_deg"] is not None:
        return f"{line}{'rotation only':>22}{score['rotation_deg']['rmse']:>11.3f}"
    if score["ate_m"] is None:
        return f"{line}  no truth"
    line += f"{100 * score['ate_m']['rmse']:>10.3f}{100 * score['ate_m']['max']:>8.2f}{'':4}"
    line += f"{score['rotation_deg']['rmse']:>11.3f}{'':5}" if score["rotation_deg"] else " " * 16
    return line + (f"{100 * score['rpe_m']['rmse']:>10.3f}" if score["rpe_m"] else "")


def _statistics_text(summary: dict[str, float], factor: float) -> str:
    parts = ((key, factor * summary[key]) for key in ("mean", "rmse", "median", "p95", "max"))
    return "  ".join(f"{key} {value:.3f}" for key, value in parts)


def _trajectory_pairs(estimate: Path, truth: Path) -> dict[str, tuple[Path, Path]]:
    """Return the estimated and the true trajectory file of each camera for which both files exist."""
    estimates = _paths_in(estimate, "trajectories")
    if not truth.is_file():
        truths = _paths_in(truth, "gt")
        names = sorted(estimates.keys() & truths.keys()) if estimate.is_dir() else ()
        return {name: (estimates[name], truths[name]) for name in names}
    is_pair = truth.suffix in TUM_SUFFIXES and len(estimates) == 1
    return {name: (path, truth) for name, path in estimates.items()} if is_pair else {}


def _motion_pair(estimate: Path, truth: Path) -> tuple[Path, Path] | None:
    """Return the file of the estimated motion and the file of the true motion; None if either is missing."""
    if estimate.is_dir():
        estimate /= _MOTION_FILE
    if truth.is_dir():
        found = [truth / part / name for part in ("", "gt") for name in _TRUTH_FILES]
        truth = next((path for path in found if path.is_file()), truth)
    usable = estimate.suffix == ".bvh" and truth.suffix in (".bvh", ".npz")
    return (estimate, truth) if usable and estimate.is_file() and truth.is_file() else None


def _paths_in(place: Path, subfolder: str) -> dict[str, Path]:
    """Return the trajectory files in a folder or its subfolder, or the file itself, by camera name."""
    if place.is_file():
        return {place.stem: place} if place.suffix in TUM_SUFFIXES else {}
    return {path.stem: path for path in (*place.glob("*.tum"), *(place / subfolder).glob("*.tum"))}
