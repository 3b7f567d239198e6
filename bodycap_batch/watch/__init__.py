"""Watch a folder: claim the jobs that users drop there, run them, and move them to `done` or `failed`."""

from bodycap_batch.watch.commands import JobRow, cancel_job, job_rows, retry_job
from bodycap_batch.watch.dropped_job import JobPermissions
from bodycap_batch.watch.job_status import read_status
from bodycap_batch.watch.job_worker import WatchOptions
from bodycap_batch.watch.spool import Spool, spool_from_path
from bodycap_batch.watch.watcher import Watcher
from bodycap_batch.watch.watcher_status import active_watcher

__all__ = [
    "JobPermissions",
    "JobRow",
    "Spool",
    "WatchOptions",
    "Watcher",
    "active_watcher",
    "cancel_job",
    "job_rows",
    "read_status",
    "retry_job",
    "spool_from_path",
]
