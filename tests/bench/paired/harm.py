"""Injected harm: copies of runs that are worse in a known way, which the comparison must find."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.model.geometry import align_points, make_transform, so3_exp
from tests.bench.paired.compare import FOLD, Fold, Outcome, compare, folds, pair_up
from tests.bench.paired.measures import Paths, truth_figures
from tests.bench.paired.runs import RunRecord

LOST, LARGER, FOLDED = 0.05, 0.10, 0.4
"""Harm: fraction of the frames that are lost, increase of the error, fraction of the frames of a fold."""
_TURN_DEG = 90.0
Run = tuple[RunRecord, Paths | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class HarmResult:
    """What the comparison says of an injected harm.

    Attributes:
        name: The harm.
        is_found: True if the comparison says what was injected.
        outcomes: The columns.
        folds: The folds.
    """

    name: str
    is_found: bool
    outcomes: list[Outcome]
    folds: list[Fold]


def lose_frames(run: Run) -> Run:
    """Return a run without one stretch of its posed frames."""
    record, paths = run
    lost = round(LOST * record.posed)
    changed = replace(record, posed=record.posed - lost, digest=record.digest + "-lost")
    if record.pictures is not None:
        right = record.pictures.right - round(LOST * record.pictures.right)
        changed = replace(changed, pictures=replace(record.pictures, right=right))
    if paths is None:
        return changed, None
    first = np.random.default_rng(record.seed).integers(len(paths.times_ns) - lost + 1)
    kept = paths.chosen(np.delete(np.arange(len(paths.times_ns)), np.arange(first, first + lost)))
    return _measured(changed, kept), kept


def enlarge_errors(run: Run) -> Run:
    """Return a run with larger errors of the centres."""
    record, paths = run
    changed = replace(record, digest=record.digest + "-larger")
    if paths is None:
        return changed, None
    true = paths.true[:, :3, 3]
    moved = align_points(paths.mine[:, :3, 3], true).apply_to_poses(paths.mine)
    moved[:, :3, 3] = true + (1.0 + LARGER) * (moved[:, :3, 3] - true)
    larger = replace(paths, mine=moved)
    return _measured(changed, larger), larger


def fold(run: Run) -> Run:
    """Return a run in which the last frames are turned by 90 degrees about the place where they begin."""
    record, paths = run
    changed = replace(record, digest=record.digest + "-fold")
    if paths is None or record.truth is None:
        if record.pictures is None:
            return changed, paths
        moved = round(FOLDED * record.pictures.right)
        figures = replace(
            record.pictures, right=record.pictures.right - moved, wrong=record.pictures.wrong + moved
        )
        return replace(changed, pictures=figures), paths
    order = np.argsort(paths.times_ns, kind="stable")
    last = order[len(order) - round(FOLDED * len(order)) :]
    pivot = paths.mine[last[0], :3, 3]
    turn = so3_exp(np.array([0.0, 0.0, np.deg2rad(_TURN_DEG)]))
    mine = paths.mine.copy()
    mine[last] = make_transform(turn, pivot - turn @ pivot) @ mine[last]
    folded = replace(paths, mine=mine)
    return _measured(changed, folded), folded


def check(runs: Mapping[tuple[str, int], Run]) -> list[HarmResult]:
    """Compare runs with copies that have injected harm, and with those of other perturbations.

    Args:
        runs: Runs of one side, with their paths, by capture and perturbation.
    """
    ordered = sorted(runs)
    captures = sorted({capture for capture, _ in ordered})
    other = {}
    for capture in captures:
        seeds = [seed for name, seed in ordered if name == capture]
        for index, seed in enumerate(seeds):
            record, paths = runs[capture, seeds[(index + 1) % len(seeds)]]
            other[capture, seed] = (replace(record, seed=seed, digest=record.digest + "-other"), paths)
    wrong = {key: (record.wrong or 0) / max(record.frames, 1) for key, (record, _) in runs.items()}
    sound = [name for name in captures if max(wrong[key] for key in ordered if key[0] == name) <= FOLD]
    one = next((key for key in ordered if key[0] in sound and runs[key][0].right), ordered[0])
    return [
        _result(
            f"{LOST:.0%} of the frames lost", runs, _each(runs, lose_frames), ("right frames", "posed frames")
        ),
        _result(f"ATE + {LARGER:.0%}", runs, _each(runs, enlarge_errors), ("ATE of common frames",)),
        _result(f"one fold, in {one[0]} with seed {one[1]}", runs, {**runs, one: fold(runs[one])}, None),
        _result("no harm: the runs of other perturbations", runs, other, ()),
    ]


def _each(runs: Mapping[tuple[str, int], Run], change: Callable[[Run], Run]) -> dict[tuple[str, int], Run]:
    return {key: change(run) for key, run in runs.items()}


def _result(
    name: str,
    before: Mapping[tuple[str, int], Run],
    after: Mapping[tuple[str, int], Run],
    expected: Sequence[str] | None,
) -> HarmResult:
    """Compare; `expected` are columns that must be worse, empty if none may be, None for a fold."""
    own = {id(record): paths for record, paths in (*before.values(), *after.values())}
    pairs = pair_up({key: (before[key][0], after[key][0]) for key in before}, lambda run: own[id(run)])
    outcomes, found = compare(pairs), folds(pairs)
    worse = {each.column.name.split(",")[0] for each in outcomes if each.word == "worse"}
    if expected is None:
        is_found = any(each.side == "B" for each in found)
    else:
        is_found = set(expected) <= worse if expected else not worse and not found
    return HarmResult(name=name, is_found=is_found, outcomes=outcomes, folds=found)


def _measured(record: RunRecord, paths: Paths) -> RunRecord:
    return replace(record, truth=truth_figures(paths))
