"""Grade stored results again, and count the grades of right and of wrong results. Nothing is solved again.

What is right is known from the truth of the capture (``--captures``), or else from a stored answer of
`bodycap evaluate RESULT --video CAPTURE --json`: ``NAME.json`` in the folder ``--evaluated``, or ``ev.json``
beside the results. A result is wrong if more than 2 % of its judged frames are wrong. The pictures show
neither slow bends nor, if a camera hardly moves, leaps. So results that the pictures confirm completely are
compared with each other: within 10 % of the path's diagonal and 5 degrees. The one with which most others
agree, at least two, is the reference of its capture, and decides about all results with poses at its times.
Results with equal paths count once. The capture of a result is the longest name in the name of its folder:
``r7_eth_desk`` is one of ``eth_desk``.

Figures that results of earlier versions lack in ``metrics.json`` are computed from the stored map and paths,
and from the videos in ``--captures``; the latter are kept in the folder ``--links``.

Bounds are chosen on one half of the captures and reported on the other one. A capture is in the half that the
first byte of the SHA-256 of its name gives: even is 0, odd is 1.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.config.job import load_job
from bodycap_batch.config.overrides import Overrides
from bodycap_batch.core.context import StageContext
from bodycap_batch.evaluate.picture_check import poses_of_frames, read_delivered
from bodycap_batch.evaluate.track_check import TrackedVideo, check_with_tracks, count_frames
from bodycap_batch.evaluate.trajectories import interpolate_truth
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.job_places import capture_of_results, find_job
from bodycap_batch.model.path_uncertainty import path_uncertainty
from bodycap_batch.model.point_tracks import STORED_STEP
from bodycap_batch.report.criteria import CAMERA_RULES
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import judge
from bodycap_batch.tasks.keyframes import regions_and_lens
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tracks import measure_rotation_chain
from tests.bench.paired.measures import (
    MAX_WRONG,
    RIGHT_M,
    Paths,
    digest_of_results,
    read_paths,
    truth_figures,
)

_JUDGE = (
    "import json, sys; from bodycap_batch.report.verdict import judge\n"
    "for line in sys.stdin: print(judge(json.loads(line), None).cameras.word)"
)
_MIN_JUDGED = 0.5
"""Minimum share of the delivered frames that must be right or wrong. Evidence: none."""
_LEAST = 3
"""Minimum number of poses that a similarity is fitted to."""
_MAX_CONFIRMED = 6
"""Maximum number of results among which the reference of a capture is chosen. Origin: each pair of them is
compared, which takes half a second."""
_MIN_VOTES = 2
"""Minimum number of results that agree with a reference. Evidence: none."""
_CONFIRMED = 0.95
"""Minimum share of right frames of a result with which others are compared. None of its frames is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GradedResult:
    """One stored result with its grade, and what is known of it.

    Attributes:
        name: Name of the result.
        half: Half of the captures that its capture is in.
        metrics: Its metrics, with the figures that were missing.
        grade: Grade of its cameras.
        coverage: Share of the frames that are delivered.
        right: Number of right frames.
        wrong: Number of wrong frames.
        known: True if enough of the delivered frames could be judged.
        doubts: Names and values of the criteria that are not good.
        before: Grade by the other code; "" without other code.
    """

    name: str
    half: int
    metrics: Mapping[str, Any]
    grade: str
    coverage: float
    right: int
    wrong: int
    known: bool
    doubts: Mapping[str, float | None]
    before: str = ""

    @property
    def truth(self) -> str:
        """Whether the result is right."""
        if not self.known:
            return "unknown"
        return "wrong" if self.wrong > MAX_WRONG * (self.right + self.wrong) else "right"


def with_missing_figures(metrics: dict[str, Any], results: Path) -> dict[str, Any]:
    """Add the uncertainty of the paths, if an earlier version did not write it."""
    if not metrics["models"] or not (results / "colmap").is_dir():
        return metrics
    stored = sorted(
        (results.parent / "store" / "artefacts").glob("*/*/"), key=lambda each: each.stat().st_mtime
    )
    for artefact in stored:
        if artefact.parent.name not in ("registration", "recover", "inertial"):
            continue
        try:
            path = load_registration(artefact).trajectory
        except (OSError, ValueError, KeyError, TypeError):  # written by another version, or another camera's
            continue
        camera = metrics["cameras"].get(path.camera, {})
        if path.registered.sum() == camera.get("frames_registered") and path.gauge == camera["frame"]:
            camera |= path_uncertainty(path)
    return metrics


def _capture_of(name: str, captures: Sequence[Path]) -> Path | None:
    """Return the folder of a result's capture: the longest name that is part of the result's name."""
    parts = f"_{name}_"
    found = [each for folder in captures for each in folder.iterdir() if f"_{each.name}_" in parts]
    return max(found, key=lambda each: len(each.name), default=None)


def _truths(capture: Path) -> list[Path]:
    return [each for each in (capture / "gt", capture / "groundtruth.txt") if each.exists()]


def _counts(results: Path, name: str, options: argparse.Namespace) -> tuple[int, int, int] | None:
    """Return the numbers of right, wrong and delivered frames; None if nothing is known."""
    capture = _capture_of(name, options.captures)
    for truth in [] if capture is None else _truths(capture):
        paths = read_paths(results, truth)
        figures = None if paths is None else truth_figures(paths)
        if paths is not None and figures is not None:
            return figures.right, figures.wrong, len(paths.times_ns)
    own = [] if options.evaluated is None else [options.evaluated / f"{name}.json"]
    for file in (each for each in (*own, results.parent / "ev.json") if each.exists()):
        cameras = json.loads(file.read_bytes())
        if isinstance(cameras, dict) and all("right" in each for each in cameras.values()):
            right, wrong, delivered = (
                sum(each[key] for each in cameras.values()) for key in ("right", "wrong", "delivered")
            )
            return right, wrong, delivered
    return None


def compared(results: Path, other: Path) -> tuple[int, int] | None:
    """Return how many poses of a result agree with those of another one, and how many do not.

    The path of each camera has a similarity of its own. Poses in further maps are not compared.

    Returns:
        None if fewer than half of the poses have a pose of the other result at their time.
    """
    posed, found = 0, [0, 0]
    for file in (results / "trajectories").glob("*.tum"):
        mine = read_tum(file)
        posed += len(mine.times_ns)
        if not (other / "trajectories" / file.name).exists():
            continue
        theirs = read_tum(other / "trajectories" / file.name)
        true, both = interpolate_truth(theirs, mine.times_ns)
        if np.count_nonzero(both) < _LEAST:
            continue
        # Lengths have no unit: they become those of a path whose diagonal is ten times the limit.
        true[:, :3, 3] *= 10.0 * RIGHT_M / max(float(np.linalg.norm(np.ptp(true[both, :3, 3], axis=0))), 1e-9)
        names = np.full(np.count_nonzero(both), file.stem)
        paths = Paths(
            camera=names, times_ns=mine.times_ns[both], mine=mine.world_from_cam[both], true=true[both]
        )
        figures = truth_figures(paths)
        if figures is not None:
            found = [found[0] + figures.right, found[1] + figures.wrong]
    return (found[0], found[1]) if posed and sum(found) >= _MIN_JUDGED * posed else None


def _agrees(counts: tuple[int, int] | None) -> bool:
    return counts is not None and counts[1] <= MAX_WRONG * sum(counts)


def reference_of(confirmed: Sequence[Path]) -> Path | None:
    """Return the result with which most others agree; None if fewer than two others do."""
    votes = {
        each: sum(_agrees(compared(other, each)) for other in confirmed if other != each)
        for each in confirmed
    }
    best = max(votes, key=lambda each: votes[each], default=None)
    return best if best is not None and votes[best] >= _MIN_VOTES else None


def links_of(results: Path, capture: Path) -> dict[str, list[dict[str, Any]]]:
    """Return what the tracks of the videos show about the paths of a result, as the stage `links` does."""
    found: dict[str, list[dict[str, Any]]] = {}
    delivered = read_delivered(results)
    footage = capture_of_results(load_job(find_job(capture).file, Overrides()), results)
    for camera in (each for each in footage.cameras if each.name in delivered):
        own = delivered[camera.name]
        lens = own.lens.scaled(camera.camera.width_px, camera.camera.height_px)
        shown = regions_and_lens(replace(camera, camera=lens), StageContext(work_dir=Path()))
        if shown.tracks is None:
            continue
        frames = np.arange(len(camera.times_ns))
        video = TrackedVideo(
            tracks=shown.tracks.chosen(frames, STORED_STEP),
            lens=lens,
            times_s=camera.times_ns / 1e9,
            readout_s=own.readout_s,
            rotation_chain=measure_rotation_chain(shown.tracks, lens, 0.0, frames),
        )
        for number, poses in enumerate(own.paths):
            checked = check_with_tracks(video, poses_of_frames(poses, camera))
            entry = {"frame": f"map_{number}" if number else "map", **count_frames(checked)}
            found.setdefault(camera.name, []).append(entry)
    return found


def _with_links(metrics: dict[str, Any], results: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Add what the tracks show, if an earlier version did not write it, and if it or the videos are there."""
    capture = _capture_of(_name_of(results), options.captures)
    if "links" in metrics["mapping"] or options.links is None or capture is None:
        return metrics
    file = options.links / f"{_name_of(results)}.json"
    if not file.exists():
        file.write_text(json.dumps(links_of(results, capture)))
    return {**metrics, "mapping": {**metrics["mapping"], "links": json.loads(file.read_bytes())}}


def _name_of(results: Path) -> str:
    return results.parent.name if results.name == "out" else results.name


def _half_of(capture: Path | None, name: str) -> int:
    return hashlib.sha256((name if capture is None else capture.name).encode()).digest()[0] % 2


def graded(options: argparse.Namespace) -> Iterator[GradedResult]:
    """Yield each stored result that has paths and of which something is known; equal paths once."""
    digests, known = set[str](), list[tuple[Path, Path | None, tuple[int, int, int]]]()
    for folder in [*options.results, *options.others]:
        results = folder / "out" if (folder / "out").is_dir() else folder
        if not (results / "metrics.json").exists() or (digest := digest_of_results(results)) in digests:
            continue
        counts = _counts(results, folder.name, options)
        if counts is not None and counts[2]:
            digests.add(digest)
            known.append((results, _capture_of(folder.name, options.captures), counts))
    references = dict[Path, Path | None]()
    for capture in {each for _, each, _ in known if each is not None and not _truths(each)}:
        references[capture] = reference_of(
            [
                each
                for each, other, (right, wrong, delivered) in known
                if other == capture and not wrong and right >= _CONFIRMED * delivered
            ][:_MAX_CONFIRMED]
        )
    for results, capture, counts in known:
        if not {results, results.parent} & set(options.results):
            continue
        right, wrong, delivered = counts
        reference = None if capture is None else references.get(capture)
        if reference is not None and (found := compared(results, reference)) is not None:
            is_whole = sum(found) >= _CONFIRMED * delivered and not any(results.glob("trajectories/map_*"))
            if not _agrees(found) or is_whole:
                right, wrong = found
        metrics = with_missing_figures(json.loads((results / "metrics.json").read_bytes()), results)
        metrics = _with_links(metrics, results, options)
        verdict = judge(metrics, None)
        assert verdict.coverage is not None
        doubts = [each for each in verdict.criteria if each.subject == "cameras" and each.grade > Grade.GOOD]
        yield GradedResult(
            name=_name_of(results),
            half=_half_of(capture, _name_of(results)),
            metrics=metrics,
            grade=verdict.cameras.word,
            coverage=verdict.coverage.share,
            right=right,
            wrong=wrong,
            known=right + wrong >= _MIN_JUDGED * delivered,
            doubts={each.name: each.value for each in doubts},
        )


def with_other_code(rows: Sequence[GradedResult], code: Path) -> list[GradedResult]:
    """Return the results with the grades that the code of another working tree gives."""
    lines = "\n".join(json.dumps(row.metrics) for row in rows)
    done = subprocess.run(
        [sys.executable, "-c", _JUDGE],
        input=lines,
        cwd=code,  # a program given with -c imports from the working folder first
        env={**os.environ, "PYTHONPATH": str(code)},
        capture_output=True,
        text=True,
        check=True,
    )
    return [replace(row, before=word) for row, word in zip(rows, done.stdout.split("\n"), strict=False)]


def table(title: str, pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Return the table of grades and truth: how many right and wrong results have each grade."""
    counts, lines = (
        Counter(pairs),
        [f"{title:20}{'right':>8}{'wrong':>8}{'unknown':>9}{'right of known':>17}"],
    )
    for word in (grade.word for grade in Grade):
        right, wrong, unknown = (counts[word, truth] for truth in ("right", "wrong", "unknown"))
        share = f"{right / (right + wrong):.0%}" if right + wrong else "-"
        lines.append(f"{word:20}{right:>8}{wrong:>8}{unknown:>9}{share:>17}")
    return lines


def criteria_table(rows: Sequence[GradedResult]) -> list[str]:
    """Return how many right and wrong results each criterion alone calls not good."""
    total = Counter(row.truth for row in rows)
    lines = [f"{'criterion alone':34}{'right':>12}{'wrong':>12}"]
    for rule in CAMERA_RULES:
        found = Counter(row.truth for row in rows if rule.name in row.doubts)
        texts = (f"{found[truth]} of {total[truth]}" for truth in ("right", "wrong"))
        lines.append(f"{rule.name:34}" + "".join(f"{text:>12}" for text in texts))
    return lines


def main(arguments: Sequence[str]) -> int:
    """Print the grade of each result and the tables of grades and truth; the exit code is 0."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench verdict",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT", help="folders of results")
    parser.add_argument(
        "--captures", nargs="*", type=Path, default=[], metavar="DIR", help="folders of captures with truth"
    )
    parser.add_argument("--evaluated", type=Path, metavar="DIR", help="folder of stored evaluations")
    parser.add_argument(
        "--others",
        nargs="*",
        type=Path,
        default=[],
        metavar="RESULT",
        help="further results of the same captures, which only help to decide what is right",
    )
    parser.add_argument(
        "--links", type=Path, metavar="DIR", help="folder for what the videos show about the paths"
    )
    parser.add_argument("--code", type=Path, metavar="DIR", help="working tree whose grades are shown, too")
    options = parser.parse_args(arguments)
    rows = list(graded(options))
    if options.code is not None:
        rows = with_other_code(rows, options.code)
    for row in sorted(rows, key=lambda each: (each.truth, each.grade, each.name)):
        before = f"{row.before} -> " if row.before else ""
        print(
            f"{row.name:30}{row.truth:9}{row.right:>6}{row.wrong:>6} {row.coverage:>5.0%}  "
            f"{before}{row.grade}{f' ({_reasons(row)})' if row.doubts else ''}"
        )
    for half in (0, 1):
        own = [row for row in rows if row.half == half]
        if options.code is not None:
            pairs = [(row.before, row.truth) for row in own]
            print("\n".join(["", *table(f"half {half}: before", pairs)]))
        print("\n".join(["", *table(f"half {half}", [(row.grade, row.truth) for row in own])]))
        print("\n".join(["", *criteria_table(own)]))
    return 0


def _reasons(row: GradedResult) -> str:
    return ", ".join(name if value is None else f"{name} {value:.3g}" for name, value in row.doubts.items())
