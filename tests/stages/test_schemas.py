"""What is written agrees with the schemas that the package ships."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from bodycap_batch.report import ReportInputs
from bodycap_batch.report.verdict import VERDICT_FILE, judge
from tests.pipeline.test_cli import Bench
from tests.reports import written
from tests.schemas import NAMES, problems, schema


@pytest.mark.parametrize("name", NAMES)
def test_the_schemas_are_valid(name: str) -> None:
    Draft202012Validator.check_schema(schema(name))


def test_the_verdict_beside_the_report_agrees_with_its_schema(inputs: ReportInputs, tmp_path: Path) -> None:
    written(inputs, tmp_path)
    verdict = json.loads((tmp_path / VERDICT_FILE).read_text(encoding="utf-8"))
    assert problems("verdict", verdict) == []
    assert verdict["coverage"]["cameras"]["torso"]["lost"][0]["frames"] == 5
    assert {each["name"] for each in verdict["body"]["criteria"]} >= {"Metric scale", "Mounts"}
    # A schema that allows anything finds nothing.
    assert problems("verdict", {**verdict, "grade": "fine"})
    assert problems("verdict", {**verdict, "further": 1})
    assert problems("verdict", {key: value for key, value in verdict.items() if key != "coverage"})


def test_the_metrics_agree_with_their_schema(inputs: ReportInputs) -> None:
    metrics = {**json.loads(json.dumps(inputs.metrics)), "left_out": []}
    assert problems("metrics", metrics) == []
    metrics["cameras"]["torso"]["coverage"] = 1.5
    assert [each.partition(":")[0] for each in problems("metrics", metrics)] == ["$.cameras.torso.coverage"]


def test_the_verdicts_of_stopped_jobs_agree_with_the_schema(inputs: ReportInputs) -> None:
    failure = {"stage": "merge", "type": "EstimationError", "message": "stopped", "hint": ""}
    without_body = {key: value for key, value in (inputs.metrics or {}).items() if key != "merge"}
    for metrics in (None, without_body):
        verdict = judge(metrics, failure).to_dict()
        assert problems("verdict", verdict) == []
        assert verdict["grade"] == "no result"


def test_equal_results_have_equal_verdicts(inputs: ReportInputs, tmp_path: Path) -> None:
    written(inputs, tmp_path)
    first = (tmp_path / VERDICT_FILE).read_bytes()
    written(replace(inputs, name="another name"), tmp_path)
    assert (tmp_path / VERDICT_FILE).read_bytes() == first


def test_the_record_of_a_run_holds_the_verdict_and_agrees_with_its_schema(
    inputs: ReportInputs, tmp_path: Path
) -> None:
    bench = Bench(tmp_path)
    bench.order(metrics=inputs.metrics)
    assert bench.run("run", "my walk")[0] == 0
    record = json.loads((tmp_path / "out" / "my_walk" / "run.json").read_text(encoding="utf-8"))
    assert problems("run", record) == []
    assert record["verdict"] == judge(inputs.metrics, None).to_dict()
