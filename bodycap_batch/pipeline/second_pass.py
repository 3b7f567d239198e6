"""Repeat map and registration without the wearer, if the wearer covers much of the pictures of a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields

from bodycap_batch.config.lost_frames import LEAST_LOST_SHARE
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.stage_results import StageResults
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks.stage import read_summary


def repeat_without_wearer(
    job: Job,
    flow: Flow,
    results: StageResults,
    run_pass: Callable[[StageResults, Callable[[], bool]], object],
) -> None:
    """Repeat map, registration and body once without the wearer, and use the results if they are better.

    Only cameras are masked in whose pictures the solved body covers much (`find_wearer`). If there are none,
    nothing is repeated. The second pass is better if more cameras are part of the body, or if as many are,
    more frames are localised, and no camera loses a notable part of its frames. Otherwise the results of the
    first pass stay. If all cameras are part of the body, the second pass ends early when a camera loses a
    notable part of its frames in the first registration against the map. Evidence:
    docs/decisions/registration.md.

    Args:
        job: The job.
        flow: The stages of the job.
        results: The results of the first pass up to the stage `fill`; changed in place.
        run_pass: Runs all stages from the map to `fill`, and puts their artefacts into its first argument. It
            ends early if its second argument, which it calls after the first registration, returns False.
    """
    if job.registration.wearer_mask == "off" or results.filled is None:
        return
    wearer = flow.find_wearer(results)
    if wearer is None:
        return
    second, before = StageResults(stage=results.stage, keyframes=results.keyframes), len(flow.runner.records)

    def can_be_better() -> bool:
        kept = _keeps_frames(_localised(results.tracked), _localised(second.tracked))
        return kept or _unused_cameras(results) > 0

    with flow.without_wearer(wearer, results.map):
        failure = _run(second, lambda: run_pass(second, can_be_better))
        is_better = second.filled is not None and _is_better(second, results)
        if is_better:
            flow.runner.release_notes()
    seconds = sum(record.seconds for record in flow.runner.records[before:])
    if failure:
        outcome = f"it gave no body ({failure}), so the first results are used"
    elif is_better:
        before_count, after_count = (
            sum(_localised(item.registrations).values()) for item in (results, second)
        )
        outcome = f"{after_count} instead of {before_count} frames are localised"
    else:
        outcome = "the first results are better and are used"
    flow.runner.note(_describe(wearer, seconds, outcome), "registration")
    if is_better:
        for item in fields(StageResults):
            setattr(results, item.name, getattr(second, item.name))


def _run(second: StageResults, run_pass: Callable[[], object]) -> str:
    """Run the second pass, and return why it gave no body; "" if it gave one or ended early."""
    try:
        run_pass()
    except EstimationError as error:
        return error.message
    return "" if second.failure is None else second.failure.message


def _describe(wearer: Artefact, seconds: float, outcome: str) -> str:
    """Return a note for the user about the second pass.

    Args:
        wearer: The artefact with the wearer's body in the pictures.
        seconds: Time that the tasks of the second pass took.
        outcome: Which results are used, and why.
    """
    summary = read_summary(wearer.path)
    shares = ", ".join(f"{summary['shares'][name]:.0%} of {name}" for name in summary["masked"])
    return (
        f"the wearer covers much of the pictures ({shares}), so the map was made again without the wearer, "
        f"which took {seconds:.0f} s: {outcome}"
    )


def _is_better(second: StageResults, first: StageResults) -> bool:
    """Return whether the results of the second pass are better, by their own measures."""
    unused_second, unused_first = _unused_cameras(second), _unused_cameras(first)
    if unused_second != unused_first:
        return unused_second < unused_first
    before, after = _localised(first.registrations), _localised(second.registrations)
    return _keeps_frames(before, after) and sum(after.values()) > sum(before.values())


def _keeps_frames(before: Mapping[str, int], after: Mapping[str, int]) -> bool:
    """Return whether no camera loses a notable part of its localised frames, given by camera name."""
    return all(after.get(name, 0) >= (1.0 - LEAST_LOST_SHARE) * number for name, number in before.items())


def _unused_cameras(results: StageResults) -> int:
    """Return the number of cameras that are not part of the body."""
    assert results.merged is not None
    return len(read_summary(results.merged.path)["unused_cameras"])


def _localised(registrations: Mapping[str, Artefact]) -> dict[str, int]:
    """Return the number of localised frames of each camera, by camera name."""
    return {name: int(read_summary(artefact.path)["localised"]) for name, artefact in registrations.items()}
