"""Run tasks in child processes, here or on other machines. The stages themselves are handed in."""

from bodycap_batch.runner.child_process import CHILD_COMMAND
from bodycap_batch.runner.children import Children, Executor, TaskEnvironment
from bodycap_batch.runner.parent import NotStored, Rules, Runner
from bodycap_batch.runner.task import Task

__all__ = ["CHILD_COMMAND", "Children", "Executor", "NotStored", "Rules", "Runner", "Task", "TaskEnvironment"]
