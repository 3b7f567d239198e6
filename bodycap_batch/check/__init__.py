"""Check a job before it runs: open all files that the job needs, without computing any result."""

from bodycap_batch.check.check_report import CameraSummary, CheckReport
from bodycap_batch.check.operator_limits import require_within_limits
from bodycap_batch.check.preflight import check_job, check_path, require_ready

__all__ = [
    "CameraSummary",
    "CheckReport",
    "check_job",
    "check_path",
    "require_ready",
    "require_within_limits",
]
