"""Run tasks in child processes, on this machine or on other machines.

This package does not import the stages; `child_main.main` receives the functions of the stages as an
argument.
"""

from bodycap_batch.runner.child_pool import Children, Executor, TaskEnvironment
from bodycap_batch.runner.child_process import CHILD_COMMAND
from bodycap_batch.runner.task import Task
from bodycap_batch.runner.task_runner import NotStored, Rules, Runner

__all__ = ["CHILD_COMMAND", "Children", "Executor", "NotStored", "Rules", "Runner", "Task", "TaskEnvironment"]
