"""Versions of algorithms follow from their source."""

from __future__ import annotations

import ast
import hashlib
import os
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

from bodycap_batch.store import code_version
from bodycap_batch.tasks.stages import STAGES

PACKAGE = Path(code_version.__file__).parent.parent
_PARSED: dict[tuple[str, bytes], code_version._Source] = {}
"""What the package finds in a file, by the file's suffix and content."""
_read = code_version._source.__wrapped__


def parsed_once(path: Path) -> code_version._Source:
    """Read a file, and parse it unless an earlier test parsed the same content."""
    key = path.suffix, path.read_bytes()
    if key not in _PARSED:
        _PARSED[key] = _read(path)
    return _PARSED[key]


def forget() -> None:
    """Forget the sources that were read."""
    for remembered in (
        code_version.algorithm_version,
        code_version._source,
        code_version._files,
        code_version._parsed_sources,
    ):
        remembered.cache_clear()


@pytest.fixture
def unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package's sources in a folder of their own, where they may be changed."""
    folder = tmp_path / "bodycap_batch"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_version, "_PACKAGE", folder)
    forget()
    yield folder
    forget()


@pytest.fixture
def copied(unread: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same; every file is read again after `forget`, but equal contents are parsed once for all tests."""
    monkeypatch.setattr(code_version, "_source", cache(parsed_once))
    return unread


def versions() -> dict[str, str]:
    forget()
    return {name: code_version.algorithm_version(stage.module) for name, stage in STAGES.items()}


def changed_by(path: Path, text: str = "\nANOTHER = 1\n") -> set[str]:
    before = versions()
    with path.open("a", encoding="utf-8") as stream:
        stream.write(text)
    after = versions()
    return {name for name in before if before[name] != after[name]}


def imported_packages(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bodycap_batch."):
            yield str(node.module).split(".")[1]


def test_the_same_sources_have_the_same_version(copied: Path) -> None:
    assert versions() == versions()
    assert len(set(versions().values())) == len({stage.module for stage in STAGES.values()})


def test_each_file_is_parsed_once_and_only_when_a_stage_needs_it(
    unread: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parse, parsed = ast.parse, Counter[str]()

    def counting(source: bytes, filename: str) -> ast.AST:
        parsed[filename] += 1
        return parse(source, filename)

    monkeypatch.setattr(ast, "parse", counting)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(code_version.algorithm_version, [STAGES["check"].module] * 4))
    assert str(unread / "check" / "__init__.py") in parsed
    assert str(unread / "mapping" / "build.py") not in parsed
    for stage in STAGES.values():
        code_version.algorithm_version(stage.module)
    assert str(unread / "mapping" / "build.py") in parsed
    assert set(parsed.values()) == {1}


class TestKeptSources:
    """What was found in the sources is kept for later processes."""

    @pytest.fixture(autouse=True)
    def may_write(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "dont_write_bytecode", False)
        monkeypatch.setattr(sys, "pycache_prefix", None)

    @staticmethod
    def version(monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
        """The version in a new process, and the number of files that the process parsed."""
        forget()
        parse, parsed = ast.parse, []

        def counting(source: bytes, filename: str) -> ast.AST:
            parsed.append(filename)
            return parse(source, filename)

        with monkeypatch.context() as patch:
            patch.setattr(ast, "parse", counting)
            return code_version.algorithm_version(STAGES["places"].module), len(parsed)

    def test_no_file_is_parsed_twice(self, unread: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        first, parsed = self.version(monkeypatch)
        assert parsed > 10
        assert self.version(monkeypatch) == (first, 0)

    def test_a_changed_file_is_parsed_again(self, unread: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        first, _ = self.version(monkeypatch)
        path = unread / "tasks" / "places.py"
        times = path.stat()
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace('name="places"', 'name="placed"'), encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # Neither time nor size tells the change.
        assert path.stat().st_size == times.st_size
        second, parsed = self.version(monkeypatch)
        assert (second != first, parsed) == (True, 1)

    def test_another_reader_reads_all_files(self, unread: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        first, before = self.version(monkeypatch)
        reader = unread / "store" / "code_version.py"
        reader.write_text(reader.read_text(encoding="utf-8") + "\n# other\n", encoding="utf-8")
        assert self.version(monkeypatch) == (first, before)

    @pytest.mark.parametrize("content", ["", "[1, 2]", '{"reader": 1}', "{", '{"sources": {"a": 1}}'])
    def test_damage_does_not_matter(
        self, unread: Path, monkeypatch: pytest.MonkeyPatch, content: str
    ) -> None:
        first = self.version(monkeypatch)
        kept = unread / "__pycache__" / "code_versions.json"
        kept.write_text(content, encoding="utf-8")
        assert self.version(monkeypatch) == first

    def test_a_folder_that_cannot_be_written_does_not_matter(
        self, unread: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (unread / "__pycache__").write_text("not a folder", encoding="utf-8")
        first = self.version(monkeypatch)
        assert self.version(monkeypatch) == first


READ_BY_ALL = {"config", "core", "formats", "model", "tasks"}
CAMERAS = READ_BY_ALL | {"capture", "presets"}
BODY = CAMERAS
HASHED = {
    "synth": BODY | {"synthetic"},
    "check": BODY | {"check", "store", "telemetry"},
    "inertial": CAMERAS | {"inertial", "registration", "telemetry"},
    "sound": CAMERAS | {"clocks", "telemetry"},
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
    "rotations": CAMERAS | {"registration", "inertial", "telemetry", "tracks"},
    # Merging reads marker boards from the images, and explains a failure by mirrored cameras.
    "merge": BODY | {"merging", "calibration", "mapping"},
    "fill": BODY | {"fill"},
    # The places of unnamed cameras follow from their paths alone.
    "places": CAMERAS | {"camera_places"},
    # The files state the timecode of the videos.
    "export": BODY | {"clocks", "export", "telemetry"},
    "undistort": BODY | {"export", "overlay", "preview"},
    "report": BODY | {"report", "overlay"},
    "preview": BODY | {"preview", "overlay"},
}
"""Packages whose files are part of a stage's version.

They are those of version 0.1.0 at their new places. The preview alone lost one: it no longer projects the
motion, so it does not depend on the export. Of the presets, opening a camera reads the table of lenses alone.
"""


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_the_code_of_a_stage_is_that_of_these_packages(copied: Path, stage: str) -> None:
    found = code_version._closure(STAGES[stage].module)
    packages = {path.relative_to(copied).parts[0].removesuffix(".py") for path in found}
    assert packages == HASHED[stage]
    wanted = {name for path in found if path.suffix == ".py" for name in imported_packages(path)}
    assert wanted - packages == set()


@pytest.mark.parametrize(
    ("stage", "package"), [("map", "mapping"), ("registration", "registration"), ("merge", "merging")]
)
def test_all_files_of_an_estimator_count(copied: Path, stage: str, package: str) -> None:
    found = code_version._closure(STAGES[stage].module)
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


def test_comments_and_docstrings_do_not_count(copied: Path) -> None:
    """A reworded sentence must not cause new computations."""
    before = versions()
    for path in chain((copied / "model").rglob("*.py"), (copied / "fill").rglob("*.py")):
        path.write_text(reworded(path.read_text(encoding="utf-8")), encoding="utf-8")
    assert versions() == before


def reworded(source: str) -> str:
    """The same code with other docstrings, other notes on assignments, and no comments."""
    tree = ast.parse(source)
    notes = (node.value for node in ast.walk(tree) if isinstance(node, ast.Expr))
    for note in notes:
        if isinstance(note, ast.Constant) and isinstance(note.value, str):
            note.value = "Other words."
    return ast.unparse(tree)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("LIMIT = 1", "LIMIT = 1.0"),
        ("LIMIT = 1", "LIMIT = True"),
        ('NAME = "a"', 'NAME = b"a"'),
        ("value = a + b", "value = a - b"),
        ('text = f"{a}"', 'text = f"{a!r}"'),
        ('text = f"{a:.1f}"', 'text = f"{a:.2f}"'),
        ("def f(a, *, b=1): return a", "def f(a, *, b=2): return a"),
        ("def f(a, b): return a", "def f(a, *, b): return a"),
        ("x = [1, 2]", "x = [1], 2"),
        ("from bodycap_batch.a import b", "from bodycap_batch.a import b as c"),
        ("call('word')", "call('other word')"),
    ],
)
def test_changed_code_counts(before: str, after: str) -> None:
    assert code_version.code_text(ast.parse(before)) != code_version.code_text(ast.parse(after))


@pytest.mark.parametrize(
    ("written", "other"),
    [
        ('"""Old."""\nA = 1\n"""Note."""\n', "A = 1  # comment"),
        ("A = (\n    1\n)", "A = 1"),
        ("text = f'{a}' f''", "text = f'{a}'"),
    ],
)
def test_layout_and_words_of_a_file_do_not_count(written: str, other: str) -> None:
    assert code_version.code_text(ast.parse(written)) == code_version.code_text(ast.parse(other))


SYNTAX = """
@dataclass(frozen=True)
class Box(Base):
    size: int = 1

    def grow(self, by=2, *rest, key=None, **more) -> "Box":
        with lock, open(f"{self.size:>{by}.1f} {key!r}") as stream:
            return [x for x in rest if x is not ... and not x] or {**more, "a": lambda: (yield)}

match box:
    case Box(size=1 | 2) as found if found:
        pass
try:
    a, *b = c[1:2, ...] if d else -1j
except* (ValueError, KeyError):
    raise
"""


def test_the_version_is_the_same_on_each_python() -> None:
    """The digest was computed with Python 3.11.7, 3.12.1 and 3.13.0."""
    text = code_version.code_text(ast.parse(SYNTAX))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "35e3d844b46998a0"


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
    # All that store a registration, and the maps of lost frames.
    stages = {"registration", "recover", "rotations", "inertial", *MAPPING}
    assert changed_by(copied / "config" / "lost_frames.py") == stages


def test_libraries_are_named_with_their_versions() -> None:
    found = code_version.library_versions(("numpy", "not-a-library|pydantic", "nothing-of-that-name"))
    assert found["numpy"].count(".") >= 1
    assert found["not-a-library"].count(".") >= 1
    assert found["nothing-of-that-name"] == "none"
