"""Versions of algorithms follow from their source."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from bodycap_batch.store import code_version
from bodycap_batch.tasks.stages import STAGES

PACKAGE = Path(code_version.__file__).parent.parent


def forget() -> None:
    """Forget the sources that were read."""
    for remembered in (code_version.algorithm_version, code_version._source, code_version._files):
        remembered.cache_clear()


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package's sources in a folder of their own, where they may be changed."""
    folder = tmp_path / "bodycap_batch"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_version, "_PACKAGE", folder)
    forget()
    yield folder
    forget()


def versions() -> dict[str, str]:
    forget()
    return {name: code_version.algorithm_version(stage.program.module) for name, stage in STAGES.items()}


def changed_by(path: Path, text: str = "\nANOTHER = 1\n") -> set[str]:
    before = versions()
    with path.open("a", encoding="utf-8") as stream:
        stream.write(text)
    after = versions()
    return {name for name in before if before[name] != after[name]}


def imported_modules(path: Path) -> Iterator[str]:
    """The modules of the package that a file imports, by its syntax tree."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bodycap_batch."):
            yield str(node.module).partition(".")[2]
        elif isinstance(node, ast.ImportFrom) and node.module == "bodycap_batch":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (a.name.partition(".")[2] for a in node.names if a.name.startswith("bodycap_batch."))


def test_the_same_sources_have_the_same_version(copied: Path) -> None:
    assert versions() == versions()
    assert len(set(versions().values())) == len({stage.program.module for stage in STAGES.values()})


READ_BY_ALL = {"config", "core", "formats", "model", "tasks"}
CAMERAS = READ_BY_ALL | {"capture", "presets"}
BODY = CAMERAS
HASHED = {
    "synth": READ_BY_ALL | {"presets", "synthetic"},
    "check": BODY | {"check", "store", "telemetry"},
    "inertial": CAMERAS | {"inertial", "registration", "telemetry"},
    "sound": READ_BY_ALL | {"capture", "clocks", "telemetry"},
    # The clocks stage compares the distances between the cameras with the reach of the body.
    "clocks": CAMERAS | {"clocks", "mapping", "telemetry"},
    "keyframes": CAMERAS | {"keyframes", "telemetry", "tracks"},
    **dict.fromkeys(("map", "extend", "refine"), CAMERAS | {"mapping", "inertial", "telemetry"}),
    **dict.fromkeys(("registration", "rig", "recover"), CAMERAS | {"registration", "inertial", "telemetry"}),
    **dict.fromkeys(
        ("further_maps", "further_poses"),
        CAMERAS | {"mapping", "registration", "inertial", "telemetry"},
    ),
    "links": CAMERAS | {"evaluate", "tracks"},
    "rotations": CAMERAS | {"tracks"},
    # Merging reads marker boards from the images, and explains a failure by mirrored cameras.
    "merge": BODY | {"merging", "calibration", "mapping"},
    "fill": {"core", "formats", "model", "presets", "tasks", "fill"},
    # The places of unnamed cameras follow from their paths alone.
    "places": CAMERAS | {"camera_places"},
    # The files state the timecode of the videos.
    "export": BODY | {"clocks", "export", "telemetry"},
    "undistort": BODY | {"export", "overlay", "preview"},
    "report": BODY | {"report", "overlay"},
    "preview": BODY | {"preview", "overlay"},
}
"""Packages whose files are part of a stage's version.

Of the presets, opening a camera reads the table of lenses alone.
"""


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_the_code_of_a_stage_is_that_of_these_packages(copied: Path, stage: str) -> None:
    found = code_version._closure(STAGES[stage].program.module)
    packages = {path.relative_to(copied).parts[0].removesuffix(".py") for path in found}
    assert packages == HASHED[stage]


def test_every_import_is_found() -> None:
    for path in PACKAGE.rglob("*.py"):
        missed = (
            set(imported_modules(path)) - code_version._source(path).mentions - code_version._NOT_COMPUTING
        )
        assert not missed, path


@pytest.mark.parametrize(
    ("stage", "package"), [("map", "mapping"), ("registration", "registration"), ("merge", "merging")]
)
def test_all_files_of_an_estimator_count(copied: Path, stage: str, package: str) -> None:
    found = code_version._closure(STAGES[stage].program.module)
    assert set((copied / package).rglob("*.py")) <= found


MAPPING = {"map", "extend", "refine", "further_maps", "further_poses"}
"""The stages that use the code of mapping."""


def test_a_stage_is_changed_by_its_own_code_and_no_other_stage_is(copied: Path) -> None:
    assert changed_by(copied / "mapping" / "build.py") == MAPPING
    assert changed_by(copied / "keyframes.py") == {"keyframes"}


def test_shared_geometry_changes_what_computes_with_it(copied: Path) -> None:
    assert changed_by(copied / "model" / "geometry.py") >= {"map", "registration", "merge", "export"}


def test_the_code_of_a_task_counts_for_its_stages(copied: Path) -> None:
    assert changed_by(copied / "tasks" / "export.py") == {"export"}
    assert changed_by(copied / "tasks" / "mapping.py") == MAPPING
    assert changed_by(copied / "tasks" / "stage.py") == set(STAGES)


def test_another_stage_does_not_change_the_version_of_any(copied: Path) -> None:
    assert changed_by(copied / "tasks" / "stages.py") == set()


@pytest.mark.parametrize("name", ["humanoid.yaml", "mounts.yaml"])
def test_data_files_of_the_body_count(copied: Path, name: str) -> None:
    assert "merge" in changed_by(copied / "presets" / name, "\n# another body\n")


def test_the_table_of_lenses_counts_for_all_stages_that_open_a_camera(copied: Path) -> None:
    changed = changed_by(copied / "presets" / "lenses" / "profiles.json.gz", "other")
    assert {"keyframes", "map", "registration"} <= changed
    assert "keyframes" not in changed_by(copied / "presets" / "humanoid.yaml", "\n# another body\n")


def test_the_reader_of_skeleton_files_counts(copied: Path) -> None:
    assert "merge" in changed_by(copied / "formats" / "bvh" / "reader.py")


def test_the_format_of_stored_results_counts(copied: Path) -> None:
    assert changed_by(copied / "formats" / "dataclass_files.py") == set(STAGES) - {"synth", "check"}


def test_code_for_output_does_not_count(copied: Path) -> None:
    assert changed_by(copied / "cli" / "display.py") == set()
    assert changed_by(copied / "core" / "progress.py") == set()
    assert changed_by(copied / "config" / "options.py") == set()


def test_the_conditions_of_recovery_count(copied: Path) -> None:
    # All that register frames, and the maps of lost frames.
    stages = {"registration", "recover", "inertial", *MAPPING}
    assert changed_by(copied / "config" / "lost_frames.py") == stages


def test_libraries_are_named_with_their_versions() -> None:
    found = code_version.library_versions(("numpy", "not-a-library|pydantic", "nothing-of-that-name"))
    assert found["numpy"].count(".") >= 1
    assert found["not-a-library"].count(".") >= 1
    assert found["nothing-of-that-name"] == "none"
