"""Repeat map and registration without the wearer, if the wearer covers much of the pictures of a camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.stage_results import StageResults
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks.stage import read_summary


@dataclass(frozen=True, slots=True, order=True)
class _Quality:
    """How good the results of a pass are, by their own measures; the first field that differs decides.

    Attributes:
        cameras: Number of cameras that the body was solved with.
        localised: Number of localised frames of all cameras.
    """

    cameras: int
    localised: int


def repeat_without_wearer(
    job: Job, flow: Flow, results: StageResults, run_pass: Callable[[StageResults], object]
) -> None:
    """Repeat map, registration and body once without the wearer, and use the results if they are better.

    Only cameras are masked in whose pictures the solved body covers much (`find_wearer`). If there are none,
    nothing is repeated. The second pass is better if more cameras are part of the body, or if as many are and
    more frames are localised. Otherwise the results of the first pass stay.

    Args:
        job: The job.
        flow: The stages of the job.
        results: The results of the first pass up to the stage `fill`; changed in place.
        run_pass: Runs all stages from the map to `fill`, and puts their artefacts into its argument.
    """
    if job.registration.wearer_mask == "off" or results.filled is None:
        return
    wearer = flow.find_wearer(results)
    if wearer is None:
        return
    second, before = StageResults(stage=results.stage, keyframes=results.keyframes), len(flow.runner.records)
    with flow.without_wearer(wearer):
        is_better = _run(second, run_pass) and _quality(second) > _quality(results)
        if is_better:
            flow.runner.release_notes()
    seconds = sum(record.seconds for record in flow.runner.records[before:])
    flow.runner.note(_describe(wearer, results, second if is_better else None, seconds), "registration")
    if is_better:
        for item in fields(StageResults):
            setattr(results, item.name, getattr(second, item.name))


def _run(second: StageResults, run_pass: Callable[[StageResults], object]) -> bool:
    """Run the second pass, and return whether it gave a body."""
    try:
        run_pass(second)
    except EstimationError:
        return False
    return second.filled is not None


def _describe(wearer: Artefact, first: StageResults, used: StageResults | None, seconds: float) -> str:
    """Return a note for the user about the second pass.

    Args:
        wearer: The artefact with the wearer's body in the pictures.
        first: The results of the first pass.
        used: The results of the second pass; None if they are not used.
        seconds: Time that the tasks of the second pass took.
    """
    summary = read_summary(wearer.path)
    shares = ", ".join(f"{summary['shares'][name]:.0%} of {name}" for name in summary["masked"])
    outcome = (
        "the first results are better and are used"
        if used is None
        else f"{_quality(used).localised} instead of {_quality(first).localised} frames are localised"
    )
    return (
        f"the wearer covers much of the pictures ({shares}), so the map was made again without the wearer, "
        f"which took {seconds:.0f} s: {outcome}"
    )


def _quality(results: StageResults) -> _Quality:
    """Return how good the results of a pass are."""
    assert results.merged is not None
    unused = read_summary(results.merged.path)["unused_cameras"]
    registered = [read_summary(artefact.path) for artefact in results.registrations.values()]
    return _Quality(-len(unused), sum(int(summary["localised"]) for summary in registered))
