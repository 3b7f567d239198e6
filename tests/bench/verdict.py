"""Grade stored results again, and count the grades of right and of wrong results. Nothing is solved again.

What is right is known from the truth of the capture (``--captures``), or else from a stored answer of
`bodycap evaluate RESULT --video CAPTURE --json`: ``NAME.json`` in the folder ``--evaluated``, or ``ev.json``
beside the results. A result is wrong if more than 2 % of its judged frames are wrong. Results with equal
paths count once. The name of a result's capture is the end of its folder's name: ``r7_eth_desk`` is one of
``eth_desk``.

Figures that results of earlier versions lack in ``metrics.json`` are computed from the stored map and paths.
"""

from __future__ import annotations

import argparse
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
import pycolmap

from bodycap_batch.export.map_links import weakest_link
from bodycap_batch.export.metrics import path_uncertainty
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import judge
from bodycap_batch.tasks.loading import load_registration
from tests.bench.paired.measures import MAX_WRONG, digest_of_results, read_paths, truth_figures

_JUDGE = (
    "import json, sys; from bodycap_batch.report.verdict import judge\n"
    "for line in sys.stdin: print(judge(json.loads(line), None).cameras.word)"
)
_MIN_JUDGED = 0.5
"""Minimum share of the delivered frames that must be right or wrong. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GradedResult:
    """One stored result with its grade, and what is known of it.

    Attributes:
        name: Name of the result.
        metrics: Its metrics, with the figures that were missing.
        grade: Grade of its cameras.
        coverage: Share of the frames that are delivered.
        right: Number of right frames.
        wrong: Number of wrong frames.
        known: True if enough of the delivered frames could be judged.
        reasons: Names and values of the criteria that are not good.
        before: Grade by the other code; "" without other code.
    """

    name: str
    metrics: Mapping[str, Any]
    grade: str
    coverage: float
    right: int
    wrong: int
    known: bool
    reasons: str
    before: str = ""

    @property
    def truth(self) -> str:
        """Whether the result is right."""
        if not self.known:
            return "unknown"
        return "wrong" if self.wrong > MAX_WRONG * (self.right + self.wrong) else "right"


def with_missing_figures(metrics: dict[str, Any], results: Path) -> dict[str, Any]:
    """Add the weakest link and the uncertainty of the paths, if an earlier version did not write them."""
    if not metrics["models"] or not (results / "colmap").is_dir():
        return metrics
    if "weakest_link" not in metrics["models"][0]:
        folder = min((results / "colmap").glob("*/"), key=lambda path: int(path.name))
        scene = pycolmap.Reconstruction(str(folder))
        seen = [
            (number, element.image_id)
            for number, point in enumerate(scene.points3D.values())
            for element in point.track.elements
        ]
        point, keyframe = np.array(seen, dtype=np.int64).reshape(-1, 2).T
        metrics["models"][0]["weakest_link"] = weakest_link(point, keyframe)
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
    """Return the folder of a result's capture: the longest name that the result's name ends with."""
    found = [each for folder in captures for each in folder.iterdir() if name.endswith(f"_{each.name}")]
    return max(found, key=lambda each: len(each.name), default=None)


def _counts(results: Path, name: str, options: argparse.Namespace) -> tuple[int, int, int] | None:
    """Return the numbers of right, wrong and delivered frames; None if nothing is known."""
    capture = _capture_of(name, options.captures)
    truths = [] if capture is None else [capture / "gt", capture / "groundtruth.txt"]
    for truth in (each for each in truths if each.exists()):
        paths = read_paths(results, truth)
        figures = None if paths is None else truth_figures(paths)
        if paths is not None and figures is not None:
            return figures.right, figures.wrong, len(paths.times_ns)
    own = [] if options.evaluated is None else [options.evaluated / f"{name}.json"]
    for file in (each for each in (*own, results.parent / "ev.json") if each.exists()):
        cameras = json.loads(file.read_bytes())
        if isinstance(cameras, dict) and all(isinstance(each, dict) for each in cameras.values()):
            right, wrong, delivered = (
                sum(each[key] for each in cameras.values()) for key in ("right", "wrong", "delivered")
            )
            return right, wrong, delivered
    return None


def graded(options: argparse.Namespace) -> Iterator[GradedResult]:
    """Yield each stored result that has paths and of which something is known; equal paths once."""
    digests = set[str]()
    for folder in options.results:
        results = folder / "out" if (folder / "out").is_dir() else folder
        if not (results / "metrics.json").exists() or (digest := digest_of_results(results)) in digests:
            continue
        counts = _counts(results, folder.name, options)
        if counts is None or not counts[2]:
            continue
        digests.add(digest)
        metrics = with_missing_figures(json.loads((results / "metrics.json").read_bytes()), results)
        verdict = judge(metrics, None)
        assert verdict.coverage is not None
        doubts = [each for each in verdict.criteria if each.subject == "cameras" and each.grade > Grade.GOOD]
        yield GradedResult(
            name=folder.name,
            metrics=metrics,
            grade=verdict.cameras.word,
            coverage=verdict.coverage.share,
            right=counts[0],
            wrong=counts[1],
            known=counts[0] + counts[1] >= _MIN_JUDGED * counts[2],
            reasons=", ".join(
                each.name if each.value is None else f"{each.name} {each.value:.3g}" for each in doubts
            ),
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
    parser.add_argument("--code", type=Path, metavar="DIR", help="working tree whose grades are shown, too")
    options = parser.parse_args(arguments)
    rows = list(graded(options))
    if options.code is not None:
        rows = with_other_code(rows, options.code)
    for row in sorted(rows, key=lambda each: (each.truth, each.grade, each.name)):
        before = f"{row.before} -> " if row.before else ""
        print(
            f"{row.name:30}{row.truth:9}{row.right:>6}{row.wrong:>6} {row.coverage:>5.0%}  "
            f"{before}{row.grade}{f' ({row.reasons})' if row.reasons else ''}"
        )
    if options.code is not None:
        print("\n".join(["", *table("grade before", [(row.before, row.truth) for row in rows])]))
    print("\n".join(["", *table("grade", [(row.grade, row.truth) for row in rows])]))
    return 0
