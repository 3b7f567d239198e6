"""Options of earlier versions: accepted with a note, without an effect."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.config.job import load_job, load_job_with_origins
from bodycap_batch.config.models import Job
from bodycap_batch.config.retired_options import RETIRED_OPTIONS
from bodycap_batch.core.errors import JobError

CAPTURE = "capture: {cameras: [{name: torso, video: torso.mp4}]}\nskeleton: none\n"
RETIRED = [(block, name) for block, names in RETIRED_OPTIONS.items() for name in names]


def _job(folder: Path, text: str) -> Path:
    (folder / "torso.mp4").touch()
    path = folder / "walk.yaml"
    path.write_text(CAPTURE + text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("block", "name"), RETIRED)
@pytest.mark.parametrize("value", ["false", "auto", "3"])
def test_a_retired_option_has_no_effect_but_a_note(tmp_path: Path, block: str, name: str, value: str) -> None:
    plain = load_job(_job(tmp_path, ""))
    loaded = load_job_with_origins(_job(tmp_path, f"{block}: {{{name}: {value}}}\n"))
    assert loaded.job == plain
    (note,) = [text for text in loaded.warnings if "no effect" in text]
    assert f"{block}.{name}" in note


def test_other_options_of_the_block_keep_their_effect(tmp_path: Path) -> None:
    loaded = load_job_with_origins(_job(tmp_path, "registration: {rounds: 1, wearer_mask: off}\n"))
    assert loaded.job.registration.rounds == 1
    assert not [text for text in load_job_with_origins(_job(tmp_path, "")).warnings if "no effect" in text]


def test_an_unknown_option_beside_a_retired_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="unknown key 'round'"):
        load_job(_job(tmp_path, "registration: {round: 1, wearer_mask: auto}\n"))


@pytest.mark.parametrize(("block", "name"), RETIRED)
def test_a_retired_option_is_no_option(block: str, name: str) -> None:
    options = Job.model_fields[block].annotation
    assert options is not None
    assert name not in options.model_fields
