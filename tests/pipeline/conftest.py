"""Fixtures shared by the tests of whole jobs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.broken import sound


@pytest.fixture(scope="session")
def sound_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound job of two cameras, rendered once; whoever changes it works on a copy."""
    folder = tmp_path_factory.mktemp("sound")
    sound(folder)
    return folder
