"""Pre-flight: open everything a job needs, compute nothing."""

from bodycap_batch.check.limits import require_within
from bodycap_batch.check.preflight import check_job, check_path, require_ready
from bodycap_batch.check.report import CameraFinding, CheckReport

__all__ = [
    "CameraFinding",
    "CheckReport",
    "check_job",
    "check_path",
    "require_ready",
    "require_within",
]
