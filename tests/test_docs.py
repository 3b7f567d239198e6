"""The documentation: every option, key and column has a description, and its pages name what exists."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from bodycap_batch.config.models import Job
from bodycap_batch.watch.job_status import JobStatusFile
from bodycap_batch.watch.spool import JobDir

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "docs" / "reference"))
import generate  # noqa: E402 - the generator of the reference lies beside its pages

METRICS = REPOSITORY / "bodycap_batch" / "export" / "metrics.py"
RUN = REPOSITORY / "bodycap_batch" / "pipeline" / "run.py"
TELEMETRY = REPOSITORY / "bodycap_batch" / "model" / "inertial_camera.py"
PICTURE_TURNS = REPOSITORY / "bodycap_batch/model/picture_turns.py"
FILL = REPOSITORY / "bodycap_batch" / "export" / "fill_report.py"


def fields_without_description(model: type[BaseModel]) -> Iterator[str]:
    for name, field in model.model_fields.items():
        inner = generate._models(field.annotation)
        for found in inner:
            yield from (f"{name}.{deeper}" for deeper in fields_without_description(found))
        if not field.description and not inner:
            yield name


PLAIN = {"capture.cameras.joint_from_cam.translation_m", "capture.cameras.joint_from_cam.quat_xyzw"}
"""Their docstring states the equation."""


def test_every_key_of_the_job_file_has_a_description() -> None:
    missing = set(fields_without_description(Job))
    calibration = {name for name in missing if ".calibration." in name}  # described in the file calib.json
    assert missing - PLAIN - calibration == set()


@pytest.mark.parametrize("name", sorted(generate.commands()))
def test_every_option_of_a_command_has_a_description(name: str) -> None:
    command = generate.commands()[name]
    assert command.help
    assert [p.name for p in command.params if p.name != "help" and not getattr(p, "help", "")] == []


def test_every_column_has_a_description() -> None:
    for name, columns in generate.columns().items():
        assert list(generate.descriptions()[name]) == list(columns)


def keys_in(path: Path) -> set[str]:
    """Names of all keys that a module writes."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Dict):
            found |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
        elif isinstance(node, ast.Subscript) and getattr(node.value, "id", "") == "out":
            found |= {node.slice.value} if isinstance(node.slice, ast.Constant) else set()
    return {key for key in found if isinstance(key, str)}


def last_parts(name: str) -> set[str]:
    return {part.removesuffix("[]") for key in generate.descriptions()[name] for part in key.split(".")}


def test_every_key_of_the_metrics_has_a_description() -> None:
    assert keys_in(METRICS) - last_parts("metrics.json") == set()


def test_every_key_of_the_inertial_sensors_has_a_description() -> None:
    described = {
        key.split(".")[-1] for key in generate.descriptions()["metrics.json"] if "telemetry.*" in key
    }
    assert (keys_in(TELEMETRY) | keys_in(PICTURE_TURNS)) - {"stabilisation"} == described


def test_every_key_of_the_filled_joints_has_a_description() -> None:
    assert keys_in(FILL) == last_parts("fill.json")


def test_every_key_of_the_record_of_a_run_has_a_description() -> None:
    record = keys_in(RUN) - {"bodycap_batch", "python"}  # versions by name
    assert record - last_parts("run.json") == set()


def test_every_key_of_the_status_has_a_description(tmp_path: Path) -> None:
    assert list(JobStatusFile(JobDir(tmp_path)).document) == sorted(
        generate.descriptions()["status.json"],
        key=list(JobStatusFile(JobDir(tmp_path)).document).index,
    )


@pytest.mark.parametrize("report", generate.reports(), ids=lambda report: report.__name__)
def test_every_key_of_the_body_has_a_description(report: Any) -> None:
    described = generate.attributes(report)
    assert [name for name in report.__dataclass_fields__ if not described.get(name)] == []


def test_the_generated_pages_name_each_command_and_key() -> None:
    text = generate.command_line()
    assert all(f"## bodycap {name}\n" in text for name in generate.commands())
    page = generate.job_file()
    assert all(f"| `{name}` |" in page for name in Job.model_fields)
