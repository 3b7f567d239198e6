"""What the README and the pages of docs/ promise exists: commands, targets, job fields, statuses, codes."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import typer

from bodycap_batch import cli
from bodycap_batch.cli.application import app
from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.core import errors
from bodycap_batch.model.scene import FrameStatus

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
PAGES = (
    REPOSITORY / "README.md",
    *(path for path in sorted(DOCS.rglob("*.md")) if not {"generated", "decisions"} & set(path.parts)),
)
TEXT = "\n".join(path.read_text(encoding="utf-8") for path in PAGES)


def blocks(language: str, text: str = TEXT) -> list[str]:
    found = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert found
    return found


def lines_starting(word: str) -> list[list[str]]:
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))[:1] == [word]]


@pytest.mark.parametrize("words", lines_starting("make"), ids=" ".join)
def test_make_targets_exist(words: list[str]) -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{words[1]}:.*## \w", makefile, re.MULTILINE)


@pytest.mark.parametrize("words", lines_starting("bodycap"), ids=" ".join)
def test_commands_and_flags_exist(words: list[str]) -> None:
    assert cli.main  # importing the package registers its commands
    group = typer.main.get_command(app)
    command = group.commands[words[1]]
    # parses the words without running the command; an unknown flag or a missing argument raises
    command.make_context(words[1], words[2:])


def test_the_job_in_the_reference_loads_and_shows_every_top_level_field(tmp_path: Path) -> None:
    (text,) = blocks("yaml")
    calibration = '{"model": "PINHOLE", "params": [1e3, 1e3, 960, 540], "width": 1920, "height": 1080}'
    (tmp_path / "calib.json").write_text(calibration, encoding="utf-8")
    (tmp_path / "job.yaml").write_text(text, encoding="utf-8")
    job = load_job(tmp_path / "job.yaml")
    assert [camera.name for camera in job.capture.cameras] == ["torso", "left_palm", "right_palm"]
    assert set(Job.model_fields) == {*re.findall(r"^(\w+):", text, re.MULTILINE)}


def test_the_option_blocks_in_the_reference_show_the_defaults(tmp_path: Path) -> None:
    (text,) = blocks("yaml")
    shown = re.search(r"^keyframes:.*^export:[^\n]*\n", text, re.MULTILINE | re.DOTALL)
    assert shown is not None
    path = tmp_path / "job.yaml"
    path.write_text(f"capture: {{cameras: [{{name: torso, video: a.mp4}}]}}\n{shown[0]}", encoding="utf-8")
    job, plain = load_job(path), Job.model_validate({"capture": {"cameras": [{"name": "a", "video": ["a"]}]}})
    for stage in ("keyframes", "map", "registration", "export"):
        assert getattr(job, stage) == getattr(plain, stage)


SETTINGS = sorted(set(re.findall(r"`((?:export|merge|map|telemetry): \{[^`…]*\})`", TEXT)))


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings_named_in_a_sentence_are_valid(tmp_path: Path, setting: str) -> None:
    path = tmp_path / "walk.yaml"
    path.write_text(f"capture: {{cameras: [{{name: torso, video: a.mp4}}]}}\n{setting}\n", encoding="utf-8")
    load_job(path)


def test_the_calibration_in_the_guide_is_read(tmp_path: Path) -> None:
    (text,) = blocks("json")
    (tmp_path / "calib.json").write_text(text, encoding="utf-8")
    for camera in ("torso", "left_palm"):
        read_calibration(tmp_path / "calib.json", camera)


def test_exit_codes_are_those_of_the_errors() -> None:
    table = (DOCS / "reference" / "results.md").read_text(encoding="utf-8").partition("## Exit codes")[2]
    rows = re.findall(r"^\| ([0-9, ]+) \|", table, re.MULTILINE)
    codes = {int(code) for row in rows for code in row.split(",")}
    typed = {kind.exit_code for kind in errors.BodycapError.__subclasses__()}
    assert {0, errors.EXIT_BUG, *typed} <= codes


def test_reasons_for_lost_frames_are_explained() -> None:
    assert not [status for status in FrameStatus if not status.localised and f"`{status}`" not in TEXT]


def test_links_and_pictures_lead_somewhere() -> None:
    named = re.findall(r"`((?:bodycap_batch|tests|jobs|examples|\.ci)/[\w./]+\.\w+|\.ci/\w+|LICENSE)`", TEXT)
    assert named
    assert not [name for name in named if not (REPOSITORY / name).exists()]
    for page in PAGES:
        links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
        local = [link for link in links if "://" not in link and "/generated/" not in f"/{link}"]
        assert not [link for link in local if not (page.parent / link).exists()], page


def test_the_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()) <= 180


def test_every_page_is_in_the_table_of_contents() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    pages = [
        page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES[1:] if page.name != "index.md"
    ]
    assert not [page for page in pages if f"\n{page}\n" not in index]


def constants_with_evidence() -> Iterator[tuple[set[str], str]]:
    """Names of constants (one, or those of one assignment), and the page of decisions to which they point."""
    for path in sorted((REPOSITORY / "bodycap_batch").rglob("*.py")):
        for first, second in pairwise(ast.parse(path.read_text(encoding="utf-8")).body):
            is_text = isinstance(second, ast.Expr) and isinstance(second.value, ast.Constant)
            if is_text and isinstance(first, ast.Assign | ast.AnnAssign):
                names = {
                    node.id
                    for node in ast.walk(first)
                    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
                }
                for page in re.findall(r"docs/decisions/\w+\.md", ast.unparse(second)):
                    yield names, page


def test_constants_that_point_to_decisions_are_named_there() -> None:
    constants = list(constants_with_evidence())
    assert constants
    texts = {page: (REPOSITORY / page).read_text(encoding="utf-8") for _, page in constants}
    on_page = {page: set(re.findall(r"\w+", text)) for page, text in texts.items()}
    assert not [(names, page) for names, page in constants if not names & on_page[page]]
