"""A job from its videos to its results: the stages in order."""

from bodycap_batch.pipeline.flow import Settings, StageRecord
from bodycap_batch.pipeline.run import RunSummary, run_job
from bodycap_batch.pipeline.sample import prepare_capture

__all__ = ["RunSummary", "Settings", "StageRecord", "prepare_capture", "run_job"]
