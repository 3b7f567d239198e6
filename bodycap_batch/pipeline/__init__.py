"""A job from its videos to its results: the stages in order."""

from bodycap_batch.pipeline.run import RunSummary, run_job
from bodycap_batch.pipeline.sample import prepare_capture
from bodycap_batch.pipeline.settings import Settings, StageRecord

__all__ = ["RunSummary", "Settings", "StageRecord", "prepare_capture", "run_job"]
