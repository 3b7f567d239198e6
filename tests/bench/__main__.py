"""Run whole jobs, and COLMAP on every frame, on captures with ground truth.

Prints accuracy, coverage, time and memory. Every job starts without earlier results, in a store of its own,
through the command line. COLMAP's mappers (the peers) run in processes of their own, with one list of pairs,
the same features and retrieval, and a fixed calibration.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.bench import (
    bare,
    batch,
    body,
    clocks,
    drawn,
    elbows,
    field,
    inertial,
    joining,
    lens_from_tracks,
    lenses,
    long,
    measure,
    ours,
    pairs,
    peers,
    real,
    scale,
    scaling,
    seeds,
    shutter,
    simulation,
    slips,
    solving,
    spool,
    sync,
    synth,
    uncertainty,
    upright,
    verdict,
    viewer,
    violent,
)
from tests.bench.paired import command as paired
from tests.bench.rows import DATA, LAB, Row, row_of, rows_in

_WITH_OPTIONS = {
    "simulation": simulation.main,
    "uncertainty": uncertainty.main,
    "upright": upright.main,
    "joining": joining.main,
    "solving": solving.main,
    "seeds": seeds.main,
    "long": long.main,
    "clocks": clocks.main,
    "sync": sync.main,
    "synth": synth.main,
    "body": body.main,
    "drawn": drawn.main,
    "elbows": elbows.main,
    "scale": scale.main,
    "slips": slips.main,
    "bare": bare.main,
    "inertial": inertial.main,
    "shutter": shutter.main,
    "lenses": lenses.main,
    "lens": lens_from_tracks.main,
    "violent": violent.main,
    "paired": paired.main,
    "pairs": pairs.main,
    "real": real.main,
    "measure": measure.main,
    "verdict": verdict.main,
}
"""Benchmarks with options of their own: of a single stage, and of a capture of ten minutes."""


def main() -> int:
    """Run the chosen benchmarks; the exit code is 0 if every job of ours ran."""
    if sys.argv[1:2] and sys.argv[1] in _WITH_OPTIONS:
        return _WITH_OPTIONS[sys.argv[1]](sys.argv[2:])
    parser = argparse.ArgumentParser(prog="make bench ARGS=...", description=__doc__)
    parser.add_argument(
        "only",
        nargs="*",
        help="rows to run, or folders of captures with truth (default: all), `scaling` (or `length`, "
        "`cameras`, `size` of it), `field` (rendered captures recorded as by phones), `batch`, "
        "`spool`, `viewer`; with options of their own: `simulation`, "
        "`uncertainty`, `joining` or `solving` (the merge stage on simulated poses), `seeds` (the map "
        "with several seeds), `clocks` (from generated sound and motion), `sync` (ten minutes of sound), "
        "`inertial` (gaps filled from a sensor), `violent` (whole jobs with and without sensors), "
        "`lenses` (named profiles in the adjustment), `body` (joints without cameras), `elbows` (their "
        "flexion with a height alone), `scale` (the metric scale with a height alone), `slips` (mounts that "
        "slip), `bare` (a camera at plain surfaces), `shutter` (drawn readout times against global "
        "shutters), `paired` (two versions on perturbed captures), `pairs` (pairs that only look alike), "
        "`real` (the table of the real captures), `measure` (how well the pictures judge poses), "
        "`synth` (seconds of a rendered frame), `verdict` (grades of stored results), `drawn` (renders the "
        "drawn captures), `lens` (the lens from tracks), and `long` (ten minutes of three cameras)",
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--lab", type=Path, default=LAB)
    parser.add_argument("--no-peers", action="store_true", help="run only our own jobs")
    parser.add_argument("--peers-only", action="store_true", help="run only COLMAP")
    parser.add_argument(
        "--peer-limit", type=float, default=15.0, metavar="MINUTES", help="time limit of a peer (15)"
    )
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="number of jobs of `batch` (8) and `spool` (1000)"
    )
    parser.add_argument(
        "--repeat", type=int, default=1, metavar="N", help="rounds of `batch`; the fastest one counts"
    )
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as folder:
        work = Path(folder)
        for row in _chosen(options, work):
            own = None
            if not options.peers_only:
                own = ours.run(row, work / row.name)
                _print_lines(results, own, ours.lines_of(own))
            # The variants of this capture differ in the body only, so the peers' results are the same.
            if not options.no_peers and not row.name.startswith("cpl_lab_"):
                for peer in peers.run_peers(row, work / row.name / "peers", 60 * options.peer_limit):
                    _print_lines(results, peer, peers.lines_of(peer, own))
        _run_by_name(options, work, results)
    if options.json:
        options.json.write_text(json.dumps([each for each in results if each], indent=1), encoding="utf-8")
    jobs = [result for result in results if result and "peer" not in result]
    return 0 if results and all(job.get("exit") == 0 for job in jobs) else 1


def _run_by_name(options: argparse.Namespace, work: Path, results: list[dict[str, Any]]) -> None:
    """Run the benchmarks that are not single captures."""
    only = options.only
    for series in scaling.SERIES if "scaling" in only else [name for name in scaling.SERIES if name in only]:
        for case in scaling.cases(series, work / series):
            own = ours.run(case.row, work / series / f"{case.row.name}_job")
            _print_lines(results, {**own, **case.size()}, scaling.lines_of(own, case))
        _print_lines(results, {}, scaling.summary(series, results))
    if "field" in only:
        for row in field.cases(work / "field"):
            own = ours.run(row, work / "field" / f"{row.name}_job")
            _print_lines(results, own, ours.lines_of(own))
    if "batch" in only:
        done = batch.run(work / "batch", options.jobs or batch.JOBS, options.repeat)
        _print_lines(results, done, list(batch.lines_of(done)))
    if "spool" in only:
        for measured in spool.run(work / "spool", options.jobs or spool.JOBS):
            _print_lines(results, measured, spool.lines_of(measured))
    if "viewer" in only or not only:
        seen = viewer.run()
        _print_lines(results, {**seen, "exit": 0 if "fps" in seen else 1}, viewer.lines_of(seen))


def _print_lines(results: list[dict[str, Any]], result: dict[str, Any], lines: Sequence[str]) -> None:
    results.append(result)
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()


def _chosen(options: argparse.Namespace, work: Path) -> list[Row]:
    """Return the captures named on the command line, or all."""
    available = rows_in(options.data, options.lab.resolve(), work)
    if not options.only:
        return available
    rows = [row for row in available if row.name in options.only]
    names = {row.name for row in rows} | {"scaling", *scaling.SERIES, "field", "batch", "spool", "viewer"}
    rows += [
        row_of(Path(name).resolve()) for name in options.only if name not in names and Path(name).is_dir()
    ]
    unknown = sorted(set(options.only) - names - {name for name in options.only if Path(name).is_dir()})
    if unknown:
        raise SystemExit(
            f"no such row or folder: {', '.join(unknown)}; rows: {', '.join(r.name for r in available)}"
        )
    return rows


if __name__ == "__main__":
    raise SystemExit(main())
