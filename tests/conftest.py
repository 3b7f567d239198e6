"""Fixtures shared by all tests, and the order of the test files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# On a busy machine it takes long to draw an input; this is no fault of a test.
settings.register_profile(
    "tests", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("tests")

REPOSITORY = Path(__file__).resolve().parent.parent
LONGEST = (
    "pipeline/test_hard_lenses.py",
    "pipeline/test_misleading_pictures.py",
    "pipeline/test_resume_proof.py",
    "pipeline/test_field_captures.py",
    "pipeline/test_hard_captures.py",
    "data",
    "pipeline/test_damage_proof.py",
    "browser",
    "pipeline/test_watch.py",
    "pipeline/test_watch_disk.py",
    "pipeline/test_permissions.py",
    "pipeline/test_commands.py",
    "pipeline/test_end_to_end.py",
    "unit/test_fuzz.py",
    "test_imports.py",
    "cluster",
    "pipeline",
    "stages",
)
"""Files and folders of tests, from the longest time to the shortest; all others are short."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files with the longest time first, so that no process is left with one of them at the end."""
    items.sort(key=_place)


def _place(item: pytest.Item) -> int:
    path = item.path.relative_to(REPOSITORY / "tests")
    names = {path.as_posix(), *(folder.as_posix() for folder in path.parents)}
    return next((place for place, name in enumerate(LONGEST) if name in names), len(LONGEST))


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Return the folder of real and rendered captures, or skip: they are no part of this repository."""
    root = Path(os.environ.get("BODYCAP_TEST_DATA") or REPOSITORY.parent / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"no captures in {root}; point BODYCAP_TEST_DATA at them")
    return root
