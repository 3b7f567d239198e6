"""Compare the runs of two sides: columns with their words, folds, floors of hard captures, and margins."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tests.bench.paired.measures import Paths, ates_of_common
from tests.bench.paired.runs import RunRecord
from tests.bench.paired.statistics import Estimate, estimate, word_of

Values = tuple[float, float]
_LEAST = 1e-6
"""Least value of which a ratio is taken."""
FOLD = 0.05
"""A run has a fold that the other side never has if its fraction of wrong frames is larger by this much than
the largest one of the other side on the same capture, which itself is at most this much."""
MAX_LOST_POINTS, MAX_ATE_RATIO = 0.5, 1.05
"""Margins against version 0.2.0, in sum over all captures that are not hard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """The runs of both sides on one input.

    Attributes:
        a: Run of side A.
        b: Run of side B.
        ates_m: Errors of both on the frames that both have; None if there are none.
    """

    a: RunRecord
    b: RunRecord
    ates_m: Values | None = None

    @property
    def is_equal(self) -> bool:
        """True if the outputs are equal byte for byte."""
        return bool(self.a.digest) and self.a.digest == self.b.digest


@dataclass(frozen=True, slots=True)
class Column:
    """One measure.

    Attributes:
        name: Name in the tables, with the unit of the difference.
        sign: 1 if more is better, -1 if less is better.
        is_ratio: True to compare logarithms.
        values: Returns the values of both sides; None if one of them has none.
        is_outcome: False for time and memory, which differ even if the outputs are equal.
    """

    name: str
    sign: int
    values: Callable[[Pair], Values | None]
    is_ratio: bool = False
    is_outcome: bool = True

    def difference(self, pair: Pair) -> float | None:
        """Return B minus A, or the logarithm of B over A."""
        found = self.values(pair)
        if found is None:
            return None
        a, b = (math.log(max(value, _LEAST)) if self.is_ratio else value for value in found)
        return b - a


def _both(value: Callable[[RunRecord], float | None]) -> Callable[[Pair], Values | None]:
    def values(pair: Pair) -> Values | None:
        a, b = value(pair.a), value(pair.b)
        return None if a is None or b is None else (a, b)

    return values


def _points(count: Callable[[RunRecord], int | None]) -> Callable[[Pair], Values | None]:
    """Return per cent of all frames."""

    def value(run: RunRecord) -> float | None:
        counted = count(run)
        return None if counted is None or not run.frames else 100.0 * counted / run.frames

    return _both(value)


def _of_truth(name: str) -> Callable[[Pair], Values | None]:
    return _both(lambda run: None if run.truth is None else float(getattr(run.truth, name)))


def _lens(key: str) -> Callable[[Pair], Values | None]:
    return _both(lambda run: run.lens.get(key))


def _of_pictures(name: str) -> Callable[[Pair], Values | None]:
    return _points(lambda run: None if run.pictures is None else int(getattr(run.pictures, name)))


RIGHT = Column("right frames, points", 1, _points(lambda run: run.right))
WRONG = Column("wrong frames, points", -1, _points(lambda run: run.wrong))
ATE = Column("ATE of common frames, ratio", -1, lambda pair: pair.ates_m, is_ratio=True)
VERDICT = Column(
    "wrong verdicts, per 100 runs",
    -1,
    _both(lambda run: None if run.right is None else 100.0 * bool(run.wrong_verdict)),
)
COLUMNS = (
    RIGHT,
    WRONG,
    Column("posed frames, points", 1, _points(lambda run: run.posed)),
    Column("right by the pictures, points", 1, _of_pictures("right")),
    Column("wrong by the pictures, points", -1, _of_pictures("wrong")),
    Column("not measurable, points", -1, _of_pictures("unmeasurable")),
    ATE,
    Column("ATE of own frames, ratio", -1, _of_truth("ate_m"), is_ratio=True),
    Column("worst frame, ratio", -1, _of_truth("worst_m"), is_ratio=True),
    Column(
        "more than 10 cm off, points", -1, _points(lambda run: None if run.truth is None else run.truth.off)
    ),
    Column("median rotation, ratio", -1, _of_truth("median_deg"), is_ratio=True),
    Column("worst rotation, ratio", -1, _of_truth("worst_deg"), is_ratio=True),
    Column(
        "share in the 95 % region from 95 %, points",
        -1,
        _both(lambda run: None if run.inside is None else 100.0 * abs(run.inside - 0.95)),
    ),
    Column("palms, ratio", -1, _both(lambda run: run.palm_m), is_ratio=True),
    Column("lens at 0.2 of the width, deg", -1, _lens("0.2")),
    Column("lens at 0.4 of the width, deg", -1, _lens("0.4")),
    Column("spread of models of a lens, deg", -1, _lens("spread")),
    VERDICT,
    Column("finished, per 100 runs", 1, _both(lambda run: 100.0 * (run.exit == 0))),
    Column("CPU seconds, ratio", -1, _both(lambda run: run.cpu_s), is_ratio=True, is_outcome=False),
    Column(
        "CPU seconds per right frame, ratio",
        -1,
        _both(lambda run: run.cpu_s / run.right if run.right else None),
        is_ratio=True,
        is_outcome=False,
    ),
    Column("peak memory, ratio", -1, _both(lambda run: run.memory_mb), is_ratio=True, is_outcome=False),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Floor:
    """What a hard capture must give, on the average of its perturbations.

    Attributes:
        right: Least fraction of right frames.
        wrong: Largest fraction of wrong frames.
    """

    right: float
    wrong: float


FLOORS: Mapping[str, Floor] = {
    "room131": Floor(right=0.60, wrong=0.05),
    "walk131_02": Floor(right=0.70, wrong=0.05),
    "clocks05": Floor(right=0.80, wrong=0.05),
    "roll131": Floor(right=0.90, wrong=0.05),
}
"""Hard captures, on which changes of no meaning move many frames. They do not count in the margins. Evidence:
docs/decisions/bench.md, paired."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The comparison in one column.

    Attributes:
        column: The measure.
        found: B minus A; None without values.
        word: "equal", "better", "worse", "no difference" or "too few".
    """

    column: Column
    found: Estimate | None
    word: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """A run with many wrong frames where the other side has none.

    Attributes:
        capture: Name of the capture.
        seed: Number of the perturbation.
        side: "A" or "B".
        points: Wrong frames beyond the largest number of the other side, per cent of all frames.
    """

    capture: str
    seed: int
    side: str
    points: float


def pair_up(
    runs: Mapping[tuple[str, int], tuple[RunRecord, RunRecord]],
    paths: Callable[[RunRecord], Paths | None],
) -> list[Pair]:
    """Return the pairs, with the errors on the frames that both have."""
    out = []
    for a, b in runs.values():
        mine, other = paths(a), paths(b)
        ates = None if mine is None or other is None else ates_of_common(mine, other)
        out.append(Pair(a=a, b=b, ates_m=ates))
    return out


def compare(pairs: Sequence[Pair]) -> list[Outcome]:
    """Return the outcome of every column that has values."""
    is_equal = bool(pairs) and all(pair.is_equal for pair in pairs)
    out = []
    for column in COLUMNS:
        found = _estimate(column, pairs)
        if found is not None:
            word = "equal" if is_equal and column.is_outcome else word_of(found, column.sign)
            out.append(Outcome(column=column, found=found, word=word))
    return out


def folds(pairs: Sequence[Pair]) -> list[Fold]:
    """Return the runs with wrong frames that the other side has in no run of the same capture.

    A single fold among many runs cannot move a mean beyond its interval, so folds are found one by one. Where
    the other side has many wrong frames itself, the mean decides.
    """
    by_capture: dict[str, list[tuple[int, float, float]]] = defaultdict(list)
    for pair in pairs:
        found = WRONG.values(pair)
        if found is not None:
            by_capture[pair.a.capture].append((pair.a.seed, found[0], found[1]))
    out = []
    for capture, rows in by_capture.items():
        worst = (max(row[1] for row in rows), max(row[2] for row in rows))
        for seed, a, b in rows:
            for side, own, other in (("A", a, worst[1]), ("B", b, worst[0])):
                if other <= 100.0 * FOLD < own - other:
                    out.append(Fold(capture=capture, seed=seed, side=side, points=own - other))
    return out


def margins(pairs: Sequence[Pair]) -> list[tuple[str, Estimate | None, str]]:
    """Return each margin against side A with its estimate and "holds", "fails" or "not decided".

    Hard captures are left out, because they have floors.
    """
    kept = [pair for pair in pairs if pair.a.capture.removesuffix("_no_lens") not in FLOORS]
    right, ratio = _estimate(RIGHT, kept), _estimate(ATE, kept)
    out = [
        (
            f"right frames, at least {-MAX_LOST_POINTS} points",
            right,
            _margin_word(right, -MAX_LOST_POINTS, 1),
        ),
        (
            f"geometric mean of ATE, at most {MAX_ATE_RATIO}",
            ratio,
            _margin_word(ratio, math.log(MAX_ATE_RATIO), -1),
        ),
    ]
    for column in (WRONG, VERDICT):
        found = _estimate(column, kept)
        word = "not decided" if found is None else "fails" if found.low > 0.0 else "holds"
        out.append((f"{column.name}: no more than the interval allows", found, word))
    return out


def floors(runs: Sequence[RunRecord]) -> list[tuple[str, float, float, str]]:
    """Return the hard captures with the mean fractions of right and wrong frames, and "holds" or "fails"."""
    out = []
    for name, floor in FLOORS.items():
        own = [run for run in runs if run.capture == name and run.frames and run.right is not None]
        if own:
            right = sum((run.right or 0) / run.frames for run in own) / len(own)
            wrong = sum((run.wrong or 0) / run.frames for run in own) / len(own)
            word = "holds" if right >= floor.right and wrong <= floor.wrong else "fails"
            out.append((name, right, wrong, word))
    return out


def conclusion(outcomes: Sequence[Outcome], found: Sequence[Fold], simpler: str, seeds: int) -> str:
    """Return the decision in one sentence.

    Args:
        outcomes: The columns.
        found: The folds.
        simpler: Name of the simpler side.
        seeds: Number of perturbations, with the input as it is.
    """
    words: dict[str, list[str]] = defaultdict(list)
    for each in outcomes:
        if each.column.is_outcome:
            words[each.word].append(each.column.name.split(",")[0])
    for fold in found:
        text = f"a fold in {fold.capture}"
        if text not in words[word := "worse" if fold.side == "B" else "better"]:
            words[word].append(text)
    parts = [f"B is {word} in: {', '.join(words[word])}" for word in ("worse", "better") if words[word]]
    if parts:
        return "; ".join(parts)
    if words["too few"] or not outcomes:
        return "not decided: too few pairs"
    what = "outputs equal byte for byte" if words["equal"] else f"no difference after {seeds} seeds"
    return f"{what}: the simpler side wins, which is {simpler}"


def _estimate(column: Column, pairs: Sequence[Pair]) -> Estimate | None:
    values: dict[str, list[float]] = defaultdict(list)
    for pair in pairs:
        difference = column.difference(pair)
        if difference is not None:
            values[pair.a.capture].append(difference)
    return estimate(values)


def _margin_word(found: Estimate | None, limit: float, sign: int) -> str:
    """Return whether the whole interval is inside the margin ("holds"), or outside ("fails")."""
    if found is None:
        return "not decided"
    low, high = sorted((sign * (found.low - limit), sign * (found.high - limit)))
    if low >= 0.0:
        return "holds"
    return (
        "fails"
        if high < 0.0
        else f"not decided, the mean {'holds' if sign * (found.mean - limit) >= 0 else 'fails'}"
    )
