"""A watched folder: what is dropped there is claimed, worked on and filed away."""

from bodycap_batch.watch.commands import JobRow, cancel_job, retry_job, rows_of
from bodycap_batch.watch.intake import Terms
from bodycap_batch.watch.options import WatchOptions
from bodycap_batch.watch.presence import watchers_of
from bodycap_batch.watch.spool import Spool, spool_at
from bodycap_batch.watch.status import read_status
from bodycap_batch.watch.watcher import Watcher

__all__ = [
    "JobRow",
    "Spool",
    "Terms",
    "WatchOptions",
    "Watcher",
    "cancel_job",
    "read_status",
    "retry_job",
    "rows_of",
    "spool_at",
    "watchers_of",
]
