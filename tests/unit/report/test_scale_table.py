"""The table of the metric scale says how many instants the calibration of the body left out."""

import pytest

from bodycap_batch.report.metric_tables import _scale_table


@pytest.mark.parametrize(
    ("count", "says"),
    [
        (0, ""),
        (1, "1 sampled instant was left out, because no plausible posture fits the camera poses."),
        (3, "3 sampled instants were left out, because no plausible posture fits the camera poses."),
    ],
)
def test_the_note_counts_the_instants_that_were_left_out(count, says):
    scale = {"sources": [], "body_alone": {"implausible_instants": count}}
    assert _scale_table({"scale": scale}).note == says


def test_results_of_earlier_versions_do_not_count_them():
    assert _scale_table({"scale": {"sources": [], "body_alone": {}}}).note == ""
