"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Return the folder of real and rendered captures, or skip: they are no part of this repository."""
    root = Path(os.environ.get("BODYCAP_TEST_DATA") or REPOSITORY.parent / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"no captures in {root}; point BODYCAP_TEST_DATA at them")
    return root
