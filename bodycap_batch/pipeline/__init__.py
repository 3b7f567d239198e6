"""Run a job from its videos to its results: all stages, one after another."""

from bodycap_batch.pipeline.batch import Batch, BatchJob, Outcome
from bodycap_batch.pipeline.exporting import export_for, export_undistorted
from bodycap_batch.pipeline.reporting import remake_report, stored_for_report
from bodycap_batch.pipeline.run import RunSummary, run_job
from bodycap_batch.pipeline.sample import prepare_capture
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.pipeline.why import Step, explain_job

__all__ = [
    "Batch",
    "BatchJob",
    "Outcome",
    "RunSummary",
    "Settings",
    "StageRecord",
    "Step",
    "explain_job",
    "export_for",
    "export_undistorted",
    "prepare_capture",
    "remake_report",
    "run_job",
    "stored_for_report",
]
