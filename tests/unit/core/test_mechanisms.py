"""The switches of the bench: which mechanisms are off, and which ones acted."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import bodycap_batch
from bodycap_batch.core import mechanisms
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.mechanisms import Mechanism

PACKAGE = Path(bodycap_batch.__file__).parent


@pytest.fixture(autouse=True)
def everything_on() -> Iterator[None]:
    """Leave this process with all mechanisms switched on."""
    yield
    mechanisms.begin_task({})


def test_the_environment_names_what_is_off_in_a_process_without_a_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mechanisms._task, "off", None)
    monkeypatch.setenv(mechanisms.VARIABLE, "skeletal_set, repair")
    assert mechanisms.switched_off() == {Mechanism.SKELETAL_SET, Mechanism.REPAIR}
    assert not mechanisms.is_on(Mechanism.REPAIR)
    assert mechanisms.is_on(Mechanism.RECOVERY)


def test_a_task_uses_the_switches_of_its_key_and_counts_from_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(mechanisms.VARIABLE, "repair")
    mechanisms.begin_task({mechanisms.KEY_OPTION: ["skeletal_set"], "features": 512})
    assert mechanisms.switched_off() == {Mechanism.SKELETAL_SET}
    mechanisms.record_act(Mechanism.REPAIR, 2)
    mechanisms.record_act(Mechanism.RECOVERY, 0)
    assert mechanisms.acted() == {"repair": 2}
    mechanisms.begin_task({})
    assert mechanisms.switched_off() == frozenset()
    assert mechanisms.acted() == {}


def test_an_unknown_mechanism_is_an_error_that_names_the_known_ones() -> None:
    with pytest.raises(JobError, match="unknown mechanism joining") as caught:
        mechanisms.mechanisms_of(["joining"])
    assert "skeletal_set" in (caught.value.hint or "")


@pytest.mark.parametrize("mechanism", list(Mechanism))
def test_each_mechanism_is_asked_for_in_the_program(mechanism: Mechanism) -> None:
    asked = re.compile(rf"Mechanism\.{mechanism.name}\b")
    files = [path for path in PACKAGE.rglob("*.py") if path.name != "mechanisms.py"]
    assert any(asked.search(path.read_text(encoding="utf-8")) for path in files)
