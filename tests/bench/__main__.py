"""Run whole jobs, and COLMAP on every frame, on captures with ground truth.

Prints accuracy, coverage, time and memory. Every job is run from nothing in a store of its own, through the
command line a user types; the peers run in processes of their own with one list of pairs, the same features
and retrieval, and the calibration held.
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
    batch,
    field,
    joining,
    long,
    ours,
    peers,
    scaling,
    seeds,
    simulation,
    solving,
    spool,
    uncertainty,
    viewer,
)
from tests.bench.rows import DATA, LAB, Row, row_of, rows_in

_WITH_OPTIONS = {
    "simulation": simulation.main,
    "uncertainty": uncertainty.main,
    "joining": joining.main,
    "solving": solving.main,
    "seeds": seeds.main,
    "long": long.main,
}
"""Benchmarks that take options of their own: of one stage alone, and of a capture of ten minutes."""


def main() -> int:
    """Run the chosen benchmarks; the exit code says whether every job of ours ran."""
    if sys.argv[1:2] and sys.argv[1] in _WITH_OPTIONS:
        return _WITH_OPTIONS[sys.argv[1]](sys.argv[2:])
    parser = argparse.ArgumentParser(prog="make bench ARGS=...", description=__doc__)
    parser.add_argument(
        "only",
        nargs="*",
        help="rows to run, or folders of captures with truth (default: all), `scaling` (or `length`, "
        "`cameras`, `size` of it), `field` (rendered captures with what phones do to them), `batch`, "
        "`spool`, `viewer`; with options of their own: `simulation`, "
        "`uncertainty`, `joining` or `solving`, the skeleton stage on simulated poses, `seeds`, the map "
        "with several seeds, and `long`, ten minutes of three cameras",
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--lab", type=Path, default=LAB)
    parser.add_argument("--no-peers", action="store_true", help="ours alone")
    parser.add_argument("--peers-only", action="store_true", help="COLMAP alone")
    parser.add_argument(
        "--peer-limit", type=float, default=15.0, metavar="MINUTES", help="a peer is stopped then (15)"
    )
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="jobs of `batch` (8) and `spool` (1000): fewer for a quick try"
    )
    parser.add_argument(
        "--repeat", type=int, default=1, metavar="N", help="rounds of `batch`, the best counts"
    )
    parser.add_argument("--json", type=Path, help="also write all figures here")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as folder:
        work = Path(folder)
        for row in _chosen(options, work):
            own = None
            if not options.peers_only:
                own = ours.run(row, work / row.name)
                _tell(results, own, ours.lines_of(own))
            # One capture with three variants of the body: the peers see no difference.
            if not options.no_peers and not row.name.startswith("cpl_lab_"):
                for peer in peers.run_peers(row, work / row.name / "peers", 60 * options.peer_limit):
                    _tell(results, peer, peers.lines_of(peer, own))
        _run_by_name(options, work, results)
    if options.json:
        options.json.write_text(json.dumps([each for each in results if each], indent=1), encoding="utf-8")
    jobs = [result for result in results if result and "peer" not in result]
    return 0 if results and all(job.get("exit") == 0 for job in jobs) else 1


def _run_by_name(options: argparse.Namespace, work: Path, results: list[dict[str, Any]]) -> None:
    """What is no capture."""
    only = options.only
    for series in scaling.SERIES if "scaling" in only else [name for name in scaling.SERIES if name in only]:
        for case in scaling.cases(series, work / series):
            own = ours.run(case.row, work / series / f"{case.row.name}_job")
            _tell(results, {**own, **case.size()}, scaling.lines_of(own, case))
        _tell(results, {}, scaling.summary(series, results))
    if "field" in only:
        for row in field.cases(work / "field"):
            own = ours.run(row, work / "field" / f"{row.name}_job")
            _tell(results, own, ours.lines_of(own))
    if "batch" in only:
        done = batch.run(work / "batch", options.jobs or batch.JOBS, options.repeat)
        _tell(results, done, list(batch.lines_of(done)))
    if "spool" in only:
        for measured in spool.run(work / "spool", options.jobs or spool.JOBS):
            _tell(results, measured, spool.lines_of(measured))
    if "viewer" in only or not only:
        seen = viewer.run()
        _tell(results, {**seen, "exit": 0 if "fps" in seen else 1}, viewer.lines_of(seen))


def _tell(results: list[dict[str, Any]], result: dict[str, Any], lines: Sequence[str]) -> None:
    results.append(result)
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()


def _chosen(options: argparse.Namespace, work: Path) -> list[Row]:
    """Rows by name and folders by path, all rows where nothing is chosen."""
    known = rows_in(options.data, options.lab.resolve(), work)
    if not options.only:
        return known
    rows = [row for row in known if row.name in options.only]
    names = {row.name for row in rows} | {"scaling", *scaling.SERIES, "field", "batch", "spool", "viewer"}
    rows += [
        row_of(Path(name).resolve()) for name in options.only if name not in names and Path(name).is_dir()
    ]
    unknown = sorted(set(options.only) - names - {name for name in options.only if Path(name).is_dir()})
    if unknown:
        raise SystemExit(
            f"no such row or folder: {', '.join(unknown)}; rows: {', '.join(r.name for r in known)}"
        )
    return rows


if __name__ == "__main__":
    raise SystemExit(main())
