"""Compare two sides on captures and perturbations: ``python -m tests.bench paired A B``.

A side is ``COMMIT`` or ``COMMIT-mechanism,mechanism``: a commit with mechanisms switched off. ``.`` is the
working tree. Jobs alternate between the sides, every job has a record, and a further call continues where the
last one stopped.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.bench.paired import compare, harm, tables
from tests.bench.paired.captures import BenchCapture, all_captures, chosen
from tests.bench.paired.measures import Paths
from tests.bench.paired.perturb import perturbation
from tests.bench.paired.runs import RunRecord, RunSettings, folder_of, run, stopping, stored_paths
from tests.bench.paired.sides import Side, check_switches, left_out, make_side, simpler

Runs = dict[tuple[str, int], tuple[RunRecord, RunRecord]]


def main(arguments: Sequence[str]) -> int:
    """Run the comparison; the exit code is 1 if B is worse, or if an injected harm is not found."""
    options = _options(arguments)
    work = options.work.resolve()
    captures = all_captures(options.real, options.drawn, write_line)
    sides = [make_side(text, work) for text in options.sides[: 1 if options.selftest else 2]]
    for side in sides:
        check_switches(side)
    names = options.sides[len(sides) :]
    if not names and not options.without_lens:
        captures = [capture for capture in captures if capture.has_lens]
    captures = chosen(captures, names)
    if options.selftest:
        return _check_harm(sides[0], captures, options.seeds, work)
    settings = run_settings(options)
    a, b = sides
    write_line(f"A: {options.sides[0]} ({a.name}); B: {options.sides[1]} ({b.name})")
    if a.name == b.name:
        raise SystemExit("A and B are the same")
    end = None if options.hours is None else time.monotonic() + 3600.0 * options.hours
    comparison = Comparison(a, b, settings, end)
    comparison.run_all(captures, options.seeds, options.jobs)
    return _write_tables(comparison, options.seeds)


class Comparison:
    """The runs of both sides.

    Attributes:
        a: Side A.
        b: Side B.
        runs: The finished pairs, by capture and perturbation.
        idle: Captures on which the mechanisms that one side leaves out never acted.
        open: Number of pairs that were not run, because the time was over.
        failed: Number of pairs that could not be measured.
    """

    def __init__(
        self,
        a: Side,
        b: Side,
        settings: RunSettings,
        end: float | None = None,
        run_job: Callable[[Side, BenchCapture, int, RunSettings], RunRecord] = run,
    ) -> None:
        """Prepare a comparison.

        Args:
            a: Side A.
            b: Side B.
            settings: How jobs run.
            end: Time of the monotonic clock at which no further job starts; None for no end.
            run_job: Runs a job, or returns its stored record.
        """
        self.a, self.b = a, b
        self.runs: Runs = {}
        self.idle: set[str] = set()
        self.open = self.failed = 0
        self._settings, self._end, self._run_job = settings, end, run_job
        self._lock = threading.Lock()

    def run_all(self, captures: Sequence[BenchCapture], seeds: int, jobs: int) -> None:
        """Run all pairs: first the inputs as they are, then one perturbation after the other.

        Args:
            captures: The captures.
            seeds: Number of perturbations, with the input as it is.
            jobs: Number of pairs that run at once.
        """
        pairs = [(capture, seed) for seed in range(seeds) for capture in captures]
        with ThreadPoolExecutor(jobs) as pool:
            started = [pool.submit(self._run_pair, *pair) for pair in pairs]
            try:
                for (capture, seed), done in zip(pairs, started, strict=True):
                    if error := done.exception():
                        self.failed += 1
                        write_line(f"{capture.name}, seed {seed}: not measured")
                        write_line("".join(traceback.format_exception(error)))
            except BaseException:
                stopping.set()
                pool.shutdown(cancel_futures=True)
                raise

    def _run_pair(self, capture: BenchCapture, seed: int) -> None:
        with self._lock:
            if capture.name in self.idle:
                return
        if self._end is not None and time.monotonic() >= self._end:
            folders = [folder_of(x.name, capture.name, seed, self._settings.work) for x in (self.a, self.b)]
            a, b = map(RunRecord.load, folders)
            with self._lock:
                if a and b:
                    self.runs[capture.name, seed] = (a, b)
                else:
                    self.open += 1
            return
        difference = left_out(self.a, self.b)
        first = difference[0] if difference else self.a
        records = {first.name: self._run(first, capture, seed)}
        if difference and self._never_acts(records[first.name], difference[2]):
            with self._lock:
                self.idle.add(capture.name)
            write_line(f"{capture.name}: {', '.join(difference[2])} never acts, not compared")
            return
        other = self.b if first is self.a else self.a
        records[other.name] = self._run(other, capture, seed)
        with self._lock:
            self.runs[capture.name, seed] = (records[self.a.name], records[self.b.name])

    def _run(self, side: Side, capture: BenchCapture, seed: int) -> RunRecord:
        started = time.monotonic()
        record = self._run_job(side, capture, seed, self._settings)
        change = perturbation(seed)
        seconds = time.monotonic() - started
        write_line(
            f"{capture.name}, seed {seed} ({change.text if change else 'as it is'}), {side.name}: "
            f"{record.right}/{record.frames} right, exit {record.exit}, {record.cpu_s:.0f} CPU s"
            + (f", {seconds:.0f} s" if seconds > 1.0 else ", stored")
        )
        return record

    @staticmethod
    def _never_acts(record: RunRecord, names: Sequence[str]) -> bool:
        """Return True if the record states what acted, and none of these mechanisms did."""
        if record.acted is None or record.exit != 0:
            return False
        return not any(record.acted.get(name) for name in names)


def _write_tables(comparison: Comparison, seeds: int) -> int:
    """Print the tables of a comparison and its conclusion."""
    a, b = comparison.a, comparison.b
    pairs = compare.pair_up(comparison.runs, _paths_in(comparison))
    outcomes, folds = compare.compare(pairs), compare.folds(pairs)
    unlike = sum(pair.a.measure != pair.b.measure for pair in pairs)
    lines = ["", f"outputs equal byte for byte: {sum(pair.is_equal for pair in pairs)} of {len(pairs)} pairs"]
    if pairs:
        lines = ["", *tables.pair_table(pairs), "", *tables.column_table(outcomes, pairs), *lines]
    lines += tables.fold_lines(folds)
    if comparison.open:
        lines.append(f"not run, the time was over: {comparison.open} pairs")
    if comparison.failed:
        lines.append(f"not measured, see above: {comparison.failed} pairs")
    if unlike:
        lines.append(f"pictures of {unlike} pairs measured by unlike versions: add --pictures-again")
    if comparison.idle:
        lines.append(f"never acts in: {', '.join(sorted(comparison.idle))}")
    lines += tables.floor_lines(compare.floors([pair.b for pair in pairs]))
    if a.is_frozen:
        lines += tables.margin_lines(compare.margins(pairs))
    sentence = compare.conclusion(outcomes, folds, simpler(a, b).name, seeds)
    if not pairs and comparison.idle and not comparison.open:
        sentence = f"it never acts on these captures: the simpler side wins, which is {simpler(a, b).name}"
    for line in (*lines, sentence):
        write_line(line)
    return int("B is worse" in sentence or comparison.failed > 0)


def _paths_in(comparison: Comparison) -> Callable[[RunRecord], Paths | None]:
    work = comparison._settings.work
    return lambda record: stored_paths(record, folder_of(record.side, record.capture, record.seed, work))


def _check_harm(side: Side, captures: Sequence[BenchCapture], seeds: int, work: Path) -> int:
    """Inject harm into stored runs of a side, and print what the comparison says."""
    runs = {}
    for capture in captures:
        for seed in range(seeds):
            folder = folder_of(side.name, capture.name, seed, work)
            record = RunRecord.load(folder)
            if record is not None and record.posed:
                runs[capture.name, seed] = (record, stored_paths(record, folder))
    write_line(f"{len(runs)} stored runs of {side.name}")
    if not runs:
        return 1
    results = harm.check(runs)
    for line in tables.harm_lines(results):
        write_line(line)
    return int(not all(each.is_found for each in results))


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench paired",
        description=__doc__,
        usage="%(prog)s A B [CAPTURE...] --work DIR [options]\n"
        "       %(prog)s --selftest A [CAPTURE...] --work DIR",
    )
    parser.add_argument(
        "sides", nargs="+", metavar="A B CAPTURE", help="the two sides, and names of captures"
    )
    parser.add_argument("--selftest", action="store_true", help="inject harm into stored runs of side A")
    parser.add_argument(
        "--without-lens",
        action="store_true",
        help="also the shared captures without their lens (NAME_no_lens)",
    )
    parser.add_argument("--drawn", type=Path, metavar="DIR", help="folder of drawn captures")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="perturbations, with the input (3)")
    parser.add_argument("--hours", type=float, metavar="H", help="start no further job after this time")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="pairs that run at once (1)")
    add_run_options(parser)
    options = parser.parse_args(arguments)
    if len(options.sides) < 2 - options.selftest:
        parser.error("give two sides")
    return options


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `paired` and `real` have in common."""
    parser.add_argument(
        "--work", type=Path, required=True, metavar="DIR", help="folder of inputs and records"
    )
    parser.add_argument("--real", type=Path, metavar="DIR", help="folder of real captures")
    parser.add_argument(
        "--limit", type=float, default=20.0, metavar="MINUTES", help="time limit of a job (20)"
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="cores of a job (1)")
    parser.add_argument("--no-pictures", action="store_true", help="do not compare with the pictures")
    parser.add_argument(
        "--pictures-again", action="store_true", help="repeat it where another version of the measure made it"
    )


def run_settings(options: argparse.Namespace) -> RunSettings:
    """Return how jobs run, from the options of `add_run_options`. SIGTERM stops them as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    return RunSettings(
        work=options.work.resolve(),
        limit_s=60.0 * options.limit,
        threads=options.threads,
        has_pictures=not options.no_pictures,
        pictures_again=options.pictures_again,
    )


def write_line(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
