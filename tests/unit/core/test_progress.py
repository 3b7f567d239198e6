"""Progress of a task: every step reaches its total."""

from __future__ import annotations

import pytest

from bodycap_batch.core.progress import StepProgress


@pytest.mark.parametrize(
    ("reported", "passed_on"),
    [
        ([(110, 119, "frames")], [(110, 119, "frames"), (119, 119, "frames")]),
        ([(119, 119, "frames")], [(119, 119, "frames")]),
        (
            [(5, 9, "frames"), (0, 0, "poses"), (0, 3, "maps")],
            [(5, 9, "frames"), (9, 9, "frames"), (0, 0, "poses"), (0, 3, "maps"), (3, 3, "maps")],
        ),
        # Another name for the same count is no other step.
        (
            [(1, 3, "bvh"), (2, 3, "glb"), (2, 3, "usd"), (3, 4, "csv")],
            [(1, 3, "bvh"), (2, 3, "glb"), (2, 3, "usd"), (3, 4, "csv"), (4, 4, "csv")],
        ),
        # The same step is repeated.
        (
            [(7, 9, "pairs"), (1, 5, "pairs")],
            [(7, 9, "pairs"), (9, 9, "pairs"), (1, 5, "pairs"), (5, 5, "pairs")],
        ),
    ],
)
def test_a_step_is_complete_when_it_ends(
    reported: list[tuple[int, int, str]], passed_on: list[tuple[int, int, str]]
) -> None:
    seen: list[tuple[int, int, str]] = []
    progress = StepProgress(lambda *values: seen.append(values))
    for values in reported:
        progress(*values)
    progress.complete()
    progress.complete()
    assert seen == passed_on
