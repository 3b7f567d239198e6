"""The tables of runs and of comparisons as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from tests.bench.paired.compare import Fold, Outcome, Pair
from tests.bench.paired.harm import HarmResult
from tests.bench.paired.runs import RunRecord
from tests.bench.paired.statistics import CONFIDENCE, Estimate

Cells = Sequence[str]


def text_table(head: Cells, rows: Iterable[Cells]) -> list[str]:
    """Return lines in which the first column starts at the left and the others end at the right."""
    every = [list(head), *map(list, rows)]
    widths = [max(len(row[column]) for row in every) for column in range(len(head))]
    return [
        "  ".join(
            cell.ljust(width) if not column else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in every
    ]


RUN_HEAD = (
    "capture", "frames", "posed", "right", "wrong", "by pictures", "models", "exit", "cameras", "CPU s",
    "s/right", "ATE cm", "rot. deg", "lens deg",
)  # fmt: skip


def run_cells(run: RunRecord) -> list[str]:
    """Return the row of one run: right and wrong by the truth if the capture has one.

    ``by pictures`` are the right, the wrong and the unmeasurable frames by the pictures.
    """
    seen = run.pictures
    return [
        run.capture,
        str(run.frames),
        f"{run.posed} + {run.rotations} rotations" if run.rotations else str(run.posed),
        _number(run.right),
        _number(run.wrong),
        f"{seen.right}/{seen.wrong}/{seen.unmeasurable}" if seen else "-",
        str(run.models),
        "limit" if run.exit is None else str(run.exit),
        (run.grade or "-") + (f" ({run.wrong_verdict})" if run.wrong_verdict else ""),
        f"{run.cpu_s:.0f}",
        f"{run.cpu_s / run.right:.2f}" if run.right else "-",
        f"{100 * run.truth.ate_m:.2f}" if run.truth else "-",
        _degrees(run.truth.median_deg if run.truth else run.rotations_deg),
        f"{run.lens['0.4']:.2f}" if "0.4" in run.lens else "-",
    ]


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def run_table(runs: Sequence[RunRecord]) -> list[str]:
    """Return the table of runs, with sums, and the errors of the jobs that did not finish."""
    lines = text_table(RUN_HEAD, map(run_cells, runs))
    frames, right = sum(run.frames for run in runs), sum(run.right or 0 for run in runs)
    cpu_s = sum(run.cpu_s for run in runs)
    shares = [(run.right or 0) / run.frames for run in runs if run.frames]
    lines.append(
        f"all: {right} of {frames} frames right ({right / max(frames, 1):.1%}; mean over captures "
        f"{sum(shares) / max(len(shares), 1):.1%}), {sum(run.wrong or 0 for run in runs)} wrong, "
        f"{sum(bool(run.wrong_verdict) for run in runs)} wrong verdicts, {cpu_s:.0f} CPU s"
    )
    return [*lines, *(f"{run.capture}: {run.error}" for run in runs if run.error)]


def pair_table(pairs: Sequence[Pair]) -> list[str]:
    """Return a row for each pair, with the values of both sides."""
    head = ("capture", "seed", "outputs", "right A", "B", "wrong A", "B", "ATE cm A", "B", "CPU s A", "B",
            "cameras A", "B")  # fmt: skip
    rows = []
    for pair in sorted(pairs, key=lambda pair: (pair.a.capture, pair.a.seed)):
        sides = (pair.a, pair.b)
        ates = [f"{100 * value:.2f}" for value in pair.ates_m] if pair.ates_m else ["-", "-"]
        rows.append(
            [
                pair.a.capture,
                str(pair.a.seed),
                "equal" if pair.is_equal else "differ",
                *(f"{_number(run.right)}/{run.frames}" for run in sides),
                *(_number(run.wrong) for run in sides),
                *ates,
                *(f"{run.cpu_s:.0f}" for run in sides),
                *(_state(run) for run in sides),
            ]
        )
    return text_table(head, rows)


def column_table(outcomes: Sequence[Outcome], pairs: Sequence[Pair]) -> list[str]:
    """Return a row for each measure: means of both sides, the difference with its interval, and the word."""
    head = ("B against A", "A", "B", "difference", f"{CONFIDENCE:.0%} interval", "pairs", "captures", "word")
    rows = []
    for each in outcomes:
        found = each.found
        if found is None:
            continue
        values = [value for pair in pairs if (value := each.column.values(pair)) is not None]
        means = [_mean([value[side] for value in values], is_ratio=each.column.is_ratio) for side in (0, 1)]
        mean, *ends = _estimate_text(found, is_ratio=each.column.is_ratio)
        rows.append(
            [
                each.column.name,
                *(f"{value:.4g}" for value in means),
                mean,
                "-" if each.word == "equal" else f"{ends[0]} to {ends[1]}",
                str(found.pairs),
                str(found.captures),
                each.word,
            ]
        )
    return text_table(head, rows)


def fold_lines(folds: Sequence[Fold]) -> list[str]:
    """Return a line for each run with wrong frames that the other side never has."""
    return [
        f"fold: {each.side} has {each.points:.0f} points of wrong frames more than any run of the other side "
        f"in {each.capture}, seed {each.seed}"
        for each in folds
    ]


def margin_lines(margins: Sequence[tuple[str, Estimate | None, str]]) -> list[str]:
    """Return a line for each margin."""
    lines = []
    for name, found, word in margins:
        mean, low, high = _estimate_text(found, is_ratio="ATE" in name) if found else ("-", "-", "-")
        lines.append(f"margin: {name}: {mean} ({low} to {high}): {word}")
    return lines


def floor_lines(floors: Sequence[tuple[str, float, float, str]]) -> list[str]:
    """Return a line for each hard capture."""
    return [
        f"floor of {name}: B has {right:.1%} of the frames right and {wrong:.1%} wrong: {word}"
        for name, right, wrong, word in floors
    ]


def harm_lines(results: Sequence[HarmResult]) -> list[str]:
    """Return for each injected harm what the comparison says."""
    lines = []
    for each in results:
        words = [
            f"{outcome.column.name.split(',')[0]} {outcome.word}"
            for outcome in each.outcomes
            if outcome.word in ("better", "worse")
        ]
        words += [f"fold of {fold.side} in {fold.capture}, seed {fold.seed}" for fold in each.folds]
        few = any(outcome.word == "too few" for outcome in each.outcomes)
        said = ", ".join(words) or ("too few pairs" if few else "no difference in any column")
        lines.append(f"{each.name}: {'as expected' if each.is_found else 'NOT AS EXPECTED'}: {said}")
    return lines


def _state(run: RunRecord) -> str:
    if run.exit == 0:
        return (run.grade or "-") + (f" ({run.wrong_verdict})" if run.wrong_verdict else "")
    return "limit" if run.exit is None else f"exit {run.exit}"


def _number(value: int | None) -> str:
    return "-" if value is None else str(value)


def _mean(values: Sequence[float], *, is_ratio: bool) -> float:
    """Return the mean, or the geometric mean where ratios are compared."""
    if is_ratio:
        return math.exp(sum(math.log(max(value, 1e-6)) for value in values) / len(values))
    return sum(values) / len(values)


def _estimate_text(found: Estimate, *, is_ratio: bool) -> tuple[str, str, str]:
    ends = (found.mean, found.low, found.high)
    mean, low, high = (f"x{math.exp(end):.3f}" if is_ratio else f"{end:+.2f}" for end in ends)
    return mean, low, high
