"""One task, one child process: ``python -m bodycap_batch.runner task.json``."""

from bodycap_batch.runner.parent import Runner
from bodycap_batch.runner.task import Task

__all__ = ["Runner", "Task"]
